"""The root of every expected error: one line for the user, no traceback.

CaneflowError
├── MessageError      caneflow.messages: a sample that breaks the contract of the wire
├── RecordingError    caneflow.recording: a file that cannot be read or written as a recording
├── ProtocolError     caneflow.protocols: bytes that a device would not send
└── DataflowError     caneflow.runtime: a graph that cannot run, or a run that failed
"""


class CaneflowError(Exception):
    """Says where, what was found and what would be right, in one line."""


def not_installed(package: str, extra: str) -> str:
    """The line for a package that is not there, in the one wording: quoted, as some shells read brackets otherwise."""
    return f"{package} is not installed; `pip install 'caneflow[{extra}]'` brings it"
