"""Where the middle of the cane's swing points: a line and one oscillation, fitted to the yaw of the last moment.

Whole numbers from the samples on, so that every processor adds up to the same.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.rotations import wrapped

STEP_NS: Final = 50_000_000  # ns between two samples of the yaw
SAMPLES: Final = 25  # 1.2 s of them: about one swing to and fro
LONGEST_GAP_NS: Final = 200_000_000  # ns between two poses, after which it begins again
SLOWEST, FASTEST, APART = 0.45, 1.35, 0.05  # Hz, of the swings that are tried
ONE: Final = 1 << 20  # a rad, and a coefficient of 1, as whole numbers

Integers = NDArray[np.int64]


class Centre(NamedTuple):
    """The middle of the swing at the newest sample."""

    yaw: float  # rad
    rate: float  # rad/s, at which the middle turns


class SwingCentre:
    """Takes the cane's yaw as it comes; `centre` is None until it has seen one swing."""

    def __init__(self) -> None:
        self.centre: Centre | None = None
        self._yaws: list[float] = []  # rad, unwrapped, STEP_NS apart, the newest last
        self._due_ns = 0  # of the next of them
        self._last_ns: int | None = None
        self._last = 0.0  # rad, unwrapped

    def clear(self) -> None:
        """Forget what was seen."""
        self.centre, self._last_ns = None, None
        self._yaws.clear()

    def update(self, stamp_ns: int, yaw: float) -> None:
        """Take the yaw, rad, at `stamp_ns`."""
        if self._last_ns is None or stamp_ns - self._last_ns > LONGEST_GAP_NS:
            self.clear()
            self._last_ns, self._last, self._due_ns = stamp_ns, yaw, stamp_ns
        turned, elapsed = wrapped(yaw - self._last), stamp_ns - self._last_ns
        has_new = False
        while self._due_ns <= stamp_ns:
            share = (self._due_ns - self._last_ns) / elapsed if elapsed else 0.0
            self._yaws.append(self._last + share * turned)
            self._due_ns += STEP_NS
            has_new = True
        self._last_ns, self._last = stamp_ns, self._last + turned
        if has_new and len(self._yaws) >= SAMPLES:
            del self._yaws[:-SAMPLES]
            self.centre = fitted(self._yaws)


def fitted(yaws: list[float]) -> Centre:
    """The middle of the swing at the last of SAMPLES yaws (rad, unwrapped), of the swing that explains most of them."""
    newest = yaws[-1]
    whole = np.array([round((yaw - newest) * ONE) for yaw in yaws], np.int64)
    explained = (_BASES @ whole).astype(np.float64)  # (frequencies, 4)
    squared = explained * explained
    best = int(np.argmax(squared[:, 0] + squared[:, 1] + squared[:, 2] + squared[:, 3]))
    middle, rate = (_LINES[best] @ whole).tolist()
    return Centre(newest + middle / (ONE * ONE), rate / (ONE * ONE))


def _coefficients() -> tuple[Integers, Integers]:
    """By frequency an orthonormal basis (4, SAMPLES) of lines and that swing, and what gives the line (2, SAMPLES)."""
    bases, lines = [], []
    time = np.arange(1 - SAMPLES, 1) * (STEP_NS * 1e-9)
    for number in range(round((FASTEST - SLOWEST) / APART) + 1):
        phase = math.tau * (SLOWEST + APART * number) * time
        shapes = np.column_stack([np.ones(SAMPLES), time, np.cos(phase), np.sin(phase)])
        bases.append(np.linalg.qr(shapes)[0].T)
        lines.append(np.linalg.pinv(shapes)[:2])
    return tuple(np.rint(np.array(each) * ONE).astype(np.int64) for each in (bases, lines))


_BASES, _LINES = _coefficients()
