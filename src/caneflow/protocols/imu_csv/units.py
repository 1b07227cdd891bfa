"""Units of a table's columns: as told, as the table states them, or as the size of the numbers shows."""

import math
import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from caneflow.physics import GRAVITY
from caneflow.protocols.errors import ProtocolError

Floats: TypeAlias = NDArray[np.float64]

# What the wire has (rad/s, m/s^2, uT) over what the file has; of time: ns.
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0, "d": 86400e9, "100us": 1e5},
    "gyro": {"rad/s": 1.0, "deg/s": math.radians(1.0), "mdeg/s": math.radians(1e-3)},
    "accel": {"m/s^2": 1.0, "g": GRAVITY, "mg": 1e-3 * GRAVITY},
    "mag": {"uT": 1.0, "nT": 1e-3, "mT": 1e3, "T": 1e6, "mG": 0.1, "G": 100.0},
}
UNITS["linear_accel"] = UNITS["accel"]
DEFAULT_UNITS = {quantity: next(iter(units)) for quantity, units in UNITS.items()}

LEAST_ROWS = 20
LEFT_OF_MOTION = 0.5  # of the variation of an accelerometer's magnitude, at most, without the acceleration it holds
SELDOM = "100us"  # taken where a table states it, and never for the size of the numbers
STEPS = (6e-4, 0.59)  # s between readings, 1.7 to 1700 Hz: of units a thousand apart at most one fits
SLOW = 0.1  # s: a thousandth of a longer step is one of a fast IMU
GYRO_FULL_SCALE = math.radians(2000.0)  # rad/s, of nearly every gyro that people carry
GYRO_FULL_SCALE_DEGREES = 4000.0  # deg/s; more is mdeg/s
REST = (0.7, 1.4)  # median of an accelerometer's magnitude over gravity, at rest or walking
EARTH = (15.0, 100.0)  # uT: 22 to 67 outdoors, steel around it bends that
BLOCK = 0.1  # s: the changes of gravity's direction that the gyro has to explain
NOTABLE = 1.0  # rad/s: an undecided unit of slower turns is not worth a line
LEAST_TURN = 0.2  # rad/s RMS, below which an offset of the gyro may be all there is

# How tables write them, without spaces, in lower case.
SPELLINGS: dict[str, dict[str, tuple[str, ...]]] = {
    "time": {
        "s": ("s", "sec", "secs", "second", "seconds"),
        "ms": ("ms", "msec", "millis", "milliseconds", "millisecond"),
        "us": ("us", "usec", "\N{MICRO SIGN}s", "\N{GREEK SMALL LETTER MU}s", "micros", "microseconds"),
        "ns": ("ns", "nsec", "nanos", "nanoseconds"),
        "d": ("d", "days"),
        "100us": ("100us", "sampletimefine"),  # Xsens' title; a DOT of theirs counts us under it
    },
    "gyro": {
        "rad/s": ("rad/s", "rad/sec", "rads", "rps", "radians/s", "rad.s-1", "rads-1"),
        "deg/s": ("deg/s", "deg/sec", "dps", "\N{DEGREE SIGN}/s", "degrees/s", "degs", "\N{DEGREE SIGN}s-1"),
        "mdeg/s": ("mdeg/s", "mdps"),
    },
    "accel": {
        "m/s^2": ("m/s^2", "m/s2", "m/s\N{SUPERSCRIPT TWO}", "m/s/s", "m/s**2", "mss", "ms2", "ms-2", "m.s-2"),
        "g": ("g", "gs", "gee"),
        "mg": ("mg",),
    },
    "mag": {
        "uT": ("ut", "\N{MICRO SIGN}t", "\N{GREEK SMALL LETTER MU}t", "microtesla"),
        "nT": ("nt", "nanotesla"),
        "mT": ("mt",),
        "T": ("t", "tesla"),
        "mG": ("mg", "mgauss", "milligauss"),
        "G": ("g", "gauss"),
    },
}
SPELLINGS["linear_accel"] = SPELLINGS["accel"]


class Judged(NamedTuple):
    """A unit, and what it was taken from."""

    unit: str
    why: str
    doubt: str = ""  # what speaks for another one, and what settles it


def require_known(units: Mapping[str, str]) -> None:
    """Raise ProtocolError for a quantity or a unit that is not known."""
    for quantity, unit in units.items():
        if quantity not in UNITS:
            raise ProtocolError(f"{quantity!r}: not a quantity; expected one of {', '.join(UNITS)}")
        if unit not in UNITS[quantity]:
            raise ProtocolError(f"{quantity}: no unit {unit!r}; there are {', '.join(UNITS[quantity])}")


def stated(quantity: str, texts: Iterable[str]) -> str | None:
    """The unit that a title or a row of units gives: in brackets, as the last word, or alone."""
    for text in texts:
        words = re.findall(r"[(\[{]\s*([^)\]}]+?)\s*[)\]}]", text) or [re.split(r"[\s_:]+", text.strip())[-1], text]
        for word in words:
            written = re.sub(r"[\s*\N{MIDDLE DOT}]", "", word).lower()
            for unit, spellings in SPELLINGS.get(quantity, {}).items():
                if written in spellings:
                    return unit
    return None


def judged_time(step: float, *, told: str | None, stated: str | None, counts: bool) -> Judged:
    """The unit of time in which `step` (NaN: not known) between readings is one of an IMU's. `counts`: by 1, whole."""
    sizes = {u: STEPS[0] <= step * ns * 1e-9 <= STEPS[1] for u, ns in UNITS["time"].items()}
    size = next((unit for unit, fits in sizes.items() if fits and unit != SELDOM), None)
    if stated == SELDOM:
        stated, size = (stated, SELDOM) if sizes[SELDOM] else (None, size)
    unit, why = _chosen("time", told, stated, size, f"readings are {step:.4g} apart")
    if told is not None or not step > 0:
        return Judged(unit, why, _contradiction("time", unit, size) if told is not None else "")
    if counts and stated is None:
        return Judged(unit, why, f"it counts by 1: sample numbers? --rate HZ, or --units time={unit}, settles it")
    if size is None:
        rate = 1e9 / (step * UNITS["time"][unit])
        return Judged(unit, why, f"{rate:.3g} Hz is unusual; --units time=UNIT settles it")
    if stated is None and step * UNITS["time"][unit] * 1e-9 > SLOW:
        rate = 1e9 / (step * UNITS["time"][unit])
        doubt = f"{rate:.3g} Hz is slow, {1000 * rate:.3g} Hz possible too; --units time=UNIT settles it"
        return Judged(unit, why, doubt)
    return Judged(unit, why, _contradiction("time", unit, size))


def judged_accel(accel: Floats, *, told: str | None, stated: str | None) -> Judged:
    """The unit in which an accelerometer's magnitude, (n, 3), is gravity."""
    middle = _middle(accel)
    likely = [u for u, scale in UNITS["accel"].items() if REST[0] <= middle * scale / GRAVITY <= REST[1]]
    return _by_size("accel", likely, f"median magnitude {middle:.4g}", told, stated)


def judged_mag(mag: Floats, *, told: str | None, stated: str | None) -> Judged:
    """The unit in which a compass's magnitude, (n, 3), is the Earth's field."""
    middle = _middle(mag)
    likely = [u for u, scale in UNITS["mag"].items() if EARTH[0] <= middle * scale <= EARTH[1]]
    return _by_size("mag", likely, f"median magnitude {middle:.4g}", told, stated)


def judged_gyro(
    times: Floats,
    gyro: Floats,
    accel: Floats | None,
    *,
    accel_unit: str | None,
    told: str | None,
    stated: str | None,
) -> Judged:
    """The unit of turn rates (n, 3): beyond a gyro's full scale it is degrees, else as gravity turns in `accel`.

    `times` (n,) s, rising; `accel` (n, 3) in any unit.
    """
    known = gyro[np.isfinite(gyro).all(axis=1)]
    largest = float(np.percentile(np.abs(known), 99.5)) if len(known) else 0.0
    size, why = None, f"turns of up to {largest:.4g}"
    if largest > GYRO_FULL_SCALE:
        size = "mdeg/s" if largest > GYRO_FULL_SCALE_DEGREES else "deg/s"
    elif accel is not None and (turned := gravity_turn(times, gyro, accel)) is not None:
        size = "rad/s" if turned > 0.5 else "deg/s"
        why = f"gravity turns {turned:.2g} times as fast as by rad/s"
    unit, why = _chosen("gyro", told, stated, size, why)
    notable = largest > NOTABLE or accel_unit not in (None, "m/s^2")  # who gives g mostly gives degrees
    if told is None and stated is None and size is None and notable:
        settles = "--units gyro=deg/s or gyro=rad/s settles it"
        return Judged(unit, why, f"turns of up to {largest:.3g} can be deg/s too; {settles}")
    return Judged(unit, why, _contradiction("gyro", unit, size))


def judged_linear(
    linear: Floats, accel: Floats | None, *, accel_unit: str | None, told: str | None, stated: str | None
) -> Judged:
    """The unit of an acceleration without gravity (n, 3): what is left of `accel` (n, 3, `accel_unit`) is gravity.

    It is near zero, so that its size says nothing, and phones give it in m/s^2 beside an accelerometer in g.
    """
    if told or stated or accel is None or accel_unit is None:
        unit = told or stated or accel_unit or DEFAULT_UNITS["linear_accel"]
        return Judged(unit, "told" if told else "as the table states" if stated else "the default")
    known = np.isfinite(linear).all(axis=1) & np.isfinite(accel).all(axis=1)
    force, linear = accel[known] * UNITS["accel"][accel_unit], linear[known]
    scales = {"": 0.0, **UNITS["linear_accel"]}
    # how much the magnitude of the rest varies in each unit; in none of them: of all
    rests = {unit: float(np.linalg.norm(force - scale * linear, axis=1).std()) for unit, scale in scales.items()}
    best = min(rests, key=lambda unit: rests[unit])
    if len(force) >= LEAST_ROWS and best and rests[best] < LEFT_OF_MOTION * rests[""]:
        return Judged(best, "what is left of accel is gravity")
    doubt = "--units linear_accel=UNIT settles it" if accel_unit != DEFAULT_UNITS["linear_accel"] else ""
    return Judged(accel_unit, "as accel", doubt and f"accel less it is not gravity in any unit; {doubt}")


def gravity_turn(times: Floats, gyro: Floats, accel: Floats) -> float | None:
    """By which factor gravity in `accel` (n, 3) turns as fast as `gyro` (n, 3), taken for rad/s, says.

    1 for rad/s, 0.017 for deg/s; the least squares of d(a)/dt = - gyro x a over blocks of 0.1 s (`times` in s).
    None where three standard deviations do not tell it from 0.5.
    """
    known = np.isfinite(gyro).all(axis=1) & np.isfinite(accel).all(axis=1)
    if known.sum() < 20:
        return None
    times, gyro, accel = times[known], gyro[known], accel[known]
    blocks, starts, counts = np.unique((times / BLOCK).astype(np.int64), return_index=True, return_counts=True)
    if len(blocks) < 6:
        return None
    turn = np.add.reduceat(gyro, starts) / counts[:, None]
    down = np.add.reduceat(accel, starts) / counts[:, None] / max(_middle(accel), 1e-12)
    middle = np.add.reduceat(times, starts) / counts
    step = np.diff(middle)[:, None]
    near = (step[:, 0] > 0) & (step[:, 0] < 3 * BLOCK)
    expected = -np.cross(turn[1:] + turn[:-1], down[1:] + down[:-1])[near] / 4 * step[near]
    seen = np.diff(down, axis=0)[near]
    power = float((expected**2).sum())
    if power <= 0 or len(seen) < 5 or float(np.mean(np.sum(turn**2, axis=1))) < LEAST_TURN**2:
        return None
    factor = float((seen * expected).sum()) / power
    spread = math.sqrt(float(((seen - factor * expected) ** 2).sum()) / (3 * len(seen)) / power)
    return factor if abs(factor - 0.5) > 3 * spread else None


def _by_size(quantity: str, likely: list[str], size: str, told: str | None, stated: str | None) -> Judged:
    unit, why = _chosen(quantity, told, stated, likely[0] if likely else None, size)
    if told is None and not likely:
        expected = "gravity" if quantity == "accel" else "the Earth's field"
        return Judged(unit, why, f"{size} is not {expected} in any unit; --units {quantity}=UNIT settles it")
    return Judged(unit, why, _contradiction(quantity, unit, likely[0] if likely else None))


def _chosen(quantity: str, told: str | None, stated: str | None, size: str | None, why: str) -> tuple[str, str]:
    if told is not None:
        return told, "told"
    if stated is not None:
        return stated, "as the table states"
    if size is not None:
        return size, why
    return DEFAULT_UNITS[quantity], "the default"


def _contradiction(quantity: str, unit: str, size: str | None) -> str:
    """What to say where the size of the numbers speaks against the unit that was told or stated."""
    if size is None or size == unit:
        return ""
    return f"by their size the numbers are {size}; --units {quantity}={size} or {quantity}={unit} settles it"


def _middle(vectors: Floats) -> float:
    """The median magnitude of (n, 3); 0 for none."""
    known = vectors[np.isfinite(vectors).all(axis=1)]
    return float(np.median(np.linalg.norm(known, axis=1))) if len(known) else 0.0
