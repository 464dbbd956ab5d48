"""A rank that was killed or hangs is found, and one that only takes long is not."""

import threading

import pytest
from torch import distributed

from megastep.agents.distributed import process_group
from megastep.agents.launch import watch
from megastep.agents.launch.watch import LossDetector

#: The rank that others wait for, and those.
LATE, AHEAD = dict(n_operations=100), dict(n_operations=101, is_waiting=True)


def heartbeat(number, rank, n_operations=100, n_updates=9, n_phases=27, **flags):
    flags = dict(is_exempt=False, is_waiting=False, has_left=False) | flags
    counts = dict(n_operations=n_operations, n_updates=n_updates, n_phases=n_phases)
    return process_group.Heartbeat(f"node-{rank}", number, **counts, **flags)


def polled(*ranks, n=40, is_broken=False, detector=None):
    """Returns the seconds after which a rank counts as lost, and what is said; None for neither.

    Args:
        ranks: of each, its heartbeat's fields; a function of the number of polls may return them.
        n: polls.
    """
    detector = detector or LossDetector()
    for number in range(n):
        fields = [one(number) if callable(one) else one for one in ranks]
        rows = [heartbeat(**dict(number=number) | one, rank=i) for i, one in enumerate(fields)]
        if problem := detector.poll(dict(enumerate(rows)), is_broken):
            return (number - 1) * watch.PERIOD, problem
    return None


@pytest.mark.parametrize(
    "ranks, is_broken, limit, text",
    [
        ([{}, dict(number=3)], False, watch.LOST_SECONDS, "rank 1 on node-1 does not answer: it "),
        ([{}, dict(number=3)], True, watch.BROKEN_SECONDS, "rank 1 on node-1 does not answer: it "),
        ([LATE, AHEAD, AHEAD], False, watch.HUNG_SECONDS, "rank 0 on node-0 hangs: others have "),
        (
            [dict(is_waiting=True)] * 2,
            False,
            watch.HUNG_SECONDS,
            "The ranks on node-0, node-1 reach torchrun's store, but not each other",
        ),
    ],
    ids=["silent", "broken", "hangs", "cut"],
)
def test_lost_rank_is_named_in_time(ranks, is_broken, limit, text):
    seconds, problem = polled(*ranks, is_broken=is_broken)
    assert limit - watch.PERIOD <= seconds <= limit + 2 * watch.PERIOD
    assert problem.startswith(text)


@pytest.mark.parametrize(
    "ranks",
    [
        [{}, dict(number=3, has_left=True)],
        [LATE | dict(is_exempt=True), AHEAD],
        [LATE | dict(n_updates=1), AHEAD],
        [LATE, LATE | dict(is_waiting=True)],  # for its GPU
        [dict(is_waiting=True), lambda n: dict(is_waiting=True, n_phases=27 + n // 5)],
        [lambda n: dict(n_operations=n // 5), lambda n: dict(n_operations=1 + n // 5)],
    ],
    ids=["left", "evaluates", "compiles", "works", "gpu", "slow"],
)
def test_rank_that_only_takes_long_is_not_lost(ranks):
    assert polled(*ranks) is None


def test_slow_rank_is_given_time():
    """After a wait of 24 s that went well, one of 60 s is no longer taken for a hang."""
    detector = LossDetector()
    assert polled(LATE, AHEAD, n=13, detector=detector) is None
    later = dict(n_operations=101), dict(n_operations=102, is_waiting=True)
    assert polled(*later, n=30, detector=detector) is None
    assert polled(*later, n=60, detector=detector)


@pytest.fixture
def as_rank(monkeypatch):
    def be(rank):
        for name, text in dict(RANK=f"{rank}", WORLD_SIZE="2", LOCAL_RANK="0").items():
            monkeypatch.setenv(name, text)

    be(0)
    return be


def test_rank_that_the_store_does_not_answer_ends(as_rank, monkeypatch):
    """Although the thread that asks it, and whoever else does, is blocked for ever."""

    class Silent:
        def compare_set(self, *arguments):
            threading.Event().wait()

    for name, seconds in dict(PERIOD=0.01, SILENT_SECONDS=0.2, CALL_SECONDS=0.01).items():
        monkeypatch.setattr(watch, name, seconds)
    monkeypatch.setattr(process_group, "store", lambda name: None)
    monkeypatch.setattr(process_group.meeting, "poll", threading.Event().wait)
    has_ended, problems = threading.Event(), []
    monkeypatch.setattr(
        watch.Team,
        "end",
        lambda self, text: (problems.append(text), has_ended.set(), self._wakes.set()),
    )
    team = watch.Team()
    team.store = Silent()
    threading.Thread(target=team.await_all, daemon=True).start()
    assert has_ended.wait(60) and "where torchrun keeps the ranks' store, has not" in problems[0]
    assert team.claim()  # as no other rank can


def test_ranks_that_start_again_find_one_name(as_rank, monkeypatch):
    """Although the store still holds what the ranks of an earlier start have left."""
    store, names = distributed.HashStore(), []
    monkeypatch.setattr(process_group, "_store", lambda: store)
    for starts_first in 0, 1, 1:
        meetings = [process_group.Meeting() for _ in range(2)]

        def poll(rank, meetings=meetings):
            as_rank(rank)
            return meetings[rank].poll()

        first = poll(starts_first)
        assert first is None if starts_first else first not in names
        names.append(poll(1 - starts_first) or poll(0) and poll(1))
        assert poll(0) == poll(1) == names[-1]
    assert len({*names}) == 3
