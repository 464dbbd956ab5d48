"""The replay buffer: sequences of past experience on the device, drawn by priority.

T steps per rollout, B lanes, K stored rollouts, L steps per sequence, M sequences per sample.

The buffer is a ring of rows, one per time step: (K T, B, ...). Each observation is stored once,
and the newest rollout overwrites the oldest. A sequence is a window of L + 1 rows of one lane. It
starts where a rollout starts, because only there the hidden state is stored, and may extend over
the following rollouts. Its last row is the observation to bootstrap from. A sequence can be drawn
once its last row has been stored, and until its first row is overwritten.
"""

import dataclasses
import math
from typing import Annotated

import torch
from pydantic import BeforeValidator, Field
from torch.utils._pytree import tree_flatten, tree_unflatten

from megastep import spaces
from megastep.agents.networks.fused import fused
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.copies import LIBRARY
from megastep.agents.storage.rollout import Rollout, copy_tree
from megastep.agents.storage.sum_tree import SET_THREADS, SumTree, has_kernels, packed
from megastep.arrdict import arrdict
from megastep.dotdict import leaves, mapping
from megastep.kernels.build.launch import Blocks, launch
from megastep.settings import frozen
from megastep.types import Env, Tree

#: Bool tensors of a row, stored as one bit each.
_FLAGS = "starts", "learns", "terminal", "truncated"
#: Tensors of which a sequence has L + 1 rows instead of L.
_WITH_LAST = "obs", "privileged", "starts", "learns", "mask"
#: Smallest priority before it is raised to alpha, so that sequences of zero error can be drawn.
_MIN_PRIORITY = 1e-6
_MAX_TENSORS = LIBRARY.constants["MAX_SELECTED"]
_READ_THREADS = LIBRARY.constants["READ_THREADS"]
_MAX_ENTRIES = 2**31  # kernels count lanes, rows and words in 32 bits
_LARGEST_HALF = torch.finfo(torch.float16).max
Exponent = Annotated[float, Field(ge=0, le=10)]


@frozen
class ReplaySettings:
    """Settings of learners that have a replay buffer.

    Args:
        capacity: observations in the buffer, all lanes together. Rounded down to whole rollouts.
        burn_in: steps at the start of a sequence that only warm up the hidden state. A sequence
            has `n_steps` more, so that every collected step is learned from in exactly one.
        ratio: samples replayed per sample collected.
        alpha: exponent of priorities; 0 draws uniformly (Schaul et al. 2016).
        beta: exponent of importance weights; 1 corrects fully for the priorities.
        start: samples to collect before the first is replayed.
    """

    capacity: Annotated[int, Field(ge=1, le=10**12)] = 1_000_000
    burn_in: Annotated[int, Field(ge=0, le=65_536)] = 0
    ratio: Annotated[float, Field(gt=0, le=1000)] = 1.0
    alpha: Exponent = 0.0
    beta: Exponent = 0.6
    start: Annotated[int, Field(ge=0, le=10**12)] = 0


def defaults_from(settings: ReplaySettings) -> BeforeValidator:
    """Returns a validator for annotations: a dict of some settings takes the others from `settings`
    instead of from the class.
    """

    def complete(value) -> object:
        return dataclasses.asdict(settings) | value if isinstance(value, dict) else value

    return BeforeValidator(complete)


def _read_entries(rows, index) -> torch.Tensor:
    """Returns entries (..., *) of rows (R, B, *). Entry r B + b is lane b of row r."""
    return rows.flatten(0, 1).index_select(0, index.flatten()).unflatten(0, index.shape)


# ---- On a GPU ----


def _can_read(replay, index, probability) -> bool:
    tensors = leaves(arrdict(replay.rows, state=replay.state))
    n_rows = (replay.length + 1) * len(index)
    return len(tensors) <= _MAX_TENSORS and all(
        rows.is_cuda
        and rows.is_contiguous()
        and rows.shape[0] * rows.shape[1] < _MAX_ENTRIES
        and n_rows * math.prod(rows.shape[2:]) * rows.element_size() < _MAX_ENTRIES
        for rows in tensors
    )


def _read_on_gpu(replay, index, probability) -> arrdict:
    n_sequences, n_steps, device = len(index), replay.length, index.device
    n_blocks = 1 + -(-(n_steps + 1) * n_sequences // _READ_THREADS)
    packed_tensors = []

    def read(rows, n_rows, dtype) -> torch.Tensor:
        nonlocal n_blocks
        result = torch.empty(n_rows, n_sequences, *rows.shape[2:], dtype=dtype, device=device)
        word_size, n_words = 0, math.prod(rows.shape[2:])  # 0: float16 to float32
        if rows.dtype == dtype:
            n_bytes = n_words * rows.element_size()
            addresses = n_bytes | rows.data_ptr() | result.data_ptr()
            word_size = next(size for size in (16, 8, 4, 2, 1) if not addresses % size)
            n_words = n_bytes // word_size
        sizes = dict(n_rows=n_rows, n_words=n_words, word_size=word_size, first_block=n_blocks)
        sizes["rows_per_rollout"] = len(rows) // replay.n_rollouts
        packed_tensors.append(LIBRARY.params.ReadTensorParams(target=result, source=rows, **sizes))
        n_blocks += -(-n_rows * n_sequences * n_words // _READ_THREADS)
        return result

    n_rows = {name: n_steps + (name in _WITH_LAST) for name in (*replay.rows, *_FLAGS)}
    batch = arrdict()
    for name, part in replay.rows.items():
        tensors, spec = tree_flatten(part)
        results = [read(rows, n_rows[name], rows.dtype) for rows in tensors]
        batch[name] = tree_unflatten(results, spec)
    batch["state"] = replay.state.map(lambda rows: read(rows, 1, torch.float32)[0])
    flags = {
        name: torch.empty(n_rows[name], n_sequences, dtype=torch.bool, device=device)
        for name in _FLAGS
    }
    weights, age = torch.empty_like(probability), torch.empty_like(index)
    weight = torch.empty_like(probability, dtype=torch.float32)
    launch(
        *(LIBRARY, "read_sequences", device, Blocks(n_blocks, threads=_READ_THREADS)),
        **dict(tensors=b"".join(packed_tensors), flags=replay.flags, **flags),
        **dict(index=index, probability=probability, weights=weights, weight=weight, age=age),
        **dict(n_added=replay.n_added, n_available=replay.n_available),
        **dict(n_tensors=len(packed_tensors), n_sequences=n_sequences, n_steps=n_steps),
        **dict(n_lanes=replay.n_lanes, n_rollouts=replay.n_rollouts),
        **dict(rows_per_rollout=replay.n_steps, beta=replay.settings.beta),
    )
    return arrdict(batch, weight=weight, age=age, **flags)


def _set_priorities_on_gpu(replay, index, errors) -> None:
    settings, values = replay.settings, torch.empty_like(errors, dtype=torch.float64)
    first_rollouts = -(-settings.start // (replay.n_steps * replay.n_lanes))
    launch(
        *(LIBRARY, "set_priorities", index.device, Blocks(1, threads=SET_THREADS)),
        **dict(tree=packed(replay.tree), index=index.contiguous(), values=values),
        **dict(errors=errors.float().contiguous(), n_added=replay.n_added),
        **dict(n_available=replay.n_available, new_priority=replay.new_priority, n=len(index)),
        first_rollouts=min(first_rollouts, _MAX_ENTRIES - 1),
        **dict(smallest=_MIN_PRIORITY, alpha=settings.alpha),
    )


class ReplayBuffer:
    """Stores rollouts and samples sequences from them. Nothing synchronises, and no shape depends
    on what is stored, so CUDA graphs can record adding and sampling.

    Args:
        rollout: an example of the rollouts to store; only its shapes, dtypes and device are used.
        settings: capacity, sequence length, priorities.
        logprobs: whether to store log-probabilities.

    Raises:
        ValueError: if the capacity is too small for a sequence per lane.
    """

    def __init__(self, rollout: Rollout, settings: ReplaySettings, logprobs: bool = True):
        self.settings, self.n_steps, self.n_lanes = settings, rollout.n_steps, rollout.n_lanes
        self.length = self.n_steps + settings.burn_in
        # of a sequence and the observation after it
        self.rollouts_per_sequence = self.length // self.n_steps + 1
        per_rollout = self.n_steps * self.n_lanes
        if settings.capacity < (needed := self.rollouts_per_sequence * per_rollout):
            raise ValueError(
                f"replay.capacity={settings.capacity:,} is too small for a sequence of "
                f"{self.length} steps of each of {self.n_lanes:,} lanes, stored {self.n_steps} "
                f"steps at a time: use at least {needed:,}, or fewer environments"
            )
        self.n_rollouts = settings.capacity // per_rollout
        device = rollout.reward.device
        n_rows = self.n_rollouts * self.n_steps
        zeros = mapping(lambda leaf: leaf.new_zeros(n_rows, *leaf.shape[1:]))
        names = "obs", "actions", "reward", *["logprobs"] * logprobs, "privileged", "mask"
        parts = {name: getattr(rollout, name) for name in names}
        self.rows = arrdict({name: zeros(x) for name, x in parts.items() if x is not None})
        self.flags = torch.zeros(n_rows, self.n_lanes, dtype=torch.uint8, device=device)
        self.state = rollout.state.map(
            lambda leaf: leaf.new_zeros(self.n_rollouts, *leaf.shape, dtype=torch.float16)
        )
        self.tree = SumTree(self.n_rollouts * self.n_lanes, device)
        self.is_finite = torch.zeros(self.n_rollouts, dtype=torch.bool, device=device)
        self.n_added = torch.zeros(1, dtype=torch.int64, device=device)  # rollouts, in total
        self.n_available = torch.zeros((), dtype=torch.int64, device=device)  # sequences
        # priority of new sequences: the largest one that `set_priorities` last set
        self.new_priority = torch.ones((), dtype=torch.float64, device=device)

    @property
    def capacity(self) -> int:
        """Number of observations that the buffer can hold."""
        return self.n_rollouts * self.n_steps * self.n_lanes

    @property
    def bytes(self) -> int:
        """Size in bytes."""
        tensors = [self.is_finite, self.n_added, self.n_available, self.new_priority, self.flags]
        tensors += [*leaves(self.rows), *leaves(self.state), *self.tree.levels]
        return sum(tensor.nbytes for tensor in tensors)

    @property
    def is_ready(self) -> torch.Tensor:
        """() bool, True once `start` samples were collected and a sequence can be drawn."""
        n_collected = self.n_added[0] * (self.n_steps * self.n_lanes)
        return (self.n_available > 0) & (n_collected >= self.settings.start)

    @torch.no_grad()
    def add(self, rollout: Rollout, is_finite: torch.Tensor | bool = True) -> None:
        """Stores the rollout collected right after the one added last, in place of the oldest if
        the buffer is full. If it is not finite, () bool, no sequence that contains part of it is
        ever drawn, and its rows are stored as zeros: `sample` returns arbitrary rows while no
        sequence can be drawn.
        """
        is_finite = torch.ones_like(self.is_finite[:1]) & is_finite
        lanes = torch.arange(self.n_lanes, device=self.n_added.device)
        slot = self.n_added % self.n_rollouts
        index = slot * self.n_steps + torch.arange(self.n_steps, device=self.n_added.device)

        def store(rows, leaf) -> None:
            leaf = torch.where(is_finite, leaf[: self.n_steps], leaf.new_zeros(()))
            rows.index_copy_(0, index, leaf)

        for name, rows in self.rows.items():
            spaces.map(store, rows, getattr(rollout, name))
        bits = [getattr(rollout, name)[: self.n_steps].byte() << i for i, name in enumerate(_FLAGS)]
        self.flags.index_copy_(0, index, torch.as_tensor(sum(bits)))
        limited = rollout.state.map(lambda leaf: leaf.clamp(-_LARGEST_HALF, _LARGEST_HALF).half())
        spaces.map(lambda rows, leaf: rows.index_copy_(0, slot, leaf[None]), self.state, limited)
        self.is_finite.index_copy_(0, slot, is_finite)
        self.n_added += 1

        self.tree.set(slot * self.n_lanes + lanes, torch.zeros_like(lanes))
        # The latest sequences that are complete: their last row has just been stored
        offsets = torch.arange(self.rollouts_per_sequence, device=slot.device)
        first = self.n_added - self.rollouts_per_sequence
        is_whole = (first >= 0) & self.is_finite[(first + offsets) % self.n_rollouts].all()
        slot = first % self.n_rollouts
        priorities = (self.new_priority * is_whole).expand(self.n_lanes)
        self.tree.set(slot * self.n_lanes + lanes, priorities)
        self.n_available.copy_((self.tree.priorities > 0).sum())

    @torch.no_grad()
    def sample(self, n: int, generator: torch.Generator | None = None) -> arrdict:
        """Draws M = n sequences. While `n_available` is 0, all numbers are finite but meaningless.

        Returns an arrdict as from `Rollout.sequences`, with leaves (L+1, M, ...) or (L, M, ...),
        and per sequence, (M,): `index` for `set_priorities`; `probability` float64, priority
        divided by the sum of all; `weight`, importance weight for the loss, at most 1 (Schaul et
        al. 2016, sec. 3.4); and `age`, number of rollouts added since the one in which it starts.
        """
        index, probability = self.tree.draw(n, generator)
        return arrdict(self._read(index, probability), index=index, probability=probability)

    @fused(_read_on_gpu, _can_read)
    def _read(self, index, probability) -> arrdict:
        """Returns the sequences with their weights and ages."""
        slot, lane = index // self.n_lanes, index % self.n_lanes
        window = torch.arange(self.length + 1, device=index.device)[:, None]
        rows = (slot * self.n_steps + window) % (self.n_rollouts * self.n_steps)
        entries = rows * self.n_lanes + lane  # (L+1, M), among (K T B, ...)
        batch = arrdict()
        for name, stored in self.rows.items():
            its_entries = entries if name in _WITH_LAST else entries[:-1]
            batch[name] = mapping(lambda leaf, at=its_entries: _read_entries(leaf, at))(stored)
        flags = _read_entries(self.flags, entries)
        for i, name in enumerate(_FLAGS):
            flag = (flags >> i & 1).bool()
            batch[name] = flag if name in _WITH_LAST else flag[:-1]
        batch["state"] = self.state.map(lambda leaf: _read_entries(leaf, index).float())
        weight = (self.n_available * probability).clamp(min=1e-30) ** -self.settings.beta
        batch["weight"] = (weight / weight.amax()).float()
        batch["age"] = (self.n_added - 1 - slot) % self.n_rollouts
        return batch

    @torch.no_grad()
    def set_priorities(self, index: torch.Tensor, errors: torch.Tensor) -> None:
        """Sets the priorities of the last sample's sequences to `errors`, (M,), to the power alpha.
        Skips non-finite ones. Does nothing if alpha is 0, or before `is_ready`.
        """
        if self.settings.alpha:
            self._set_priorities(index, errors)

    @fused(_set_priorities_on_gpu, lambda self, index, _: has_kernels(self.tree, len(index)))
    def _set_priorities(self, index, errors) -> None:
        old = self.tree.priorities.index_select(0, index)
        new = errors.double().clamp(min=_MIN_PRIORITY) ** self.settings.alpha
        # old is 0 where the sequence cannot be drawn
        is_set = self.is_ready & (old > 0) & new.isfinite()
        self.tree.set(index, torch.where(is_set, new, old))
        largest = torch.where(is_set, new, 0.0).amax()
        self.new_priority.copy_(torch.where(largest > 0, largest, self.new_priority))

    def state_dict(self) -> dict[str, Tree]:
        """Returns the stored rollouts, priorities and counts. Synchronises."""
        n_rollouts = min(int(self.n_added), self.n_rollouts)
        first = mapping(lambda rows: rows[: n_rollouts * self.n_steps])
        stored = dict(first(self.rows), flags=first(self.flags))
        stored["state"] = self.state.map(lambda rows: rows[:n_rollouts])
        levels = {str(i): level for i, level in enumerate(self.tree.levels)}
        names = "is_finite", "n_added", "n_available", "new_priority"
        return dict(stored=stored, tree=levels, **{name: getattr(self, name) for name in names})

    def load_state_dict(self, state: dict[str, Tree]) -> None:
        """Restores a `state_dict` of a buffer with the same settings, from any device."""
        self.n_added.copy_(state["n_added"])
        copy_tree(self.state_dict(), state)


def replay_size(
    env: Env, policy: Policy, n_steps: int, settings: ReplaySettings, logprobs: bool = True
) -> tuple[int, float]:
    """Returns the number of observations that a replay buffer will hold, and its bytes for each."""
    meta = torch.device("meta")
    state, of_env = policy.initial(1, meta), (env.obs_space, env.action_space)
    rollout = Rollout(n_steps, 1, *of_env, state, meta, policy.privileged_space, values=False)
    replay_buffer = ReplayBuffer(rollout, settings, logprobs)
    return settings.capacity, replay_buffer.bytes / replay_buffer.capacity
