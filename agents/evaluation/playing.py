"""Plays episodes with a policy, and duels of two.

N environments of A agents, B = N A lanes. A slot is the index of an agent in its environment.
"""

from collections.abc import Callable, Sequence

import torch
from torch.utils import _pytree

from megastep.agents import console
from megastep.agents.generator import SeededGenerator
from megastep.agents.selfplay.mixed_policy import MixedPolicy, rotating_teams, score_pairs, teams_of
from megastep.agents.storage.collector import capture_with
from megastep.arrdict import arrdict
from megastep.types import Env, PolicyLike, Tree, World, n_lanes, optional

#: Steps between two checks of whether all episodes have ended. A check waits for the GPU, which
#: costs more than a few superfluous steps.
CHECK_EVERY = 64
#: A duel is a draw after this many steps.
MAX_STEPS = 500
#: Steps of a CUDA graph, a divisor of `CHECK_EVERY`.
STEPS_PER_GRAPH = 16


def step_until(
    is_over: torch.Tensor,
    step: Callable[[World, Tree], tuple[World, Tree]],
    world: World,
    state: Tree,
    env: Env,
    policies: tuple[PolicyLike, ...],
    roots: tuple,
    max_steps: int,
) -> None:
    """Calls `world, state = step(world, state)` until all of `is_over` is true, or `max_steps`
    times. On a GPU, in CUDA graphs after the first `CHECK_EVERY` steps, where libraries initialise
    themselves, if `can_capture`. `step` acts by `policies`, steps `env`, and changes only what is
    below them, `is_over` and `roots`, see `megastep.capture.capture`.
    """

    def several(world, state, n_steps=STEPS_PER_GRAPH) -> tuple[World, Tree]:
        for _ in range(n_steps):
            world, state = step(world, state)
        return world, state

    play, before = several, None
    for start in range(0, max_steps, STEPS_PER_GRAPH):
        if start % CHECK_EVERY == 0:
            n_over, n = int(is_over.sum()), is_over.numel()
            console.count(n_over, n)
            if n_over == n:
                break
        if start == CHECK_EVERY and is_over.is_cuda:
            carried = world, state
            if can_capture(env, policies) and _has_fixed_form(before, carried):
                changed = is_over, *roots
                play = capture_with(env, policies, several, carried, changed, warmup=1)
        before = world, state
        if start + STEPS_PER_GRAPH <= max_steps:
            world, state = play(world, state)
        else:
            several(world, state, max_steps - start)


def can_capture(env: Env, policies: Sequence[PolicyLike]) -> bool:
    """Returns whether steps may be replayed as a CUDA graph: all of them are `capturable`."""
    return optional(env, "capturable") and all(
        getattr(policy, "capturable", type(policy).__module__.startswith("megastep."))
        for policy in policies
    )


def _has_fixed_form(before, after) -> bool:
    """Whether both trees have tensors only, under the same names."""
    (_, spec), (leaves, other) = map(_pytree.tree_flatten, (before, after))
    return spec == other and all(isinstance(leaf, torch.Tensor) for leaf in leaves)


@torch.no_grad()
def first_episodes(
    env: Env, policy: PolicyLike, seed: int = 1, greedy: bool = False, max_steps: int | None = None
) -> arrdict:
    """Plays the first episode of each lane that learns, or of all lanes if none does.

    Args:
        seed: of the action sampling.
        greedy: takes the most likely actions instead of sampling.
        max_steps: maximum number of steps, by default the environment's `max_episode_steps`;
            unfinished episodes have `done` False.

    Returns:
        An arrdict on the environment's device, (B,) each:

        - returns, lengths (steps): float32
        - done, terminal: bool, true if the episode ended or is not played; if it was not truncated
        - learns: bool, from the first world; all true if worlds have no `learns`
        - metrics: name -> float32, from the last world of the episode; nan if unfinished
        - envs: int64, the lane's environment
        - homes: int32, the lane's layout; only if `env.layout` exists. Layouts change only at
          respawns, so the whole episode is played in it.
        - starts: (B, 3) float32, where each agent was put: x and y in metres, degrees; only of
          environments with a `core`
    """
    device, n_agents = torch.device(env.device), optional(env, "n_agents")
    draws = SeededGenerator(seed)
    world, state = env.reset(), policy.initial(n_lanes(env), device)
    layout = optional(env, "layout")
    envs = torch.arange(env.n_envs, device=device).repeat_interleave(n_agents)
    homes = {} if layout is None else {"homes": layout.repeat_interleave(n_agents)}
    agents = getattr(getattr(env, "core", None), "agents", None)
    starts = {}
    if agents is not None:
        poses = torch.cat([agents.positions, agents.angles[..., None]], -1)
        starts["starts"] = poses.flatten(0, 1).float().clone()
    returns, lengths = (torch.zeros(n_lanes(env), device=device) for _ in range(2))
    done, terminal = torch.zeros(2, n_lanes(env), dtype=torch.bool, device=device)
    learns = torch.ones_like(done) if "learns" not in world else world["learns"].clone()
    if learns.any():  # the others are not counted, and may be of agents that are not there
        done |= ~learns
    metrics = arrdict(
        {name: torch.full_like(returns, torch.nan) for name in world.get("metrics", {})}
    )

    def step(world, state) -> tuple[World, Tree]:
        decision, state = policy(world, state, sample=not greedy, generator=draws.on(done.device))
        world = env.step(decision)
        returns.add_(torch.where(done, 0.0, world.reward))
        lengths.add_(~done)
        ends = (world.terminal | world.truncated) & ~done
        for name, values in metrics.items():
            values.copy_(torch.where(ends, world["metrics"][name], values))
        done.logical_or_(ends)
        terminal.logical_or_(world.terminal & ends)
        return world, state

    changed = draws, returns, lengths, metrics, terminal
    most: int = optional(env, "max_episode_steps") if max_steps is None else max_steps
    step_until(done, step, world, state, env, (policy,), changed, most)
    played = arrdict(returns=returns, lengths=lengths, done=done, terminal=terminal)
    return arrdict(played, learns=learns, metrics=metrics, envs=envs, **homes, **starts)


# ---- Duels ----


def duel_policy(policy: PolicyLike, opponent: PolicyLike, own: torch.Tensor) -> MixedPolicy:
    """Returns a policy that is `policy` for some agents, (N, A) bool, `opponent` for the others."""
    lanes = torch.arange(own.numel(), device=own.device)
    return MixedPolicy([policy, opponent], [lanes[own.flatten()], lanes[~own.flatten()]])


@torch.no_grad()
def first_duels(
    env: Env,
    policy: PolicyLike,
    opponent: PolicyLike,
    seed: int = 1,
    greedy: bool = False,
    max_steps: int = MAX_STEPS,
    own: torch.Tensor | None = None,
) -> arrdict:
    """Plays one duel per environment, from a reset, to the first step that is terminal for any of
    its agents; `score_pairs` decides who won. It is a draw if the episode is truncated or
    `max_steps` is reached first. `opponent` controls all other agents than `policy`, or teams, as
    agents of one role are, and the score is the mean over decided pairs.

    Args:
        seed: of the action sampling.
        greedy: takes the most likely actions instead of sampling.
        own: (N, A) bool, the agents that `policy` controls; by default `rotating_teams`.

    Returns:
        An arrdict of `score`, float32: 1 if `policy` won, 0 if it lost, 0.5 for a draw; `lengths`,
        float32 steps; `slots`, int64, the first agent that `policy` controlled; and, if
        `env.layout` exists, `homes`, int32, the layouts after the reset: (N,) each.
    """
    device, shape = torch.device(env.device), (env.n_envs, optional(env, "n_agents"))
    draws = SeededGenerator(seed)
    own = rotating_teams(env.n_envs, teams_of(env)) if own is None else own
    both = duel_policy(policy, opponent, own)
    world, state = env.reset(), both.initial(n_lanes(env), device)
    layout = optional(env, "layout")
    homes = {} if layout is None else {"homes": layout.clone()}
    returns, lengths = torch.zeros(shape, device=device), torch.zeros(env.n_envs, device=device)
    score, is_over = torch.full_like(lengths, 0.5), torch.zeros_like(lengths, dtype=torch.bool)

    def step(world, state) -> tuple[World, Tree]:
        decision, state = both(world, state, sample=not greedy, generator=draws.on(is_over.device))
        world = env.step(decision)
        terminal: torch.Tensor = world.terminal.view(shape)
        truncated: torch.Tensor = world.truncated.view(shape)
        returns.add_(world.reward.view(shape))
        lengths.add_(~is_over)
        won, decided = score_pairs(terminal, returns, own)
        score.copy_(torch.where((decided > 0) & ~is_over, won / decided, score))
        is_over.logical_or_((terminal | truncated).any(1))
        return world, state

    changed = both, draws, returns, lengths, score
    step_until(is_over, step, world, state, env, (policy, opponent), changed, max_steps)
    optional(env, "check")()
    return arrdict(score=score, lengths=lengths, slots=own.int().argmax(1), **homes)
