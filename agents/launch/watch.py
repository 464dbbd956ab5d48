"""Detects ranks that were killed or cut off, in a thread of each rank, and ends the others.

Every rank writes a heartbeat to the ranks' key-value store and reads those of all. The first to
miss one tells the others. A rank that the store no longer answers ends itself. A rank that hangs
but beats is left to PyTorch's own time-outs.
"""

import contextlib
import itertools
import os
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn, TypeVar

from megastep.agents import console
from megastep.agents.distributed import environment, process_group
from megastep.agents.errors import UserError
from megastep.agents.launch import endings
from megastep.agents.runs import folders

#: Seconds between heartbeats.
PERIOD = 2.0
#: A rank is lost after this many seconds without a heartbeat; and once a connection has broken.
LOST_SECONDS, BROKEN_SECONDS = 20.0, 5.0
#: Seconds without an answer of the store after which a rank ends. Together with the seconds of its
#: last words, below a minute.
SILENT_SECONDS = 45.0
#: Seconds within which all ranks must have started.
START_SECONDS = 300.0
#: Seconds for one call that something lost may block for ever.
CALL_SECONDS = 4.0
#: The last heartbeat of a rank that is done, and what a poll finds if the store does not answer.
LEFT, SILENCE = "left", "silence"

T = TypeVar("T")

#: Numbers the teams of this process, equally on all ranks, so that each has its own keys.
NUMBERS = itertools.count()


def within(seconds: float | None, function: Callable[[], T], default: T) -> T:
    """Returns what a function returns; a default if it fails, or takes longer, in a thread."""
    values = [default]

    def call() -> None:
        with contextlib.suppress(Exception):
            values.append(function())

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(seconds)
    return values[-1]


class Team:
    """The ranks of a run, as one of them sees and monitors them, until `leave`."""

    def __init__(self) -> None:
        info = environment.rank_info()
        assert info is not None
        self.folder: Path | None = None
        self.rank, self.is_first_here = info.rank, not info.local_rank
        self.is_ours = endings.JOB in os.environ  # the store is in `launcher`, which Ctrl-Z stops
        self.keys = [f"heartbeat {number}" for number in range(info.n_ranks)]
        self.missing = [*range(info.n_ranks)]
        self.beats, self.n_silent, self.n_beats = [""] * info.n_ranks, Counter(), 0
        self.is_broken = self.has_left = False
        self._wakes = threading.Event()
        self.store = process_group.store(f"watch {next(NUMBERS)}", is_shared=False)
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    # ---- In the thread that trains ----

    def await_all(self) -> None:
        """Waits until all ranks have started. Raises UserError if some have not in time."""
        deadline = time.monotonic() + START_SECONDS
        while missing := self.missing:
            if time.monotonic() > deadline:
                raise UserError(
                    f"rank{'s' * (len(missing) > 1)} {', '.join(map(str, missing))} of "
                    f"{len(self.keys)} did not start within {START_SECONDS:.0f} s; see what "
                    "torchrun printed on the other machines"
                )
            time.sleep(0.02)

    def set_folder(self, folder: Path) -> None:
        """Tells the launcher the run folder."""
        self.folder = folder
        if self.rank == 0 and self.is_ours:
            Path(os.environ[endings.JOB], endings.RUN).write_text(str(folder))

    def claim(self) -> bool:
        """Returns True on the first rank that calls this: it reports the error, the others end."""

        def is_first() -> bool:
            return self.store.compare_set("end", "", f"{self.rank}").decode() == f"{self.rank}"

        return within(CALL_SECONDS, is_first, True)  # if the store is gone, no other can report

    def end_lost(self, loss: object) -> NoReturn:
        """Exits after a broken connection, once the lost rank is found, or cannot be."""
        self.is_broken = True
        self._thread.join(LOST_SECONDS + 2 * PERIOD)  # which ends this process
        self.end(f"A rank is lost: {loss}" if self.claim() else None)

    def leave(self, seconds: float = 0.0) -> None:
        """Stops the watch, so that this rank is not lost, and waits for rank 0 to leave, too."""
        deadline = time.monotonic() + seconds
        self.has_left = True
        self._wakes.set()
        self._thread.join(CALL_SECONDS)
        within(CALL_SECONDS, self._poll, None)
        while self.rank > 0 and self.beats[0] != LEFT and time.monotonic() < deadline:
            if within(CALL_SECONDS, self._poll, SILENCE):
                break
            time.sleep(0.1)

    # ---- In the thread of the watch ----

    def _watch(self) -> None:
        while not self._wakes.wait(0.1 if self.missing else PERIOD):
            problem = within(None if self.is_ours else SILENT_SECONDS, self._poll, SILENCE)
            if problem == SILENCE:
                if not self.is_ours and not self._wakes.wait(CALL_SECONDS):
                    problem = (
                        f"{os.environ.get('MASTER_ADDR')}, where torchrun keeps the ranks' store, "
                        "does not answer: torchrun has ended there, or that machine or the network "
                        "is down"
                    )  # which one rank of this machine reports, as others may be out of reach
                    self.end(problem if self.is_first_here else None)
                return  # `launcher` ends its ranks itself
            if problem and not self.has_left:
                if not self.claim():
                    self.end(None)
                if not self.is_ours:  # torchrun's store may end with this rank: others read first
                    time.sleep(2 * PERIOD)
                self.end(problem)

    def _poll(self) -> str | None:
        """Writes a heartbeat and reads all. Returns what has happened, None if no rank is lost."""
        self.n_beats += 1
        beat = LEFT if self.has_left else f"{self.n_beats} {environment.hostname()}"
        self.store.set(self.keys[self.rank], beat)
        if self.store.check(["end"]) and not self.has_left:
            self.end(None)
        self.missing = [n for n in self.missing if not self.store.check([self.keys[n]])]
        if self.missing:
            return None
        before = self.beats
        self.beats = [text.decode() for text in self.store.multi_get(self.keys)]
        limit = BROKEN_SECONDS if self.is_broken else LOST_SECONDS
        # counted in polls, so that no rank is lost when a machine wakes up after an hour of sleep
        for n, (old, new) in enumerate(zip(before, self.beats)):
            self.n_silent[n] = self.n_silent[n] + 1 if old == new != LEFT else 0
            if self.n_silent[n] * PERIOD > limit:
                return (
                    f"rank {n} on {new.partition(' ')[2]} does not answer: it was killed or "
                    "suspended, the system ran out of memory, or its network is down"
                )
        return None

    # ---- The end of all ranks ----

    def end(self, problem: str | None) -> NoReturn:
        """Exits at once, because a rank was lost; reports it unless another rank does."""
        # a folder on a machine that is gone blocks whoever reads it, and so may a pipe
        if problem:
            unknown = "Its run folder does not answer, so what is saved is not known"
            advice = within(CALL_SECONDS, lambda: folders.to_continue(self.folder), unknown)
            ending = endings.Ending(endings.LOST, f"{problem}. {advice}")
            within(CALL_SECONDS, lambda: endings.report_ending(ending), None)
        within(CALL_SECONDS, console.restore, None)
        os._exit(0 if problem is None and self.is_ours else endings.LOST)
