"""Minibatches of fresh sequences and replayed ones, side by side.

Axes: T time, M lanes of a minibatch, of which the first are fresh.
"""

from typing import Any

import torch

from megastep.agents.storage.replay import Replay
from megastep.agents.storage.rollout import Rollout
from megastep.arrdict import arrdict, cat
from megastep.dotdict import mapping

# what has an axis of time
_IN_TIME = (
    *("obs", "privileged", "starts", "learns"),
    *("actions", "logprobs", "reward", "terminal", "truncated"),
)


def fresh(rollout: Rollout, rows: torch.Tensor) -> arrdict:
    """Whole sequences of some lanes, rows (M,), as `Rollout.sequences` gives them; and of each,
    (M,), `weight` in the loss, 1, and `age`, 0.
    """
    batch = rollout.sequences(rows)
    return arrdict(batch, weight=torch.ones_like(batch.reward[0]), age=torch.zeros_like(rows))


def with_replayed(
    batch: arrdict, replay: Replay, policy: Any, n: int, generator: torch.Generator
) -> arrdict:
    """A fresh batch and n sequences of a replay memory behind it, (T, M + n, ...). Their burn-in
    has warmed up the policy's memory. None of them learns while there is nothing to draw.

    `index` (n,) is what `Replay.set_priorities` takes.
    """
    drawn = _warmed_up(replay.sample(n, generator), policy, replay.settings.burn_in)
    drawn["learns"] = drawn.learns & replay.is_ready
    joined = {key: cat([batch[key], drawn[key]], int(key in _IN_TIME)) for key in batch}
    return arrdict(joined, index=drawn.index)


@torch.no_grad()
def _warmed_up(batch, policy, burn_in):
    """A batch less its first steps, with the state after them."""
    if not burn_in:
        return batch
    first, rest = mapping(lambda leaf: leaf[:burn_in]), mapping(lambda leaf: leaf[burn_in:])
    state = policy.unroll(first(batch.obs), first(batch.starts), batch.state).state
    parts = {key: rest(part) if key in _IN_TIME else part for key, part in batch.items()}
    return arrdict(parts, state=state)
