"""Marks of the swing: at its turning points whatever the body does, each second without one, and the mean between."""

import math

import numpy as np
import pytest

from caneflow.algorithms.cane.swing_marks import FullSwing, SwingMarks


def marked(yaws: np.ndarray, arms: np.ndarray | None = None) -> list[tuple[int, FullSwing | None]]:
    """Index and full swing at every mark, for yaws (rad) and arms (m, x + jy) at 100 Hz."""
    marks, found = SwingMarks(math.radians(4.0)), []
    for index in range(1, len(yaws)):
        if marks.update(0.01, yaws[index] - yaws[index - 1]):
            arm = 0j if arms is None else complex(arms[index])
            found.append((index, marks.full(float(yaws[index]), arm)))
    return found


@pytest.mark.parametrize("rate", [0.0, 0.2])
def test_over_a_full_swing_the_mean_is_where_the_body_walks(rate: float) -> None:
    """Swinging by 20 deg at 0.55 Hz, the body straight or turning: two marks a period, the swing gone from the mean."""
    time = 0.01 * np.arange(2000)
    body = 0.7 + rate * time
    arms = np.exp(1j * time)
    found = marked(body + math.radians(20.0) * np.sin(2 * math.pi * 0.55 * time), arms)
    assert len(found) == pytest.approx(20.0 * 2 * 0.55, abs=1.5)
    assert found[1][1] is None  # two marks make no full swing yet
    for (before, _), (index, swing) in zip(found[1:-2], found[3:], strict=True):
        assert swing is not None
        assert index - before == pytest.approx(100 / 0.55, abs=3)
        assert swing.yaw == pytest.approx(body[before + 1 : index + 1].mean(), abs=math.radians(0.7))
        assert swing.turned == pytest.approx(rate * 0.01 * (index - before), abs=math.radians(0.7))
        assert swing.arm == pytest.approx(arms[index] - arms[before])


def test_without_a_swing_there_is_a_mark_each_second() -> None:
    found = marked(np.linspace(0.0, 0.5, 700))
    indices = [index for index, _ in found[1:]]  # a turn begins, as that of a swing would
    assert np.diff(indices).tolist() == pytest.approx([100] * (len(indices) - 1), abs=1)
    swing = found[4][1]
    assert swing is not None
    assert swing.turned == pytest.approx(0.5 / 699 * 200, abs=0.002)


def test_what_is_forgotten_is_no_swing() -> None:
    marks = SwingMarks(0.07)
    for _ in range(2):
        marks.full(0.0, 0j)
    marks.forget()
    assert marks.full(0.0, 0j) is None
