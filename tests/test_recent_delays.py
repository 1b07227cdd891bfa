"""The spread of delays that a node tells of its inputs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caneflow.messages.control import Delays
from caneflow.runtime.hosts.process.recent_delays import KEPT, RecentDelays, percentile


@given(st.lists(st.integers(-(10**9), 10**12), min_size=1, max_size=300), st.sampled_from([0.01, 0.5, 0.9, 0.99, 1.0]))
def test_a_percentile_is_numpys_inverted_distribution(delays: list[int], part: float) -> None:
    assert percentile(sorted(delays), part) == pytest.approx(np.quantile(delays, part, method="inverted_cdf") / 1e9)


def test_nothing_is_told_of_nothing() -> None:
    assert RecentDelays(live=True).spread(now=5) == Delays()


def test_latency_age_and_silence() -> None:
    delays = RecentDelays(live=True)
    for number in range(100):
        put = (number + 1) * 10_000_000
        delays.note(now=put + 1000 * number, sent_at=put, stamp=put - 2_000_000)
    spread = delays.spread(now=100 * 10_000_000 + 99_000 + 250_000_000)
    assert (spread.latency_p50, spread.latency_p99) == pytest.approx((49e-6, 98e-6))
    assert (spread.age_p50, spread.age_p99) == pytest.approx((2.049e-3, 2.098e-3))
    assert spread.silent == 0.25


def test_a_replay_has_no_age_and_a_writer_that_says_no_time_no_latency() -> None:
    replayed, foreign = RecentDelays(live=False), RecentDelays(live=True)
    replayed.note(now=2_000, sent_at=1_000, stamp=5)
    foreign.note(now=2_000, sent_at=0, stamp=500)
    assert replayed.spread(2_000) == Delays(latency_p50=1e-6, latency_p99=1e-6, silent=0.0)
    assert foreign.spread(2_000) == Delays(age_p50=1.5e-6, age_p99=1.5e-6, silent=0.0)


def test_old_delays_are_forgotten() -> None:
    delays = RecentDelays(live=False)
    delays.note(now=10**9, sent_at=1, stamp=0)
    for _ in range(KEPT):
        delays.note(now=2, sent_at=1, stamp=0)
    assert delays.spread(2).latency_p99 == 1e-9


def test_the_age_at_which_a_sample_was_handled_is_told_live_only() -> None:
    assert RecentDelays(live=True).spread(now=5, handled=2.5).handled == 2.5
    assert RecentDelays(live=False).spread(now=5, handled=2.5).handled is None
