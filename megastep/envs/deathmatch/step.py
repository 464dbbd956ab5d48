"""One step of Deathmatch, as one operation of the device. N environments, A agents each, B lanes."""

import math
from typing import NamedTuple

import torch

from megastep.engine import checks
from megastep.engine.agents import Agents
from megastep.engine.devices import threads
from megastep.engine.launch_params import lanes_of, state_params
from megastep.engine.outputs import Observation
from megastep.engine.scenery import Scenery
from megastep.kernels.build.launch import launch, params

__all__ = ["MAX_AGENTS", "DeathmatchStep", "deathmatch_step"]

MAX_AGENTS = 16  # agents per environment


class DeathmatchStep(NamedTuple):
    """A step of agents that hit whoever stands in the middle of their view, one value per lane."""

    reward: torch.Tensor  # (B,)
    reset: torch.Tensor  # (B,) bool, as the next two
    terminal: torch.Tensor
    truncated: torch.Tensor
    metrics: torch.Tensor  # (4, B): where an episode ends, kills, deaths, damage, accuracy; else 0
    vitals: torch.Tensor  # (B, 1, 3) fp16: health, whether it hit somebody, how many hit it
    told: torch.Tensor | None  # (B, 1, 1 + 5 (A - 1)): what a critic is told; None if not wanted


def deathmatch_step(
    scenery: Scenery,
    agents: Agents,
    view: Observation,
    health: torch.Tensor,
    tally: torch.Tensor,
    ages: torch.Tensor,
    ended: torch.Tensor,
    *,
    damage: float = 0.1,
    recovery: float = 0.0,
    drain: float = 0.0,
    spoils: float = 0.0,
    limit: int = 1000,
    hit_reward: float = 1.0,
    wound_cost: float = 1.0,
    kill_reward: float = 0.0,
    death_cost: float = 0.0,
    aim_reward: float = 0.0,
    told: bool = False,
) -> DeathmatchStep:
    """Each agent hits whoever stands in the middle of its view; see
    :class:`~megastep.envs.Deathmatch`. Those that begin an episode neither hit nor are hit.

    Args: ``view``, as of :func:`observe` by one camera per agent, with ``centre_line`` and, for
    aim_reward, ``agent_ray``; in place, ``health`` (B,) float32, 1 where whole, ``tally`` (3, B)
    float32, kills, damage and hits of an episode so far, ``ages`` (B,) int32, ``ended`` (B,) bool,
    lanes that begin an episode in this step, and then those that end theirs. Of health, 1 in all,
    ``damage`` is what a hit takes, ``spoils`` what it gives whoever scored it, ``recovery`` what a
    step without a wound gives back, ``drain`` what any step takes; ``limit`` steps per episode;
    rewards and costs per hit, per wound, per kill (shared among those who hit last), per death, and
    for an agent in the middle of the view, falling to 0 at its edge; ``told``: what a critic is
    told is wanted, too.
    """
    n, a = lanes = lanes_of(scenery, agents)
    on, n_lanes = scenery.device, n * a
    if not 2 <= a <= MAX_AGENTS:
        raise ValueError(f"shoot takes 2 to {MAX_AGENTS} agents per environment, not {a}")
    if agents.n_cameras > 1:
        raise ValueError(f"shoot takes one camera per agent, not {agents.n_cameras}")
    checks.instance("view", view, Observation)
    rules = dict(damage=damage, recovery=recovery, drain=drain, spoils=spoils)
    prices = dict(hit_reward=hit_reward, wound_cost=wound_cost, kill_reward=kill_reward)
    prices |= dict(death_cost=death_cost, aim_reward=aim_reward)
    for name, value in {**rules, **prices}.items():
        checks.number(name, value, -math.inf, math.inf)
    for name, value in rules.items():
        if value < 0:
            raise ValueError(f"{name} must be at least 0, not {value:g}")
    agent_ray, poses = 0, dict(positions=0, angles=0)
    if aim_reward:
        agent_ray = checks.address("view.agent_ray", view.agent_ray, lanes, torch.int32, on)
    if checks.flag("told", told):
        poses = state_params(scenery, agents, "positions", "angles")
    flags = [torch.empty(n_lanes, dtype=torch.bool, device=on) for _ in range(3)]
    half, n_told = torch.float16, 1 + 5 * (a - 1)
    out = DeathmatchStep(
        torch.empty(n_lanes, device=on),
        *flags,
        metrics=torch.empty((4, n_lanes), device=on),
        vitals=torch.empty((n_lanes, 1, 3), dtype=half, device=on),
        told=torch.empty((n_lanes, 1, n_told), device=on) if told else None,
    )
    packed = params.ShootParams(
        centre_line=checks.address("view.centre_line", view.centre_line, lanes, torch.int32, on),
        agent_ray=agent_ray,
        **poses,
        health=checks.address("health", health, (n_lanes,), torch.float32, on),
        tally=checks.address("tally", tally, (3, n_lanes), torch.float32, on),
        ages=checks.address("ages", ages, (n_lanes,), torch.int32, on),
        ended=checks.address("ended", ended, (n_lanes,), torch.bool, on),
        **{k: 0 if v is None else v.data_ptr() for k, v in out._asdict().items()},
        **rules,
        **prices,
        limit=checks.integer("limit", limit, 1, 2**31 - 1),
        res=agents.res,
        n_envs=n,
        n_agents=a,
        n_model=len(scenery.model),
        n_threads=threads(),
    )
    launch("shoot", packed, on, threads=n)
    return out
