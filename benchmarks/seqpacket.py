"""The floor: a pair of Unix seqpacket sockets. `python -m benchmarks.seqpacket source|relay|sink`."""

import socket
import sys
import time
from pathlib import Path

from benchmarks.work import KINDS, Job, Notes, relayed, samples
from caneflow.messages import decode, numbered

LARGEST = 8 * 2**20


def listening(path: Path) -> socket.socket:
    """A connection from whoever dials `path`."""
    server = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    server.bind(str(path))
    server.listen(1)
    connection, _ = server.accept()
    return connection


def dialled(path: Path) -> socket.socket:
    """A connection to who listens at `path`, once it does."""
    client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, LARGEST)
    while True:
        try:
            client.connect(str(path))
        except OSError:
            time.sleep(0.005)
        else:
            return client


def main(role: str, job: Job) -> None:
    """Play one role to the end."""
    first, second = Path(job.folder) / "first", Path(job.folder) / "second"
    if role == "source":
        out = dialled(first)
        for seq, message in enumerate(samples(job)):
            out.send(numbered(message, seq))
        time.sleep(3600)
    elif role == "relay":
        out, work = dialled(second), relayed(job)
        into = listening(first)
        while payload := into.recv(LARGEST):
            out.send(work(payload))
    else:
        notes, into = Notes(job), listening(second)
        while payload := into.recv(LARGEST):
            notes.take(decode(payload, KINDS[job.kind]))


if __name__ == "__main__":
    main(sys.argv[1], Job.told())
