"""Detects ranks that were killed or hang, in a thread of each rank, and ends the others.

Every rank writes a heartbeat to the ranks' key-value store and reads those of all. The first to
detect a loss tells the others through the store. A rank is lost if its heartbeat stops, or if
others have waited too long for it in a collective operation. A second thread, which never touches
the store, ends a rank that the store no longer answers, whatever its other threads are blocked in.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import math
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NoReturn, TypeVar

from megastep.agents import console
from megastep.agents.distributed import environment, process_group
from megastep.agents.distributed.process_group import Heartbeat, counts
from megastep.agents.errors import UserError
from megastep.agents.launch import endings

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
#: Seconds after which ranks that have not started yet are named.
NOTICE_SECONDS = 30.0
#: Seconds for one call that something lost may block for ever.
CALL_SECONDS = 4.0

T = TypeVar("T")

#: Numbers the teams of this process, equally on all ranks, so that each has its own keys.
NUMBERS = itertools.count()


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
        rows = {n: row for n, row in rows.items() if not row.has_left and n in before}
        if not rows:
            return None
        for n, row in rows.items():
            self.n_silent[n] = self.n_silent[n] + 1 if row == before[n] else 0
            if self.n_silent[n] * PERIOD > (BROKEN_SECONDS if is_broken else LOST_SECONDS):
                return (
                    f"rank {n} on {row.host} does not answer: it was killed or suspended, the "
                    "system ran out of memory, or its network is down"
                )
        n_done = min(row.n_operations for row in rows.values())
        late = {n: row for n, row in rows.items() if row.n_operations == n_done}
        is_stuck = all(
            (row.n_operations, row.n_phases) == (before[n].n_operations, before[n].n_phases)
            for n, row in late.items()
        )
        if len(late) < len(rows):
            is_stuck &= not any(row.is_exempt for row in late.values())
        else:
            is_stuck &= all(row.is_waiting for row in rows.values())
        has_compiled = min(row.n_updates for row in rows.values()) > 2
        if has_compiled and not is_stuck:
            self.longest = max(self.longest, self.n_stuck)
        self.n_stuck = self.n_stuck + 1 if is_stuck else 0
        seconds = self.n_stuck * PERIOD
        limit = max(HUNG_SECONDS, PATIENCE * self.longest * PERIOD)
        if seconds <= (limit if has_compiled else FIRST_SECONDS):
            return None
        if len(late) < len(rows):
            n, row = next(iter(late.items()))
            return f"rank {n} on {row.host} hangs: others have waited for it for {seconds:.0f} s"
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


class Team:
    """The ranks of a training run, as one of them sees and monitors them, until `leave`.

    Attributes:
        folder: the run folder, once it is known.
    """

    def __init__(self) -> None:
        info = environment.rank_info()
        assert info is not None
        self.folder: Path | None = None
        self.rank, self.n_ranks, self.is_first_here = info.rank, info.n_ranks, not info.local_rank
        self.is_ours = endings.JOB in os.environ
        self.is_broken = counts.has_left = False
        self.keys = [f"heartbeat {number}" for number in range(info.n_ranks)]
        self.n_answers = 0
        self._leaves_by = math.inf
        self._wakes = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._job = process_group.store("job")
        if not self.is_ours:  # the store is in `launcher`, which Ctrl-Z suspends
            threading.Thread(target=self._watch_store, daemon=True).start()

    # ---- In the thread that trains ----

    def await_all(self) -> None:
        """Waits until all ranks have started. Raises UserError if some have not in time."""
        began, has_warned = time.monotonic(), False
        while missing := self._missing():
            seconds = time.monotonic() - began
            problem = (
                f"rank{'s' * (len(missing) > 1)} {', '.join(map(str, missing))} of {self.n_ranks} "
                f"did not start within {seconds:.0f} s; see what torchrun printed on the other "
                "machines"
            )
            if seconds > process_group.START_SECONDS:
                raise UserError(problem)
            if seconds > NOTICE_SECONDS and not has_warned and self.is_first_here:
                console.warn(f"{problem}. Waiting on")
                has_warned = True
            time.sleep(0.1)

    def _missing(self) -> list[int]:
        """Returns the ranks that have not started yet. Each rank calls this until all have."""
        name = process_group.meeting.poll()
        self.n_answers += 1
        if name is None:
            return [0]
        if self._thread.ident is None:
            self.store = process_group.store(f"watch {name} {next(NUMBERS)}", is_shared=False)
            self._beat()
            self._thread.start()
        return [number for number, key in enumerate(self.keys) if not self.store.check([key])]

    def set_folder(self, folder: Path) -> None:
        """Publishes the run folder to restarted ranks and to the launcher."""
        self.folder = folder
        if self.rank == 0:
            self._job.set("folder", str(folder))
            if self.is_ours:
                Path(os.environ[endings.JOB], endings.RUN).write_text(str(folder))

    def earlier_folder(self) -> Path | None:
        """Returns the run folder of an earlier attempt, if the ranks were restarted."""
        folder = self._job.get("folder").decode() if self._job.check(["folder"]) else ""
        return Path(folder) if folder else None

    def finish(self) -> None:
        """Leaves the run, which is done: another of this process does not continue it."""
        if self.rank == 0:
            self._job.set("folder", "")
        self.leave()

    def claim(self) -> bool:
        """Returns True on the first rank that calls this: it reports the error, the others end."""

        def is_first() -> bool:
            return self.store.compare_set("end", "", f"{self.rank}").decode() == f"{self.rank}"

        # if the store is gone, or has not been opened, no other rank can report
        return within(CALL_SECONDS, is_first, True)

    def end_lost(self, loss: object) -> NoReturn:
        """Exits after a broken connection, once the lost rank is found, or cannot be."""
        self.is_broken = True
        self._thread.join(LOST_SECONDS + 2 * PERIOD)  # which ends this process
        self.end(f"A rank is lost: {loss}" if self.claim() else None)

    def leave(self, seconds: float = 0.0) -> None:
        """Stops the watch; this rank no longer counts as lost.

        Args:
            seconds: how long to wait for rank 0 to leave, too.
        """
        self._leaves_by = time.monotonic() + seconds
        counts.has_left = True
        self._wakes.set()
        if self._thread.is_alive():
            self._thread.join(seconds + CALL_SECONDS)

    # ---- In threads of the watch ----

    def _watch(self) -> None:
        detector = LossDetector()
        try:
            while not self._wakes.wait(PERIOD):
                self._beat()
                if self.store.check(["end"]):
                    self.end(None)
                if self.store.check(self.keys):
                    problem = detector.poll(dict(enumerate(self._heartbeats())), self.is_broken)
                    if problem and not counts.has_left:
                        self._end_all(problem)
                self.n_answers += 1
            self._beat()
            while self.rank > 0 and time.monotonic() < self._leaves_by:
                if not self.store.check(self.keys) or self._heartbeats()[0].has_left:
                    break
                time.sleep(0.1)
        except RuntimeError:  # the store is gone; `launcher` ends its ranks itself
            if not self.is_ours and not self._wakes.wait(CALL_SECONDS):
                self._end_in_silence("closed the connection")

    def _watch_store(self) -> None:
        n_silent, n_answers = 0, 0
        while not self._wakes.wait(PERIOD):
            n_silent = n_silent + 1 if self.n_answers == n_answers else 0
            n_answers = self.n_answers
            if n_silent * PERIOD > SILENT_SECONDS:
                self._end_in_silence(f"not answered for {n_silent * PERIOD:.0f} s")

    def _beat(self) -> None:
        counts.number += 1
        self.store.set(self.keys[self.rank], json.dumps(dataclasses.asdict(counts)))

    def _heartbeats(self) -> list[Heartbeat]:
        return [Heartbeat(**json.loads(text)) for text in self.store.multi_get(self.keys)]

    # ---- The end of all ranks ----

    def _end_all(self, problem: str) -> NoReturn:
        """Ends all ranks. The first to call this reports what has happened."""
        if not self.claim():
            self.end(None)
        if not self.is_ours:  # torchrun's store may end with this rank: the others read first
            time.sleep(2 * PERIOD)
        self.end(problem)

    def _end_in_silence(self, silence: str) -> NoReturn:
        """Ends this rank. One of this machine reports it, as the others may be out of reach."""
        problem = (
            f"{os.environ.get('MASTER_ADDR')}, where torchrun keeps the ranks' store, has "
            f"{silence}: torchrun has ended there, or that machine or the network is down"
        )
        self.end(problem if self.is_first_here else None)

    def end(self, problem: str | None) -> NoReturn:
        """Exits at once, because a rank was lost.

        Args:
            problem: what to report; None if another rank reports it.
        """
        # a folder on a machine that is gone blocks whoever reads it, and so may a pipe
        if problem:
            unknown = "Its run folder does not answer, so what is saved is not known"
            advice = within(CALL_SECONDS, lambda: endings.hint(self.folder), unknown)
            ending = endings.Ending(endings.LOST, f"{problem}. {advice}")
            within(CALL_SECONDS, lambda: endings.report_ending(ending), None)
        within(CALL_SECONDS, console.restore, None)
        os._exit(0 if problem is None and self.is_ours else endings.LOST)
