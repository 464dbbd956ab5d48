"""Several policies that act in one environment, each in a fixed set of lanes; and who has won.

Axes: B lanes of the environment, M lanes of the mixed policy (M = B unless others act too); N
environments of A agents, whose index is their slot.
"""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext

import torch

from megastep.agents.storage.copies import select_tree
from megastep.arrdict import arrdict, cat
from megastep.types import Env, PolicyLike, Tree, World, optional


class MixedPolicy:
    """A policy made of several policies, each with a fixed set of lanes.

    Call it like any policy if it has all lanes of the environment. Use `start` and `finish` if
    other policies act in the remaining lanes. On a GPU each policy runs on a separate CUDA stream,
    also inside a CUDA graph, because one small network does not fill the GPU.

    Args:
        policies: the policies. A bot that reads the environment has the method `in_lanes(lanes)`,
            which returns one that plays in its lanes.
        lanes: the lanes of each policy, int64 (m,).

    Attributes:
        lanes: (M,) int64, the lanes of all policies, one policy after the other.
        sizes: number of lanes of each policy.
    """

    def __init__(self, policies: Sequence[PolicyLike], lanes: Sequence[torch.Tensor]):
        self.policies = [
            policy if (in_lanes := getattr(policy, "in_lanes", None)) is None else in_lanes(own)
            for policy, own in zip(policies, lanes, strict=True)
        ]
        self.sizes = [len(policy_lanes) for policy_lanes in lanes]
        self.lanes = torch.cat(list(lanes))
        self.order = self.lanes.argsort()
        is_cuda = self.lanes.is_cuda
        self.streams = [torch.cuda.Stream(self.lanes.device) for _ in policies if is_cuda]

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the initial hidden state of each policy, by its index as a string."""
        return arrdict(
            {
                str(i): policy.initial(size, device)
                for i, (policy, size) in enumerate(zip(self.policies, self.sizes, strict=True))
            }
        )

    def __call__(
        self,
        world: World,
        state: arrdict,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[arrdict, arrdict]:
        """Acts in all lanes of an environment. Returns (arrdict(actions), next state)."""
        started = self.start(self.select_lanes(world), state, sample, generator)
        actions, state = self.finish(started)
        return arrdict(actions=select_tree(actions, self.order)), state

    def select_lanes(self, world: World) -> arrdict:
        """Returns a copy of `obs`, `reset` and, if there is one, `mask`, in the lanes of the
        policies.
        """
        parts = {key: world[key] for key in ("obs", "reset", "mask") if key in world}
        return select_tree(arrdict(parts), self.lanes)

    def start(
        self,
        world: Mapping,
        state: arrdict,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> list[tuple[Mapping, arrdict]]:
        """Acts on the result of `select_lanes`. Returns what `finish` takes: until then nothing may
        use the results, and `world` and `state` must not change.
        """
        for stream in self.streams:
            stream.wait_stream(torch.cuda.current_stream(self.lanes.device))
        started, start = [], 0
        for i, (policy, size) in enumerate(zip(self.policies, self.sizes, strict=True)):
            policy_world, start = world[start : start + size], start + size
            with torch.cuda.stream(self.streams[i]) if self.streams else nullcontext():
                started.append(policy(policy_world, state[str(i)], sample, generator))
        return started

    def finish(self, started: Sequence[tuple[Mapping, arrdict]]) -> tuple[Tree, arrdict]:
        """Returns the actions (M, ...) and the next state of what `start` began."""
        for stream in self.streams:
            torch.cuda.current_stream(self.lanes.device).wait_stream(stream)
        actions = cat([decision["actions"] for decision, _ in started])
        return actions, arrdict({str(i): state for i, (_, state) in enumerate(started)})


def score_pairs(
    terminal: torch.Tensor, returns: torch.Tensor, own: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Scores the agents of one team per environment against each other agent, on a single step.

    A pair is decided when either agent's episode is terminal. If only one is, the other agent has
    won. If both are, as in a game that ends for all, the higher return wins, and equal returns are
    a draw.

    Args:
        terminal: (N, A) bool, of this step.
        returns: (N, A), rewards since each agent's episode began.
        own: (N, A) bool, the agents that are scored.

    Returns:
        Two (N,) float32: pairs won, with a draw as half, and pairs decided.
    """
    ours, theirs = terminal[:, :, None], terminal[:, None]
    ahead = returns[:, :, None] - returns[:, None]
    sign = torch.where(ours == theirs, ahead, theirs.float() - ours.float()).sign()
    decided = own[:, :, None] & ~own[:, None] & (ours | theirs)
    won = torch.where(decided, (1 + sign) / 2, 0.0).sum((1, 2))
    return won, decided.float().sum((1, 2))


def teams_of(env: Env) -> torch.Tensor:
    """Returns the team of each agent, (A,) int64: its role, or itself without different roles."""
    roles, n_agents = optional(env, "roles") or (), optional(env, "n_agents")
    names = [*dict.fromkeys(roles)]
    teams = [names.index(role) for role in roles] if len(names) > 1 else [*range(n_agents)]
    return torch.tensor(teams, device=env.device)


def rotating_teams(n_envs: int, teams: torch.Tensor) -> torch.Tensor:
    """Returns the agents of one team per environment, (N, A) bool: those of team 0 in the first N
    environments / number of teams, and so on.
    """
    n_teams = len(teams.unique())
    team = torch.arange(n_envs, device=teams.device) * n_teams // n_envs
    return teams == team[:, None]
