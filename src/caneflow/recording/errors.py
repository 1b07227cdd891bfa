"""The one error of this room."""

from caneflow.errors import CaneflowError


class RecordingError(CaneflowError):
    """A file that cannot be read or written as a recording: which one, what was found, what would be right."""
