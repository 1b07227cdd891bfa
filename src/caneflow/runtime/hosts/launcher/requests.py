"""What a tool asks a launcher to do: over a Unix socket in the run's folder, where the kernel says who asks.

Not over Zenoh: who comes by TCP, as to a flow with `links: tcp`, may be any user of the machine.
"""

import os
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import msgspec

from caneflow.runtime.hosts.launcher.private_folder import PrivateFolder

SOCKET = "requests"
LONGEST = 4096  # bytes of a request, and of an answer
PATIENCE = 2.0  # s that a tool has to say what it wants, and to take the answer
CREDENTIALS = struct.Struct("3i")  # pid, uid, gid of the other end


class Restart(msgspec.Struct, frozen=True):
    """The request: end this node and start it again."""

    restart: str  # the node


class Answer(msgspec.Struct, frozen=True, omit_defaults=True):
    """What became of it."""

    error: str = ""  # why not; "": it is done
    elsewhere: bool = False  # the node runs on another machine of the flow
    pid: int = 0  # of the node's new process


@dataclass(frozen=True)
class RestartAsked:
    """A request, with the tool that waits for the answer."""

    node: str
    link: socket.socket

    def answer(self, answer: Answer) -> None:
        """Answer, and let the tool go; one that is gone does not matter."""
        with self.link, suppress(OSError):
            self.link.send(msgspec.json.encode(answer))


@contextmanager
def requests(folder: PrivateFolder, put: Callable[[RestartAsked], None]) -> Iterator[None]:
    """Put what tools of this user, and of root, ask for, on a thread of its own, while the block lasts."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(address(folder.descriptor))
        listener.listen()
        thread = threading.Thread(target=_listen, args=(listener, put), name="requests", daemon=True)
        thread.start()
        try:
            yield
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            thread.join()


def address(folder: int) -> str:
    """Of the socket in an open run folder: short, however long the folder's path is."""
    return f"/proc/self/fd/{folder}/{SOCKET}"


def _listen(listener: socket.socket, put: Callable[[RestartAsked], None]) -> None:
    while True:
        try:
            link, _ = listener.accept()
        except OSError:  # the block has ended
            return
        try:
            put(RestartAsked(_read(link), link))
        except (OSError, msgspec.MsgspecError):
            link.close()


def _read(link: socket.socket) -> str:
    """The node that the tool at the other end wants to be started again; raises OSError for another user's."""
    link.settimeout(PATIENCE)
    credentials = link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, CREDENTIALS.size)
    _, user, _ = CREDENTIALS.unpack(credentials)
    if user not in (os.getuid(), 0):
        raise PermissionError("another user's")
    return msgspec.json.decode(link.recv(LONGEST), type=Restart).restart
