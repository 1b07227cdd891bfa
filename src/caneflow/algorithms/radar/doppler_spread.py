"""How wide the Doppler of the ground is, as the speed to the side that would make it so.

The beam's azimuths close at different rates when the antenna goes sideways, so pairs of scans are the less alike the
farther they are apart: with the variance s2 of the phase from scan to scan, |sum x(t) conj(x(t - k T))| falls as
exp(-k^2 s2 / 2). From lag 1 to lag k noise drops out. A speed v_l to the side makes s2 = (4 pi f T / c cos(g) v_l)^2
times the mean square of sin(phi) over the beam's two-way power, 1 / kappa (ground_velocity.beam_factor), so each cell
tells a v_l^2, and all together their least squares.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_LEAST, _LARGEST = -0.3, 1.5  # (m/s)^2, of one cell: noise, and walls and people, tell anything
_FAINT: Final = 1e-30  # power of nothing


def doppler_spread(
    scans: NDArray[np.complex64], cell: int, lag: int, per_sideways: Floats, *, least_fit: float
) -> float | None:
    """The speed (m/s) to the side that would widen the Doppler as much; None where scans are not alike.

    Moving `scans`, oldest first, shape (W, K * cell), K cells of that many bins; `per_sideways`, shape (K,): variance
    of the phase ((rad)^2) from scan to scan per (m/s)^2. `least_fit`: the coherence at `lag` below which nothing is
    said.
    """
    newer = scans[lag:]
    near = np.add.reduce(newer * scans[lag - 1 : -1].conj())
    far = np.add.reduce(newer * scans[:-lag].conj())
    power = np.add.reduce(newer.real**2 + newer.imag**2)
    cells = len(per_sideways), cell
    near_size = np.abs(np.add.reduce(near.reshape(cells), axis=1)) + _FAINT
    far_size = np.abs(np.add.reduce(far.reshape(cells), axis=1)) + _FAINT
    in_cells = np.add.reduce(power.reshape(cells), axis=1) + _FAINT
    total = float(np.add.reduce(power))
    if total <= 0.0 or float(np.add.reduce(far_size)) < least_fit * total:
        return None
    squares = np.log(near_size / far_size) * (2.0 / (lag * lag - 1.0)) / per_sideways
    np.minimum(squares, _LARGEST, out=squares)
    np.maximum(squares, _LEAST, out=squares)
    weight = far_size / in_cells * per_sideways
    weight *= weight
    square = float(np.add.reduce(weight * squares)) / float(np.add.reduce(weight))
    return math.sqrt(max(square, 0.0))
