"""A rank that was killed or hangs is found, and one that only takes long is not."""

import pytest

from megastep.agents.launch import watch
from megastep.agents.launch.watch import Heartbeat, LossDetector


def heartbeat(number, n_operations=100, n_updates=9, is_exempt=False, has_left=False):
    return Heartbeat(number, n_operations, n_updates, is_exempt, has_left, "node-7")


def polled(ours, theirs, is_broken=False):
    """Returns the number of the poll, from 0, that finds the other rank lost, and what is said."""
    detector = LossDetector()
    for number, pair in enumerate(zip(ours, theirs, strict=True)):
        if problem := detector.poll(*pair, is_broken):
            return number * watch.PERIOD, problem
    return None, None


def test_silent_rank_is_lost():
    ours = [heartbeat(n) for n in range(20)]
    seconds, problem = polled(ours, [heartbeat(3)] * 20)
    assert watch.LOST_SECONDS < seconds <= watch.LOST_SECONDS + 2 * watch.PERIOD
    assert "killed" in problem
    seconds, _ = polled(ours, [heartbeat(3)] * 20, is_broken=True)
    assert watch.BROKEN_SECONDS < seconds <= watch.BROKEN_SECONDS + 2 * watch.PERIOD


def test_rank_that_left_is_not_lost():
    assert polled([heartbeat(n) for n in range(50)], [heartbeat(3, has_left=True)] * 50)[1] is None


def behind(n, **options):
    """Returns the heartbeats of a rank that waits for another, and of that."""
    ours = [heartbeat(i, n_operations=101) for i in range(n)]
    return ours, [heartbeat(i, n_operations=100, **options) for i in range(n)]


def test_hanging_rank_is_lost():
    seconds, problem = polled(*behind(30))
    assert watch.LOST_SECONDS < seconds <= watch.LOST_SECONDS + 2 * watch.PERIOD
    assert "hangs" in problem


@pytest.mark.parametrize("options", [dict(is_exempt=True), dict(n_updates=1)])
def test_rank_that_compiles_or_saves_is_not_lost(options):
    assert polled(*behind(30, **options))[1] is None


def test_rank_that_is_waited_for_alone_can_hang():
    """A rank that waits is not ahead of the one that does: neither is lost."""
    ours, theirs = behind(30)
    assert polled(theirs, ours)[1] is None


def test_slow_rank_is_given_time():
    """After a wait of 16 s that went well, one of 60 s is no longer taken for a hang."""
    ours, theirs = behind(9)
    ours += [heartbeat(10 + i, n_operations=102) for i in range(31)]
    theirs += [heartbeat(10 + i, n_operations=101) for i in range(31)]
    assert polled(ours, theirs)[1] is None
    assert polled(*behind(40))[1] is not None
