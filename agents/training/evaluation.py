"""What a policy earns: the first episode of every lane, and a confidence interval for its mean.

B lanes, N environments. The host waits for the device once every `CHECK` steps, and at the end.
"""

from collections.abc import Mapping, Sequence
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
    steps, `done` (B,) bool, `learns` (B,) bool, as of the first world, `metrics` by name (B,)
    float32, of the world it ended with, nan without one, `envs` (B,) int64, the environment that
    the lane is of, and `homes` (B,) int32, on the environment's device.

    `homes` are the layouts that the environment shows after its reset, one per lane; a layout
    changes at respawns alone, so each lane's episode is played in that home from end to end.
    Without `env.layout` there is no such key. An episode still going after `max_steps` is reported
    as it stands, with `done` False.
    """
    device, lanes = torch.device(env.device), env.n_envs * env.n_agents
    generator = torch.Generator(device).manual_seed(seed)
    world, state = env.reset(), policy.initial(lanes, device)
    layout = getattr(env, "layout", None)
    envs = torch.arange(env.n_envs, device=device).repeat_interleave(env.n_agents)
    homes = {} if layout is None else {"homes": layout.repeat_interleave(env.n_agents)}
    returns, lengths = (torch.zeros(lanes, device=device) for _ in range(2))
    done = torch.zeros(lanes, dtype=torch.bool, device=device)
    learns = torch.ones_like(done) if "learns" not in world else world["learns"].clone()
    metrics = arrdict(
        {name: torch.full_like(returns, torch.nan) for name in world.get("metrics", {})}
    )
    for step in range(max_steps):
        if step % CHECK == 0 and bool(done.all()):
            break
        decision, state = policy(world, state, sample=not greedy, generator=generator)
        world = env.step(decision)
        returns += torch.where(done, 0.0, world.reward)
        lengths += ~done
        ends = (world.terminal | world.truncated) & ~done
        for name, values in metrics.items():
            values.copy_(torch.where(ends, world["metrics"][name], values))
        done |= ends
    return arrdict(
        returns=returns,
        lengths=lengths,
        done=done,
        learns=learns,
        metrics=metrics,
        envs=envs,
        **homes,
    )


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


def summaries(episodes: Mapping, roles: Sequence[str] | None = None) -> list[dict]:
    """A table's rows for what `first_episodes` gave: of all lanes that learn, or of all if none
    does; and of those of each role, where an environment's lanes have `roles` in turn.
    """
    learns = episodes["learns"].cpu().numpy()
    learns = learns if learns.any() else ~learns
    rows = [_summary(episodes, learns)]
    of_lane = np.resize(np.array(roles or ()), len(learns))
    for role in dict.fromkeys(roles or ()):
        if (chosen := learns & (of_lane == role)).any():
            rows.append({"role": role, **_summary(episodes, chosen)})
    return rows


def _summary(episodes, chosen):
    """The mean return of the chosen lanes (B,) with its 95 % interval, their mean length, the means
    of their metrics where episodes ended, and what all was taken over; `homes` is None where there
    are none. Without homes, or in a single one, intervals are over environments.
    """
    taken = {
        key: episodes[key].cpu().numpy()[chosen]
        for key in ("returns", "lengths", "done", "envs", "homes")
        if key in episodes
    }
    homes, done = taken.get("homes"), taken["done"]
    groups = taken["envs"] if homes is None or len(np.unique(homes)) == 1 else homes
    mean, lower, upper = interval(taken["returns"], groups)
    return {
        "return": mean,
        "lower": lower,
        "upper": upper,
        "length": float(taken["lengths"].mean()),
        "lanes": int(chosen.sum()),
        "homes": None if homes is None else len(np.unique(homes)),
        "unfinished": int((~done).sum()),
        "metrics": {
            name: _metric(values.cpu().numpy()[chosen][done], groups[done])
            for name, values in episodes["metrics"].items()
        },
    }


def _metric(values, homes):
    """The mean with its 95 % interval; None for each where no episode ended."""
    found = interval(values, homes) if len(values) else (None,) * 3
    return dict(zip(("mean", "lower", "upper"), found, strict=True))
