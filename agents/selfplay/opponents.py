"""Opponents: past selves and a scripted policy, in some of the environments of one that learns.

Axes: E environments of A agents, B = E A lanes, O environments with opponents.
"""

from typing import Annotated, Any

import torch
from pydantic import Field

from megastep.agents.generator import SeededGenerator
from megastep.agents.selfplay import duels
from megastep.agents.selfplay.mixed_policy import MixedPolicy
from megastep.arrdict import arrdict
from megastep.dotdict import mapping
from megastep.settings import checked

Share = Annotated[float, Field(ge=0, le=1)]


class Opponents:
    """An environment in some of whose environments others play: there one lane learns, each
    agent's place in turn, and all others are opponents. Their `learns` is False, and what a
    decision says of them is ignored. In the first environments every lane learns, as it does
    without opponents: the policy plays itself as it is now.

    env, policy  the environment, of two agents or more, and the policy that learns in it
    scripted     another policy, which acts as policies do
    past         the share of environments against past selves
    bot          the share against the scripted policy
    snapshots    how many past selves there are, in as many environments each; all begin as copies
                 of the policy
    every        updates after which the oldest one becomes a copy of the policy as it is then

    Which lanes learn never changes, and weights are copied in place, so a graph stays valid. Beside
    what `env` has there are `learners` (B,) bool, the lanes that learn, and `kinds`, by name: the
    lanes (B,) bool of environments against "now", "past" and "bot". ValueError if the shares are
    no shares, or leave a snapshot without an environment.
    """

    @checked
    def __init__(
        self,
        env: Any,
        policy: Any,
        scripted: Any = None,
        *,
        past: Share = 0.0,
        bot: Share = 0.0,
        snapshots: Annotated[int, Field(ge=1, le=10_000)] = 4,
        every: Annotated[int, Field(ge=1, le=10**9)] = 100,
        seed: int = 1,
    ):
        self.env, self.every, device = env, every, env.device
        each, n_bot = shared(env, past, bot, snapshots)
        # autocast keeps the cast of a weight only where it could need a gradient
        n_actors = snapshots if past else 0
        self.actors = [policy.actor().requires_grad_(True) for _ in range(n_actors)]
        self.random = SeededGenerator(seed)
        groups = [each for _ in self.actors] + [n_bot] * (n_bot > 0)  # environments, by opponent
        self.n_past, self.n_opposed = each * len(self.actors), sum(groups)

        self.seat = torch.cat([duels.seats(n, env.n_agents, device) for n in groups])
        learners = torch.ones(env.n_envs, env.n_agents, dtype=torch.bool, device=device)
        learners[-self.n_opposed :] = torch.zeros_like(self.seat, dtype=torch.bool)
        learners[-self.n_opposed :].scatter_(1, self.seat, True)
        self.learners = learners.flatten()
        opposing = (~self.learners).nonzero()[:, 0].split([n * (env.n_agents - 1) for n in groups])
        self.lineup = MixedPolicy([*self.actors, scripted][: len(groups)], opposing)
        self.kinds = self._kinds({"past": self.n_past, "bot": n_bot})
        # pairs of a learner and an opponent that were won and decided since `take`, by environment
        self.pairs = torch.zeros(2, self.n_opposed, device=device)
        self.returns = torch.zeros(self.n_opposed, env.n_agents, device=device)

    def _kinds(self, numbers):
        """Which lanes are of environments against whom, {name: (B,) bool}, where there are any."""
        numbers = {"now": self.env.n_envs - self.n_opposed, **numbers}
        lanes = torch.tensor(list(numbers.values())) * self.env.n_agents
        kind = torch.arange(len(numbers)).repeat_interleave(lanes).to(self.env.device)
        return {name: kind == i for i, name in enumerate(numbers) if numbers[name]}

    def __getattr__(self, name):
        if name == "env":  # of an object that is being copied
            raise AttributeError(name)
        return getattr(self.env, name)

    def reset(self) -> arrdict:
        """Starts every episode anew. Returns a world."""
        self.memory = self.lineup.initial(len(self.learners), self.env.device)
        self.returns.zero_()
        return self._shown(self.env.reset())

    @torch.no_grad()
    def step(self, decision: arrdict) -> arrdict:
        """One step by `decision.actions` (B, ...) of the lanes that learn, and by the opponents'
        own of theirs. Returns a world.
        """
        generator = self.random.on(self.learners.device)
        theirs, self.memory = self.lineup.act(self.seen, self.memory, generator=generator)
        put = mapping(lambda all_of, own: all_of.index_copy(0, self.lineup.lanes, own.to(all_of)))
        world = self.env.step(arrdict(actions=put(decision["actions"], theirs)))
        self._count(world)
        return self._shown(world)

    def _shown(self, world):
        self.seen = self.lineup.seen(world)
        learns = self.learners if "learns" not in world else self.learners & world["learns"]
        return arrdict(world, learns=learns)

    def _count(self, world):
        """Adds up pairs that this step decided."""
        reward, terminal, truncated = (
            world[key].view(-1, self.env.n_agents)[-self.n_opposed :]
            for key in ("reward", "terminal", "truncated")
        )
        self.returns += reward
        self.pairs += torch.stack(duels.pairs(terminal, self.returns, self.seat))
        self.returns.masked_fill_(terminal | truncated, 0.0)

    def refresh(self, policy: Any, updates: int) -> None:
        """After each update: where it is time to, the oldest snapshot becomes what the policy is
        now, and forgets what it remembered of its episodes.
        """
        if not self.actors or updates % self.every:
            return
        slot = (updates // self.every - 1) % len(self.actors)
        actor, weights = self.actors[slot], policy.state_dict()
        actor.load_state_dict({name: weights[name] for name in actor.state_dict()})
        lanes, memory = self.lineup.sizes[slot], self.memory[str(slot)]
        memory[:] = actor.initial(lanes, self.env.device)

    def take(self) -> dict[str, float]:
        """The share of pairs that were won against each kind of opponent since the last call, of
        those that were decided. Synchronises.
        """
        found = {}
        for name, part in zip(("past", "bot"), self.pairs.double().tensor_split([self.n_past], 1)):
            won, decided = part.sum(1).tolist()
            if decided:
                found[f"episode/won/{name}"] = won / decided
        self.pairs.zero_()
        return found

    def state_dict(self) -> dict[str, Any]:
        """The snapshots, and what was counted: dicts of tensors and numbers."""
        return dict(
            actors={str(i): actor.state_dict() for i, actor in enumerate(self.actors)},
            pairs=self.pairs,
            random=self.random.state_dict(),
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from a `state_dict`. Episodes start anew."""
        for i, actor in enumerate(self.actors):
            actor.load_state_dict(state["actors"][str(i)])
        self.pairs.copy_(state["pairs"])
        self.random.load_state_dict(state["random"], self.learners.device)


def shared(env: Any, past: float, bot: float, snapshots: int) -> tuple[int, int]:
    """How many environments each snapshot and the scripted policy play in. ValueError if that
    cannot be.
    """
    if env.n_agents < 2:
        raise ValueError(
            f"opponents need an environment of two agents or more, and {type(env).__name__} has one"
        )
    if past + bot > 1:
        raise ValueError(
            f"opponents.past={past} and opponents.bot={bot} are shares of the environments, "
            "together at most 1"
        )
    each, n_bot = round(past * env.n_envs) // snapshots, round(bot * env.n_envs)
    if past and not each:
        raise ValueError(
            f"opponents.past={past} of {env.n_envs:,} environments are "
            f"{round(past * env.n_envs):,}, one for each of so many snapshots and not for "
            f"{snapshots:,}: give opponents.snapshots or env.n_envs"
        )
    if bot and not n_bot:
        raise ValueError(
            f"opponents.bot={bot} of {env.n_envs:,} environments are none: give more env.n_envs"
        )
    return each, n_bot
