"""Which node of a process a line is of: several nodes write to one pipe."""

import logging
import threading

MARK = "\x02node "  # no line for people begins like this


class _Speaker(threading.local):
    """The node that a thread works for just now; "": it works for the process."""

    node = ""


SPEAKER = _Speaker()


def speak_for(node: str) -> None:
    """Let what this thread says from here on be a node's."""
    SPEAKER.node = node


def name_speakers() -> None:
    """Let every line of the log say whose it is."""
    for handler in logging.getLogger().handlers:
        handler.addFilter(_name)


def spoken(line: str) -> tuple[str, str]:
    """The node that wrote a line, and the line itself; "": the line does not say."""
    if not line.startswith(MARK):
        return "", line
    node, _, text = line.removeprefix(MARK).partition(" ")
    return node, text


def _name(record: logging.LogRecord) -> bool:
    if SPEAKER.node:
        record.levelname = f"{MARK}{SPEAKER.node} {record.levelname}"
    return True
