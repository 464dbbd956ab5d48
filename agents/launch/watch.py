"""Detects ranks that were killed or hang, in a thread of each rank, and ends the others.

Every rank writes a heartbeat to torchrun's key-value store. Each rank monitors one neighbour, the
next rank; the first to detect a loss tells all others through the store.

A rank is lost if its heartbeat stops (it was killed or suspended, or is cut off), or if it hangs:
its neighbour has waited too long for it in a collective operation. If all wait for each other in
the same operation, they cannot reach each other. A second thread, which never touches the store,
ends a rank that the store no longer answers, whatever its other threads are blocked in.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import signal
import threading
import time
from collections.abc import Callable
from typing import NamedTuple, TypeVar

from pydantic import TypeAdapter

from megastep.agents.distributed import environment, process_group

#: Seconds between heartbeats.
PERIOD = 2.0
#: A rank is lost after this many seconds without a heartbeat, or while its neighbour waits for it.
LOST_SECONDS = 20.0
#: The same for heartbeats, once a connection has broken.
BROKEN_SECONDS = 5.0
#: Seconds to wait for a rank in the first two updates, which compile kernels and graphs.
FIRST_SECONDS = 300.0
#: A wait may last this many times the longest earlier wait, if that is more.
PATIENCE = 5
#: Seconds that all ranks may wait for each other in the same operation.
STALLED_SECONDS = 40.0
#: Seconds without an answer of the store after which a rank ends. Together with the seconds of its
#: last words, below a minute.
SILENT_SECONDS = 45.0
#: Seconds for one call that something lost may block for ever.
CALL_SECONDS = 4.0

T = TypeVar("T")

#: Numbers the watches of this process, equally on all ranks, so that each has its own keys.
NUMBERS = itertools.count()


class Heartbeat(NamedTuple):
    """The progress of a rank.

    Attributes:
        number: counts heartbeats.
        n_operations: collective operations started.
        n_updates: updates started.
        n_phases: phases of updates that its GPU has finished.
        is_exempt: True while the others wait for it without limit, as during an evaluation.
        is_waiting: True while it waits for the other ranks.
        has_left: True once it is done and no longer monitored.
        host: name of its machine.
    """

    number: int
    n_operations: int
    n_updates: int
    n_phases: int
    is_exempt: bool
    is_waiting: bool
    has_left: bool
    host: str


HEARTBEAT = TypeAdapter(Heartbeat)


class LossDetector:
    """Decides whether the neighbouring rank is lost, from its heartbeats and this rank's.

    Time is counted in polls, so no rank is lost when a machine wakes up after an hour of sleep.
    """

    def __init__(self) -> None:
        self.last = None
        self.n_silent = self.n_ahead = self.n_stalled = self.longest = 0

    def poll(self, ours: Heartbeat, theirs: Heartbeat, is_broken: bool) -> str | None:
        """Compares two heartbeats, once every `PERIOD` seconds.

        Args:
            ours: heartbeat of this rank.
            theirs: heartbeat of the monitored rank.
            is_broken: a connection to any rank has broken.

        Returns:
            What happened to the other rank, as the rest of a sentence; None if it is not lost.
        """
        before, self.last = self.last, theirs
        if theirs.has_left or before is None:
            return None
        self.n_silent = self.n_silent + 1 if theirs == before else 0
        if self.n_silent * PERIOD > (BROKEN_SECONDS if is_broken else LOST_SECONDS):
            return (
                "does not answer: it was killed or suspended, the system ran out of memory, or its "
                "network is down"
            )
        is_stalled = ours.is_waiting and theirs.is_waiting and before.is_waiting
        is_stalled &= ours.n_operations == theirs.n_operations == before.n_operations
        is_stalled &= theirs.n_phases == before.n_phases
        self.n_stalled = self.n_stalled + 1 if is_stalled else 0
        is_ahead = ours.n_operations > theirs.n_operations and not theirs.is_exempt
        if is_ahead and theirs.n_operations == before.n_operations:
            self.n_ahead += 1
        else:
            if min(ours.n_updates, theirs.n_updates) > 2:
                self.longest = max(self.longest, self.n_ahead)
            self.n_ahead = 0
        seconds = max(LOST_SECONDS, PATIENCE * self.longest * PERIOD)
        if min(ours.n_updates, theirs.n_updates) <= 2:
            seconds = FIRST_SECONDS
        if self.n_ahead * PERIOD > seconds:
            waited = round(self.n_ahead * PERIOD)
            return f"hangs: the others have waited for it for {waited} s"
        return None


def within(seconds: float, function: Callable[[], T], default: T) -> T:
    """Returns what a function returns, or a default if that takes longer or fails.

    Calls it in a thread, which is left behind if it is blocked.
    """
    values = [default]

    def call() -> None:
        with contextlib.suppress(Exception):
            values.append(function())

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(seconds)
    return values[-1]


class Watch:
    """Monitors the ranks of this job, from `start` to `leave`.

    Args:
        on_lost: called in a thread of the watch when a rank is lost; must end this process. Its
            argument is `rank 1 on node-7 hangs: ...` on the rank that reports the loss, None on the
            others.
        on_silence: called, as `on_lost`, when the store has not answered for so many seconds.
        may_be_silent: the process with the store may be suspended, but ends this one if it is gone.
    """

    def __init__(
        self,
        on_lost: Callable[[str | None], None],
        on_silence: Callable[[float], None] = lambda seconds: None,
        may_be_silent: bool = False,
    ):
        info = environment.rank_info()
        assert info is not None
        self.on_lost, self.on_silence, self.may_be_silent = on_lost, on_silence, may_be_silent
        self.is_broken = self.is_gone = self.has_left = False
        self.rank, self.n_ranks = info.rank, info.n_ranks
        self.number = self.n_answers = 0
        self._leaves_by = math.inf
        self._wakes = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Ends this rank if the store falls silent. The others are monitored once they start."""
        threading.Thread(target=self._guard, daemon=True).start()

    def missing(self) -> list[int]:
        """Returns the ranks that have not started yet. Each rank calls this until all have."""
        name = process_group.meeting.poll()
        self.n_answers += 1
        if name is None:
            return [0]
        if self._thread.ident is None:
            self.store = process_group.store(f"watch {name} {next(NUMBERS)}")
            self._beat()
            self._thread.start()
        ranks = range(self.n_ranks)
        if self.store.check([_key(rank) for rank in ranks]):
            return []
        return [rank for rank in ranks if not self.store.check([_key(rank)])]

    def claim(self) -> bool:
        """Returns True on the first rank that calls this: it reports the error, the others end."""

        def is_first() -> bool:
            return self.store.compare_set("end", "", f"{self.rank}").decode() == f"{self.rank}"

        # if the store is gone, or has not been opened, no other rank can report
        return within(CALL_SECONDS, is_first, True)

    def await_verdict(self) -> None:
        """Waits after a broken connection until the lost rank is found, which ends this process."""
        self.is_broken = True
        within(CALL_SECONDS, lambda: self.store.set("broken", "1"), None)
        self._thread.join(LOST_SECONDS + 2 * PERIOD)

    def leave(self, seconds: float = 0.0) -> None:
        """Stops the watch; this rank no longer counts as lost.

        Args:
            seconds: how long to wait for rank 0 to leave, too.
        """
        self._leaves_by = time.monotonic() + seconds
        self.has_left = True
        self._wakes.set()
        if self._thread.is_alive():
            self._thread.join(seconds + CALL_SECONDS)

    def _run(self) -> None:
        detector, other = LossDetector(), (self.rank + 1) % self.n_ranks
        try:
            while not self._wakes.wait(PERIOD):
                ours = self._beat()
                if self.store.check(["end"]):
                    return self.on_lost(None)
                self.is_broken |= self.store.check(["broken"])
                theirs = self._heartbeat_of(other)
                problem = detector.poll(ours, theirs, self.is_broken) if theirs else None
                if theirs and problem and not self.has_left:
                    label = f"rank {other} on {theirs.host}"
                    return self._end(f"{label} {problem}")
                if detector.n_stalled * PERIOD > STALLED_SECONDS and self.rank == 0:
                    if problem := self._stall(ours):
                        return self._end(problem)
                self.n_answers += 1
            self._beat()
            while self.rank > 0 and time.monotonic() < self._leaves_by:
                if (first := self._heartbeat_of(0)) is None or first.has_left:
                    break
                time.sleep(0.1)
        except RuntimeError:  # the store is gone, with torchrun or the machine of rank 0
            self.is_gone = True
            if not self.has_left:
                # saves, as SIGTERM would, but bears one of torchrun's after it
                os.kill(os.getpid(), signal.SIGUSR1)

    def _end(self, problem: str) -> None:
        """Ends all ranks. The first to call this reports what has happened."""
        if not self.claim():
            return self.on_lost(None)
        if not self.may_be_silent:  # torchrun's store may end with this rank: the others read first
            time.sleep(2 * PERIOD)
        self.on_lost(problem)

    def _guard(self) -> None:
        # counts polls, as a suspended job may go on later
        n_silent, n_answers = 0, 0
        while not self._wakes.wait(PERIOD):
            may_be_silent = self.may_be_silent and not self.is_gone
            n_silent = n_silent + 1 if self.n_answers == n_answers and not may_be_silent else 0
            n_answers = self.n_answers
            if n_silent * PERIOD > SILENT_SECONDS:
                return self.on_silence(n_silent * PERIOD)

    def _stall(self, ours: Heartbeat) -> str | None:
        """Returns what is wrong if all ranks wait in the same operation; None otherwise."""
        hosts = {}
        for rank in range(self.n_ranks):
            theirs = self._heartbeat_of(rank)
            if not (theirs and theirs.is_waiting and theirs.n_operations == ours.n_operations):
                return None
            hosts[theirs.host] = None
        return (
            f"The ranks on {', '.join(hosts)} reach torchrun's store, but not each other, and have "
            f"waited for {STALLED_SECONDS:.0f} s: a network is down, or NCCL_SOCKET_IFNAME and "
            "GLOO_SOCKET_IFNAME name another interface than the one that connects them"
        )

    def _beat(self) -> Heartbeat:
        self.number += 1
        heartbeat = Heartbeat(
            self.number,
            process_group.counts.n_operations,
            process_group.counts.n_updates,
            process_group.counts.n_phases,
            process_group.counts.is_exempt,
            process_group.counts.is_waiting,
            self.has_left,
            process_group.hostname(),
        )
        self.store.set(_key(self.rank), json.dumps(heartbeat))
        return heartbeat

    def _heartbeat_of(self, rank) -> Heartbeat | None:
        if not self.store.check([_key(rank)]):
            return None
        try:
            return HEARTBEAT.validate_json(self.store.get(_key(rank)))
        except ValueError:  # written by something other than a rank
            return None


def _key(rank) -> str:
    return f"heartbeat {rank}"
