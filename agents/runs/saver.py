"""Saves checkpoints of a run in the background, with the states of all ranks."""

import contextlib
import math
import os
import shutil
import threading
import time
import warnings
from pathlib import Path

import torch
from torch.utils._pytree import tree_leaves

from megastep.agents.algorithms.nonfinite import NonFiniteError, nonfinite_leaf
from megastep.agents.runs import checkpoint
from megastep.agents.types import Config, Row, StateDict
from megastep.atomic_files import delete, replacing

#: A replay buffer of up to so many bytes is in every checkpoint; in the last one of a run.
SMALL_REPLAY, LAST_REPLAY = 2**28, 2**32
#: The folder of a training without a run.
NOWHERE = Path(os.devnull)
#: Seconds that rank 0 waits for the other ranks' files.
RANK_SECONDS = 60.0


class Saver:
    """Writes the checkpoints of a run in a background thread. Each rank has one; rank 0 moves the
    others' files into the checkpoint. If the disk fails, `wait` warns once, and later calls retry.

    Args:
        folder: the run's `checkpoints` folder, which all ranks share. `NOWHERE`: nothing is saved.
        config, keep_checkpoints, made_with: see `checkpoint.save`.
        replay_every: a replay buffer of more than `SMALL_REPLAY` bytes is saved once per
            this many checkpoints, and with the last one if it has at most `LAST_REPLAY` bytes.
        launch: name of this start, the same on all ranks. Files of others are deleted.

    Attributes:
        error: why the last checkpoint could not be written; None if it was. Valid after `wait`.
        lacks_replay: True if the last call left out the replay buffer.
    """

    def __init__(
        self,
        folder: Path,
        config: Config,
        keep_checkpoints: int = 2,
        made_with: Row | None = None,
        replay_every: int = 20,
        launch: str = "",
        rank: int = 0,
        n_ranks: int = 1,
    ):
        self.folder, self.config, self.keep_checkpoints = folder, config, keep_checkpoints
        self.made_with, self.replay_every = made_with, replay_every
        self.launch, self.rank, self.n_ranks = launch, rank, n_ranks
        self.error: str | None = None
        self.lacks_replay, self._n_since_replay, self._number = False, 0, 0
        self._pinned = {}
        self._thread: threading.Thread | None = None
        self._failure: tuple[int, int, Exception] | None = None
        self._is_given_up = threading.Event()
        for path in folder.glob(".rank*") if rank == 0 else ():
            delete(path)

    def __call__(
        self, step: int, state: StateDict, score: float | None = None, is_last: bool = False
    ) -> None:
        """Copies `state` to the CPU and starts to write a checkpoint of it. `is_last`: no other
        follows. Raises NonFiniteError if policy or learner have a NaN or infinity.
        """
        if self.folder == NOWHERE:
            return
        self.wait()
        self._number += 1
        state, devices = self._with_replay(state, is_last), set()
        copy = {key: _on_host(part, (key,), self._pinned, devices) for key, part in state.items()}
        for device in devices:
            torch.cuda.synchronize(device)
        # environments may hold infinities, weights may not
        learnt = {name: copy[name] for name in ("policy", "learner") if name in copy}
        if path := nonfinite_leaf(learnt):
            raise NonFiniteError(
                f"The checkpoint at {step:,} samples was not saved: {path} is not finite"
            )
        self._thread = threading.Thread(target=self._write, args=(step, copy, score))
        self._thread.start()

    def _with_replay(self, state, is_last) -> StateDict:
        """Returns the state, without a large replay buffer that is not due or cannot be copied."""
        self.lacks_replay, n_bytes = False, nbytes(state.get("replay"))
        if n_bytes <= SMALL_REPLAY:
            return state
        self._n_since_replay += 1
        is_due = self._n_since_replay >= self.replay_every
        if is_due or (is_last and n_bytes <= LAST_REPLAY):
            free = math.inf
            with contextlib.suppress(ValueError, OSError):  # not known everywhere
                free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
            if n_bytes <= free / 2:
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
        try:
            if self.rank > 0:  # without the policy's weights, which rank 0 saves
                self.folder.mkdir(parents=True, exist_ok=True)
                own = {name: part for name, part in state.items() if name != "policy"}
                with replacing(self._rank_file(self.rank)) as path:
                    checkpoint.save_tensors(path, own)
            else:
                what = step, state, self.config, self.keep_checkpoints, score, self.made_with
                checkpoint.save(self.folder, *what, self._collect)
        except Exception as error:
            self._failure = step, nbytes(state), error

    def _rank_file(self, rank) -> Path:
        return self.folder / f".rank{rank}-{self.launch}-{self._number}"

    def _collect(self, folder) -> None:
        """Moves the other ranks' files into a checkpoint's folder, once they are there."""
        deadline = time.monotonic() + RANK_SECONDS
        for rank in range(1, self.n_ranks):
            path = self._rank_file(rank)
            while not path.exists():
                if self._is_given_up.wait(0.02) or time.monotonic() > deadline:
                    seconds = f"{RANK_SECONDS:.0f} s"
                    raise OSError(f"rank {rank} did not write its state within {seconds}")
            os.replace(path, folder / f"rank{rank}.pt")

    def give_up(self) -> None:
        """Stops waiting for the files of other ranks, because one has ended."""
        self._is_given_up.set()

    def wait(self) -> None:
        """Waits until the last checkpoint is written. Warns if the disk failed."""
        if self._thread is None:
            return
        self._thread.join()
        self._thread = None
        failure, self._failure = self._failure, None
        if failure is None:
            self.error = None
            return
        step, n_bytes, error = failure
        if not isinstance(error, OSError):
            raise error
        self._n_since_replay = self.replay_every  # so that the next checkpoint includes it
        has_warned, place = self.error is not None or self._is_given_up.is_set(), self.folder.parent
        room = f"in {place}, which cannot be read"
        with contextlib.suppress(OSError):
            room = f"and {shutil.disk_usage(place).free / 1e6:.1f} MB are free in {place}"
        self.error = (
            f"The checkpoint at {step:,} samples could not be saved ({error.strerror or error}): "
            f"it needs about {n_bytes / 1e6:.1f} MB, {room}"
        )
        if not has_warned:
            text = f"{self.error}. Training goes on; the next checkpoint tries again"
            warnings.warn(text, stacklevel=2)


def _on_host(node, path, pinned, devices) -> object:
    """Returns a copy on the CPU; from a GPU, which joins `devices`, asynchronously."""
    if isinstance(node, dict):
        return {key: _on_host(part, (*path, key), pinned, devices) for key, part in node.items()}
    if isinstance(node, (list, tuple)):
        parts = (_on_host(part, (*path, i), pinned, devices) for i, part in enumerate(node))
        return type(node)(parts)
    if not isinstance(node, torch.Tensor):
        check_plain(node, ".".join(map(str, path)))
        return node
    tensor = node.detach()
    if tensor.device.type != "cuda":
        return tensor.clone()
    if path[0] == "replay" or "rollouts" in path:  # possibly too large to pin
        return tensor.cpu()
    kept = pinned.get(path)
    if kept is None or kept.shape != tensor.shape or kept.dtype != tensor.dtype:
        kept = pinned[path] = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
    devices.add(tensor.device)
    return kept.copy_(tensor, non_blocking=True)


def check_plain(tree: object, name: str) -> None:
    """TypeError, naming the path, for what a `weights_only` checkpoint cannot hold."""
    if isinstance(tree, (dict, list, tuple)):
        for key, part in tree.items() if isinstance(tree, dict) else enumerate(tree):
            check_plain(part, f"{name}.{key}")
    elif type(tree) not in (bool, int, float, str, type(None)) and not torch.is_tensor(tree):
        raise TypeError(
            f"{name} is a {type(tree).__module__}.{type(tree).__name__}, and checkpoints hold "
            "tensors, numbers, strings, lists and dicts only: convert it, for example with float()"
        )


def nbytes(state: object) -> int:
    """Returns the bytes of the tensors in a tree."""
    return sum(getattr(leaf, "nbytes", 0) for leaf in tree_leaves(state))
