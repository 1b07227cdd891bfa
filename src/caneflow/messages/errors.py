"""The one error of this room."""

from caneflow.errors import CaneflowError


class MessageError(CaneflowError):
    """A sample that breaks the contract of the wire: which field, what was found, what would be right."""
