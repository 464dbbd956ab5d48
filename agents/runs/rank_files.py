"""Collects the states of all ranks in one checkpoint. Each rank but 0 writes a file beside the
checkpoints; rank 0, which writes the checkpoint, moves the files into it.
"""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from megastep.agents.runs import checkpoint_format
from megastep.agents.runs.atomic_files import write_atomically

if TYPE_CHECKING:
    from megastep.agents.types import Row, StateDict

#: Seconds that rank 0 waits for the other ranks' files.
SECONDS = 60.0


class RankFiles:
    """The ranks' files of one launch of a run.

    Args:
        folder: the run's `checkpoints` folder, which all ranks share.
        launch: name of this launch, the same on all ranks. Rank 0 deletes files of other launches.
        rank: this rank.
        n_ranks: number of ranks.
    """

    def __init__(self, folder: Path, launch: str = "", rank: int = 0, n_ranks: int = 1):
        self.folder, self.launch, self.rank, self.n_ranks = folder, launch, rank, n_ranks
        self._is_given_up = threading.Event()
        if rank == 0:
            self._delete_leftovers()

    def _delete_leftovers(self) -> None:
        for path in self.folder.glob(".rank*"):
            with contextlib.suppress(OSError):
                path.unlink()

    def _paths(self, rank, number) -> tuple[Path, Path]:
        """Returns the paths of a rank's state and of its manifest entry, which is written last."""
        name = f".rank{rank}-{self.launch}-{number}"
        return self.folder / f"{name}.pt", self.folder / f"{name}.json"

    def hand_in(self, number: int, state: StateDict, replay_seconds: float | None = None) -> None:
        """Writes this rank's file: its state without the policy's weights, which rank 0 saves.

        Args:
            number: number of the checkpoint, the same on all ranks.
            state, replay_seconds: as for `checkpoint.save`.

        Raises:
            OSError: the disk is full or not writable.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        own = {name: part for name, part in state.items() if name != "policy"}
        path, entry_path = self._paths(self.rank, number)
        try:
            entry = checkpoint_format.write_state(path, own, replay_seconds)
            write_atomically(entry_path, json.dumps(entry).encode())
        except BaseException:
            path.unlink(missing_ok=True)
            raise

    def collect(self, number: int, folder: Path) -> Row:
        """Waits for the other ranks' files and moves them into a checkpoint, as `rank1.pt` and so
        on. Returns their manifest entries by name.

        Args:
            number: number of the checkpoint.
            folder: the checkpoint's folder.

        Raises:
            OSError: a rank did not write its file in time.
        """
        entries, deadline = {}, time.monotonic() + SECONDS
        for rank in range(1, self.n_ranks):
            path, entry_path = self._paths(rank, number)
            while not entry_path.exists():
                if self._is_given_up.wait(0.02) or time.monotonic() > deadline:
                    raise OSError(f"rank {rank} did not write its state within {SECONDS:.0f} s")
            name = checkpoint_format.rank_file(rank)
            entries[name] = json.loads(entry_path.read_bytes())
            os.replace(path, folder / name)
            entry_path.unlink()
        return entries

    @property
    def is_given_up(self) -> bool:
        """True if another rank has ended and will write no file."""
        return self._is_given_up.is_set()

    def give_up(self) -> None:
        """Makes `collect` stop waiting, because another rank has ended."""
        self._is_given_up.set()
