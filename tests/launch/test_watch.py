"""A rank that was killed or cut off is found, and no other."""

import threading

import pytest
from torch import distributed

from megastep.agents.distributed import process_group
from megastep.agents.launch import watch


class Ended(BaseException):
    """In place of the end of the process."""


@pytest.fixture
def teams(monkeypatch):
    """Makes the teams of two ranks, whose store is in this process and whose threads do nothing."""
    store = distributed.HashStore()
    monkeypatch.setattr(process_group, "store", lambda name, is_shared: store)
    monkeypatch.setattr(watch.Team, "_watch", lambda self: None)
    monkeypatch.setenv("WORLD_SIZE", "2")
    made = []
    for rank in range(2):
        monkeypatch.setenv("RANK", f"{rank}")
        monkeypatch.setenv("LOCAL_RANK", "0")
        made.append(watch.Team())
    return made


def seconds_until_lost(team, other, n=40):
    """Returns the seconds until a rank misses the other, which beats if it is given."""
    for number in range(n):
        if other:
            other._poll()
        if problem := team._poll():
            assert problem.startswith("rank 1 on ")
            return (number + 1) * watch.PERIOD
    return None


def test_silent_rank_is_lost_and_one_that_has_left_is_not(teams):
    first, second = teams
    assert first._poll() is None and first.missing == [1]
    assert seconds_until_lost(first, second) is None and not first.missing
    assert 0 <= seconds_until_lost(first, None) - watch.LOST_SECONDS <= 2 * watch.PERIOD
    second._poll()
    first._poll()
    first.is_broken = True
    assert 0 <= seconds_until_lost(first, None) - watch.BROKEN_SECONDS <= 2 * watch.PERIOD
    second.leave()
    assert seconds_until_lost(first, None) is None


def test_one_rank_reports_and_the_others_end(teams, monkeypatch):
    first, second = teams
    assert second.claim() and not first.claim() and second.claim()
    ended = []
    monkeypatch.setattr(watch.Team, "end", lambda self, problem: ended.append(problem))
    first._poll()
    assert ended == [None]


def test_rank_that_the_store_does_not_answer_ends(teams, monkeypatch):
    """Although the thread that asks it, and whoever else does, is blocked for ever."""

    class Silent:
        def set(self, *arguments):
            threading.Event().wait()

        compare_set = set

    monkeypatch.undo()
    for name, seconds in dict(PERIOD=0.01, SILENT_SECONDS=0.2, CALL_SECONDS=0.01).items():
        monkeypatch.setattr(watch, name, seconds)
    problems = []

    def end(self, problem):
        problems.append(problem)
        raise Ended

    monkeypatch.setattr(watch.Team, "end", end)
    teams[0].store = Silent()
    with pytest.raises(Ended):
        teams[0]._watch()
    (problem,) = problems
    assert "where torchrun keeps the ranks' store, does not answer" in problem
    assert teams[0].claim()  # as no other rank can
