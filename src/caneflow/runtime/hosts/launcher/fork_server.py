"""The process that a flow's nodes are forked from, so that what they all import is imported once.

A node that starts as an interpreter of its own spends half a second on imports, at every restart too. The fork server
is forked from the launcher before that has threads, links or users' code, none of which survives a fork. It is the
parent of the nodes: it tells how each ends, and when the launcher dies, however it dies, it kills them all.
"""

import atexit
import contextlib
import ctypes
import gc
import logging
import os
import runpy
import select
import signal
import socket
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

import msgspec
from setproctitle import setproctitle, setthreadtitle

from caneflow.runtime.hosts.launcher.background import silence
from caneflow.runtime.hosts.process.last_words import telling_failures
from caneflow.runtime.user_files import run_as_main

REQUEST_BYTES = 65_536  # of the longest command line
PR_SET_PDEATHSIG = 1  # of Linux' prctl: the signal for a process whose parent dies
PLAN = 3  # the descriptor under which a process finds its plan
PLAN_PATH = f"/proc/self/fd/{PLAN}"
RESET = (signal.SIGTERM, signal.SIGCHLD)
FROM_OUTSIDE = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}  # what the launcher's process has handlers for


class Started(msgspec.Struct, frozen=True, tag=True):
    """A node's process is there."""

    pid: int


class Ended(msgspec.Struct, frozen=True, tag=True):
    """A node's process is not there any more."""

    pid: int
    status: int  # negative: the signal that ended it


class ForkServer:
    """The launcher's end: start nodes, and hear of their ends; a context manager that leaves none."""

    def __init__(self, *, silent: bool = False) -> None:
        """Fork the fork server; to be done before this process has any thread. `silent`: nobody hears its own bugs."""
        self._socket, inner = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # Ctrl-C reaches both processes: the fork server must not take it as the launcher would.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, FROM_OUTSIDE)
        self.pid = os.fork()
        if self.pid == 0:
            self._socket.close()
            if silent:
                silence()
            _end(lambda: _Parent(inner).serve())
        inner.close()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def __enter__(self) -> "ForkServer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self, arguments: Sequence[str], output: int, plan: int | None = None) -> None:
        """Start what follows `python`; what it writes goes to the descriptor `output`. Started says its pid.

        `plan`: a descriptor of the file that the last argument names. The process finds it as PLAN_PATH, so that no
        folder is needed at a restart. Raises OSError when the fork server has been killed.
        """
        descriptors = [output] if plan is None else [output, plan]
        socket.send_fds(self._socket, [msgspec.msgpack.encode(arguments)], descriptors)

    def hear(self) -> Started | Ended | None:
        """Wait for the next word; None: the fork server has ended, and its nodes with it."""
        try:
            word = self._socket.recv(REQUEST_BYTES)
        except OSError:  # closed here meanwhile
            return None
        return msgspec.msgpack.decode(word, type=Started | Ended) if word else None

    def close(self) -> None:
        """End it, and whatever it still runs."""
        with contextlib.suppress(OSError):  # it has ended already
            self._socket.shutdown(socket.SHUT_RDWR)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(self.pid, 0)
        self._socket.close()


class _Parent:
    """The fork server's own end."""

    def __init__(self, inner: socket.socket) -> None:
        self._socket = inner
        self._pid = os.getpid()
        self._running: set[int] = set()

    def serve(self) -> None:
        """Start nodes and tell of their ends, until the launcher's end of the socket closes."""
        setproctitle("caneflow.runtime.hosts.launcher.fork_server")
        os.setsid()
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as nohup has it
            signal.signal(signal.SIGHUP, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, FROM_OUTSIDE)
        with Path(os.devnull).open("rb") as nothing:
            os.dup2(nothing.fileno(), 0)
        woken, waker = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.set_wakeup_fd(waker)
        gc.freeze()  # what is shared stays shared
        while self._take_request(woken):
            self._tell_ends(woken)
        for pid in self._running:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)

    def _take_request(self, woken: int) -> bool:
        """Wait for a request or an end, and do what is asked; False when the launcher is gone."""
        ready, _, _ = select.select([self._socket.fileno(), woken], [], [])
        if self._socket.fileno() not in ready:
            return True
        request, descriptors, _, _ = socket.recv_fds(self._socket, REQUEST_BYTES, 2)
        if not request:
            return False
        arguments = msgspec.msgpack.decode(request, type=list[str])
        pid = os.fork()
        if pid == 0:
            self._socket.close()
            _end(lambda: _become(arguments, *descriptors, parent=self._pid))
        for descriptor in descriptors:
            os.close(descriptor)
        self._running.add(pid)
        self._say(Started(pid))
        return True

    def _tell_ends(self, woken: int) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(woken, REQUEST_BYTES)
        for pid in list(self._running):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                self._running.remove(pid)
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.killpg(pid, signal.SIGKILL)  # what it started itself ends with it
                self._say(Ended(pid, os.waitstatus_to_exitcode(status)))

    def _say(self, word: Started | Ended) -> None:
        with contextlib.suppress(OSError):  # the launcher is gone: the next request is its end
            self._socket.send(msgspec.msgpack.encode(word))


def _become(arguments: Sequence[str], output: int, plan: int | None = None, *, parent: int) -> None:
    """Be what `python ARGUMENTS` would be, in a session of its own, from a fork."""
    os.setsid()
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died in between
        os.kill(os.getpid(), signal.SIGKILL)
    signal.set_wakeup_fd(-1)
    for number in RESET:
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.dup2(output, 1)
    os.dup2(output, 2)
    if plan is not None:
        os.dup2(plan, PLAN)
        os.set_inheritable(PLAN, False)
    os.closerange(PLAN if plan is None else PLAN + 1, os.sysconf("SC_OPEN_MAX"))
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(line_buffering=True)  # type: ignore[union-attr]  # typeshed takes them for any TextIO
    setproctitle(" ".join(("python", *arguments)))
    setthreadtitle(Path(arguments[-1]).stem)  # the node's name, where only fifteen letters are shown
    if plan is not None:
        arguments = [*arguments[:-1], PLAN_PATH]
    with telling_failures(building=True):  # before the program has come to its own `run`
        if arguments[0] == "-m":
            sys.argv = list(arguments[1:])
            # A word of the command is a module that this process, a fork, has already.
            warnings.filterwarnings("ignore", ".* found in sys.modules", RuntimeWarning)
            runpy.run_module(arguments[1], run_name="__main__", alter_sys=True)
        else:
            sys.argv = list(arguments)
            sys.path.insert(0, str(Path(arguments[0]).parent))
            run_as_main(Path(arguments[0]))


def _end(work: Callable[[], None]) -> NoReturn:
    """Do `work` in a fork, then end the process without going back to what was forked; as an interpreter ends."""
    status = 1
    try:
        work()
        status = 0
    except SystemExit as end:
        if isinstance(end.code, str):
            sys.stderr.write(f"{end.code}\n")
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        atexit._run_exitfuncs()
        logging.shutdown()
        with contextlib.suppress(OSError, ValueError):  # the reader of the pipe may be gone
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)
