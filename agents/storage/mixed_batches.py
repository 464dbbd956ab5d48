"""Minibatches of fresh sequences followed by replayed ones.

T time, M lanes of a minibatch, fresh ones first.
"""

import torch

from megastep.agents.networks.policy import Policy
from megastep.agents.storage.replay import ReplayBuffer
from megastep.agents.storage.rollout import Rollout
from megastep.arrdict import arrdict, cat
from megastep.dotdict import mapping

# keys with a time axis
_IN_TIME = (
    *("obs", "privileged", "starts", "learns", "mask"),
    *("actions", "logprobs", "reward", "terminal", "truncated"),
)


def from_rollout(rollout: Rollout, lanes: torch.Tensor) -> arrdict:
    """Returns `Rollout.sequences` of some lanes (M,), with `weight` 1 and `age` 0, both (M,)."""
    batch = rollout.sequences(lanes)
    return arrdict(batch, weight=torch.ones_like(batch.reward[0]), age=torch.zeros_like(lanes))


def add_replayed(
    batch: arrdict, replay: ReplayBuffer, policy: Policy, n: int, generator: torch.Generator
) -> arrdict:
    """Returns a fresh batch followed by n replayed sequences, (T, M + n, ...).

    Burn-in steps warm up the hidden state and are then removed. Until the buffer is ready, replayed
    sequences have `learns` false. `index` (n,) is for `ReplayBuffer.set_priorities`.
    """
    replayed = _burn_in(replay.sample(n, generator), policy, replay.settings.burn_in)
    replayed["learns"] = replayed.learns & replay.is_ready
    joined = {key: cat([batch[key], replayed[key]], int(key in _IN_TIME)) for key in batch}
    return arrdict(joined, index=replayed.index)


def _burn_in(batch, policy, n_steps) -> arrdict:
    """Returns a batch without its first steps, with the hidden state after them."""
    if not n_steps:
        return batch
    first, rest = mapping(lambda leaf: leaf[:n_steps]), mapping(lambda leaf: leaf[n_steps:])
    state = policy.warm_up(first(batch.obs), first(batch.starts), batch.state)
    parts = {key: rest(part) if key in _IN_TIME else part for key, part in batch.items()}
    return arrdict(parts, state=state)
