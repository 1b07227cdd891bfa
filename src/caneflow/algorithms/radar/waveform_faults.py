"""Faults of a sampled waveform: impulses and steps, which say nothing and spread over a whole spectrum, and silence.

A bus that drops a bit gives one wild sample, an amplifier that settles or a wire that is touched gives a step. Both
are single changes far beyond all the others around them. A channel that is muted, unplugged or at its end does not
change at all.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

JUMP = 12.0  # median changes: 8 standard deviations of white noise, so that noise has none; a tone's largest is 1.4
MOST_JUMPS = 0.01  # of the samples; what jumps more often is the signal, what changes less often carries nothing
LONGEST_IMPULSE = 4  # samples


class Mended(NamedTuple):
    """A waveform without its jumps."""

    samples: Floats  # shape (n,)
    still: int  # samples in the longest run without a change, jumps apart


def mended(samples: Floats) -> Mended:
    """`samples`, shape (n,), with impulses bridged and steps taken back, and how long nothing changed.

    Left as they are where more than MOST_JUMPS of them jump.
    """
    most = MOST_JUMPS * len(samples)
    sizes = np.abs(samples[1:] - samples[:-1])
    changes = np.flatnonzero(sizes)
    if len(changes) <= most:
        limit, jumps = 0.0, changes
    else:
        changed = sizes[changes]
        middle = len(changed) // 2
        limit = JUMP * float(np.partition(changed, middle)[middle])
        jumps = changes[changed > limit]
    if 0 < len(jumps) <= most:
        samples = _without(samples, jumps, limit)
        changes = np.setdiff1d(changes, jumps, assume_unique=True)
    return Mended(samples, _longest_run(changes, len(samples)))


def _without(samples: Floats, jumps: NDArray[np.intp], limit: float) -> Floats:
    """The samples with a straight line from before each group of `jumps` to after it, and no step in between."""
    repaired = samples.copy()
    for group in np.split(jumps, np.flatnonzero(np.diff(jumps) > LONGEST_IMPULSE) + 1):
        before, after = int(group[0]), int(group[-1]) + 1  # the last sample that is good, the next one
        step = repaired[after] - repaired[before]
        if abs(step) > limit * (after - before):
            repaired[after:] -= step
            step = 0.0
        repaired[before:after] = repaired[before] + step * np.arange(after - before) / (after - before)
    return repaired


def _longest_run(changes: NDArray[np.intp], count: int) -> int:
    """The most samples in a row, of `count`, that are equal; change i is between the samples i and i + 1."""
    if len(changes) == count - 1:
        return 1
    ends = np.concatenate(([-1], changes, [count - 1]))
    return int(np.diff(ends).max())
