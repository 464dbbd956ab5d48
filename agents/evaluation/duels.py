"""Duels of two policies in an environment with several agents.

Axes: N environments, A agents, B = N A lanes. A slot is the index of an agent in its environment.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from megastep.agents import factory
from megastep.agents.evaluation import eval_env, tables
from megastep.agents.evaluation.playing import step_until
from megastep.agents.evaluation.statistics import TAIL, by_part, interval, worst_homes
from megastep.agents.factory import settings
from megastep.agents.generator import SeededGenerator
from megastep.agents.runs import checkpoint, restore
from megastep.agents.selfplay.mixed_policy import MixedPolicy, rotating_slots, score_pairs
from megastep.arrdict import arrdict, numpyify
from megastep.types import Env, PolicyLike, n_lanes, optional

if TYPE_CHECKING:
    from megastep.agents.types import Row
    from megastep.types import World

#: A duel is a draw after this many steps.
MAX_STEPS = 500


def duel_policy(
    policy: PolicyLike, opponent: PolicyLike, slots: torch.Tensor, n_agents: int
) -> MixedPolicy:
    """Returns a policy that is `policy` in one slot per environment, of (N, 1) int64, and
    `opponent` in the others.
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
        An arrdict of `score`, float32: 1 if `policy` won, 0 if it lost, 0.5 for a draw; `lengths`,
        float32 steps; `slots`, int64, the agent that `policy` controlled; and, if `env.layout`
        exists, `homes`, int32, the layouts after the reset: (N,) each.
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


class Duels:
    """The agent of a run against others, in unseen homes.

    Two agents play, or as many as the environment has if their number is fixed. Each home is played
    in from every agent's slot, equally often, in up to `cfg.episodes` duels.
    """

    def __init__(
        self,
        cfg: settings.Evaluate,
        run: checkpoint.Checkpoint,
        env: settings.Env,
        homes: list,
        device: torch.device,
    ):
        self.cfg, self.run = cfg, run
        where = eval_env.EvalEnv(env, homes, cfg.episodes, cfg.seed, device, is_duel=True)
        self.where, self.env = where, where.env
        self.agent = eval_env.load_player(run, where.sample, run)
        restore.load_wrappers(self.env, run)
        self.others = [self.player(name) for name in cfg.against or ()]
        n_envs, n_agents = where.shard.n_envs, optional(self.env, "n_agents")
        self.slots = rotating_slots(n_envs, n_agents, self.env.device)[[*where.shard.envs]]
        where.warn_without_layout()

    def player(self, name: str) -> eval_env.Player:
        """Returns who plays in the environment, see `find_player`."""
        return self.where.find_player(name, self.run, self.cfg.trust)

    def play(self, player: eval_env.Player, opponent: eval_env.Player) -> arrdict:
        """Returns the duels of two players, those of all ranks."""
        both = player.policy, opponent.policy
        max_steps = self.cfg.max_steps or MAX_STEPS
        with factory.errors():
            played = play(
                self.env, *both, self.where.seed, self.cfg.greedy, max_steps, slots=self.slots
            )
        return self.where.shard.with_others(played)

    def rows(self, source: str | None = None) -> "list[Row]":
        """Plays the run's agent against each of `cfg.against`, in homes of a `source` or of
        several. Returns the table rows.
        """
        sources = None if source else factory.sources_of(self.where.homes)
        roles, rows = optional(self.env, "roles"), []
        for opponent in self.others:
            played = self.play(self.agent, opponent)
            found = summaries(played, roles, sources)
            if source == tables.DENSE and "homes" in played:
                found.append({"tail": TAIL, **worst_summary(played)})
            rows += [{"against": opponent.name, **row} for row in found]
        return rows


def summaries(
    duels: Mapping, roles: Sequence[str] | None = None, sources: Sequence[str] | None = None
) -> "list[Row]":
    """Returns the table rows, `by_part`, of the result of `play`. A role's row has the duels in
    which `policy` played it.

    `won` is the fraction of duels won, a draw counting half; `lower` and `upper` are its 95 %
    interval over homes, or over duels if there are no homes.
    """
    played = numpyify(duels)
    every, homes = np.ones(len(played["score"]), bool), played.get("homes")
    role_of = np.array(roles)[played["slots"]] if roles else None
    return by_part(lambda lanes: _summary(played, lanes), every, role_of, roles, homes, sources)


def worst_summary(duels: Mapping) -> "Row":
    """Returns a table row of the worst homes, `worst_homes`, from a result of `play`."""
    played = numpyify(duels)
    numbers, means = worst_homes({"won": played["score"]}, played["homes"])
    won = means["won"]
    row = _summary(played, np.isin(played["homes"], numbers))
    return row | {"won": won["mean"], "lower": won["lower"], "upper": won["upper"]}


def _summary(played, lanes) -> "Row":
    score, homes = played["score"][lanes], played["homes"][lanes] if "homes" in played else None
    mean, lower, upper = interval(score, homes)
    return {
        "won": mean,
        "lower": lower,
        "upper": upper,
        "wins": int((score == 1).sum()),
        "losses": int((score == 0).sum()),
        "draws": int(((score != 1) & (score != 0)).sum()),
        "length": float(played["lengths"][lanes].mean()),
        "duels": len(score),
        "homes": None if homes is None else len(np.unique(homes)),
    }
