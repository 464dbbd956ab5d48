"""Who wins between agents of one environment, and duels of two policies in many.

Axes: E environments of A agents, B = E A lanes.
"""

from typing import Any

import torch

from megastep.agents.selfplay.mixed_policy import MixedPolicy
from megastep.agents.training.evaluation import CHECK
from megastep.arrdict import arrdict

#: Steps after which a duel is a draw.
MAX_STEPS = 500


def pairs(
    terminal: torch.Tensor, returns: torch.Tensor, seat: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """What a step decides between the agent at `seat` (E, 1) of each environment and each of its
    others: `(won, decided)`, both (E,) float32, how many of those pairs it won, a draw being half,
    and how many were decided.

    A pair is decided by a step that one of the two does not survive, its `terminal` (E, A): who
    survives has won. If it is terminal for both, as a game is that ends for all, the higher of
    their `returns` (E, A) has, the rewards since each one's episode began; equal ones are a draw.
    """
    mine, my_return = terminal.gather(1, seat), returns.gather(1, seat)
    ahead = torch.where(
        terminal == mine, my_return - returns, terminal.float() - mine.float()
    ).sign()
    decided = (terminal | mine).scatter(1, seat, False)
    won = torch.where(decided, (1 + ahead) / 2, 0.0).sum(1)
    return won, decided.float().sum(1)


def seats(n_envs: int, n_agents: int, device: Any = None) -> torch.Tensor:
    """(E, 1) int64: every agent's place in turn, each for as many environments, one after the
    other.
    """
    return (torch.arange(n_envs, device=device) * n_agents // n_envs)[:, None]


def lineup(policy: Any, opponent: Any, seat: torch.Tensor, n_agents: int) -> MixedPolicy:
    """`policy` at its `seat` (E, 1) of each environment, `opponent` at all others."""
    is_mine = torch.zeros(len(seat), n_agents, dtype=torch.bool, device=seat.device)
    is_mine = is_mine.scatter(1, seat, True).flatten()
    lanes = torch.arange(len(is_mine), device=seat.device)
    return MixedPolicy([policy, opponent], [lanes[is_mine], lanes[~is_mine]])


@torch.no_grad()
def play(
    env: Any,
    policy: Any,
    opponent: Any,
    seed: int = 1,
    greedy: bool = False,
    max_steps: int = MAX_STEPS,
) -> arrdict:
    """One duel in each environment, from its reset: arrdict of `score` (E,) float32, 1 where
    `policy` won, 0 where it lost and 0.5 for a draw, `lengths` (E,) float32 steps, `seat` (E,)
    int64, the agent that `policy` was, each in turn (`seats`), and `homes` (E,) int32, the layouts
    that the environment shows after its reset, if it has any.

    A duel ends with the first step that is terminal for any of its agents: `pairs` says who won.
    A step that truncates an episode, or `max_steps`, ends it as a draw. With more than two agents,
    `opponent` is all others.
    """
    device, shape = torch.device(env.device), (env.n_envs, env.n_agents)
    generator = torch.Generator(device).manual_seed(seed)
    seat = seats(*shape, device)
    both = lineup(policy, opponent, seat, env.n_agents)
    world, state = env.reset(), both.initial(env.n_envs * env.n_agents, device)
    homes = {} if getattr(env, "layout", None) is None else {"homes": env.layout.clone()}
    returns, lengths = torch.zeros(shape, device=device), torch.zeros(env.n_envs, device=device)
    score, is_over = torch.full_like(lengths, 0.5), torch.zeros_like(lengths, dtype=torch.bool)
    for step in range(max_steps):
        if step % CHECK == 0 and bool(is_over.all()):
            break
        decision, state = both(world, state, sample=not greedy, generator=generator)
        world = env.step(decision)
        reward, terminal, truncated = (
            world[key].view(shape) for key in ("reward", "terminal", "truncated")
        )
        returns += reward
        lengths += ~is_over
        won, decided = pairs(terminal, returns, seat)
        score = torch.where((decided > 0) & ~is_over, won / decided, score)
        is_over |= (terminal | truncated).any(1)
    env.check()
    return arrdict(score=score, lengths=lengths, seat=seat[:, 0], **homes)
