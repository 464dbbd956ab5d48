"""Opponents: past snapshots of the policy, other members of its population, or a scripted bot, in
some of the environments.

Axes: N environments of A agents, B = N A lanes; M of the environments have opponents.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field, SkipValidation

from megastep import spaces
from megastep.agents.generator import SeededGenerator, stream_seed
from megastep.agents.networks.policy import Policy
from megastep.agents.selfplay.mixed_policy import MixedPolicy, rotating_teams, score_pairs, teams_of
from megastep.agents.storage.rollout import copy_tree
from megastep.agents.types import StateDict
from megastep.arrdict import arrdict
from megastep.kernels.build.kernel_library import FAST_CUDA_FLAGS, KernelLibrary
from megastep.kernels.build.launch import launch
from megastep.settings import checked
from megastep.types import Env, PolicyLike, World, optional

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels", FAST_CUDA_FLAGS)
Fraction = Annotated[float, Field(ge=0, le=1)]


class Opponents:
    """Wraps a multi-agent environment so that past snapshots, other members of a population or a
    scripted bot play some agents.

    In an environment with opponents, one agent learns and a single opponent controls all others.
    The learning agent's slot rotates across environments. If agents have different roles, those of
    a role are a team, and a team learns instead of an agent. In the remaining environments, which
    come first, the current policy controls every agent and learns from all of them. Opponents'
    lanes have `learns` False, and `step` ignores the decision's actions in them.

    Args:
        env: environment with at least two agents.
        policy: the policy that learns. Snapshots are copies of its actor.
        scripted: the bot, a policy; needed if `bot` > 0.
        past, bot, league: fractions of environments played against snapshots, against `scripted`,
            and against other members of a population, of which there are as many snapshots again.
        snapshots: number of snapshots. Each gets the same number of environments.
        every: updates between two refreshes; each replaces the oldest snapshot.
        role: the role that learns against opponents. Default: each in equally many environments.
        seed: of the opponents' actions.

    Attributes, beside those of `env`:
        learners: (B,) bool, lanes whose transitions are used for learning. Never changes, so CUDA
            graphs stay valid.
        matchups: (B,) bool by name, the lanes of environments played against "now" (the current
            policy), "past", "league" and "bot". Names without environments are absent.
        snapshots, rivals: those of the policy and of other members, refreshed in place.
        scripted: the bot, or None if it does not play.

    Raises:
        ValueError: the environment has one agent, `past + league + bot` is 0 or above 1, `bot > 0`
            without `scripted`, a snapshot or the bot would get no environment, or nobody has the
            role.
    """

    @checked
    def __init__(
        self,
        env: SkipValidation[Env],
        policy: SkipValidation[Policy],
        scripted: SkipValidation[PolicyLike] | None = None,
        *,
        past: Fraction = 0.0,
        bot: Fraction = 0.0,
        league: Fraction = 0.0,
        snapshots: Annotated[int, Field(ge=1, le=10_000)] = 4,
        every: Annotated[int, Field(ge=1, le=10**9)] = 100,
        role: str | None = None,
        seed: int = 1,
    ):
        self.env, self.every, device = env, every, env.device
        self.n_agents = optional(env, "n_agents")
        self.scripted = scripted if bot else None
        self.n_by_kind = count_environments(env, env.n_envs, past, bot, snapshots, league)
        if bot and scripted is None:
            raise ValueError(
                f"opponents.bot={bot} needs a bot that plays: pass scripted=, a policy, or bot=0"
            )
        # autocast caches the cast of a weight only if the weight requires a gradient
        self.snapshots, self.rivals = (
            [policy.actor().requires_grad_(True) for _ in range(snapshots if share else 0)]
            for share in (past, league)
        )
        self.copies = [*self.snapshots, *self.rivals]
        self.generator = SeededGenerator(stream_seed(seed, "opponents"))
        kinds = {"past": len(self.snapshots), "league": len(self.rivals), "bot": int(bot > 0)}
        n_each = [self.n_by_kind[kind] // n for kind, n in kinds.items() for _ in range(n)]
        self.n_opposed = sum(n_each)
        teams = teams_of(env)
        own = [rotating_teams(n, teams) for n in n_each]
        if role is not None:
            roles = optional(env, "roles") or ()
            if role not in roles or len({*roles}) == 1:
                raise ValueError(f"opponents.role={role} is none of {[*dict.fromkeys(roles)]}")
            own = [(teams == teams[roles.index(role)]).expand(n, -1) for n in n_each]
        self.own = torch.cat(own)  # (M, A)
        learners = torch.ones(env.n_envs, self.n_agents, dtype=torch.bool, device=device)
        learners[-self.n_opposed :] = self.own
        self.learners = learners.flatten()
        lanes = (~self.learners).nonzero()[:, 0].split([int((~part).sum()) for part in own])
        bots = [] if self.scripted is None else [self.scripted]
        self.mixed_policy = MixedPolicy([*self.copies, *bots], lanes)
        n_by_kind = {"now": env.n_envs - self.n_opposed, **self.n_by_kind}
        n_lanes = torch.tensor(list(n_by_kind.values())) * self.n_agents
        kind = torch.arange(len(n_by_kind)).repeat_interleave(n_lanes).to(device)
        self.matchups = {name: kind == i for i, name in enumerate(n_by_kind) if n_by_kind[name]}
        # (2, M): pairs of a learning agent and an opponent that were won and decided since `pop`
        self.pairs = torch.zeros(2, self.n_opposed, device=device)
        self.returns = torch.zeros(self.n_opposed, self.n_agents, device=device)

    def __getattr__(self, name: str) -> Any:
        if name == "env":  # not set yet while the object is being copied
            raise AttributeError(name)
        return getattr(self.env, name)

    @property
    def opponent_pool(self) -> "Opponents":
        """This object, by the name under which a trainer looks for opponents."""
        return self

    def reset(self) -> World:
        """Starts every episode and returns the first world."""
        self.hidden_state = self.mixed_policy.initial(len(self.learners), self.env.device)
        self.acting = None
        self.returns.zero_()
        return self._observed(self.env.reset())

    @torch.no_grad()
    def begin_step(self) -> None:
        """Has the opponents choose the actions of the next step; on a GPU beside whatever comes
        until then. `step` does it otherwise.
        """
        generator = self.generator.on(self.learners.device)
        self.acting = self.mixed_policy.start(
            self.opponent_world, self.hidden_state, generator=generator
        )

    @torch.no_grad()
    def step(self, decision: Mapping) -> World:
        """Steps the environment by `decision.actions`, (B, ...), in the lanes that learn; the
        opponents act in the others.
        """
        if self.acting is None:
            self.begin_step()
        assert self.acting is not None
        opponent_actions, self.hidden_state = self.mixed_policy.finish(self.acting)
        self.acting = None
        lanes = self.mixed_policy.lanes

        def replace(_, leaf, theirs) -> torch.Tensor:
            return leaf.index_copy(0, lanes, theirs.to(leaf))

        space = self.env.action_space
        actions = spaces.map(replace, space, decision["actions"], opponent_actions)
        world = self.env.step(arrdict(actions=actions))
        self._count_pairs(world)
        return self._observed(world)

    def _observed(self, world) -> arrdict:
        self.opponent_world = self.mixed_policy.select_lanes(world)
        learns = self.learners if "learns" not in world else self.learners & world["learns"]
        return arrdict(world, learns=learns)

    def _count_pairs(self, world) -> None:
        reward, terminal, truncated = (
            world[key].contiguous().view(-1, self.n_agents)[-self.n_opposed :]
            for key in ("reward", "terminal", "truncated")
        )
        if reward.is_cuda and reward.dtype == torch.float32:
            launch(
                *(LIBRARY, "count_pairs", reward.device, self.n_opposed),
                **dict(reward=reward, terminal=terminal, truncated=truncated, own=self.own),
                **dict(returns=self.returns, pairs=self.pairs),
                **dict(n_envs=self.n_opposed, n_agents=self.n_agents),
            )
            return
        self.returns += reward
        self.pairs += torch.stack(score_pairs(terminal, self.returns, self.own))
        self.returns.masked_fill_(terminal | truncated, 0.0)

    def refresh_snapshots(self, policy: Policy, n_updates: int) -> None:
        """Copies the policy into the oldest snapshot, every `every` updates. Called after each."""
        if self.snapshots and n_updates % self.every == 0:
            self._refresh((n_updates // self.every - 1) % len(self.snapshots), policy)

    def is_due(self, n_updates: int) -> bool:
        """Returns whether `refresh_rival` replaces one after so many updates."""
        return bool(self.rivals) and n_updates % self.every == 0

    def next_rival(self, member: int, size: int, n_updates: int) -> int:
        """Returns whose policy `refresh_rival` is to copy: the members of a population take turns,
        beginning with the one after this member.
        """
        return (member + 1 + (n_updates // self.every - 1) % (size - 1)) % size

    def refresh_rival(self, policy: Policy, n_updates: int) -> None:
        """Copies another member's policy into the oldest of the rivals. Called when `is_due`."""
        number = (n_updates // self.every - 1) % len(self.rivals)
        self._refresh(len(self.snapshots) + number, policy)

    def _refresh(self, index: int, policy: Policy) -> None:
        copy, weights = self.copies[index], policy.state_dict()
        copy.load_state_dict({name: weights[name] for name in copy.state_dict()})
        state = self.hidden_state[str(index)]
        state[:] = copy.initial(self.mixed_policy.sizes[index], self.env.device)

    def pop_win_rates(
        self, sum_over_ranks: Callable[[torch.Tensor], torch.Tensor] = lambda sums: sums
    ) -> dict[str, float]:
        """Returns the fraction of decided pairs that were won since the last call, of each kind of
        opponent that has one. Synchronises.

        Metrics:
            episode/won/KIND: fraction of pairs won against past snapshots (past), other members of
                the population (league) or the bot (bot) since the last report, of those that were
                decided.

        Args:
            sum_over_ranks: adds the numbers of the other ranks, where there are any.
        """
        parts = self.pairs.split([*self.n_by_kind.values()], 1)
        sums = sum_over_ranks(torch.stack([pairs.double().sum(1) for pairs in parts])).tolist()
        self.pairs.zero_()
        both = zip(self.n_by_kind, sums, strict=True)
        return {f"episode/won/{name}": won / decided for name, (won, decided) in both if decided}

    def state_dict(self) -> StateDict:
        """Returns the snapshots, the generator's state, and by lane what opponents see and remember
        and the scores of the episodes in progress.
        """
        return dict(
            snapshots={str(i): policy.state_dict() for i, policy in enumerate(self.copies)},
            generator=self.generator.state_dict(),
            lanes=dict(self._lanes(), pairs=self.pairs.clone()),  # a report clears the pairs
        )

    def load_state_dict(self, state: StateDict) -> None:
        """Restores a `state_dict`. Without `lanes`, the opponents begin new episodes. Raises
        ValueError if it has another number of snapshots.
        """
        if len(state["snapshots"]) != len(self.copies):
            raise ValueError(
                f"the saved opponents have {len(state['snapshots'])} snapshots, these have "
                f"{len(self.copies)}: use the opponents.snapshots and opponents.past of the run"
            )
        for i, copy in enumerate(self.copies):
            copy.load_state_dict(state["snapshots"][str(i)])
        self.generator.load_state_dict(state["generator"], self.learners.device)
        if "lanes" in state:
            copy_tree(self._lanes(), state["lanes"])

    def _lanes(self) -> dict[str, torch.Tensor]:
        names = "hidden_state", "opponent_world", "pairs", "returns"
        return {name: getattr(self, name) for name in names}


def count_environments(
    env: Env, n_envs: int, past: float, bot: float, snapshots: int, league: float = 0.0
) -> dict[str, int]:
    """Returns the number of environments against snapshots, against those of other members, and
    against the bot. Raises ValueError as `Opponents`.
    """
    if optional(env, "n_agents") < 2:
        raise ValueError(
            f"opponents need an environment with at least two agents; {type(env).__name__} has one"
        )
    if not 0 < past + bot + league <= 1:
        others = f", opponents.league={league}" if league else ""
        raise ValueError(
            f"opponents.past={past}{others} and opponents.bot={bot} are fractions of the "
            "environments, so their sum must be above 0 and at most 1"
        )
    counts = {}
    for name, share, n_players in ("past", past, snapshots), ("league", league, snapshots):
        n = round(share * n_envs)
        if share and n < n_players:
            raise ValueError(
                f"opponents.{name}={share} of {n_envs:,} environments is {n:,} environments, too "
                f"few for opponents.snapshots={snapshots:,}: reduce opponents.snapshots or raise "
                "env.n_envs"
            )
        counts[name] = n - n % n_players
    if bot and not round(bot * n_envs):
        raise ValueError(
            f"opponents.bot={bot} of {n_envs:,} environments is none: raise opponents.bot or "
            "env.n_envs"
        )
    return {**counts, "bot": round(bot * n_envs)}
