"""Duels of two policies in an environment with several agents.

Axes: N environments, A agents, B = N A lanes. A slot is the index of an agent in its environment.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from megastep.agents.evaluation.playing import step_until
from megastep.agents.evaluation.statistics import interval, lanes_by_source, worst_homes
from megastep.agents.generator import SeededGenerator
from megastep.agents.selfplay.mixed_policy import MixedPolicy
from megastep.agents.selfplay.slots import rotating_slots, score_pairs
from megastep.arrdict import arrdict
from megastep.types import Env, PolicyLike, n_lanes, optional

if TYPE_CHECKING:
    from megastep.agents.types import Row
    from megastep.types import World

#: A duel is a draw after this many steps.
MAX_STEPS = 500


def duel_policy(
    policy: PolicyLike, opponent: PolicyLike, slots: torch.Tensor, n_agents: int
) -> MixedPolicy:
    """Returns a policy that is `policy` in one slot per environment and `opponent` in the others.

    Args:
        slots: (N, 1) int64.
    """
    in_slot = torch.zeros(len(slots), n_agents, dtype=torch.bool, device=slots.device)
    in_slot = in_slot.scatter(1, slots, True).flatten()
    lanes = torch.arange(len(in_slot), device=slots.device)
    return MixedPolicy([policy, opponent], [lanes[in_slot], lanes[~in_slot]])


@torch.no_grad()
def play(
    env: Env,
    policy: PolicyLike,
    opponent: PolicyLike,
    seed: int = 1,
    greedy: bool = False,
    max_steps: int = MAX_STEPS,
    slots: torch.Tensor | None = None,
) -> arrdict:
    """Plays one duel per environment, from a reset.

    A duel ends at the first step that is terminal for any of its agents; `score_pairs` decides who
    won. It is a draw if the episode is truncated or `max_steps` is reached first. With more than
    two agents, `opponent` controls all the others, and the score is the mean over decided pairs.

    Args:
        seed: of the action sampling.
        greedy: takes the most likely actions instead of sampling.
        slots: (N, 1) int64, the agent that `policy` controls; by default `rotating_slots`.

    Returns:
        An arrdict of

        - score: (N,) float32, 1 if `policy` won, 0 if it lost, 0.5 for a draw
        - lengths: (N,) float32, steps
        - slots: (N,) int64, the agent that `policy` controlled
        - homes: (N,) int32, the layouts after the reset; only if `env.layout` exists
    """
    device, n_agents = torch.device(env.device), optional(env, "n_agents")
    shape = env.n_envs, n_agents
    draws = SeededGenerator(seed)
    slots = rotating_slots(*shape, device) if slots is None else slots
    both = duel_policy(policy, opponent, slots, n_agents)
    world, state = env.reset(), both.initial(n_lanes(env), device)
    layout = optional(env, "layout")
    homes = {} if layout is None else {"homes": layout.clone()}
    returns, lengths = torch.zeros(shape, device=device), torch.zeros(env.n_envs, device=device)
    score, is_over = torch.full_like(lengths, 0.5), torch.zeros_like(lengths, dtype=torch.bool)

    def step(world, state) -> "tuple[World, arrdict]":
        decision, state = both(world, state, sample=not greedy, generator=draws.on(is_over.device))
        world = env.step(decision)
        names = "reward", "terminal", "truncated"
        outcome: list[torch.Tensor] = [world[name].view(shape) for name in names]
        reward, terminal, truncated = outcome
        returns.add_(reward)
        lengths.add_(~is_over)
        won, decided = score_pairs(terminal, returns, slots)
        score.copy_(torch.where((decided > 0) & ~is_over, won / decided, score))
        is_over.logical_or_((terminal | truncated).any(1))
        return world, state

    changed = both, draws, returns, lengths, score
    step_until(is_over, step, world, state, env, (policy, opponent), changed, max_steps)
    optional(env, "check")()
    return arrdict(score=score, lengths=lengths, slots=slots[:, 0], **homes)


def summaries(
    played: Mapping, roles: Sequence[str] | None = None, sources: Sequence[str] | None = None
) -> "list[Row]":
    """Returns table rows for the result of `play`: one overall, then one per role and one per
    source of homes.

    `won` is the fraction of duels won, a draw counting half; `lower` and `upper` are its 95 %
    interval over homes, or over duels if there are no homes.

    Args:
        roles: the role of each agent slot. A role's row has the duels in which `policy` played it.
        sources: the source of each home.
    """
    arrays = {key: values.cpu().numpy() for key, values in played.items()}
    rows, slots = [_summary(arrays)], arrays["slots"]
    roles = roles or ()
    for role in dict.fromkeys(roles):
        has_role = np.array([name == role for name in roles])[slots]
        if has_role.any():
            rows.append({"role": role, **_summary(_of(arrays, has_role))})
    for source, in_source in lanes_by_source(arrays.get("homes"), sources).items():
        rows.append({"source": source, **_summary(_of(arrays, in_source))})
    return rows


def worst_summary(played: Mapping) -> "Row":
    """Returns a table row of the worst homes, `statistics.worst_homes`, from a result of `play`."""
    arrays = {key: values.cpu().numpy() for key, values in played.items()}
    numbers, means = worst_homes({"won": arrays["score"]}, arrays["homes"])
    won = means["won"]
    row = _summary(_of(arrays, np.isin(arrays["homes"], numbers)))
    return row | {"won": won["mean"], "lower": won["lower"], "upper": won["upper"]}


def _of(arrays, is_included) -> dict[str, np.ndarray]:
    return {key: values[is_included] for key, values in arrays.items()}


def _summary(arrays) -> "Row":
    score, homes = arrays["score"], arrays.get("homes")
    mean, lower, upper = interval(score, homes)
    return {
        "won": mean,
        "lower": lower,
        "upper": upper,
        "wins": int((score == 1).sum()),
        "losses": int((score == 0).sum()),
        "draws": int(((score != 1) & (score != 0)).sum()),
        "length": float(arrays["lengths"].mean()),
        "duels": len(score),
        "homes": None if homes is None else len(np.unique(homes)),
    }
