"""The replay buffer: sequences of past experience on the device, drawn by priority.

T steps per rollout, B lanes, K stored rollouts, L steps per sequence, M sequences per sample.

The buffer is a ring of rows, one per time step: (K T, B, ...). Each observation is stored once,
and the newest rollout overwrites the oldest. A sequence is a window of L + 1 rows of one lane. It
starts where a rollout starts, because only there the hidden state is stored, and may extend over
the following rollouts. Its last row is the observation to bootstrap from. A sequence can be drawn
once its last row has been stored, and until its first row is overwritten.
"""

import math

import torch
from torch.utils._pytree import TreeSpec, tree_flatten, tree_unflatten

from megastep import spaces
from megastep.agents.networks.fused import fused
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.copies import LIBRARY
from megastep.agents.storage.replay_settings import ReplaySettings
from megastep.agents.storage.rollout import Rollout, copy_tree
from megastep.agents.storage.sum_tree import SET_THREADS, SumTree, has_kernels, packed
from megastep.arrdict import arrdict
from megastep.dotdict import leaves, mapping
from megastep.kernels.build.launch import Blocks, launch
from megastep.types import Env, Space, Tree

#: Bool tensors of a row, stored as one bit each.
_FLAGS = "starts", "learns", "terminal", "truncated"
#: Tensors of which a sequence has L + 1 rows instead of L.
_WITH_LAST = "obs", "privileged", "starts", "learns", "mask"
#: Smallest priority before it is raised to alpha, so that sequences of zero error can be drawn.
_MIN_PRIORITY = 1e-6
_MAX_TENSORS = LIBRARY.constants["MAX_SELECTED"]
_READ_THREADS = LIBRARY.constants["READ_THREADS"]
_MAX_ENTRIES = 2**31  # kernels count lanes, rows and words in 32 bits
_COPIES = {size: LIBRARY.constants[f"COPY_{size}"] for size in (16, 8, 4, 2, 1)}
#: How a stored dtype is read as another.
_CONVERSIONS = {
    (torch.uint8, torch.int64): LIBRARY.constants["BYTE_TO_LONG"],
    (torch.int16, torch.int64): LIBRARY.constants["SHORT_TO_LONG"],
    (torch.int32, torch.int64): LIBRARY.constants["INT_TO_LONG"],
    (torch.uint8, torch.float16): LIBRARY.constants["BYTE_TO_HALF"],
    (torch.uint8, torch.float32): LIBRARY.constants["BYTE_TO_FLOAT"],
    (torch.float16, torch.float32): LIBRARY.constants["HALF_TO_FLOAT"],
}


class Column:
    """Rows (R, ...) of one tensor of the experience, stored in another dtype than that which `read`
    returns, unless `stored` is None.
    """

    def __init__(
        self,
        n_rows: int,
        shape: tuple[int, ...],
        dtype: torch.dtype,
        stored: torch.dtype | None,
        device: torch.device,
    ):
        self.dtype = dtype
        self.rows = torch.zeros(n_rows, *shape, dtype=stored or dtype, device=device)

    def write(self, index: torch.Tensor, values: torch.Tensor) -> None:
        """Stores the first m of values (>= m, ...) at rows index (m,)."""
        values = cast(values[: len(index)], self.rows.dtype)
        self.rows.index_copy_(0, index, values)

    def read(self, index: torch.Tensor) -> torch.Tensor:
        """Returns entries (..., *) of rows (R, B, *). Entry r B + b is lane b of row r."""
        rows = self.rows.flatten(0, 1).index_select(0, index.flatten())
        return cast(rows, self.dtype).unflatten(0, index.shape)


def stored_dtype(space: Space, images: str) -> torch.dtype | None:
    """Returns the dtype in which values of a leaf space are stored; None if it does not change.
    Integers are stored in the smallest dtype that holds them.
    """
    if isinstance(space, spaces.MultiDiscrete):
        dtypes = torch.uint8, torch.int16, torch.int32
        return next(dtype for dtype in dtypes if space.n_actions - 1 <= torch.iinfo(dtype).max)
    if isinstance(space, spaces.MultiImage) and images == "uint8":
        return torch.uint8
    return None


def cast(values: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """Returns values in another dtype. Fractions from 0 to 1 become integers from 0 to 255 and
    back; float16 is clipped to its range.
    """
    source = values.dtype
    if source.is_floating_point and dtype == torch.uint8:
        return (values * 255).round_().clamp_(0, 255).to(dtype)
    if source == torch.uint8 and dtype.is_floating_point:
        return values.to(dtype) / 255
    if dtype == torch.float16 and source != dtype:
        largest = torch.finfo(dtype).max
        return values.clamp(-largest, largest).to(dtype)
    return values.to(dtype)


# ---- On a GPU ----


def _parts(replay) -> tuple[list[Column], list[int], TreeSpec]:
    """Returns the columns of a sequence's tensors, how many rows it has of each, and their tree."""
    columns, n_rows = [], []
    tree = arrdict(replay.columns, state=replay.state)
    for name, part in tree.items():
        of_part, _ = tree_flatten(part)
        length = 1 if name == "state" else replay.length + (name in _WITH_LAST)
        columns += of_part
        n_rows += [length] * len(of_part)
    return columns, n_rows, tree_flatten(tree)[1]


def _can_read(replay, index, probability) -> bool:
    columns, *_ = _parts(replay)
    n_words = (replay.length + 1) * len(index)
    return len(columns) <= _MAX_TENSORS and all(
        column.rows.is_cuda
        and column.rows.is_contiguous()
        and (column.rows.dtype == column.dtype or (column.rows.dtype, column.dtype) in _CONVERSIONS)
        and column.rows.shape[0] * column.rows.shape[1] < _MAX_ENTRIES
        and n_words * math.prod(column.rows.shape[2:]) * column.rows.element_size() < _MAX_ENTRIES
        for column in columns
    )


def _read_on_gpu(replay, index, probability) -> arrdict:
    columns, n_rows, spec = _parts(replay)
    n_sequences, n_steps, device, packed_rows = len(index), replay.length, index.device, []
    results, n_blocks = [], 1 + -(-(n_steps + 1) * n_sequences // _READ_THREADS)
    for column, n in zip(columns, n_rows, strict=True):
        rows, dtype = column.rows, column.dtype
        result = torch.empty(n, n_sequences, *rows.shape[2:], dtype=dtype, device=device)
        n_words, kind = math.prod(rows.shape[2:]), _CONVERSIONS.get((rows.dtype, dtype))
        if rows.dtype == dtype:
            n_bytes = n_words * rows.element_size()
            addresses = n_bytes | rows.data_ptr() | result.data_ptr()
            word_size = next(size for size in _COPIES if not addresses % size)
            n_words, kind = n_bytes // word_size, _COPIES[word_size]
        packed_rows.append(
            LIBRARY.params.ReadTensorParams(
                **dict(target=result, source=rows, n_rows=n, n_words=n_words, kind=kind),
                **dict(rows_per_rollout=len(rows) // replay.n_rollouts, first_block=n_blocks),
            )
        )
        results.append(result)
        n_blocks += -(-n * n_sequences * n_words // _READ_THREADS)
    flags = {
        name: torch.empty(
            n_steps + (name in _WITH_LAST), n_sequences, dtype=torch.bool, device=device
        )
        for name in _FLAGS
    }
    weights, age = torch.empty_like(probability), torch.empty_like(index)
    weight = torch.empty_like(probability, dtype=torch.float32)
    launch(
        *(LIBRARY, "read_sequences", device, Blocks(n_blocks, threads=_READ_THREADS)),
        **dict(tensors=b"".join(packed_rows), flags=replay.flags.rows, **flags),
        **dict(index=index, probability=probability, weights=weights, weight=weight, age=age),
        **dict(n_added=replay.n_added, n_available=replay.n_available),
        **dict(n_tensors=len(columns), n_sequences=n_sequences, n_steps=n_steps),
        **dict(n_lanes=replay.n_lanes, n_rollouts=replay.n_rollouts),
        **dict(rows_per_rollout=replay.n_steps, beta=replay.settings.beta),
    )
    batch = arrdict(tree_unflatten(results, spec), weight=weight, age=age, **flags)
    batch["state"] = mapping(lambda leaf: leaf[0])(batch.state)
    return batch


def _store_priorities_on_gpu(replay, index, errors) -> None:
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
        obs_space, action_space: the environment's.
        settings: capacity, sequence length, priorities.
        logprobs: whether to store log-probabilities.

    Raises:
        ValueError: if the capacity is too small for a sequence.
    """

    def __init__(
        self,
        rollout: Rollout,
        obs_space: Space,
        action_space: Space,
        settings: ReplaySettings,
        logprobs: bool = True,
    ):
        self.settings, self.n_steps, self.n_lanes = settings, rollout.n_steps, rollout.n_lanes
        self.length = self.n_steps + settings.burn_in
        self.n_rollouts = settings.n_rollouts(self.n_steps, self.n_lanes)
        device = rollout.reward.device
        n_rows = self.n_rollouts * self.n_steps

        def column(leaf, space=None) -> Column:  # for a leaf (T, B, ...) of the rollout
            stored = None if space is None else stored_dtype(space, settings.images)
            return Column(n_rows, leaf.shape[1:], leaf.dtype, stored, device)

        def column_of_state(leaf) -> Column:
            return Column(self.n_rollouts, leaf.shape, leaf.dtype, torch.float16, device)

        self.columns = arrdict(
            obs=spaces.map(column, rollout.obs, obs_space),
            actions=spaces.map(column, rollout.actions, action_space),
            reward=column(rollout.reward),
        )
        parts = dict(privileged=rollout.privileged, mask=rollout.mask)
        if logprobs:
            parts = dict(logprobs=rollout.logprobs) | parts
        for name, part in parts.items():
            if part is not None:
                self.columns[name] = mapping(column)(part)
        self.flags = Column(n_rows, (self.n_lanes,), torch.uint8, None, device)
        self.state = mapping(column_of_state)(rollout.state)
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
        columns = [*leaves(self.columns), *leaves(self.state), self.flags]
        tensors = [self.is_finite, self.n_added, self.n_available, self.new_priority]
        tensors += [column.rows for column in columns] + self.tree.levels
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
        steps = torch.arange(self.n_steps, device=self.n_added.device)
        lanes = torch.arange(self.n_lanes, device=self.n_added.device)
        slot = self.n_added % self.n_rollouts
        rows = slot * self.n_steps + steps

        def write(column, leaf) -> None:
            column.write(rows, torch.where(is_finite, leaf, leaf.new_zeros(())))

        for name, columns in self.columns.items():
            spaces.map(write, columns, getattr(rollout, name))
        bits = [getattr(rollout, name)[: self.n_steps].byte() << i for i, name in enumerate(_FLAGS)]
        self.flags.write(rows, torch.as_tensor(sum(bits)))
        spaces.map(lambda column, leaf: column.write(slot, leaf[None]), self.state, rollout.state)
        self.is_finite.index_copy_(0, slot, is_finite)
        self.n_added += 1

        self.tree.set(slot * self.n_lanes + lanes, torch.zeros_like(lanes))
        # The latest sequences that are complete: their last row has just been stored
        n_touched = self.settings.rollouts_per_sequence(self.n_steps)
        offsets = torch.arange(n_touched, device=slot.device)
        first = self.n_added - n_touched
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
        batch = self._read(index, probability)
        batch["index"], batch["probability"] = index, probability
        return batch

    @fused(_read_on_gpu, _can_read)
    def _read(self, index, probability) -> arrdict:
        """Returns the sequences with their weights and ages."""
        slot, lane = index // self.n_lanes, index % self.n_lanes
        window = torch.arange(self.length + 1, device=index.device)[:, None]
        rows = (slot * self.n_steps + window) % (self.n_rollouts * self.n_steps)
        rows = rows * self.n_lanes + lane  # (L+1, M), among rows (K T B, ...)
        batch = arrdict()
        for name, columns in self.columns.items():
            batch[name] = mapping(Column.read)(columns, rows if name in _WITH_LAST else rows[:-1])
        flags = self.flags.read(rows)
        for i, name in enumerate(_FLAGS):
            flag = (flags >> i & 1).bool()
            batch[name] = flag if name in _WITH_LAST else flag[:-1]
        batch["state"] = mapping(Column.read)(self.state, index)
        weight = (self.n_available * probability).clamp(min=1e-30) ** -self.settings.beta
        batch["weight"] = (weight / weight.amax()).float()
        batch["age"] = (self.n_added - 1 - slot) % self.n_rollouts
        return batch

    @torch.no_grad()
    def set_priorities(self, index: torch.Tensor, values: torch.Tensor) -> None:
        """Sets the priorities of the last sample's sequences to `values`, (M,), to the power alpha.
        Skips non-finite values. Does nothing if alpha is 0, or before `is_ready`.
        """
        if self.settings.alpha:
            self._store_priorities(index, values)

    @fused(
        _store_priorities_on_gpu,
        lambda self, index, errors: has_kernels(self.tree, len(index)),
    )
    def _store_priorities(self, index, values) -> None:
        old = self.tree.priorities.index_select(0, index)
        new = values.double().clamp(min=_MIN_PRIORITY) ** self.settings.alpha
        # old is 0 where the sequence cannot be drawn
        is_set = self.is_ready & (old > 0) & new.isfinite()
        self.tree.set(index, torch.where(is_set, new, old))
        largest = torch.where(is_set, new, 0.0).amax()
        self.new_priority.copy_(torch.where(largest > 0, largest, self.new_priority))

    def state_dict(self) -> dict[str, Tree]:
        """Returns the stored rollouts, priorities and counts. Synchronises."""
        n_filled = min(int(self.n_added), self.n_rollouts)
        stored = self._rows(n_filled)
        levels = {str(i): level for i, level in enumerate(self.tree.levels)}
        names = "is_finite", "n_added", "n_available", "new_priority"
        return dict(stored=stored, tree=levels, **{name: getattr(self, name) for name in names})

    def load_state_dict(self, state: dict[str, Tree]) -> None:
        """Restores a `state_dict` of a buffer with the same settings, from any device."""
        self.n_added.copy_(state["n_added"])
        copy_tree(self.state_dict(), state)

    def _rows(self, n_rollouts) -> dict[str, object]:
        """Returns the first `n_rollouts` rollouts of every column, as views."""
        rows = mapping(lambda column: column.rows[: n_rollouts * self.n_steps])
        state = mapping(lambda column: column.rows[:n_rollouts])(self.state)
        return dict(rows(self.columns), flags=rows(self.flags), state=state)


def bytes_per_observation(
    env: Env, policy: Policy, n_steps: int, settings: ReplaySettings, logprobs: bool = True
) -> float:
    """Returns the size in bytes of a replay buffer per observation, everything included."""
    meta = torch.device("meta")
    env_spaces = env.obs_space, env.action_space
    state = policy.initial(1, meta)
    rollout = Rollout(n_steps, 1, *env_spaces, state, meta, policy.privileged_space, values=False)
    replay_buffer = ReplayBuffer(rollout, *env_spaces, settings, logprobs)
    return replay_buffer.bytes / replay_buffer.capacity
