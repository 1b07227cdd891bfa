"""The flows that come with caneflow, and the one that fits a recording."""

from collections.abc import Iterable
from importlib.resources import as_file, files
from importlib.util import find_spec
from pathlib import Path

from caneflow.recording import Recording
from caneflow.runtime.dataflow.yaml_file import read_yaml
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.wording import did_you_mean, listed

USUAL = Path("dataflow.yaml")  # the flow of the folder that a command is given in
BEFORE = ("cane", "room", "imu")  # of those that fit a recording equally well


def shipped() -> dict[str, Path]:
    """The flows that come with caneflow, by name."""
    if find_spec("caneflow.flows") is None:
        return {}
    with as_file(files("caneflow.flows")) as folder:
        return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def shipped_text(name: str) -> str:
    """A shipped flow as text to be written elsewhere, without the line that names a schema by a relative path.

    Raises DataflowError for a name that there is not.
    """
    flows = shipped()
    if name not in flows:
        raise DataflowError(f"no flow {name!r};{did_you_mean(name, flows)} there are {listed(flows)}")
    lines = flows[name].read_text(encoding="utf-8").splitlines(keepends=True)
    return "".join(line for line in lines if not line.startswith("# yaml-language-server:"))


def flow_for(recordings: Iterable[Path], given: Path | None = None) -> Path:
    """The dataflow that a command on recordings means.

    The one that is `given`, else the folder's dataflow.yaml, else the one beside a recording, else a shipped one: that
    of the recording's flow by name, or the one most of whose drivers the recording holds.

    Raises DataflowError when none fits, and RecordingError for a first recording that cannot be read.
    """
    if given is not None:
        return given
    if USUAL.exists():
        return USUAL
    for path in recordings:
        if (beside := path.parent / USUAL).exists():
            return beside
        with Recording(path) as recording:
            nodes, flow = {node for node, _ in recording.streams}, recording.flow
        drivers = {name: _drivers(file) for name, file in shipped().items()}
        fitting = [name for name, needed in drivers.items() if needed and needed <= nodes]
        if fitting:
            return shipped()[max(fitting, key=lambda name: (name == flow, len(drivers[name]), name in BEFORE))]
    raise DataflowError(f"{USUAL}: there is none here; name one with --flow, or write one: `caneflow new flow cane`")


def _drivers(file: Path) -> set[str]:
    """The nodes of a flow that read nothing: what a recording stands for."""
    nodes: dict[str, dict[str, object]] = read_yaml(file).value["nodes"]
    return {name for name, node in nodes.items() if "inputs" not in node}
