"""The expected errors of bridges."""

from caneflow.errors import CaneflowError


class BridgeError(CaneflowError):
    """A form of another system that cannot be written or read here."""
