"""The engine's operations that are a game's whole step: ``pong``, ``shoot`` and ``seek``.

N environments, A agents per environment, B lanes.
"""

import math

import torch

from . import checks
from .agents import Agents, check_flag_on_cpu, check_on_cpu
from .devices import threads
from .goal_fields import GoalFields
from .kernels.launch import launch, params
from .launch_params import error_flag as error_flag_of
from .launch_params import lanes_of, scenery_params, seed_params, state_params
from .outputs import Observation, Pong, Shots, Sought
from .scenery import Scenery

__all__ = [
    "CELL",
    "FEATURES",
    "GAME_FIELDS",
    "JOURNEY",
    "MAX_SHOOTERS",
    "PIXELS",
    "pong",
    "seek",
    "shoot",
]

MAX_SHOOTERS = 16  # agents per environment
GAME_FIELDS = 13  # of a game of Pong
FEATURES = 8  # that a side is told of it
PIXELS = 30, 40  # of its picture
JOURNEY = 7  # numbers that are kept of an agent that seeks a goal
TOLD = 4  # numbers that its critic is told
CELL = 256  # parts of a pixel that its places and speeds are counted in


def pong(
    games: torch.Tensor,
    actions: torch.Tensor,
    error_flag: torch.Tensor,
    seed: int,
    *,
    restart: bool = False,
    points: int = 1,
    limit: int = 1000,
    tracker_speed: float = 0.5,
    pixels: torch.Tensor | None = None,
) -> Pong:
    """One step of N games of Pong, or, where the last step ended one, the start of another; see
    :class:`~megastep.envs.Pong`. Each serve draws once from the environment's random stream.

    Args: ``games`` (13, N) int32, updated in place, zeros before the first ``restart``, which
    starts all; ``actions`` (B, 1) int64, of one lane per game, or two, the left paddle first: 0
    nothing, 1 up, 2 down; ``error_flag`` (1,) int32, see :func:`check_flag`; ``points`` that win a
    game; ``limit`` steps that truncate it; ``tracker_speed`` cells per step of the right paddle
    where it is no lane; ``pixels`` (B, 1, 1, 30, 40) uint8, written instead of features.
    """
    n, on = checks.length("games", games, axis=1), games.device
    lanes = checks.length("actions", actions)
    if lanes not in (n, 2 * n) or actions.device != on:
        raise ValueError(
            f"actions must be of one lane or two for each of the {n} games on {on}, but those of "
            f"{lanes} lanes on {actions.device} were given"
        )
    flags = [torch.empty(lanes, dtype=torch.bool, device=on) for _ in range(3)]
    reward, points_won = (torch.empty(lanes, device=on) for _ in range(2))
    features, pixels_at = None, 0
    if pixels is None:
        features = torch.empty((lanes, 1, FEATURES), dtype=torch.float16, device=on)
    else:
        pixels_at = checks.address("pixels", pixels, (lanes, 1, 1, *PIXELS), torch.uint8, on)
        if pixels_at % 8:
            raise ValueError("pixels must begin at a multiple of 8 bytes, as a whole tensor does")
    speed = checks.number("tracker_speed", tracker_speed, -math.inf, PIXELS[1], "cells per step")
    if speed < 0:
        raise ValueError(f"tracker_speed must be at least 0 cells per step, not {speed:g}")
    packed = params.PongParams(
        games=checks.address("games", games, (GAME_FIELDS, n), torch.int32, on),
        actions=checks.address("actions", actions, (lanes, 1), torch.int64, on),
        reward=reward.data_ptr(),
        reset=flags[0].data_ptr(),
        terminal=flags[1].data_ptr(),
        truncated=flags[2].data_ptr(),
        points_won=points_won.data_ptr(),
        features=0 if features is None else features.data_ptr(),
        pixels=pixels_at,
        error_flag=checks.address("error_flag", error_flag, (1,), torch.int32, on),
        **seed_params(seed),
        n_envs=n,
        n_sides=lanes // n,
        restart=int(checks.flag("restart", restart)),
        points=checks.integer("points", points, 1, 2**31 - 1),
        limit=checks.integer("limit", limit, 1, 2**31 - 1),
        tracker_speed=round(CELL * speed),
        n_threads=threads(),
    )
    launch("pong", packed, on, threads=n)
    check_flag_on_cpu(error_flag)
    return Pong(reward, *flags, points_won, features)


def shoot(
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
) -> Shots:
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
    if not 2 <= a <= MAX_SHOOTERS:
        raise ValueError(f"shoot takes 2 to {MAX_SHOOTERS} agents per environment, not {a}")
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
    out = Shots(
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


def seek(
    scenery: Scenery,
    agents: Agents,
    goals: GoalFields,
    chosen: torch.Tensor,
    journey: torch.Tensor,
    ages: torch.Tensor,
    ended: torch.Tensor,
    draws: torch.Tensor,
    spawned: torch.Tensor,
    free: torch.Tensor | None = None,
    *,
    seed: int = 1,
    reach: float = 0.2,
    bonus: float = 5.0,
    cost: float = 0.02,
    limit: int = 500,
    told: bool = False,
) -> Sought:
    """Each agent is told where its goal lies, paid for what the shortest way there has become
    shorter, and done within ``reach`` metres; see :class:`~megastep.envs.PointGoal`. Those that
    begin an episode draw a goal, once from their random stream.

    Args: in place, ``chosen`` (B,) int32, the goals' numbers, ``journey`` (7, B) float32, of which
    rows 2 to 6 are metres to go by the shortest way, the same at the start, the length of the
    shortest way from there, metres walked, and collisions; ``ages`` (B,) int32, ``ended`` (B,)
    bool, lanes that begin an episode in this step, and then those that end theirs, ``draws`` (B,)
    int32, goals drawn so far; ``spawned`` (N, A) int32, the spawn points of those that begin one;
    ``free`` (N, A) float32, the progress of :func:`physics`, None if no step was taken; ``bonus``
    for being there, ``cost`` of a step, ``limit`` steps per episode; ``told``: what a critic is
    told is wanted, too.
    """
    n, a = lanes = lanes_of(scenery, agents)
    on, n_lanes = scenery.device, n * a
    checks.instance("goals", goals, GoalFields)
    if goals.n_layouts != len(scenery.layouts) or goals.device != on:
        raise ValueError(
            f"goals must be of the scenery's {len(scenery.layouts)} layouts and on {on}, but those "
            f"of {goals.n_layouts} on {goals.device} were given"
        )
    for name, value in dict(reach=reach, bonus=bonus, cost=cost).items():
        checks.number(name, value, -math.inf, math.inf)
    flags = [torch.empty(n_lanes, dtype=torch.bool, device=on) for _ in range(3)]
    out = Sought(
        torch.empty(n_lanes, device=on),
        *flags,
        metrics=torch.empty((4, n_lanes), device=on),
        bearing=torch.empty((n_lanes, 1, 3), dtype=torch.float16, device=on),
        told=torch.empty((n_lanes, 1, TOLD), device=on) if checks.flag("told", told) else None,
    )
    packed = params.SeekParams(
        scenery=scenery_params(scenery, agents.radius),
        **state_params(scenery, agents, "positions", "angles"),
        free=0 if free is None else checks.address("free", free, lanes, torch.float32, on),
        spawned=checks.address("spawned", spawned, lanes, torch.int32, on),
        **goals.addresses,
        draws=checks.address("draws", draws, (n_lanes,), torch.int32, on),
        goals=checks.address("chosen", chosen, (n_lanes,), torch.int32, on),
        journey=checks.address("journey", journey, (JOURNEY, n_lanes), torch.float32, on),
        ages=checks.address("ages", ages, (n_lanes,), torch.int32, on),
        ended=checks.address("ended", ended, (n_lanes,), torch.bool, on),
        error_flag=error_flag_of(scenery, agents),
        **{k: 0 if v is None else v.data_ptr() for k, v in out._asdict().items()},
        **seed_params(seed),
        per_cell=1 / goals.cell,
        reach=reach,
        bonus=bonus,
        cost=cost,
        limit=checks.integer("limit", limit, 1, 2**31 - 1),
        n_goals=goals.n_goals,
        n_spawns=goals.n_spawns,
    )
    launch("seek", packed, on, threads=n_lanes)
    check_on_cpu(agents)
    return out
