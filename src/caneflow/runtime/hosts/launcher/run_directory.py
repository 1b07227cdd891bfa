"""Where a running flow keeps its plans and says how tools attach to it: one private folder per run.

What lies in a folder of another user is not believed: neither by a launcher, which would run its plans and snapshots,
nor by tools, which would connect to its addresses. Root's tools see the flows of all users, and say whose they are.
"""

import os
import pwd
import re
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType

import msgspec
import psutil

from caneflow.messages import NAME
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.launcher.private_folder import NotOurs, PrivateFolder, folder_of_user
from caneflow.runtime.hosts.links.session import UNIX
from caneflow.runtime.wording import shown

ADDRESS = "flow.json"
NAMES = "names.json"  # what there is to be named on a command line, for shells that complete it
LONGEST_ADDRESS = 4096  # bytes of flow.json
SHOWN_OF_FLOW = 20  # letters of the flow's name in the run folder's: paths of sockets are short
OTHERS_WRITE = 0o002
TCP = re.compile(r"tcp/127\.0\.0\.1:([0-9]{1,5})")
OF_YOUR_OWN = "set XDG_RUNTIME_DIR to a folder of your own"
OF_PROCESS = re.compile(r".*-([0-9]{1,10})")  # the name of a run folder, with the launcher's pid
LOST = {  # with the folder of a run, by the kind of its links
    "unix": "tools cannot attach any more, and a node that ends cannot start again",
    "tcp": "tools cannot find it by its name any more",
}


class RunningFlow(msgspec.Struct, frozen=True):
    """How to find a flow that runs on this machine."""

    flow: str
    pid: int  # of its launcher
    endpoint: str  # where tools attach, as Zenoh clients
    owner: str = ""  # the other user whose flow it is; "": this user's own
    folder: str = ""  # of the run


class RunDirectory:
    """The folder of one run, there while it runs; a context manager.

    Entering it raises DataflowError when no folder can be made that is this user's alone.
    """

    def __init__(self, flow: str) -> None:
        self._flow = flow
        self._socket: Path | None = None  # where tools attach, with Unix sockets
        self._name = f"{flow[:SHOWN_OF_FLOW]}-{os.getpid()}"
        self.remark = ""  # why the run is not in the usual place, if it is not

    def __enter__(self) -> "RunDirectory":
        self.root, self.remark = _own_root()
        _sweep(self.root)
        self.root.remove(self._name)  # of a process that was killed and had the same pid
        self.folder = self.root.child(self._name)
        self.path = self.folder.path
        return self

    def __exit__(self, *_: object) -> None:
        self.root.remove(self._name)
        self.folder.close()
        self.root.close()

    @contextmanager
    def announced(self, endpoint: str, names: Mapping[str, Iterable[str]] = MappingProxyType({})) -> Iterator[None]:
        """Tell tools that they may attach to `endpoint`, while the block lasts; `names`: by node its output ports."""
        if endpoint.startswith(f"{UNIX}/"):
            self._socket = Path(endpoint.removeprefix(f"{UNIX}/"))
        running = {"flow": self._flow, "pid": os.getpid(), "endpoint": endpoint}
        if names:
            self.folder.write(NAMES, msgspec.json.encode({node: tuple(ports) for node, ports in names.items()}))
        self.folder.write(ADDRESS, msgspec.json.encode(running))
        try:
            yield
        finally:
            self.folder.remove(ADDRESS)

    @property
    def is_there(self) -> bool:
        """Whether the folder and the launcher's socket are where they were made: a cleaner may have removed them."""
        return self.folder.is_there and (self._socket is None or self._socket.exists())

    def without_it(self, links: str) -> str:
        """What follows when it has been removed, where the nodes' links are `links`."""
        return f"{self.path} was removed: the flow goes on, but {LOST[links]}"


def running_flows() -> list[RunningFlow]:
    """The flows that run on this machine and that this user may believe: the own ones; root sees all."""
    found = {flow.pid: flow for flow in _found() if isinstance(flow, RunningFlow)}
    return sorted(found.values(), key=lambda flow: (flow.flow, flow.pid))


def run_roots() -> list[Path]:
    """The folders that may hold the runs of this user, or, for root, of others."""
    return _roots()


def refused_addresses() -> list[str]:
    """What is wrong with this user's run folders whose flow cannot be reached, one line for each."""
    return [said for said in _found() if isinstance(said, str)]


def _found() -> Iterator[RunningFlow | str]:
    """Every flow that runs, or what is wrong with the address that its run folder holds."""
    me = os.getuid()
    for root in _roots():
        with suppress(OSError), folder_of_user(root, me) as (within, of_root):  # it may be ending, or another's
            for name in os.listdir(within):  # noqa: PTH208 - not by its path
                launcher = OF_PROCESS.fullmatch(name)
                if launcher is None or not _belongs_to(int(launcher[1]), of_root.st_uid):
                    continue
                with suppress(OSError), folder_of_user(name, me, within) as (folder, of_folder):
                    if of_folder.st_uid == of_root.st_uid:
                        yield from _read_address(root / name, folder, int(launcher[1]), of_folder.st_uid)


def _read_address(path: Path, folder: int, pid: int, owner: int) -> Iterator[RunningFlow | str]:
    """The flow whose run folder is `path`, or what is wrong with its address; nothing while there is none."""
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK  # a pipe of that name would hold up its reader
    with os.fdopen(os.open(ADDRESS, flags, dir_fd=folder), "rb") as file:
        about = os.fstat(file.fileno())
        if not stat.S_ISREG(about.st_mode) or about.st_uid != owner:
            return
        text = file.read(LONGEST_ADDRESS + 1)
    try:
        written = msgspec.json.decode(text[:LONGEST_ADDRESS], type=RunningFlow)
    except (msgspec.DecodeError, UnicodeDecodeError):
        yield f"{path / ADDRESS}: is damaged, or not an address of a flow"
        return
    if not NAME.fullmatch(written.flow) or written.pid != pid:
        yield f"{path / ADDRESS}: is not of this folder"
    elif not _is_address_in(path, folder, owner, written.endpoint):
        yield f"{path / ADDRESS}: {shown(written.endpoint)} is not an endpoint of this folder or of 127.0.0.1"
    else:
        yield RunningFlow(written.flow, pid, written.endpoint, _owner_name(owner), str(path))


def _belongs_to(pid: int, owner: int) -> bool:
    """Whether the process `pid` runs, as the user `owner`: else a folder could speak for another user's flow."""
    try:
        return int(psutil.Process(pid).uids().real) == owner
    except psutil.Error:
        return False


def _is_address_in(path: Path, folder: int, owner: int, endpoint: str) -> bool:
    """Whether tools may dial `endpoint` since it stands in the run folder `path`."""
    if local := TCP.fullmatch(endpoint):
        return 0 < int(local[1]) < 2**16
    socket = Path(endpoint.removeprefix(f"{UNIX}/"))
    if not endpoint.startswith(f"{UNIX}/") or socket.parent != path:
        return False
    try:
        found = os.stat(socket.name, dir_fd=folder, follow_symlinks=False)
    except (OSError, ValueError):
        return False
    return stat.S_ISSOCK(found.st_mode) and found.st_uid == owner


def _owner_name(owner: int) -> str:
    if owner == os.getuid():
        return ""
    try:
        return pwd.getpwuid(owner).pw_name
    except KeyError:
        return f"uid {owner}"


def _own_root() -> tuple[PrivateFolder, str]:
    """The folder that holds this user's run folders, and why it is not the usual one, if that is to be known.

    Where another user was first, a folder of another name is as good: tools find it by whose it is.
    """
    base = _base()
    name = f"caneflow-{os.getuid()}"
    remark = ""
    try:
        for path in (base / name, *sorted(base.glob(f"{name}-*"))):
            try:
                return PrivateFolder.at(path), remark
            except NotOurs as error:
                if error.suspicious:  # and not one that a version before this made
                    remark = remark or str(error)
        return PrivateFolder.at(Path(tempfile.mkdtemp(prefix=f"{name}-", dir=base))), remark
    except (OSError, DataflowError) as error:
        raise DataflowError(f"{base / name}: is needed for the run ({error}); {OF_YOUR_OWN}") from error


def _base() -> Path:
    """Where this user's folder of runs lies, made when it is not there; raises DataflowError when it is of no use."""
    try:
        base = Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()).absolute()
        for missing in [path for path in (base, *base.parents) if not path.exists()][::-1]:
            PrivateFolder.at(missing).close()
        mode = base.stat().st_mode
    except OSError as error:
        raise DataflowError(f"{error.filename or 'no temporary folder'}: {error.strerror}; {OF_YOUR_OWN}") from error
    if mode & OTHERS_WRITE and not mode & stat.S_ISVTX:
        raise DataflowError(
            f"{base}: anybody may exchange folders in it (mode {stat.S_IMODE(mode):04o}, expected 1777); {OF_YOUR_OWN}"
        )
    return base


def _roots() -> list[Path]:
    """Where flows may have been started: by this session, by one with another environment, by another user."""
    bases = [os.environ.get("XDG_RUNTIME_DIR"), tempfile.gettempdir(), "/tmp", "/run/caneflow"]  # noqa: S108 - looked at
    with suppress(OSError):
        bases += map(str, Path("/run/user").iterdir())
    roots: dict[Path, None] = {}
    for base in filter(None, bases):
        with suppress(OSError):  # that of another user
            roots.update(dict.fromkeys(Path(base).absolute().glob("caneflow-*")))
    return list(roots)


def state_folder(flow: str, machine: str, run: str) -> PrivateFolder:
    """Where snapshots outlive a launcher of this machine, for as long as the leader's run goes on.

    Raises DataflowError when it is not this user's alone, or cannot be made.
    """
    # systemd names a folder that outlives a reboot (StateDirectory=).
    given = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    base = PrivateFolder.given(Path(given)) if given else _own_root()[0]
    runs = base.child(f"state-{flow}-{machine}")
    folder = runs.child(run)
    for other in runs.names():
        if other != run:
            runs.remove(other)
    return folder


def remove_state_folder(folder: PrivateFolder) -> None:
    """Remove the snapshots of a run that ended in order."""
    runs = folder.parent
    if runs is not None and runs.parent is not None:
        runs.parent.remove(runs.path.name)


def _sweep(root: PrivateFolder) -> None:
    """Remove what launchers left that were killed."""
    for name in root.names():
        launcher = OF_PROCESS.fullmatch(name)
        if launcher is not None and not Path("/proc", launcher[1]).exists():
            root.remove_unused(name)
