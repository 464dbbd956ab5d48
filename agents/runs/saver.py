"""Saves checkpoints of a run in the background, with the states of all ranks."""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import threading
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch.utils._pytree import tree_leaves

from megastep.agents.algorithms.nonfinite import NonFiniteError, nonfinite_leaf
from megastep.agents.runs import checkpoint
from megastep.atomic_files import delete, replacing

if TYPE_CHECKING:
    from megastep.agents.types import Config, Row, StateDict

#: A replay buffer of up to so many bytes is in every checkpoint; in the last one of a run.
SMALL_REPLAY, LAST_REPLAY = 2**28, 2**32
#: Seconds that rank 0 waits for the other ranks' files.
RANK_SECONDS = 60.0


class RankFiles:
    """The files by which ranks give rank 0 their states, in one launch of a run.

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
            for path in folder.glob(".rank*"):
                delete(path)

    def _path(self, rank, number) -> Path:
        return self.folder / f".rank{rank}-{self.launch}-{number}"

    def hand_in(self, number: int, state: StateDict) -> None:
        """Writes this rank's file: its state without the policy's weights, which rank 0 saves.

        Args:
            number: number of the checkpoint, the same on all ranks.
            state: as for `checkpoint.save`.

        Raises:
            OSError: the disk is full or not writable.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        own = {name: part for name, part in state.items() if name != "policy"}
        with replacing(self._path(self.rank, number)) as path:
            checkpoint.save_tensors(path, own)

    def collect(self, number: int, folder: Path) -> None:
        """Waits for the other ranks' files and moves them into a checkpoint, as `rank1.pt` and so
        on.

        Args:
            number: number of the checkpoint.
            folder: the checkpoint's folder.

        Raises:
            OSError: a rank did not write its file in time.
        """
        deadline = time.monotonic() + RANK_SECONDS
        for rank in range(1, self.n_ranks):
            path = self._path(rank, number)
            while not path.exists():
                if self._is_given_up.wait(0.02) or time.monotonic() > deadline:
                    seconds = f"{RANK_SECONDS:.0f} s"
                    raise OSError(f"rank {rank} did not write its state within {seconds}")
            os.replace(path, folder / checkpoint.rank_file(rank))

    @property
    def is_given_up(self) -> bool:
        """True if another rank has ended and will write no file."""
        return self._is_given_up.is_set()

    def give_up(self) -> None:
        """Makes `collect` stop waiting, because another rank has ended."""
        self._is_given_up.set()


class Saver:
    """Writes the checkpoints of a run in a background thread.

    If the disk is full, read-only or faulty, the next call or `wait` warns once; later calls try
    again.

    Args:
        folder: the run's `checkpoints` folder.
        config: the run's configuration, stored in each checkpoint.
        keep_checkpoints: number of checkpoints to keep, besides the one with the best score.
        made_with: versions and devices that the numbers depend on, see `provenance.made_with`.
        replay_every: a replay buffer of more than `SMALL_REPLAY` bytes is saved once per
            this many checkpoints, and with the last one if it has at most `LAST_REPLAY` bytes.
        rank_files: passes the states of the other ranks to rank 0. Each rank has a saver, and rank
            0's writes the checkpoints.

    Attributes:
        error: why the last checkpoint could not be written, as a sentence; None if it was
            written. Valid after `wait`.
        lacks_replay: True if the last call left out the replay buffer.
        seconds: time that writing the last checkpoint took.
    """

    def __init__(
        self,
        folder: Path,
        config: Config,
        keep_checkpoints: int = 2,
        made_with: Row | None = None,
        replay_every: int = 20,
        rank_files: RankFiles | None = None,
    ):
        self.folder, self.config, self.keep_checkpoints = folder, config, keep_checkpoints
        self.made_with, self.replay_every = made_with, replay_every
        self.rank_files = rank_files or RankFiles(folder)
        self.error: str | None = None
        self.lacks_replay = False
        self.seconds, self._n_since_replay, self._number = 0.0, 0, 0
        self._host_copy = _HostCopy()
        self._thread: threading.Thread | None = None
        self._failure: tuple[int, int, Exception] | None = None

    def __call__(
        self, step: int, state: StateDict, score: float | None = None, is_last: bool = False
    ) -> None:
        """Copies `state` to the CPU and starts to write a checkpoint of it.

        Args:
            step: environment steps so far, of all lanes.
            state: dicts and lists of tensors and plain values; may change once this returns.
            score: such as the mean return, higher is better; None if unknown.
            is_last: no other checkpoint follows.

        Raises:
            NonFiniteError: policy or learner have a NaN or infinity. Earlier checkpoints are kept.
        """
        self.wait()
        self._number += 1
        state = self._host_copy(self._with_replay(state, is_last))
        # environments may hold infinities, weights may not
        learnt = {name: state[name] for name in ("policy", "learner") if name in state}
        if path := nonfinite_leaf(learnt):
            raise NonFiniteError(
                f"The checkpoint at {step:,} samples was not saved: {path} is not finite"
            )
        self._thread = threading.Thread(target=self._write, args=(step, state, score))
        self._thread.start()

    def _with_replay(self, state, is_last) -> StateDict:
        """Returns the state, without a large replay buffer that is not due, or that there is too
        little memory to copy.
        """
        self.lacks_replay = False
        n_bytes = _nbytes(state.get("replay"))
        if n_bytes <= SMALL_REPLAY:
            return state
        self._n_since_replay += 1
        is_due = self._n_since_replay >= self.replay_every
        if is_due or (is_last and n_bytes <= LAST_REPLAY):
            if n_bytes <= _free_memory() / 2:
                self._n_since_replay = 0
                return state
            problem = "since there is too little memory to copy it"
            warnings.warn(f"Checkpoints leave out the replay buffer, {problem}", stacklevel=3)
        self.lacks_replay = True
        return {name: part for name, part in state.items() if name != "replay"}

    @property
    def is_writing(self) -> bool:
        """True while the thread writes."""
        return self._thread is not None and self._thread.is_alive()

    def _write(self, step, state, score) -> None:
        began = time.monotonic()
        files, number = self.rank_files, self._number
        try:
            if files.rank > 0:
                files.hand_in(number, state)
            else:
                checkpoint.save(
                    self.folder,
                    step,
                    state,
                    self.config,
                    self.keep_checkpoints,
                    score,
                    self.made_with,
                    lambda folder: files.collect(number, folder),
                )
        except Exception as error:
            self._failure = step, _nbytes(state), error
        self.seconds = time.monotonic() - began

    def give_up(self) -> None:
        """Stops waiting for the files of other ranks, because one has ended."""
        self.rank_files.give_up()

    def wait(self) -> None:
        """Waits until the last checkpoint is written. Warns if the disk failed.

        Raises:
            Exception: any other error of the thread.
        """
        if self._thread is None:
            return
        self._thread.join()
        self._thread = None
        failure, self._failure = self._failure, None
        if failure is None:
            self.error = None
            return
        if not isinstance(failure[-1], OSError):
            raise failure[-1]
        self._n_since_replay = self.replay_every  # so that the next checkpoint includes it
        has_warned = self.error is not None or self.rank_files.is_given_up
        self.error = self._message(*failure)
        if not has_warned:
            warnings.warn(
                f"{self.error}. Training goes on; the next checkpoint tries again", stacklevel=2
            )

    def _message(self, step, n_bytes, error) -> str:
        reason = getattr(error, "strerror", None) or str(error)
        sentence = (
            f"The checkpoint at {step:,} samples could not be saved ({reason}): it needs about "
            f"{n_bytes / 1e6:.1f} MB"
        )
        try:
            free_bytes = shutil.disk_usage(self.folder.parent).free
        except OSError:
            return f"{sentence} in {self.folder.parent}, which cannot be read"
        return f"{sentence}, and {free_bytes / 1e6:.1f} MB are free in {self.folder.parent}"


class NoSaver:
    """Saves nothing: for a training without a run folder."""

    error: str | None = None
    lacks_replay = is_writing = False

    def __init__(self) -> None:
        self.folder, self.config = Path(), {}

    def __call__(
        self, step: int, state: StateDict, score: float | None = None, is_last: bool = False
    ) -> None:
        """Does nothing."""

    def give_up(self) -> None:
        """Does nothing."""

    def wait(self) -> None:
        """Does nothing."""


class _HostCopy:
    """Copies a state to the CPU, from a GPU into pinned memory that is reused."""

    def __init__(self) -> None:
        self.pinned = {}

    def __call__(self, state: StateDict) -> StateDict:
        """Returns the copy as plain dicts, lists and tuples. Synchronises."""
        self.devices = set()
        copy = {key: self._copied(part, (key,)) for key, part in state.items()}
        for device in self.devices:
            torch.cuda.synchronize(device)
        return copy

    def _copied(self, node, path) -> object:
        if isinstance(node, torch.Tensor):
            return self._copied_tensor(node.detach(), path)
        if isinstance(node, dict):
            return {key: self._copied(part, (*path, key)) for key, part in node.items()}
        if isinstance(node, (list, tuple)):
            return type(node)(self._copied(part, (*path, i)) for i, part in enumerate(node))
        check_plain(node, ".".join(map(str, path)))
        return node

    def _copied_tensor(self, tensor, path) -> torch.Tensor:
        if tensor.device.type != "cuda":
            return tensor.clone()
        if path[0] == "replay" or "rollouts" in path:  # possibly too large to pin
            return tensor.cpu()
        kept = self.pinned.get(path)
        if kept is None or kept.shape != tensor.shape or kept.dtype != tensor.dtype:
            kept = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
            self.pinned[path] = kept
        self.devices.add(tensor.device)
        return kept.copy_(tensor, non_blocking=True)


def check_plain(tree: object, name: str) -> None:
    """Checks that a tree can be loaded without running code: it may hold tensors, numbers, strings,
    None, and lists, tuples and dicts of these.

    Args:
        tree: what to check.
        name: the tree's name in messages.

    Raises:
        TypeError: naming the path of anything else.
    """
    if isinstance(tree, dict):
        for key, part in tree.items():
            check_plain(part, f"{name}.{key}")
    elif isinstance(tree, (list, tuple)):
        for i, part in enumerate(tree):
            check_plain(part, f"{name}.{i}")
    elif type(tree) not in (bool, int, float, str, type(None)) and not hasattr(
        tree, "untyped_storage"
    ):
        raise TypeError(
            f"{name} is a {type(tree).__module__}.{type(tree).__name__}, and checkpoints hold "
            "tensors, numbers, strings, lists and dicts only: convert it, for example with float()"
        )


def _free_memory() -> float:
    """Returns free memory in bytes, infinity if unknown."""
    with contextlib.suppress(ValueError, OSError):
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return math.inf


def _nbytes(state) -> int:
    return sum(getattr(leaf, "nbytes", 0) for leaf in tree_leaves(state))
