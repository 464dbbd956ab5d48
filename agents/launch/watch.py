"""Finds ranks that were killed or hang, from a thread of each rank, and ends the others.

Every rank writes a heartbeat into torchrun's key-value store, and reads that of the next rank. So
does each know of one other, however many there are, and the first that misses one tells them all.

A rank is lost if its heartbeat stops: it was killed, or stopped. It is lost as well if it hangs,
that is if another has for some time been ahead of it in the operations that all ranks take part in.
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

#: Seconds between two heartbeats.
PERIOD = 2.0
#: Seconds without a heartbeat, or behind another rank, after which a rank is lost; and without a
#: heartbeat once a connection has broken.
LOST_SECONDS, BROKEN_SECONDS = 20.0, 5.0
#: Seconds behind another rank in the first two updates: kernels are compiled, graphs recorded.
FIRST_SECONDS = 300.0
#: An operation that once took long and went well may take so many times as long.
PATIENCE = 5
#: Seconds in which a rank may still save and end once the store is gone.
LAST_SECONDS = 60.0

#: Numbers of the watches in this process, equal on all ranks: each watch has keys of its own.
NUMBERS = itertools.count()


class Heartbeat(NamedTuple):
    """What a rank says of itself.

    Attributes:
        number: counts heartbeats.
        n_operations: number of operations of all ranks that it has begun.
        n_updates: number of updates that it has begun.
        is_exempt: it does something that others wait for, such as an evaluation.
        has_left: it is done.
        host: its machine.
    """

    number: int
    n_operations: int
    n_updates: int
    is_exempt: bool
    has_left: bool
    host: str


HEARTBEAT = TypeAdapter(Heartbeat)


class Patience:
    """Tells when another rank is lost, from its heartbeats and our own.

    Time is counted in looks, not by a clock: a machine that sleeps for an hour loses no rank.
    """

    def __init__(self):
        self.last = None
        self.n_silent = self.n_ahead = self.longest = 0

    def look(self, ours: Heartbeat, theirs: Heartbeat, is_broken: bool) -> str | None:
        """Returns what has become of the other rank, None if nothing is wrong.

        Args:
            is_broken: a connection to some rank has broken.
        """
        before, self.last = self.last, theirs
        if theirs.has_left or before is None:
            return None
        self.n_silent = self.n_silent + 1 if theirs == before else 0
        if self.n_silent * PERIOD > (BROKEN_SECONDS if is_broken else LOST_SECONDS):
            return "does not answer: it was killed, or stopped, or the system ran out of memory"
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
    """Watches over the ranks of this process group, from `start` to `leave`.

    Args:
        on_lost: is called in a thread with `rank 1 on node-7 hangs: ...` if this rank is the first
            to find it, with None otherwise, and ends this process.
    """

    def __init__(self, on_lost: Callable[[str | None], None]):
        self.on_lost = on_lost
        self.is_broken = self.has_left = False
        self.rank, self.n_ranks = process_group.rank(), process_group.n_ranks()
        self.number = 0
        self._wakes = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        attempt = environment.launched().attempt
        self.store = process_group.store(f"watch {attempt} {next(NUMBERS)}")
        self._beat()
        self._thread.start()

    def claim(self) -> bool:
        """Returns whether this rank is the first to tell of an error. The others end then."""
        with contextlib.suppress(RuntimeError):  # the store is gone, so nobody else can tell
            return self.store.compare_set("end", "", f"{self.rank}").decode() == f"{self.rank}"
        return True

    def await_verdict(self) -> None:
        """Waits until the lost rank is found, which ends this process, after a connection broke."""
        self.is_broken = True
        with contextlib.suppress(RuntimeError):
            self.store.set("broken", "1")
        self._thread.join(LOST_SECONDS + 2 * PERIOD)

    def leave(self, seconds: float = 0.0) -> None:
        """Ends the watch: the others may go on without this rank.

        Args:
            seconds: how long to wait for rank 0 to leave as well.
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

    def _run(self):
        patience, other = Patience(), (self.rank + 1) % self.n_ranks
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
                problem = theirs and patience.look(ours, theirs, self.is_broken)
                if problem and not self.has_left:
                    place = f"rank {other} on {theirs.host}"
                    return self.on_lost(f"{place} {problem}" if self.claim() else None)
            except RuntimeError:  # the store has ended, with torchrun or the machine of rank 0
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
