"""Detects ranks that were killed or hang, in a thread of each rank, and ends the others.

Every rank writes a heartbeat to torchrun's key-value store and reads those of all. The first to
detect a loss tells the others through the store.

A rank is lost if its heartbeat stops (it was killed or suspended, or is cut off), or if it hangs:
others have waited too long for it in a collective operation. If all wait for each other in the same
operation, they cannot reach each other. A second thread, which never touches the store, ends a rank
that the store no longer answers, whatever its other threads are blocked in.
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
from collections import Counter
from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeVar

from megastep.agents.distributed import environment, process_group

#: Seconds between heartbeats.
PERIOD = 2.0
#: A rank is lost after this many seconds without a heartbeat; and once a connection has broken.
LOST_SECONDS, BROKEN_SECONDS = 20.0, 5.0
#: A rank hangs if the others have waited this many seconds for it; and in the first two updates,
#: which compile kernels and graphs.
HUNG_SECONDS, FIRST_SECONDS = 30.0, 300.0
#: A wait may last this many times the longest earlier wait, if that is more.
PATIENCE = 5
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


class LossDetector:
    """Decides from the heartbeats of all ranks whether one is lost.

    Time is counted in polls, so no rank is lost when a machine wakes up after an hour of sleep.
    """

    def __init__(self) -> None:
        self.before: Mapping[int, Heartbeat] = {}
        self.n_silent: Counter[int] = Counter()
        self.n_stuck = self.longest = 0

    def poll(self, rows: Mapping[int, Heartbeat], is_broken: bool = False) -> str | None:
        """Compares heartbeats with those before, once every `PERIOD` seconds.

        Args:
            rows: the heartbeats, by rank.
            is_broken: a connection to a rank has broken.

        Returns:
            What has happened, a sentence without a full stop; None if no rank is lost.
        """
        before, self.before = self.before, rows
        rows = {rank: row for rank, row in rows.items() if not row.has_left and rank in before}
        for rank, row in rows.items():
            self.n_silent[rank] = self.n_silent[rank] + 1 if row == before[rank] else 0
            if self.n_silent[rank] * PERIOD > (BROKEN_SECONDS if is_broken else LOST_SECONDS):
                return (
                    f"rank {rank} on {row.host} does not answer: it was killed or suspended, the "
                    "system ran out of memory, or its network is down"
                )
        n_done = min((row.n_operations for row in rows.values()), default=0)
        late = {rank: row for rank, row in rows.items() if row.n_operations == n_done}
        is_stuck = bool(rows) and not any(
            (row.n_operations, row.n_phases) != (before[rank].n_operations, before[rank].n_phases)
            for rank, row in late.items()
        )
        if len(late) < len(rows):
            is_stuck &= not any(row.is_exempt for row in late.values())
        else:
            is_stuck &= all(row.is_waiting for row in rows.values())
        has_compiled = min((row.n_updates for row in rows.values()), default=0) > 2
        if not is_stuck:
            self.longest = max(self.longest, self.n_stuck * has_compiled)
        self.n_stuck = self.n_stuck + 1 if is_stuck else 0
        seconds = self.n_stuck * PERIOD
        limit = max(HUNG_SECONDS, PATIENCE * self.longest * PERIOD)
        if seconds <= (limit if has_compiled else FIRST_SECONDS):
            return None
        if len(late) < len(rows):
            rank, row = next(iter(late.items()))
            return f"rank {rank} on {row.host} hangs: others have waited for it for {seconds:.0f} s"
        return (
            f"The ranks on {', '.join(dict.fromkeys(row.host for row in rows.values()))} reach "
            f"torchrun's store, but not each other, and have waited for {seconds:.0f} s: a network "
            "is down, or NCCL_SOCKET_IFNAME and GLOO_SOCKET_IFNAME name another interface than the "
            "one that connects them"
        )


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
    """Monitors the ranks of this job until `leave`. Ends this rank if the store falls silent; the
    others are monitored once they start.

    Args:
        on_lost: called in a thread of the watch when a rank is lost; must end this process. Its
            argument is `rank 1 on node-7 hangs: ...` on the rank that reports the loss, None on the
            others.
        may_be_silent: the process with the store may be suspended, but ends this one if it is gone.
    """

    def __init__(self, on_lost: Callable[[str | None], None], may_be_silent: bool = False):
        info = environment.rank_info()
        assert info is not None
        self.on_lost, self.may_be_silent = on_lost, may_be_silent
        self.is_broken = self.is_gone = self.has_left = False
        self.rank, self.n_ranks = info.rank, info.n_ranks
        self.keys = [f"heartbeat {rank}" for rank in range(info.n_ranks)]
        self.number = self.n_answers = 0
        self._leaves_by = math.inf
        self._wakes = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
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
        return [rank for rank, key in enumerate(self.keys) if not self.store.check([key])]

    def claim(self) -> bool:
        """Returns True on the first rank that calls this: it reports the error, the others end."""

        def is_first() -> bool:
            return self.store.compare_set("end", "", f"{self.rank}").decode() == f"{self.rank}"

        # if the store is gone, or has not been opened, no other rank can report
        return within(CALL_SECONDS, is_first, True)

    def await_verdict(self) -> None:
        """Waits after a broken connection until the lost rank is found, which ends this process."""
        self.is_broken = True
        self._thread.join(LOST_SECONDS + 2 * PERIOD)
        if self.is_gone:
            self._end_in_silence("closed the connection")

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
        detector = LossDetector()
        try:
            while not self._wakes.wait(PERIOD):
                self._beat()
                if self.store.check(["end"]):
                    return self.on_lost(None)
                if self.store.check(self.keys):
                    problem = detector.poll(dict(enumerate(self._heartbeats())), self.is_broken)
                    if problem and not self.has_left:
                        return self._end(problem)
                self.n_answers += 1
            self._beat()
            while self.rank > 0 and time.monotonic() < self._leaves_by:
                if not self.store.check(self.keys) or self._heartbeats()[0].has_left:
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
                return self._end_in_silence(f"not answered for {n_silent * PERIOD:.0f} s")

    def _end_in_silence(self, silence: str) -> None:
        """Ends this rank. One of this machine reports it, as the others may be out of reach."""
        problem = (
            f"{os.environ.get('MASTER_ADDR')}, where torchrun keeps the ranks' store, has "
            f"{silence}: torchrun has ended there, or that machine or the network is down"
        )
        self.on_lost(problem if environment.is_first_here() else None)

    def _beat(self) -> None:
        self.number += 1
        counts = process_group.counts
        heartbeat = Heartbeat(
            self.number,
            counts.n_operations,
            counts.n_updates,
            counts.n_phases,
            counts.is_exempt,
            counts.is_waiting,
            self.has_left,
            environment.hostname(),
        )
        self.store.set(self.keys[self.rank], json.dumps(heartbeat))

    def _heartbeats(self) -> list[Heartbeat]:
        return [Heartbeat(*json.loads(text)) for text in self.store.multi_get(self.keys)]
