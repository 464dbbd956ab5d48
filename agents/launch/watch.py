"""Detects ranks that were killed or hang, in a thread of each rank, and ends the others.

Every rank writes a heartbeat to torchrun's key-value store. Each rank monitors one neighbour, the
next rank; the first to detect a loss tells all others through the store.

A rank is lost if its heartbeat stops (it was killed or suspended), or if it hangs: its neighbour
has waited too long for it in a collective operation.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

from pydantic import TypeAdapter

from megastep.agents.distributed import environment, process_group

#: Seconds between heartbeats.
PERIOD = 2.0
#: Seconds without a heartbeat, or behind the neighbour, after which a rank is lost; and seconds
#: without a heartbeat if a connection has broken.
LOST_SECONDS, BROKEN_SECONDS = 20.0, 5.0
#: Seconds that a rank may be behind in the first two updates, which compile kernels and graphs.
FIRST_SECONDS = 300.0
#: A rank may be behind for this many times the longest wait so far that ended well.
PATIENCE = 5
#: Seconds that a rank may still take to save and end after the store is gone.
LAST_SECONDS = 60.0

#: Counts the watches of this process, in step on all ranks: each watch has its own keys.
NUMBERS = itertools.count()


class Heartbeat(NamedTuple):
    """The progress of a rank.

    Attributes:
        number: counts heartbeats.
        n_operations: collective operations started.
        n_updates: updates started.
        is_exempt: the others wait for it however long it takes, as for an evaluation.
        has_left: it is done.
        host: name of its machine.
    """

    number: int
    n_operations: int
    n_updates: int
    is_exempt: bool
    has_left: bool
    host: str


HEARTBEAT = TypeAdapter(Heartbeat)


class LossDetector:
    """Decides from the heartbeats of two ranks whether the other one is lost.

    Time is counted in polls, so that a machine may sleep for an hour without losing a rank.
    """

    def __init__(self) -> None:
        self.last = None
        self.n_silent = self.n_ahead = self.longest = 0

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
            return "does not answer: it was killed or suspended, or the system ran out of memory"
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


class Watch:
    """Monitors the ranks of this process group, from `start` to `leave`.

    Args:
        on_lost: called in the watch's thread when a rank is lost; must end this process. Its
            argument is `rank 1 on node-7 hangs: ...` on the rank that reports the loss, None on the
            others.
    """

    def __init__(self, on_lost: Callable[[str | None], None]):
        self.on_lost = on_lost
        self.is_broken = self.has_left = False
        self.rank, self.n_ranks = process_group.rank(), process_group.n_ranks()
        self.number = 0
        self._wakes = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        info = environment.rank_info()
        assert info is not None
        self.store = process_group.store(f"watch {info.attempt} {next(NUMBERS)}")
        self._beat()
        self._thread.start()

    def claim(self) -> bool:
        """Returns True on the first rank that calls this: it reports the error, the others end."""
        with contextlib.suppress(RuntimeError):  # the store is gone, so no other rank can report
            return self.store.compare_set("end", "", f"{self.rank}").decode() == f"{self.rank}"
        return True

    def await_verdict(self) -> None:
        """Waits after a broken connection until the lost rank is found, which ends this process."""
        self.is_broken = True
        with contextlib.suppress(RuntimeError):
            self.store.set("broken", "1")
        self._thread.join(LOST_SECONDS + 2 * PERIOD)

    def leave(self, seconds: float = 0.0) -> None:
        """Stops the watch; this rank no longer counts as lost.

        Args:
            seconds: how long to wait for rank 0 to leave, too.
        """
        self.has_left = True
        self._wakes.set()
        if self._thread.is_alive():
            self._thread.join(PERIOD)
        with contextlib.suppress(RuntimeError):  # the store is gone
            self._beat()
            deadline = time.monotonic() + seconds
            while self.rank > 0 and time.monotonic() < deadline:
                if (first := self._heartbeat_of(0)) is None or first.has_left:
                    break
                time.sleep(0.1)

    def _run(self) -> None:
        detector, other = LossDetector(), (self.rank + 1) % self.n_ranks
        while not self.has_left:
            self._wakes.wait(PERIOD)
            if self.has_left:
                return
            try:
                ours = self._beat()
                if self.store.check(["end"]):
                    return self.on_lost(None)
                self.is_broken |= self.store.check(["broken"])
                theirs = self._heartbeat_of(other)
                problem = detector.poll(ours, theirs, self.is_broken) if theirs else None
                if theirs and problem and not self.has_left:
                    label = f"rank {other} on {theirs.host}"
                    return self.on_lost(f"{label} {problem}" if self.claim() else None)
            except RuntimeError:  # the store is gone, with torchrun or the machine of rank 0
                os.kill(os.getpid(), signal.SIGTERM)
                self._wakes.wait(LAST_SECONDS)
                return None if self.has_left else self.on_lost(None)

    def _beat(self) -> Heartbeat:
        self.number += 1
        heartbeat = Heartbeat(
            self.number,
            process_group.counts.n_operations,
            process_group.counts.n_updates,
            process_group.counts.is_exempt,
            self.has_left,
            process_group.hostname(),
        )
        self.store.set(f"heartbeat {self.rank}", json.dumps(heartbeat))
        return heartbeat

    def _heartbeat_of(self, rank) -> Heartbeat | None:
        name = f"heartbeat {rank}"
        if not self.store.check([name]):
            return None
        try:
            return HEARTBEAT.validate_json(self.store.get(name))
        except ValueError:  # which no rank has written
            return None
