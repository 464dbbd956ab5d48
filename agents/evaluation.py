"""What a policy earns: the first episode of every lane, and a confidence interval for its mean.

B lanes, N environments. The host waits for the device once every `CHECK` steps, and at the end.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from megastep.arrdict import arrdict
from megastep.dotdict import mapping

#: Steps between two looks at whether all lanes are done: a look empties a GPU's queue, a
#: superfluous step costs little.
CHECK = 64


class RandomActions:
    """A policy that draws every action evenly; the row a trained one is compared with."""

    def __init__(self, action_space: Any):
        self.action_space = action_space

    def initial(self, n_lanes: int, device: torch.device | str) -> arrdict:
        return arrdict(lane=torch.zeros(n_lanes, device=device))

    def __call__(
        self, world: Mapping, state: Mapping, sample: bool = True, generator=None
    ) -> tuple[arrdict, Mapping]:
        lanes = len(state["lane"])

        @mapping
        def draw(space):
            return torch.randint(
                space.n_actions,
                (lanes, *space.shape),
                device=state["lane"].device,
                generator=generator,
            )

        return arrdict(actions=draw(self.action_space)), state


@torch.no_grad()
def first_episodes(
    env: Any, policy: Any, seed: int = 1, greedy: bool = False, max_steps: int = 100_000
) -> arrdict:
    """Plays each lane's first episode: arrdict of `returns` (B,) float32, `lengths` (B,) float32
    steps, `done` (B,) bool, and `homes` (B,) int32, on the environment's device.

    `homes` are the layouts that the environment shows after its reset, one per lane; a layout
    changes at respawns alone, so each lane's episode is played in that home from end to end.
    Without `env.layout` there is no such key. An episode still going after `max_steps` is reported
    as it stands, with `done` False.
    """
    device, lanes = torch.device(env.device), env.n_envs * env.n_agents
    generator = torch.Generator(device).manual_seed(seed)
    world, state = env.reset(), policy.initial(lanes, device)
    layout = getattr(env, "layout", None)
    homes = {} if layout is None else {"homes": layout.repeat_interleave(env.n_agents)}
    returns, lengths = (torch.zeros(lanes, device=device) for _ in range(2))
    done = torch.zeros(lanes, dtype=torch.bool, device=device)
    for step in range(max_steps):
        if step % CHECK == 0 and bool(done.all()):
            break
        decision, state = policy(world, state, sample=not greedy, generator=generator)
        world = env.step(decision)
        returns += torch.where(done, 0.0, world.reward)
        lengths += ~done
        done |= world.terminal | world.truncated
    return arrdict(returns=returns, lengths=lengths, done=done, **homes)


def interval(
    values: ArrayLike,
    groups: ArrayLike | None = None,
    level: float = 0.95,
    n_resamples: int = 2000,
    seed: int = 1,
) -> tuple[float, float, float]:
    """The mean of `values` (B,) and a bootstrap interval for it: `(mean, lower, upper)`.

    Lanes in one home are alike, so homes are drawn with replacement, each with all its lanes
    (`groups`, (B,) integers): Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section
    13.3. Each resample's estimate is that of the table, the mean over its lanes: the sum of the
    values drawn over their number, also where homes hold unequal numbers of lanes. Without groups,
    or with a single one, lanes are drawn.
    """
    values = np.asarray(values, float)
    groups = np.zeros(len(values)) if groups is None else np.asarray(groups)
    if len(np.unique(groups)) == 1:
        groups = np.arange(len(values))
    _, groups = np.unique(groups, return_inverse=True)
    sums, counts = np.bincount(groups, values), np.bincount(groups)
    chosen = np.random.default_rng(seed).integers(len(sums), size=(n_resamples, len(sums)))
    means = sums[chosen].sum(1) / counts[chosen].sum(1)
    lower, upper = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(values.mean()), float(lower), float(upper)


def summary(episodes: Mapping) -> dict:
    """A table's row for what `first_episodes` gave: the mean return with its 95 % interval, the
    mean length, and what they were taken over; `homes` is None where there are none.
    """
    homes = episodes["homes"].cpu().numpy() if "homes" in episodes else None
    mean, lower, upper = interval(episodes["returns"].cpu().numpy(), homes)
    return {
        "return": mean,
        "lower": lower,
        "upper": upper,
        "length": float(episodes["lengths"].mean()),
        "lanes": len(episodes["returns"]),
        "homes": None if homes is None else len(np.unique(homes)),
        "unfinished": int((~episodes["done"]).sum()),
    }
