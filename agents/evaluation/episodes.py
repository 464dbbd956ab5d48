"""Episodes of a policy in homes: the rows of a table, one per episode, and their means."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
import torch

from megastep.agents import factory
from megastep.agents.evaluation import arena, playing, statistics
from megastep.agents.factory import settings
from megastep.types import Env, PolicyLike, optional

if TYPE_CHECKING:
    import pandas  # pyright: ignore[reportMissingImports]

    from megastep.agents.types import Row

#: How an episode ended: terminal or truncated, as the environment said, or cut off at the limit of
#: steps.
ENDS = "cut off", "truncated", "terminal"


class Evaluation(NamedTuple):
    """The result of :func:`evaluate`.

    Attributes:
        rows: a dict per episode, see :func:`rows_of`.
        summary: dicts of means with their 95 % intervals: `return`, `lower`, `upper`, `length` in
            steps, `lanes`, `homes`, `unfinished` (counts) and `metrics`, {name: {mean, lower,
            upper}}. The first is of all episodes; others have a `role` or a `source` of homes.
    """

    rows: "list[Row]"
    summary: "list[Row]"

    def frame(self) -> "pandas.DataFrame":
        """Returns the rows as a pandas frame.

        Raises:
            ImportError: pandas is not installed.
        """
        import pandas  # pyright: ignore[reportMissingImports]

        return pandas.DataFrame(self.rows)


def evaluate(
    policy: PolicyLike,
    env: Env | settings.Env,
    episodes: int | None = None,
    geometries: Sequence = (),
    seed: int = 1,
    greedy: bool = False,
    max_steps: int | None = None,
) -> Evaluation:
    """Plays the first episode of each lane, and returns them one by one and their means.

    ::

        result = evaluation.evaluate(policy, envs.Explorer(geometries=homes, n_envs=64))
        print(result.summary[0]['return'], result.rows[0])

    Args:
        policy: acts; see :class:`megastep.types.PolicyLike`.
        env: an environment; or its settings, of which one is made in which each of the
            ``geometries`` is played equally often.
        episodes: with settings, the number of episodes, by default one in each geometry; rounded up
            to a multiple of geometries. An environment has as many as it has lanes.
        geometries: with settings, the homes.
        seed: of the action sampling and, with settings, of spawns.
        greedy: takes the most likely actions instead of sampling.
        max_steps: by default the environment's own limit.

    Raises:
        ValueError: ``episodes`` or ``geometries`` with an environment that is made already.
    """
    numbers = sources = None
    if dataclasses.is_dataclass(env):
        homes = [*geometries]
        device = getattr(next(iter(_parameters(policy)), None), "device", "cpu")
        chosen = cast("settings.Env", env)
        stage = arena.Stage(chosen, homes, episodes or max(1, len(homes)), seed, device)
        numbers, sources, made = stage.numbers, factory.sources_of(stage.homes), stage.env
    elif episodes is not None or geometries:
        raise ValueError(
            "an environment has as many episodes as lanes, in its own homes: give settings to "
            "choose episodes and geometries, or make it with another n_envs"
        )
    else:
        made = cast("Env", env)
    played = playing.first_episodes(made, policy, seed, greedy, max_steps)
    roles = optional(made, "roles")
    rows = rows_of(played, seed, numbers, sources, roles)
    return Evaluation(rows, statistics.summaries(played, roles, sources))


def _parameters(policy) -> "list[torch.Tensor]":
    return [*policy.parameters()] if isinstance(policy, torch.nn.Module) else []


def rows_of(
    played: Mapping,
    seed: int,
    numbers: Sequence[int] | None = None,
    sources: Sequence[str] | None = None,
    roles: Sequence[str] | None = None,
) -> "list[Row]":
    """Returns a dict per episode for the result of `playing.first_episodes`.

    Only lanes that learn have one, or all lanes if none learns, as in `statistics.summaries`. Keys,
    those of what is known:

    - episode: the number of the lane; seed: of the evaluation
    - home, source: its number in the split, and the source it is from
    - role: of the agent
    - start_x, start_y, start_angle: where the agent was put, metres and degrees
    - return, length (steps), and each metric by its name, None if it is not finite
    - ended: terminal, truncated, or cut off at the limit of steps

    Args:
        numbers: the number of each home in the split; by default its index.
        sources: the source of each home.
        roles: the role of each agent slot, repeated over environments.
    """
    arrays = {k: v.cpu().numpy() for k, v in played.items() if isinstance(v, torch.Tensor)}
    learns = arrays["learns"]
    lanes = np.flatnonzero(learns if learns.any() else ~learns)
    columns = {"episode": lanes.tolist(), "seed": [seed] * len(lanes)}
    if (homes := arrays.get("homes")) is not None:
        known = homes[lanes].tolist()
        columns["home"] = [home if numbers is None else numbers[home] for home in known]
        columns |= {"source": [sources[home] for home in known]} if sources else {}
    if roles:
        columns["role"] = [roles[lane % len(roles)] for lane in lanes]
    if (starts := arrays.get("starts")) is not None:
        names = "start_x", "start_y", "start_angle"
        columns |= dict(zip(names, starts[lanes].T.tolist(), strict=True))
    columns["return"] = arrays["returns"][lanes].tolist()
    columns["length"] = arrays["lengths"][lanes].astype(int).tolist()
    ended = arrays["done"][lanes].astype(int) + arrays["terminal"][lanes]
    columns["ended"] = [ENDS[how] for how in ended]
    for name, values in played["metrics"].items():
        finite = [x if np.isfinite(x) else None for x in values.cpu().numpy()[lanes].tolist()]
        columns[name + "_" * (name in columns)] = finite
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
