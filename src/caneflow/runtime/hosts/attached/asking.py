"""How a tool has a launcher of this user end, or start a node again."""

import os
import select
import signal
import socket
import time

import msgspec

from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.attached.run_logs import run_of
from caneflow.runtime.hosts.launcher.private_folder import folder_of_user
from caneflow.runtime.hosts.launcher.requests import LONGEST, Answer, Restart, address
from caneflow.runtime.hosts.launcher.run_directory import RunningFlow, running_flows
from caneflow.runtime.hosts.launcher.run_log import LoggedRun
from caneflow.runtime.wording import listed

RESTART_PATIENCE = 60.0  # s that a node has to end and to be ready again


def stopped(launchers: list[RunningFlow], patience: float) -> list[LoggedRun | None]:
    """End the launchers of a flow in order; what each noted at its end, None where it could not.

    Raises DataflowError when one has not ended after `patience` s.
    """
    held = [(each, _process(each)) for each in launchers]
    try:
        for _, process in held:
            if process is not None:
                signal.pidfd_send_signal(process, signal.SIGTERM)
        deadline = time.monotonic() + patience
        for each, process in held:
            if process is not None and not select.select([process], [], [], max(0.0, deadline - time.monotonic()))[0]:
                raise DataflowError(
                    f"{each.flow} (pid {each.pid}) has not ended after {patience:g} s; it goes on ending"
                )
    except PermissionError as error:
        raise DataflowError(f"{launchers[0].flow} belongs to another user") from error
    finally:
        for _, process in held:
            if process is not None:
                os.close(process)
    return [run_of(each) for each in launchers]


def _process(launcher: RunningFlow) -> int | None:
    """A descriptor of the launcher's process, and of no other that may have its pid later; None: it has ended."""
    try:
        process = os.pidfd_open(launcher.pid)
    except ProcessLookupError:
        return None
    if launcher not in running_flows():
        os.close(process)
        return None
    return process


def restarted(launchers: list[RunningFlow], node: str) -> Answer:
    """Have `node` end and start again, by the launcher that it has; raises DataflowError when it is not to be had."""
    for launcher in launchers:
        answer = _asked(launcher, node)
        if answer.error:
            raise DataflowError(answer.error)
        if not answer.elsewhere:
            return answer
    pids = listed(str(each.pid) for each in launchers)
    raise DataflowError(f"{node} runs on another machine; say it there (here is pid {pids})")


def _asked(launcher: RunningFlow, node: str) -> Answer:
    try:
        with (
            folder_of_user(launcher.folder, os.getuid()) as (folder, _),
            socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link,
        ):
            link.settimeout(RESTART_PATIENCE)
            link.connect(address(folder))
            link.send(msgspec.json.encode(Restart(node)))
            said = link.recv(LONGEST)
    except TimeoutError as error:
        raise DataflowError(f"{node} is not ready after {RESTART_PATIENCE:g} s; see `caneflow status`") from error
    except OSError as error:
        raise DataflowError(f"{launcher.flow} does not answer ({error.strerror or error})") from error
    if not said:
        raise DataflowError(f"{launcher.flow} has ended meanwhile; see `caneflow logs {launcher.flow}`")
    return msgspec.json.decode(said, type=Answer)
