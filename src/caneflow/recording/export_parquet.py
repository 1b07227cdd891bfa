"""One stream of a recording as a Parquet table, for polars, pandas, DuckDB and Arrow."""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from caneflow.errors import not_installed
from caneflow.messages import SAMPLES
from caneflow.recording.columns import arrays, flat
from caneflow.recording.errors import RecordingError
from caneflow.recording.untyped_rows import untyped_rows

if TYPE_CHECKING:
    from caneflow.recording.reader import Recording, Stream


def export_parquet(recording: "Recording", stream: "Stream", path: Path) -> int:
    """Write a row per sample and return their number; the whole stream is held in memory meanwhile.

    A vector is a column per element, `gyro_0`, `gyro_1`, `gyro_2`. A larger array is one column of lists of its shape,
    and complex numbers are two such columns, `scans_re` and `scans_im`. What a sample lacks is null. Units and frames
    are those of the message.

    Raises:
        RecordingError: polars is not installed, or arrays change their shape from sample to sample.
    """
    if find_spec("polars") is None:
        raise RecordingError(not_installed("polars", "parquet"))
    polars = import_module("polars")
    key = (stream.node, stream.port)
    if stream.schema in SAMPLES:
        rows = recording.array(key)
        table = polars.DataFrame(flat(rows) | arrays(rows), nan_to_null=True)
    else:  # a message that is known by its recorded schema only
        names, *cells = untyped_rows(recording.samples([key]), recording.json_schema(*key))
        table = polars.DataFrame(cells, schema=list(names), orient="row", infer_schema_length=None)
    table.write_parquet(path)
    return len(table)
