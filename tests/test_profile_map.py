"""A map by range profiles: against places known beforehand, on arrays and on two real recordings."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat
from scipy.signal import hilbert

from caneflow.algorithms.radar.analytic_signal import AnalyticSignal
from caneflow.algorithms.surroundings.profile_map import ProfileMap, leading_evidence, standing_evidence
from caneflow.protocols.mrm_logs import parse_log
from tests.test_rail_recording import CLOCK_SHIFT, RAIL, RANGE_BIAS, REFLECTORS, times_of, tracked_places
from tests.test_room_trackers import NODES, P4XX, TRIANGLE, distance_to_triangle, leading_ranges

STEP = 0.01  # m per bin, or per scan along a way


def profile(distances: list[float], bins: int = 600) -> np.ndarray:
    """A scan with an echo at each distance, m."""
    ranges = STEP * np.arange(bins)
    return sum((np.exp(-0.5 * ((ranges - each) / 0.05) ** 2) for each in distances), 0.01 + 0j * ranges)


def test_two_things_are_where_profiles_from_many_places_cross() -> None:
    things, grid = ((2.0, 1.0), (2.5, 3.0)), ProfileMap(0.5, 0.0, 0.1, (40, 40))
    for y in np.arange(0.0, 3.0, 0.05):
        seen = profile([math.dist((0.0, y), thing) for thing in things])
        grid.add((0.0, y), standing_evidence(seen), 0.0, STEP)
    found = grid.peaks(2, 0.5)
    for thing in things:
        assert min(math.dist(thing, (peak.x, peak.y)) for peak in found) < 0.1
    grid.clear()
    assert grid.peaks(1, 0.5)[0].counts == 0


def test_a_radar_above_sees_a_thing_at_its_slant_range() -> None:
    grid = ProfileMap(0.0, -0.05, 0.1, (40, 1))
    grid.add((0.0, 0.0), standing_evidence(profile([2.5])), 0.0, STEP, height=1.5)
    assert grid.peaks(1, 0.5)[0].x == pytest.approx(2.0, abs=0.06)


@pytest.mark.parametrize("nothing", [np.zeros(50), np.full(50, 1e-320)])
def test_an_empty_scan_says_nothing_of_any_place(nothing: np.ndarray) -> None:
    assert not standing_evidence(nothing + 0j).any()
    assert not leading_evidence(np.zeros(50), STEP).any()


def test_the_near_side_of_a_deep_body_counts_and_what_echoes_behind_it_does_not() -> None:
    moving = np.zeros(400)
    moving[150:200], moving[300:310] = 1.0, 0.8
    evidence = leading_evidence(moving, STEP)
    assert np.average(np.arange(400), weights=evidence) == pytest.approx(149.5, abs=0.5)
    assert not evidence[180:].any()


def test_both_reflectors_beside_the_rail_come_first_and_second() -> None:
    """A scan for each centimetre of the way, so that the places where the radar stood do not count for more."""
    path = RAIL / "scan_2105627.txt"
    if not path.exists():
        pytest.skip("the rail recording is not here")
    scans = parse_log(path.read_bytes()).scans
    first, places = scans[0], tracked_places(times_of(scans) + CLOCK_SHIFT)
    analytic = AnalyticSignal(bins=len(first.samples), range_step=first.range_step, carrier=4.3e9, bandwidth=1.7e9)
    returns = analytic(np.stack([scan.samples for scan in scans]))
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places[:, [0, 2]], axis=0), axis=1))])
    chosen = np.unique(np.searchsorted(way, np.arange(0.0, way[-1], STEP)))
    grid = ProfileMap(0.8, -6.5, 0.1, (46, 96))  # the side that the antennas look to: ranges alone cannot tell it
    for scan, (x, height, z) in zip(returns[chosen] - returns[chosen].mean(axis=0), places[chosen], strict=True):
        start = first.range_start() - RANGE_BIAS
        grid.add((x, z), standing_evidence(scan), start, first.range_step, height - REFLECTORS[0][1])
    found = grid.peaks(2, 1.0)
    errors = [[math.hypot(peak.x - x, peak.y - z) for x, _, z in REFLECTORS] for peak in found]
    assert {int(np.argmin(each)) for each in errors} == {0, 1}, found
    assert max(map(min, errors)) <= 0.35, errors


def test_a_person_between_four_radars_is_on_the_triangle_that_they_walk() -> None:
    """Ten times a second, by the last 0.15 s alone; the one range offset is calibrated at the known start."""
    if not P4XX.exists():
        pytest.skip("the recordings of four P4xx radars are not here")
    seen = {node: leading_ranges(P4XX / f"{node}_P1.mat") for node in NODES}
    begin = min(times[0] for times, _ in seen.values())
    at_start = [
        (ranges - math.dist(NODES[node], TRIANGLE[0]))[times < begin + 3000] for node, (times, ranges) in seen.items()
    ]
    offset = float(np.nanmedian(np.concatenate(at_start)))
    radars = {node: moving_profiles(P4XX / f"{node}_P1.mat") for node in NODES}
    end, grid, errors = min(times[-1] for times, *_ in radars.values()), ProfileMap(-2.5, -2.5, 0.05, (100, 100)), []
    for now in np.arange(begin + 500, end, 100):
        grid.clear()
        for node, (times, start, step, evidence) in radars.items():
            for number in np.flatnonzero((times <= now) & (times > now - 150)):
                grid.add(NODES[node], evidence[number], start - offset, step)
        peak = grid.peaks(1, 1.0)[0]
        errors.append(distance_to_triangle(np.array([peak.x, peak.y])))
    assert len(errors) > 300
    assert np.median(errors) <= 0.10
    assert np.percentile(errors, 90) <= 0.15


def moving_profiles(path: Path) -> tuple[np.ndarray, float, float, list[np.ndarray]]:
    """Times (ms), range of the first bin and a bin's length (m), and the evidence of each scan."""
    scans = loadmat(path, struct_as_record=False, squeeze_me=True)["scn"]
    metres = 299_792_458.0 / 2.0 * 1e-12
    start, end = metres * scans[0].Tstrt, metres * scans[0].Tstp
    step = (end - start) / scans[0].Nscn
    analytic = hilbert(np.array([scan.scn for scan in scans], dtype=float), axis=1)
    background, evidence = analytic[:20].mean(axis=0), []
    for scan in analytic:
        moving = np.convolve(np.abs(scan - background), np.ones(9) / 9.0, mode="same")
        background = background + 0.05 * (scan - background)
        evidence.append(leading_evidence(moving, step))
    return np.array([scan.T for scan in scans]), start, step, evidence
