"""The one error of this room."""

from caneflow.errors import CaneflowError


class ProtocolError(CaneflowError):
    """Bytes that a device would not send, or a value that it could not be sent: what was found, what is right."""
