"""Episodes of an evaluation once more: the same agent, environment and seed make the same episodes,
on the same kind of device.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch

from megastep.agents import factory
from megastep.agents.errors import UserError, shortened, user_errors
from megastep.agents.evaluation import tables
from megastep.agents.evaluation.eval_env import EvalEnv
from megastep.agents.evaluation.statistics import SCORES
from megastep.agents.factory import check, settings
from megastep.agents.generator import SeededGenerator
from megastep.agents.runs import checkpoint, folders, restore, trust
from megastep.agents.runs.typed_json import loads
from megastep.types import Env, PolicyLike, Tree, World, optional

if TYPE_CHECKING:
    from megastep.agents.runs.checkpoint import Checkpoint
    from megastep.agents.types import Row


class AsEvaluated:
    """A policy with the generator and the choice of actions that an evaluation gave it.

    Args:
        policy: the policy.
        seed: of the action sampling.
        greedy: takes the most likely actions.
    """

    def __init__(self, policy: PolicyLike, seed: int, greedy: bool):
        self.policy, self.greedy, self.draws = policy, greedy, SeededGenerator(seed)
        self.initial = policy.initial

    def __call__(
        self,
        world: World,
        state: Tree,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[Mapping, Tree]:
        """Acts as the policy does."""
        own = self.draws.on(world["reset"].device)
        return self.policy(world, state, sample=not self.greedy, generator=own)


class Table(NamedTuple):
    """An evaluation that can be played again.

    Attributes:
        path: of its .json.
        title: what it says of itself.
        checkpoint: the name of what was evaluated.
        cfg: its settings.
        env, geometry: what was played in.
        rows: those of the episodes of the run's agent.
        n_ranks: number of ranks that played them.
    """

    path: Path
    title: str
    checkpoint: str
    cfg: settings.Evaluate
    env: settings.Env
    geometry: settings.Geometry
    rows: "list[Row]"
    n_ranks: int

    def chosen(
        self, worst: int | None, episode: int | None = None, home: int | None = None
    ) -> "list[Row]":
        """Returns the rows of some episodes: the `worst`, by the first of `SCORES` that they have,
        or those of a number, in a home or in all.

        Raises:
            UserError: there are none.
        """
        rows = self.rows
        if home is not None:
            rows = [row for row in rows if row.get("home") == home]
            if not rows:
                homes = sorted({row["home"] for row in self.rows if "home" in row})
                have = (
                    f"it has {len(homes)} homes, {homes[0]} to {homes[-1]}"
                    if homes
                    else "it has none"
                )
                raise UserError(f"{self.path} has no episode in home {home}: {have}")
        if episode is not None:
            if not (rows := [row for row in rows if row["episode"] == episode]):
                last = max(row["episode"] for row in self.rows)
                where = "" if home is None else f" in home {home}"
                raise UserError(
                    f"{self.path} has no episode {episode}{where}: they are 0 to {last}"
                )
            return rows
        names = [name for name in SCORES if all(row.get(name) is not None for row in rows)]
        return sorted(rows, key=lambda row: [row[name] for name in names])[:worst]

    def plays(
        self, rows: "Sequence[Row]", loaded: "Checkpoint", device: torch.device
    ) -> "Iterator[tuple[Row, Env, PolicyLike, int]]":
        """Yields each of some rows with an environment, what plays there, and the lane in it. Rows
        of one rank's environment share it.
        """
        homes = factory.homes(self.env, self.geometry, self.cfg.split)
        parts, made = tables.parts_of(self.geometry, homes), {}
        sources = [source for source, _ in parts]
        where: dict[str, Any] = dict(seed=self.cfg.seed, device=device)
        n_agents = optional(factory.make_sample(self.env, homes, **where), "n_agents")
        for row in rows:
            part = sources.index(row["source"]) if sources != [None] else 0
            e, slot = divmod(row["episode"], n_agents)
            number = e % self.n_ranks
            if (part, number) not in made:
                one = EvalEnv(
                    *(self.env, parts[part][1], self.cfg.episodes),
                    **where,
                    rank=(number, self.n_ranks),
                    films=True,
                )
                policy = restore.policy_of(loaded, one.env)
                restore.load_wrappers(one.env, loaded)
                made[part, number] = one.env, AsEvaluated(policy, one.seed, self.cfg.greedy)
            yield row, *made[part, number], (e // self.n_ranks) * n_agents + slot


def newest(folder: Path, loaded: checkpoint.Checkpoint, is_trusted: bool) -> Table:
    """Returns the newest evaluation in a run's folder whose episodes can be played again.

    Args:
        loaded: a checkpoint of the run.
        is_trusted: import what an evaluation of another user's names.

    Raises:
        UserError: there is none, or it is damaged.
    """
    paths = [path.with_suffix(".json") for path in (folder / "evaluations").glob("*.csv")]
    paths = [path for path in paths if path.exists()]
    if not paths:
        command = folders.command_of("evaluate", "run", folder)
        raise UserError(f"{folder} has no evaluation yet with episodes to film; first {command}")
    path = max(paths, key=lambda path: path.stat().st_mtime)
    with user_errors(f"{path} cannot be used: ", (Exception,)):
        table = loads(path.read_bytes())
        names = trust.untrusted(trust.foreign_names({"train": table["evaluation"]}))
        foreign = {*names} - {*trust.foreign_names(loaded.config)}
        if foreign and not is_trusted:
            raise ValueError(f"it would import {shortened(sorted(foreign))}; trust=true allows it")
        cfg = check.check(settings.Evaluate, table["evaluation"])
        trained = factory.config_of(loaded)
        env = cfg.env or trained.env
        columns = table["episodes"]
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        rows = [row for row in rows if row["agent"] == rows[0]["agent"]]
        geometry = factory.typed_or(trained.geometry, cfg.geometry, env)
        name = Path(table["checkpoint"]).name
        n_ranks = int(table["ranks"])
    return Table(path, str(table["title"]), name, cfg, env, geometry, rows, n_ranks)
