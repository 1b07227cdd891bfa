"""The superior edge against shapes whose steepest fall is known, and the derivation of what it lies beyond."""

import math

import numpy as np
import pytest

from caneflow.algorithms.radar.edges import EDGE_BEYOND_SPEED, superior_edges
from caneflow.algorithms.radar.range_doppler import hann

PADDING = 4  # Doppler bins per resolution cell


def hann_power(cells: np.ndarray) -> np.ndarray:
    """Power spectrum of the Hann window, |sinc(x) / (1 - x^2)|^2, at `cells` from the line."""
    at_one = np.abs(np.abs(cells) - 1) < 1e-6  # 0 / 0, in the limit 1 / 2
    away = np.where(at_one, 0.0, cells)
    return np.where(at_one, 0.25, (np.sinc(away) / (1 - away**2)) ** 2)


def steepest_fall(cells: np.ndarray, magnitude: np.ndarray) -> float:
    at = int(np.diff(magnitude).argmin())
    return float(cells[at] + cells[at + 1]) / 2


@pytest.mark.parametrize("centre", [20.0, 20.3, 40.75, 77.5])
def test_finds_the_inflection_of_a_smooth_flank(centre: float) -> None:
    columns = np.arange(129)
    rows = np.stack([1 / (1 + np.exp((columns - centre) / width)) for width in (2.0, 3.0)])
    edges, falls = superior_edges(rows)
    assert edges == pytest.approx([centre, centre], abs=0.03)
    assert falls == pytest.approx([1 / 8, 1 / 12], rel=0.03)  # the slope 1 / (4 width) at the inflection


def test_every_row_is_looked_at_by_itself() -> None:
    rng = np.random.default_rng(4)
    rows = rng.random((9, 65)).astype(np.float32)
    edges, falls = superior_edges(rows)
    for row, edge, fall in zip(rows, edges, falls, strict=True):
        drops = (row[:-1] - row[1:])[1:-1]
        assert fall == drops.max()
        assert abs(edge - (drops.argmax() + 1.5)) <= 0.5
        alone, _ = superior_edges(row[None, :])
        assert alone[0] == edge


def test_how_the_rows_lie_in_memory_does_not_matter() -> None:
    rows = np.random.default_rng(5).random((9, 130)).astype(np.float32)
    half = np.ascontiguousarray(rows[:, :65])
    assert superior_edges(rows[:, :65]) == superior_edges(half)
    assert superior_edges(np.asfortranarray(half)) == superior_edges(half)


def test_flat_rows_and_falls_at_the_rim_give_no_nonsense() -> None:
    rows = np.zeros((4, 16), dtype=np.float32)
    rows[1] = 5
    rows[2, 0] = 9
    rows[3, :15] = 9
    edges, falls = superior_edges(rows)
    assert all(0 <= edge <= 15 for edge in edges)
    assert falls[:2] == [0, 0]


@pytest.mark.parametrize("length", [32, 64, 128])
def test_the_edge_of_a_single_line_lies_0_94_cells_beyond_it(length: int) -> None:
    """By the window's formula, and as found on a zero-padded transform."""
    cells = np.linspace(0, 2, 20_001)
    formula = steepest_fall(cells, np.sqrt(hann_power(cells)))
    assert formula == pytest.approx(0.942, abs=1e-3)
    n = np.arange(length)
    lines = 5 + np.linspace(0, 1, 9)  # cells
    tones = np.exp(2j * math.pi * lines[:, None] * n / length) * hann(length)
    edges, _ = superior_edges(np.abs(np.fft.fft(tones, PADDING * length, axis=1))[:, : PADDING * length // 2])
    assert np.array(edges) / PADDING - lines == pytest.approx(np.full(9, formula), abs=0.02)


@pytest.mark.parametrize("fastest", [3.0, 5.0, 7.0, 9.0, 12.0])
def test_the_edge_of_ground_in_a_beam_lies_about_0_8_cells_beyond_its_fastest_line(fastest: float) -> None:
    """Ground at azimuth phi shows at fastest * cos(phi) cells, in power like the beam's two ways.

    The expected power spectrum is that density convolved with the window's. At N = 64, 100 Hz and 4.3 GHz a cell
    is 0.054 m/s of radial speed: 3 to 12 cells are 0.2 to 0.9 m/s over ground at 42 deg.
    """
    azimuths = np.linspace(-math.pi / 2, math.pi / 2, 4001)
    one_way = np.exp(-4 * math.log(2) * (azimuths / math.radians(50)) ** 2)
    lines = fastest * (np.cos(azimuths) - 1)  # cells from the fastest
    cells = np.linspace(-2, 3, 1001)
    power = (one_way**2 * hann_power(cells[:, None] - lines)).sum(axis=1)
    assert steepest_fall(cells, np.sqrt(power)) == pytest.approx(EDGE_BEYOND_SPEED, abs=0.07)


@pytest.mark.parametrize("at_the_left", [True, False])
def test_a_fall_at_the_rim_that_is_steeper_moves_the_edge_half_a_column_towards_it(at_the_left: bool) -> None:
    """The steepest of those looked at is beside the rim: the true one lies beyond it, on that side."""
    row = np.array([[20.0, 10.0, 7.0, 6.5, 6.0, 5.6, 5.3, 5.0]])  # falls 10, 3, 0.5 ...: column 0 is not looked at
    edge = superior_edges(row if at_the_left else 20.0 - row[:, ::-1])[0][0]
    assert edge == (1.5 - 0.5 if at_the_left else 5.5 + 0.5)
