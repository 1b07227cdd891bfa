"""Evaluations kept in one SQLite file as they come, so that a fleet's night of work goes on after a kill.

An evaluation is kept with a fingerprint of all it depends on; one with another fingerprint is made again.
"""

import hashlib
import json
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import caneflow
from caneflow.runtime.dataflow.graph import Graph
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.replays.evaluation import FIGURES, Evaluation

APPLICATION = 0x63616E65  # "cane", in the file's header: another program's file is not touched
TABLES = f"""
CREATE TABLE evaluations (recording TEXT PRIMARY KEY, fingerprint TEXT NOT NULL, finished TEXT NOT NULL);
CREATE TABLE figures (
    recording TEXT NOT NULL, method TEXT NOT NULL, {", ".join(f"{name} REAL" for name in FIGURES)},
    PRIMARY KEY (recording, method)
);
CREATE TABLE failures (
    recording TEXT NOT NULL, method TEXT NOT NULL, reason TEXT NOT NULL, PRIMARY KEY (recording, method)
);
PRAGMA application_id = {APPLICATION};
"""


class ResultsFile:
    """The evaluations of one graph, settings and choice of methods; a context manager.

    Raises DataflowError for a file that is none.
    """

    def __init__(self, path: Path, graph: Graph, methods: Sequence[str]) -> None:
        self._methods = tuple(methods)
        self._setting = _digest(caneflow.__version__, graph.path.read_text(), *_settings_of(graph), *methods)
        try:
            self._file = sqlite3.connect(path, isolation_level=None)
            (application,) = self._file.execute("PRAGMA application_id").fetchone()
            (tables,) = self._file.execute("SELECT count(*) FROM sqlite_master").fetchone()
            if application != APPLICATION and tables:
                raise DataflowError(f"{path}: is another program's database; give the name of a new file")
            if not tables:
                self._file.executescript(TABLES)
        except sqlite3.DatabaseError as error:
            raise DataflowError(f"{path}: {error}; it should be a file that `caneflow eval` wrote, or none") from error

    def __enter__(self) -> "ResultsFile":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def get(self, recording: Path) -> Evaluation | None:
        """The evaluation of a recording that has not changed since, if it is there."""
        found = self._file.execute("SELECT fingerprint FROM evaluations WHERE recording = ?", (str(recording),))
        if found.fetchone() != (self._fingerprint(recording),):
            return None
        figures = self._rows("figures", FIGURES, recording)
        failures = self._rows("failures", ("reason",), recording)
        return Evaluation(
            recording=recording,
            figures={method: dict(zip(FIGURES, row, strict=True)) for method, *row in figures},
            failures={method: reason for method, reason in failures},
        )

    def add(self, evaluation: Evaluation) -> None:
        """Keep an evaluation, in the place of an older one; once this returns no kill takes it away."""
        recording = str(evaluation.recording)
        columns = ", ".join("?" * (len(FIGURES) + 2))
        self._file.execute("BEGIN IMMEDIATE")
        with self._file:
            for table in ("evaluations", "figures", "failures"):
                self._file.execute(f"DELETE FROM {table} WHERE recording = ?", (recording,))  # noqa: S608 - our names
            self._file.execute(
                "INSERT INTO evaluations VALUES (?, ?, datetime('now'))",
                (recording, self._fingerprint(evaluation.recording)),
            )
            self._file.executemany(
                f"INSERT INTO figures VALUES ({columns})",  # noqa: S608 - question marks
                [
                    (recording, method, *(figures[name] for name in FIGURES))
                    for method, figures in evaluation.figures.items()
                ],
            )
            self._file.executemany(
                "INSERT INTO failures VALUES (?, ?, ?)",
                [(recording, method, reason) for method, reason in evaluation.failures.items()],
            )

    def _rows(self, table: str, names: Sequence[str], recording: Path) -> list[Any]:
        select = f"SELECT method, {', '.join(names)} FROM {table} WHERE recording = ?"  # noqa: S608 - our own names
        return self._file.execute(select, (str(recording),)).fetchall()

    def _fingerprint(self, recording: Path) -> str:
        try:
            known = recording.stat()
        except OSError:  # it may be there next time
            return _digest(self._setting, "absent")
        return _digest(self._setting, str(known.st_size), str(known.st_mtime_ns))


def _settings_of(graph: Graph) -> Iterator[str]:
    """What each node was told, overrides included."""
    for name, node in graph.nodes.items():
        yield json.dumps([name, node.settings_map], default=str, sort_keys=True)


def _digest(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]
