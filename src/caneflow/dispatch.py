"""Which numerical kernels run: pinned, so that a recording gives the same bytes on every processor of one architecture.

numpy, OpenBLAS and the C library each hold several versions of their kernels and choose by the processor that they find
(fused multiply-add, AVX2, AVX-512); their results differ in the last digits. Pinned, each takes the version that
every processor has. numpy and OpenBLAS choose when they are loaded, the C library before the interpreter's first line.
"""

import os
import re
import sys
from importlib.util import find_spec
from pathlib import Path

# One thread for linear algebra in each process: a flow is parallel already, and sums must not depend on cores.
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

# numpy's names of what it would choose beyond its baseline, as its own module says them (__cpu_dispatch__): other names
# are ignored with an ImportWarning, a name of the baseline is an error.
FEATURES = {  # by architecture, then from which numpy on
    "x86_64": {
        (2, 4): ("X86_V3", "X86_V4", "AVX512_ICL", "AVX512_SPR"),
        (0, 0): (
            *("SSSE3", "SSE41", "POPCNT", "SSE42", "AVX", "F16C", "FMA3", "AVX2", "AVX512F", "AVX512CD"),
            *("AVX512_KNL", "AVX512_KNM", "AVX512_SKX", "AVX512_CLX", "AVX512_CNL", "AVX512_ICL"),
        ),
    },
    "aarch64": {
        (2, 4): ("ASIMDHP", "ASIMDDP", "ASIMDFHM", "SVE"),
        (2, 0): ("ASIMDHP", "ASIMDFHM", "SVE"),
        (0, 0): ("ASIMDHP", "ASIMDFHM"),
    },
}

# The oldest kernels of OpenBLAS that every processor has on which numpy's wheels run; and their name once chosen.
BLAS_CORES = {"x86_64": "Nehalem", "aarch64": "ARMV8"}

# glibc has its mathematics (sin, exp, pow ...) with and without fused multiply-add on x86-64. "_Usable": before 2.33.
TUNABLE = "glibc.cpu.hwcaps"
NO_FUSED = ("-FMA", "-FMA4", "-FMA_Usable", "-FMA4_Usable")
RESTARTED = "CANEFLOW_RESTARTED"  # set in the environment for the second start: there is no third


def pin() -> None:
    """Pin numpy and BLAS in this process, if numpy is not yet imported, and all in those that it will start."""
    for variable in ONE_THREAD:
        os.environ.setdefault(variable, "1")
    machine = _machine()
    features = [*os.environ.get("NPY_DISABLE_CPU_FEATURES", "").replace(",", " ").split(), *_numpy_features(machine)]
    os.environ.pop("NPY_ENABLE_CPU_FEATURES", None)  # numpy cannot be imported with both
    if features:
        os.environ["NPY_DISABLE_CPU_FEATURES"] = " ".join(dict.fromkeys(features))
    if machine in BLAS_CORES:
        os.environ["OPENBLAS_CORETYPE"] = BLAS_CORES[machine]
    if _has_fused_mathematics():
        os.environ["GLIBC_TUNABLES"] = _pinned_tunables(os.environ.get("GLIBC_TUNABLES", ""))


def restart_with_pinned_mathematics() -> None:
    """Begin this program again with the C library's mathematics pinned, unless they are; glibc on x86-64 only.

    The process stays the same, its interpreter is a new one: to be called before anything else is done.
    """
    # Restarted already, and to no avail: glibc hides tunables from privileged programs.
    restarted = os.environ.pop(RESTARTED, None) is not None
    begun_with = _tunables_at_start()
    if restarted or not _has_fused_mathematics() or begun_with is None or _pinned_tunables(begun_with) == begun_with:
        return
    if sys.executable:  # not inside another program
        os.environ[RESTARTED] = "1"
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])  # noqa: S606 - the same program again, and no shell


def pinned() -> tuple[str, ...]:
    """What of "numpy", "blas" and "mathematics" is pinned in this process, as they say themselves; imports numpy."""
    parts = {"numpy": _numpy_is_pinned(), "blas": _blas_is_pinned(), "mathematics": _mathematics_are_pinned()}
    return tuple(part for part, held in parts.items() if held)


def _machine() -> str:
    """The processor's architecture; "" on Windows, where nothing is pinned."""
    return os.uname().machine if hasattr(os, "uname") else ""


def _numpy_features(machine: str) -> tuple[str, ...]:
    installed = _numpy_version()
    return next((names for since, names in FEATURES.get(machine, {}).items() if installed >= since), ())


def _numpy_version() -> tuple[int, int]:
    """The installed numpy's version, read from its files: importing it would be too late. (0, 0): there is none."""
    spec = find_spec("numpy")
    if spec is None or spec.origin is None:
        return 0, 0
    text = Path(spec.origin).with_name("version.py").read_text(encoding="utf-8")
    found = re.search(r'^version = "(\d+)\.(\d+)', text, re.MULTILINE)
    return (int(found[1]), int(found[2])) if found else (0, 0)


def _numpy_is_pinned() -> bool:
    import numpy as np

    core = sys.modules.get("numpy._core._multiarray_umath") or sys.modules["numpy.core._multiarray_umath"]
    assert np.__version__
    return not any(core.__cpu_features__.get(name) for name in core.__cpu_dispatch__)


def _blas_is_pinned() -> bool:
    """Whether every OpenBLAS in this process says that it runs the pinned kernels; another BLAS cannot be asked."""
    expected = BLAS_CORES.get(_machine(), "").lower()
    cores = [_core_name(path) for path in _loaded_libraries("openblas")]
    return bool(cores) and all(core == expected for core in cores)


def _loaded_libraries(part: str) -> list[str]:
    """The paths of this process's libraries with `part` in their names."""
    try:
        lines = Path("/proc/self/maps").read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    except OSError:  # no Linux: nothing is known
        return []
    paths = dict.fromkeys(line.split(maxsplit=5)[5] for line in lines if "/" in line)
    return [path for path in paths if part in Path(path).name]


def _core_name(path: str) -> str:
    """The kernels that the OpenBLAS at `path` runs, in lower case; "" when it does not say."""
    import ctypes  # here: every command imports this module

    library = ctypes.CDLL(path)
    for prefix in ("scipy_", ""):  # of the wheels' own builds
        for suffix in ("64_", ""):
            ask = getattr(library, f"{prefix}openblas_get_corename{suffix}", None)
            if ask is not None:
                ask.restype = ctypes.c_char_p
                return str(ask().decode()).lower()
    return ""


def _mathematics_are_pinned() -> bool:
    """Whether the C library chose its mathematics under the tunable: it reads that once, as the process begins."""
    if not _has_fused_mathematics():
        return _machine() == "aarch64" and bool(glibc())  # which has one version of them
    begun_with = _tunables_at_start()
    return begun_with is not None and _pinned_tunables(begun_with) == begun_with


def _tunables_at_start() -> str | None:
    """GLIBC_TUNABLES as this process's program began with it; None where the system does not tell."""
    try:
        entries = Path("/proc/self/environ").read_bytes().split(b"\0")
    except OSError:
        return None
    name = b"GLIBC_TUNABLES="
    return next((entry[len(name) :].decode(errors="replace") for entry in entries if entry.startswith(name)), "")


def _has_fused_mathematics() -> bool:
    return _machine() == "x86_64" and bool(glibc())


def glibc() -> str:
    """The C library's name and version, as in "glibc 2.36"; "" when it is another."""
    try:
        return os.confstr("CS_GNU_LIBC_VERSION") or ""
    except (ValueError, OSError):
        return ""


def _pinned_tunables(given: str) -> str:
    """`given`, a value of GLIBC_TUNABLES, with ours in front: glibc leaves only the first of them to be read again."""
    entries = [entry for entry in given.split(":") if entry]
    words = [
        word for entry in entries if entry.startswith(f"{TUNABLE}=") for word in entry.partition("=")[2].split(",")
    ]
    ours = f"{TUNABLE}={','.join(dict.fromkeys([*words, *NO_FUSED]))}"
    return ":".join([ours, *(entry for entry in entries if not entry.startswith(f"{TUNABLE}="))])
