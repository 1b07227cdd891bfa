"""What was sent and is kept: the slowest reader decides, a word from before takes nothing back, what is full waits."""

import pytest

from caneflow.runtime.stages.byte_budget import PER_SAMPLE
from caneflow.runtime.stages.sent_samples import History, Kept


def history(*, count: int = 5, budget: int | None = None, waits: bool = False) -> History:
    """Samples 0 .. count - 1 of one byte each, sent to two readers."""
    made = History(
        {"pose": ("a", "b"), "unread": ()}, None if budget is None else {"pose": budget, "unread": 0}, waits=waits
    )
    for seq in range(count):
        made.keep("pose", seq, bytes([seq]))
    return made


def test_what_the_slowest_reader_has_confirmed_is_forgotten() -> None:
    kept = history()
    kept.confirm("pose", "a", 3)
    assert kept.first("pose") == 0
    kept.confirm("pose", "b", 1)
    assert (kept.first("pose"), kept.since("pose", 0)) == (2, [b"\x02", b"\x03", b"\x04"])
    kept.confirm("pose", "b", 4)
    assert kept.first("pose") == 4
    kept.confirm("pose", "a", 4)
    assert (kept.first("pose"), kept.since("pose", 0), kept.held) == (5, [], 0)


def test_an_older_word_takes_nothing_back() -> None:
    """Words of one reader may come in another order: what it has made sure of it never asks for again."""
    kept = history()
    for reader, seq in [("a", 3), ("a", 0), ("b", 3)]:
        kept.confirm("pose", reader, seq)
    assert kept.first("pose") == 4


@pytest.mark.parametrize("seq", range(6))
def test_samples_are_sent_again_from_the_number_that_was_asked_for(seq: int) -> None:
    assert history().since("pose", seq) == [bytes([each]) for each in range(seq, 5)]


def test_strangers_confirm_nothing_and_what_nobody_reads_is_not_kept() -> None:
    kept = history()
    kept.confirm("pose", "stranger", 4)
    kept.confirm("other", "a", 4)
    assert kept.first("pose") == 0
    kept.keep("unread", 7, b"1234")
    assert (kept.since("unread", 0), kept.first("unread"), kept.kept()["unread"]) == ([], 8, [])


def test_live_the_oldest_are_let_go_beyond_the_budget() -> None:
    kept = history(count=5, budget=3 * (PER_SAMPLE + 1))
    assert (kept.kept()["pose"][0], kept.let_go, kept.held) == (Kept(2, b"\x02"), 2, 3 * (PER_SAMPLE + 1))


def test_in_a_replay_nothing_is_let_go_and_the_port_is_full_until_there_is_room() -> None:
    kept = history(count=5, budget=3 * (PER_SAMPLE + 1), waits=True)
    assert (kept.full, kept.let_go, kept.first("pose")) == ({"pose"}, 0, 0)
    kept.confirm("pose", "a", 1)
    kept.confirm("pose", "b", 0)
    assert kept.full == {"pose"}  # four are left
    kept.confirm("pose", "b", 1)
    assert kept.full == set()
