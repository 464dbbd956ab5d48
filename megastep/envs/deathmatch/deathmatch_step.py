"""One step of Deathmatch as one operation. N environments, A agents each, B = N A lanes."""

import math
from pathlib import Path
from typing import NamedTuple

import torch

from megastep.devices import threads
from megastep.engine import checks
from megastep.engine.agents import Agents
from megastep.engine.launch_params import lanes_of, state_params
from megastep.engine.rendering import Observation
from megastep.engine.scenery import Scenery
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import launch

__all__ = [
    *("MAX_AGENTS", "LIBRARY", "TALLY_ROWS"),
    *("DeathmatchStep", "actions_of_live", "deathmatch_step", "privileged_size"),
]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
MAX_AGENTS = LIBRARY.constants["MAX_AGENTS"]  # per environment
TALLY_ROWS = LIBRARY.constants["TALLY_ROWS"]


class DeathmatchStep(NamedTuple):
    """The outcome of a step, one row per lane."""

    reward: torch.Tensor  # (B,)
    reset: torch.Tensor  # (B,) bool
    terminal: torch.Tensor  # (B,) bool
    truncated: torch.Tensor  # (B,) bool
    metrics: torch.Tensor  # (4, B): kills, deaths, damage, accuracy where an episode ends; else 0
    health_obs: torch.Tensor  # (B, 1, 3) fp16: health, whether it hit, how many hit it
    sound: torch.Tensor | None  # (B, 1, 3) fp16: loudness, cosine and sine; None if not wanted
    privileged: torch.Tensor | None  # (B, 1, privileged_size(A)) for a critic; None if not wanted


def privileged_size(n_agents: int) -> int:
    """Returns the size of the privileged observation: the agent's health, and five numbers per
    other agent.
    """
    return 1 + LIBRARY.constants["PRIVILEGED_PER_OPPONENT"] * (n_agents - 1)


def actions_of_live(actions: torch.Tensor, ended: torch.Tensor) -> torch.Tensor:
    """Returns the actions (B, 1) int64 that a step takes: 0 where an episode has ended.

    Args:
        actions: (B, 1) int64.
        ended: (B,) bool, lanes whose episode ended in the last step.
    """
    n, device = len(ended), ended.device
    out = torch.empty((n, 1), dtype=torch.int64, device=device)
    launch(
        *(LIBRARY, "actions_of_live", device, n),
        actions=checks.address("actions", actions, (n, 1), torch.int64, device),
        ended=checks.address("ended", ended, (n,), torch.bool, device),
        out=out,
        n_lanes=n,
    )
    return out


def deathmatch_step(
    scenery: Scenery,
    agents: Agents,
    view: Observation,
    health: torch.Tensor,
    tally: torch.Tensor,
    ages: torch.Tensor,
    ended: torch.Tensor,
    round_ages: torch.Tensor | None = None,
    *,
    damage: float = 0.1,
    recovery: float = 0.0,
    drain: float = 0.0,
    health_per_hit: float = 0.0,
    limit: int = 1000,
    hit_reward: float | torch.Tensor = 1.0,
    wound_cost: float | torch.Tensor = 1.0,
    kill_reward: float | torch.Tensor = 0.0,
    death_cost: float | torch.Tensor = 0.0,
    aim_reward: float | torch.Tensor = 0.0,
    search_reward: float = 0.0,
    hearing: float = 0.0,
    privileged: bool = False,
) -> DeathmatchStep:
    """Lets each agent hit whoever is at the centre of its view; see
    :class:`~megastep.envs.Deathmatch`. An agent that starts an episode neither hits nor is hit.

    Args:
        view: from :func:`~megastep.engine.observe` with one camera per agent and ``centre_line``;
            with ``agent_ray`` too if ``aim_reward`` is not 0, and ``newly_seen`` if
            ``search_reward`` is not.
        health: (B,) float32, from 0 to 1, updated in place.
        tally: (4, B) float32, updated in place: kills, damage and hits of the episode so far, and
            how well the agent aimed in the last step.
        ages: (B,) int32, steps since the first observation, updated in place.
        ended: (B,) bool, updated in place. In: lanes that start an episode in this step. Out: lanes
            whose episode ends in this step.
        round_ages: (N,) int32, steps of the round, -1 if the next step begins one, updated in
            place. When they reach ``limit``, all episodes of the environment are truncated, but not
            while one begins. None: there are no rounds.
        damage: health that a hit costs its target.
        recovery: health regained in a step without a wound.
        drain: health lost in every step.
        health_per_hit: health gained by an agent that hits.
        limit: steps after which an episode is truncated.
        hit_reward: per hit; as the other rewards a number, or a tensor () on the device.
        wound_cost: per hit received.
        kill_reward: per kill, shared among the agents that hit the target in that step.
        death_cost: per death.
        aim_reward: for bringing another agent from the edge of the view to its centre; taken back
            as far as it leaves again.
        search_reward: per texel that ``view.newly_seen`` counts.
        hearing: metres at which the sound of the nearest other agent fades. 0: no sound.
        privileged: compute the privileged observation.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
    """
    n, a = lanes = lanes_of(scenery, agents)
    device, n_lanes = scenery.device, n * a
    if not 2 <= a <= MAX_AGENTS:
        raise ValueError(f"deathmatch_step takes 2 to {MAX_AGENTS} agents per environment, not {a}")
    if agents.n_cameras > 1:
        raise ValueError(f"deathmatch_step takes one camera per agent, not {agents.n_cameras}")
    checks.instance("view", view, Observation)
    rewards = dict(hit_reward=hit_reward, wound_cost=wound_cost, kill_reward=kill_reward)
    rewards |= dict(death_cost=death_cost, aim_reward=aim_reward)
    rewards = {name: checks.weight(name, value, device) for name, value in rewards.items()}
    rules = dict(damage=damage, recovery=recovery, drain=drain, health_per_hit=health_per_hit)
    rules |= dict(hearing=hearing)
    for name, value in dict(rules, search_reward=search_reward).items():
        checks.number(name, value, -math.inf, math.inf)
        if name in rules and value < 0:
            raise ValueError(f"{name} must be at least 0, not {value:g}")
    is_scheduled, poses = isinstance(aim_reward, torch.Tensor), dict(positions=0, angles=0)
    has_aim = view.agent_ray is not None if is_scheduled else aim_reward
    wanted = dict(centre_line=True, agent_ray=has_aim, newly_seen=search_reward)
    int32 = torch.int32, device
    seen = {
        name: checks.address(f"view.{name}", getattr(view, name), lanes, *int32) if is_wanted else 0
        for name, is_wanted in wanted.items()
    }
    if checks.flag("privileged", privileged) or hearing:
        poses = state_params(scenery, agents, "positions", "angles")
    flags = [torch.empty(n_lanes, dtype=torch.bool, device=device) for _ in range(3)]
    metrics, reward = torch.empty((4, n_lanes), device=device), torch.empty(n_lanes, device=device)
    health_obs = torch.empty((n_lanes, 1, 3), dtype=torch.float16, device=device)
    sound = torch.empty_like(health_obs) if hearing else None
    size = n_lanes, 1, privileged_size(a)
    privileged_out = torch.empty(size, device=device) if privileged else None
    outputs = dict(metrics=metrics, health_obs=health_obs, sound=sound, privileged=privileged_out)
    out = DeathmatchStep(reward, *flags, **outputs)
    launch(
        *(LIBRARY, "deathmatch_step", device, n),
        **seen,
        **poses,
        round_ages=checks.optional("round_ages", round_ages, (n,), *int32),
        health=checks.address("health", health, (n_lanes,), torch.float32, device),
        tally=checks.address("tally", tally, (TALLY_ROWS, n_lanes), torch.float32, device),
        ages=checks.address("ages", ages, (n_lanes,), *int32),
        ended=checks.address("ended", ended, (n_lanes,), torch.bool, device),
        **out._asdict(),
        **rules,
        **rewards,
        search_reward=search_reward,
        limit=checks.integer("limit", limit, 1, 2**31 - 1),
        res=agents.res,
        n_envs=n,
        n_agents=a,
        n_model=len(scenery.model),
        n_threads=threads(),
    )
    return out
