"""Ground velocity from many sweeps in a short window: the one speed with which the pairs of all ranges turn in step.

For radars that sweep a thousand times a second and see little (Acconeer A121: -10 to 10 dB a sweep). The phase of each
range cell would be noise alone, so none is taken. Pairs at lags 1 to 3 of all cells are turned back by what a speed
predicts and added up; noise of different sweeps cancels, the right speed gives the largest sum. Whether that sum
is more than noise makes, and how much the speeds of parts of the window differ, says what the result is worth.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LAGS: Final = 3
BLOCKS: Final = 5  # of the window, whose speeds are compared
FASTEST: Final = 8.0  # m/s over ground that is looked for: nobody runs faster with a cane
BEYOND: Final = 1.3  # times the unambiguous speed, up to where one that has come round is looked for
_STEP: Final = 0.5  # rad at the longest lag between two speeds that are tried
_ROUNDS: Final = 4  # of Newton's method
_TURNS: Final = 4.0 * math.pi  # rad of phase in a window beyond which what stands can be told from what moves


class LagSums(NamedTuple):
    """Sums of pairs over parts of a window, for K range cells."""

    pairs: NDArray[np.complex128]  # (BLOCKS, LAGS, K), of x(t) conj(x(t - lag T))
    standing: Floats  # (K,) power of the window's mean, less what noise has in it
    power: Floats  # (K,) mean |x|^2 of a sweep
    sweeps: int  # in the window


class MatchedSpeed(NamedTuple):
    """The speed that fits the most."""

    forward: float  # m/s
    significance: float  # sum of the pairs, over its standard deviation if all were noise
    variance: float  # (m/s)^2, of the speed, by noise, speckle and what is not known of the vertical speed
    per_height: float  # m/s of speed per m of height


class Doubts(NamedTuple):
    """What no window helps against, as standard deviations."""

    rise: float  # m/s, of the vertical speed
    least: float  # m/s, of any speed
    speckle: float  # of the speed, as a share of it


def lag_sums(sweeps: NDArray[np.complex64]) -> LagSums:
    """Sums of the pairs in `sweeps`, shape (W, K), oldest first."""
    count, cells = sweeps.shape
    pairs = np.zeros((BLOCKS, LAGS, cells), np.complex128)
    for lag in range(1, LAGS + 1):
        products = sweeps[lag:] * sweeps[:-lag].conj()
        first = [block * len(products) // BLOCKS for block in range(BLOCKS)]
        pairs[:, lag - 1] = np.add.reduceat(products, first, axis=0)
    power = np.mean(sweeps.real**2 + sweeps.imag**2, axis=0, dtype=np.float64)
    mean = sweeps.mean(axis=0)
    # less than nothing by chance: cut off there, it would be too much on average
    noise = np.maximum(power - np.abs(pairs[:, 0].sum(axis=0)) / (count - 1), 0.0)
    standing = mean.real**2 + mean.imag**2 - noise / count
    return LagSums(pairs, np.asarray(standing, np.float64), np.asarray(power, np.float64), count)


def matched_speed(
    sums: LagSums, per_forward: Floats, per_vertical: Floats, per_height: Floats, rise: float, doubts: Doubts
) -> MatchedSpeed | None:
    """The speed over ground with which all cells turn in step; None where they cannot tell.

    Args:
        sums: of the window.
        per_forward: (K,) rad per sweep and m/s of forward speed.
        per_vertical: (K,) rad per sweep and m/s of vertical speed.
        per_height: (K,) rad per sweep, m/s of forward speed, and m of height.
        rise: m/s, the antenna's vertical speed.
        doubts: how well the vertical speed is known, and what limits every estimate.
    """
    lags = np.arange(1.0, LAGS + 1.0)[:, None]
    level = sums.pairs * np.exp(-1j * rise * lags * per_vertical)  # of an antenna that does not rise
    steepest = float(np.max(per_forward, initial=0.0))
    if steepest <= 0.0:
        return None
    most = min(BEYOND * math.pi / steepest, FASTEST)
    grid = np.linspace(-most, most, 2 * math.ceil(most * steepest * LAGS / _STEP) + 1)
    turns = lags * per_forward  # (LAGS, K) rad per m/s
    back = np.exp(-1j * grid[:, None] * turns.reshape(1, -1))  # (G, LAGS K)
    whole = level.sum(axis=0)
    forward = _refined(float(grid[(back @ whole.ravel()).real.argmax()]), whole, turns, grid[1] - grid[0])
    if abs(forward) * sums.sweeps * float(per_forward.mean()) > _TURNS:
        # the background of a rest before stands still, and would draw the speed to zero
        whole = whole - (sums.sweeps - lags) * sums.standing * np.exp(-1j * rise * lags * per_vertical)
        forward = _refined(float(grid[(back @ whole.ravel()).real.argmax()]), whole, turns, grid[1] - grid[0])
    turned = whole * np.exp(-1j * forward * turns)
    noise = 0.5 * (sums.sweeps - lags) * sums.power**2  # variance of a sum's real part, and of its imaginary part
    significance = float(turned.real.sum()) / math.sqrt(float(noise.sum()) + 1e-300)
    weights = turns * turned.real
    bend = float((turns * weights).sum())
    if bend <= 0.0:
        return None
    pulls = (level * np.exp(-1j * forward * turns)).imag * turns
    blocks = BLOCKS * pulls.sum(axis=(1, 2)) / bend  # how far the speed of each part is from that of the whole
    seen = float(np.var(blocks, ddof=1)) / BLOCKS
    expected = float((turns**2 * noise).sum()) / bend**2
    # five parts alone tell their scatter to a third only
    alone = 0.5 * (seen + expected) + doubts.least**2 + (doubts.speckle * forward) ** 2
    rises = lags * per_vertical
    moved, variance = _with_rise(
        bend,
        float((turns * rises * turned.real).sum()),
        float((rises * rises * turned.real).sum()),
        float((rises * turned.imag).sum()),
        alone,
        doubts.rise,
    )
    return MatchedSpeed(
        forward=forward + moved,
        significance=significance,
        variance=variance,
        per_height=abs(forward * float((weights * lags * per_height).sum())) / bend,
    )


def _with_rise(
    bend: float, both: float, rise_bend: float, rise_pull: float, alone: float, rise_error: float
) -> tuple[float, float]:
    """How far the speed moves, and its variance, when the vertical speed is an unknown too, known to `rise_error`.

    `bend`, `both`, `rise_bend`: second derivatives of the sum; `rise_pull`: its slope along the vertical speed, where
    that along the forward speed is 0; `alone`: variance of the forward speed, were the other one known.
    """
    scale = 1.0 / (alone * bend)  # of the sum, as a likelihood
    vertical = scale * max(rise_bend, 0.0) + rise_error**-2
    determinant = scale * bend * vertical - (scale * both) ** 2
    if determinant <= 1e-9 * scale * bend * vertical:
        return 0.0, alone + (both / bend * rise_error) ** 2
    return -scale * both * scale * rise_pull / determinant, vertical / determinant


def _refined(forward: float, pairs: NDArray[np.complex128], turns: Floats, step: float) -> float:
    """The top of the sum near `forward`, by Newton's method; no farther away than a `step` of the grid."""
    begin = forward
    for _ in range(_ROUNDS):
        turned = pairs * np.exp(-1j * forward * turns)
        bend = float((turns * turns * turned.real).sum())
        if bend <= 0.0:
            return begin
        forward += float((turns * turned.imag).sum()) / bend
        if abs(forward - begin) > step:
            return begin
    return forward
