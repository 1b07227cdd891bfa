"""Whom a launcher tells how its run goes."""

from typing import Protocol


class Say(Protocol):
    """Takes a line for people, and for the log."""

    def __call__(self, node: str, line: str, level: str = "") -> None:
        """Take a line of `node`; `level` as logs have it, "": the line says so itself, or is for information."""


class Watcher(Protocol):
    """Who started the run, and follows it."""

    def line(self, node: str, line: str) -> None:
        """Take a line of `node`, its level in front where it has one."""

    def settled(self) -> None:
        """Hear that every node is ready, or that this machine waits for the others: nothing can be wrong any more."""

    def played(self, played_s: float, of_s: float | None) -> None:
        """Hear how much (s of event time) of a replay every node has handled; None: it has no end."""
