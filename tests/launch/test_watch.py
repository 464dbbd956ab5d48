"""A rank that was killed or hangs is found, and one that only takes long is not."""

import threading
import time

import pytest
from torch import distributed

from megastep.agents.launch import watch
from megastep.agents.launch.watch import Heartbeat, LossDetector


def heartbeat(number, n_operations=100, n_updates=9, host="node-7", **flags):
    flags = dict(n_phases=27, is_exempt=False, is_waiting=False, has_left=False) | flags
    return Heartbeat(number, n_operations, n_updates, host=host, **flags)


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


@pytest.fixture
def two(monkeypatch):
    """The watch of rank 0 of two, which has not started."""
    for name, text in dict(RANK="0", WORLD_SIZE="2", LOCAL_RANK="0").items():
        monkeypatch.setenv(name, text)
    monkeypatch.setattr(watch, "PERIOD", 0.01)
    one = watch.Watch(lambda problem: None)
    one.store = distributed.HashStore()
    return one


def test_ranks_that_all_wait_in_one_operation_cannot_reach_each_other(two):
    detector = LossDetector()
    for number in range(5):
        pair = [heartbeat(number, host=f"node-{rank}", is_waiting=True) for rank in range(2)]
        assert detector.poll(*pair, False) is None
    assert detector.n_stalled == 4
    for others, is_stalled in (
        (dict(is_waiting=True), True),
        (dict(is_waiting=False), False),
        (dict(is_waiting=True, n_operations=101), False),
    ):
        beats = heartbeat(4, host="node-0", is_waiting=True), heartbeat(4, host="node-1", **others)
        for rank, beat in enumerate(beats):
            two.store.set(f"heartbeat {rank}", watch.json.dumps(beat))
        problem = two._stall(beats[0])
        assert bool(problem) == is_stalled
        assert not problem or problem.startswith("The ranks on node-0, node-1 reach torchrun's ")
    assert detector.poll(*beats, False) is None and detector.n_stalled == 0
    for number in range(3):  # the neighbour's GPU goes on, so only this host is far ahead of it
        pair = [heartbeat(number, is_waiting=True, n_phases=27 + number) for _ in range(2)]
        assert detector.poll(*pair, False) is None and detector.n_stalled == 0


def test_rank_that_the_store_does_not_answer_ends(two, monkeypatch):
    """Although the thread that asks it, and whoever else does, is blocked for ever."""

    class Silent:
        def compare_set(self, *arguments):
            threading.Event().wait()

    monkeypatch.setattr(watch, "SILENT_SECONDS", 0.2)
    monkeypatch.setattr(watch, "CALL_SECONDS", 0.01)
    monkeypatch.setattr(watch.process_group.meeting, "poll", threading.Event().wait)
    two.store = Silent()
    has_ended, seconds = threading.Event(), []
    two.on_silence = lambda silent: (seconds.append(silent), has_ended.set())
    two.start()
    threading.Thread(target=two.missing, daemon=True).start()
    assert has_ended.wait(60) and 0.2 < seconds[0] < 0.3
    assert two.claim()  # as no other rank can
    two._thread = threading.Thread(target=threading.Event().wait, daemon=True)
    two._thread.start()
    two.leave()


@pytest.mark.parametrize("may_be_silent", [False, True])
def test_rank_that_reports_a_loss_waits_until_others_have_read_it(two, monkeypatch, may_be_silent):
    """If torchrun's store ends with the first, the others are blocked in an operation for longer.
    The launcher's store does not.
    """
    steps = []
    monkeypatch.setattr(watch.time, "sleep", lambda s: steps.append((s, two.store.get("end"))))
    two.on_lost, two.may_be_silent = steps.append, may_be_silent
    two._end("rank 1 hangs")
    two.rank = 1
    two._end("rank 0 hangs")
    pause = [] if may_be_silent else [(2 * watch.PERIOD, b"0")]
    assert steps == [*pause, "rank 1 hangs", None]


def test_store_of_a_launcher_that_is_suspended_may_be_silent(two, monkeypatch):
    monkeypatch.setattr(watch, "SILENT_SECONDS", 0.05)
    has_ended = threading.Event()
    two.on_silence, two.may_be_silent = lambda seconds: has_ended.set(), True
    threading.Thread(target=two._guard, daemon=True).start()
    assert not has_ended.wait(0.5)
    two.is_gone = True
    assert has_ended.wait(60)


def test_calls_have_a_deadline():
    assert watch.within(60, lambda: 3, None) == 3
    assert watch.within(60, lambda: 1 / 0, "default") == "default"
    began = time.monotonic()
    assert watch.within(0.01, threading.Event().wait, "default") == "default"
    assert time.monotonic() - began < 30


def test_ranks_that_start_again_find_one_name(monkeypatch):
    """Although the store still holds what the ranks of an earlier start have left."""
    store, names = distributed.HashStore(), []
    monkeypatch.setattr(watch.process_group, "_store", lambda: store)
    for starts_first in 0, 1, 1:
        meetings = [watch.process_group.Meeting() for _ in range(2)]

        def poll(rank, meetings=meetings):
            for name, text in dict(RANK=f"{rank}", WORLD_SIZE="2", LOCAL_RANK="0").items():
                monkeypatch.setenv(name, text)
            return meetings[rank].poll()

        first = poll(starts_first)
        assert first is None if starts_first else first not in names
        names.append(poll(1 - starts_first) or poll(0) and poll(1))
        assert poll(0) == poll(1) == names[-1]
    assert len({*names}) == 3
