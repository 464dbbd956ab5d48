"""A replay memory on the device: sequences of what was collected, drawn again and again.

Axes: T steps of a rollout, B lanes, K rollouts that are stored, L steps of a sequence, M sequences
of a sample. The memory is a ring in time: rows (K T, B, ...), each observation once, in which the
newest rollout takes the place of the oldest. A sequence is a window of L + 1 rows of one lane that
starts where a rollout did, since there the policy's state was stored, and may run on over the
rollouts that followed; the last row is the observation from which returns are bootstrapped. So it
can be drawn once that row is there, and until its first row is overwritten.
"""

from typing import Annotated, Any, Literal

import torch
from pydantic import Field

from megastep import spaces
from megastep.agents.storage.rollout import Rollout
from megastep.agents.storage.sum_tree import SumTree
from megastep.arrdict import arrdict
from megastep.dotdict import leaves
from megastep.settings import frozen

#: Flags of a row, a bit each.
_FLAGS = "starts", "learns", "terminal", "truncated"
#: What a sequence has one row more of than it has steps.
_MORE = "obs", "privileged", "starts", "learns"
#: The least priority: what was learnt to the last digit may be drawn again.
_MIN_PRIORITY = 1e-6
Exponent = Annotated[float, Field(ge=0, le=10)]


@frozen
class ReplaySettings:
    """What learners that have a replay memory let one choose.

    capacity  observations that it holds, all lanes together, less what does not fill a rollout
    images    how images of numbers from 0 to 1 are stored: fp16, as they are; uint8, in steps of
              1/255, in half of the memory. Numbers beyond 0 and 1 are clipped then.
    burn_in   so many steps at the start of a sequence only warm up the memory
    length    steps of a sequence, those of its burn-in included; null: as many as make every step
              that was collected part of one sequence behind its burn-in
    ratio     how many samples are replayed for each that is collected
    alpha     exponent of the priorities that sequences are drawn by; 0: all alike
    beta      exponent of the importance weights that make up for it, 1: fully
    start     so many samples are collected before the first is replayed
    """

    capacity: Annotated[int, Field(ge=1, le=10**12)] = 1_000_000
    images: Literal["fp16", "uint8"] = "fp16"
    burn_in: Annotated[int, Field(ge=0, le=65_536)] = 0
    length: Annotated[int, Field(ge=1, le=131_072)] | None = None
    ratio: Annotated[float, Field(gt=0, le=1000)] = 1.0
    alpha: Exponent = 0.0
    beta: Exponent = 0.6
    start: Annotated[int, Field(ge=0, le=10**12)] = 0

    def sequence_steps(self, rollout_steps: int) -> int:
        """L, where rollouts have so many steps. ValueError if that leaves out steps, or there are
        none beside the burn-in.
        """
        length = rollout_steps + self.burn_in if self.length is None else self.length
        if length <= self.burn_in:
            raise ValueError(
                f"replay.burn_in={self.burn_in} leaves nothing of a sequence of {length} steps to "
                f"learn from; it has to be shorter than replay.length"
            )
        if length < rollout_steps:
            raise ValueError(
                f"replay.length={length} is less than n_steps={rollout_steps}: a sequence starts "
                f"where a rollout does, so what is beyond it would never be learnt from"
            )
        return length

    def n_rollouts(self, rollout_steps: int, n_lanes: int) -> int:
        """How many rollouts there is room for. ValueError if these hold no whole sequence."""
        length, each = self.sequence_steps(rollout_steps), rollout_steps * n_lanes
        least = _rollouts_of(length, rollout_steps) * each
        if self.capacity < least:
            raise ValueError(
                f"replay.capacity={self.capacity:,} is too small for a sequence of {length} steps "
                f"of each of {n_lanes:,} lanes, stored {rollout_steps} steps at a time: it needs "
                f"at least {least:,}, or fewer environments"
            )
        return self.capacity // each


def _rollouts_of(length, rollout_steps):
    """How many rollouts a sequence is in, with the row that follows it."""
    return length // rollout_steps + 1


class Replay:
    """A replay memory for rollouts like a given one. Nothing synchronises and no shape depends on
    what is stored: adding and sampling can be part of a CUDA graph.

    Args: `rollout`, of which sizes are read; `obs_space`, `action_space`, those of the environment;
    `logprobs`, whether a learner needs them. On the device "meta" it takes no memory but has all
    its sizes. ValueError if a sequence does not fit, or has no steps to learn from.
    """

    def __init__(
        self,
        rollout: Rollout,
        obs_space: Any,
        action_space: Any,
        settings: ReplaySettings,
        logprobs: bool = True,
    ):
        self.settings, self.n_steps, self.n_lanes = settings, rollout.n_steps, rollout.n_lanes
        self.length = settings.sequence_steps(self.n_steps)
        self.n_rollouts = settings.n_rollouts(self.n_steps, self.n_lanes)
        device = rollout.reward.device
        n_rows = self.n_rollouts * self.n_steps

        def column(leaf, dtype=None):  # of a leaf (T, B, ...) of the rollout
            return _Column(n_rows, leaf.shape[1:], leaf.dtype, dtype or leaf.dtype, device)

        def column_of(leaf, space):
            return column(leaf, _stored_dtype(space, settings.images))

        self.columns = arrdict(
            obs=_each(column_of, rollout.obs, obs_space),
            actions=_each(column_of, rollout.actions, action_space),
            reward=column(rollout.reward),
        )
        if logprobs:
            self.columns["logprobs"] = column(rollout.logprobs)
        if rollout.privileged is not None:
            self.columns["privileged"] = _each(column, rollout.privileged)
        self.flags = _Column(n_rows, (self.n_lanes,), torch.uint8, torch.uint8, device)
        self.state = _each(
            lambda leaf: _Column(self.n_rollouts, leaf.shape, leaf.dtype, torch.float16, device),
            rollout.state,
        )
        self.tree = SumTree(self.n_rollouts * self.n_lanes, device)
        self.is_fine = torch.zeros(self.n_rollouts, dtype=torch.bool, device=device)
        self.n_added = torch.zeros(1, dtype=torch.int64, device=device)  # rollouts, ever
        self.n_available = torch.zeros((), dtype=torch.int64, device=device)  # sequences
        # the priority of sequences that were not learnt from: the largest of the last sample
        self.fresh = torch.ones((), dtype=torch.float64, device=device)

    @property
    def capacity(self) -> int:
        """Observations that there is room for."""
        return self.n_rollouts * self.n_steps * self.n_lanes

    @property
    def bytes(self) -> int:
        """All that is allocated."""
        columns = [*leaves(self.columns), *leaves(self.state), self.flags]
        others = self.is_fine, self.n_added, self.n_available, self.fresh
        return (
            sum(column.rows.nbytes for column in columns)
            + sum(tensor.nbytes for tensor in others)
            + self.tree.bytes
        )

    @property
    def is_ready(self) -> torch.Tensor:
        """Whether there is a sequence to draw, and `start` samples were collected: a bool ()."""
        n_collected = self.n_added[0] * (self.n_steps * self.n_lanes)
        return (self.n_available > 0) & (n_collected >= self.settings.start)

    @torch.no_grad()
    def add(self, rollout: Rollout, is_fine: torch.Tensor | bool = True) -> None:
        """Stores the rollout that followed the one added last, in place of the oldest. No sequence
        with a row of a rollout that is not fine, a bool (), will be drawn; its rows are stored as
        zeros, as a sample holds some of them while nothing can be drawn.
        """
        is_fine = torch.ones_like(self.is_fine[:1]) & is_fine
        steps = torch.arange(self.n_steps, device=self.n_added.device)
        lanes = torch.arange(self.n_lanes, device=self.n_added.device)
        slot = self.n_added % self.n_rollouts
        rows = slot * self.n_steps + steps
        for name, columns in self.columns.items():
            kept = _each(lambda leaf: torch.where(is_fine, leaf, 0), getattr(rollout, name))
            _each(lambda column, leaf: column.write(rows, leaf), columns, kept)
        bits = [getattr(rollout, name)[: self.n_steps].byte() << i for i, name in enumerate(_FLAGS)]
        self.flags.write(rows, sum(bits))
        _each(lambda column, leaf: column.write(slot, leaf[None]), self.state, rollout.state)
        self.is_fine.index_copy_(0, slot, is_fine)
        self.n_added += 1

        self.tree.set(slot * self.n_lanes + lanes, torch.zeros_like(lanes))
        # the rollout of which the last row, that of the next observation, has just come
        within = torch.arange(_rollouts_of(self.length, self.n_steps), device=slot.device)
        first = self.n_added - len(within)
        is_whole = (first >= 0) & self.is_fine[(first + within) % self.n_rollouts].all()
        slot = first % self.n_rollouts
        self.tree.set(slot * self.n_lanes + lanes, (self.fresh * is_whole).expand(self.n_lanes))
        self.n_available.copy_((self.tree.priorities > 0).sum())

    @torch.no_grad()
    def sample(self, n: int, generator: torch.Generator | None = None) -> arrdict:
        """M = n sequences, as `Rollout.sequences` gives them, L steps long and (L+1, M, ...) or (L,
        M, ...), and of each, (M,):

        index        int64, what `set_priorities` takes
        probability  float64, of being drawn, in each of n equal parts of all there is
        weight       float32, what its loss counts, so that what is drawn often does not count often
                     (importance sampling; Schaul et al. 2016), the largest 1
        age          int64, rollouts that were added after the one it starts in

        While nothing can be drawn, it holds numbers that mean nothing, all of them finite.
        """
        index = self.tree.sample(n, generator)
        probability = self.tree.probability(index)
        slot, lane = index // self.n_lanes, index % self.n_lanes
        window = torch.arange(self.length + 1, device=index.device)[:, None]
        rows = (slot * self.n_steps + window) % (self.n_rollouts * self.n_steps)
        rows = rows * self.n_lanes + lane  # (L+1, M), among rows (K T B, ...)
        batch = arrdict()
        for name, columns in self.columns.items():
            some = rows if name in _MORE else rows[:-1]
            batch[name] = _each(lambda column, some=some: column.read(some), columns)
        flags = self.flags.read(rows)
        for i, name in enumerate(_FLAGS):
            flag = (flags >> i & 1).bool()
            batch[name] = flag if name in _MORE else flag[:-1]
        batch["state"] = _each(lambda column: column.read(index), self.state)
        likely = (self.n_available * probability).clamp(min=1e-30) ** -self.settings.beta
        batch["index"], batch["probability"] = index, probability
        batch["weight"] = (likely / likely.amax()).float()
        batch["age"] = (self.n_added - 1 - slot) % self.n_rollouts
        return batch

    @torch.no_grad()
    def set_priorities(self, index: torch.Tensor, values: torch.Tensor) -> None:
        """Says how much sequences, of the last sample, are worth being drawn again: values (M,),
        of which a power is taken. What is not finite changes nothing. Uniform memories ignore it,
        as all do until they are ready: what was drawn until then was not learnt from.
        """
        if self.settings.alpha == 0:
            return
        old = self.tree.priorities.index_select(0, index)
        new = values.double().clamp(min=_MIN_PRIORITY) ** self.settings.alpha
        is_set = self.is_ready & (old > 0) & new.isfinite()  # 0: what cannot be drawn
        self.tree.set(index, torch.where(is_set, new, old))
        largest = torch.where(is_set, new, 0.0).amax()
        self.fresh.copy_(torch.where(largest > 0, largest, self.fresh))


def bytes_per_observation(
    env: Any, policy: Any, n_steps: int, settings: ReplaySettings, logprobs: bool = True
) -> float:
    """What a replay memory of rollouts of T steps takes for each observation, of an environment
    like this one.
    """
    meta = torch.device("meta")
    spaces_of = env.obs_space, env.action_space
    state = policy.initial(1, meta)
    rollout = Rollout(n_steps, 1, *spaces_of, state, meta, policy.privileged_space, values=False)
    replay = Replay(rollout, *spaces_of, settings, logprobs)
    return replay.bytes / replay.capacity


class _Column:
    """Rows (R, ...) of one part of what is stored, in a dtype of their own."""

    def __init__(self, n_rows, shape, given, stored, device):
        self.given = given
        self.rows = torch.zeros(n_rows, *shape, dtype=stored, device=device)

    def write(self, index, values):
        """Stores values (>= m, ...), as many as the index (m,) has rows."""
        values = _cast(values[: len(index)], self.rows.dtype)
        self.rows.index_copy_(0, index, values)

    def read(self, index):
        """Rows of a lane each, index (...) into (R B): (..., shape of a lane)."""
        rows = self.rows.flatten(0, 1).index_select(0, index.flatten())
        return _cast(rows, self.given).unflatten(0, index.shape)


def _cast(values, dtype):
    """Values in another dtype: fractions from 0 to 1 as integers from 0 to 255 and back, float16
    clipped to what it can hold.
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


def _stored_dtype(space, images):
    """What values of a space are stored in; None: in what they have."""
    if isinstance(space, spaces.MultiDiscrete):
        dtypes = torch.uint8, torch.int16, torch.int32
        return next(d for d in dtypes if space.n_actions - 1 <= torch.iinfo(d).max)
    if isinstance(space, spaces.MultiImage) and images == "uint8":
        return torch.uint8
    return None


def _each(f, tree, *others):
    """f of every leaf of a tree, and of those of others with the same keys."""
    if not isinstance(tree, dict):
        return f(tree, *others)
    return arrdict({key: _each(f, tree[key], *(other[key] for other in others)) for key in tree})
