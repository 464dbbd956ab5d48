"""Episodes of an evaluation once more, from the actions that it stored.

An environment draws from its seed alone, so the same actions of all lanes make the same episodes.
"""

import io
import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from megastep import spaces
from megastep.agents import factory
from megastep.agents.errors import UserError, shortened, user_errors
from megastep.agents.evaluation import arena, suite
from megastep.agents.evaluation.playing import MAX_BYTES, Actions, narrow
from megastep.agents.evaluation.statistics import SCORES
from megastep.agents.factory import check, settings
from megastep.agents.runs import checkpoint, folders, strange_files, trust
from megastep.agents.runs.typed_json import loads
from megastep.arrdict import arrdict
from megastep.types import Env, PolicyLike, Tree, World, optional

if TYPE_CHECKING:
    from megastep.agents.runs.checkpoint import Checkpoint
    from megastep.agents.types import Row


def as_bytes(parts: Sequence[Actions | None]) -> bytes | None:
    """Returns an .npz of the actions in each part of an evaluation, None if one has none."""
    arrays = {}
    for number, actions in enumerate(parts):
        if actions is None:
            return None
        arrays |= {f"{number}-{name}": narrow(leaf) for name, leaf in actions.leaves.items()}
        arrays["n_ranks"] = np.array(actions.n_ranks)
    if sum(array.nbytes for array in arrays.values()) > MAX_BYTES:
        return None
    np.savez_compressed(content := io.BytesIO(), **arrays)
    return content.getvalue()


class Replay:
    """Takes actions that were taken before.

    Args:
        env: whose actions they are.
        leaves: (T, B, ...) per leaf of its action space, by name.

    Raises:
        ValueError: they are not actions of that space.
    """

    capturable = False

    def __init__(self, env: Env, leaves: Mapping[str, np.ndarray]):
        self._space, self._leaves = env.action_space, {}
        for name, space in spaces.leaves(env.action_space).items():
            steps = torch.as_tensor(leaves[name], device=env.device)
            steps = steps.to(getattr(space, "dtype", torch.int64))
            n_lanes = env.n_envs * optional(env, "n_agents")
            if steps.shape[1:2] != (n_lanes,) or not spaces.are_actions(space, steps):
                raise ValueError(f"the stored actions {name!r} are not those of {space!r}")
            self._leaves[name] = steps

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> int:
        """Returns 0, the number of the first step."""
        return 0

    def __call__(
        self,
        world: World,
        state: int,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[Mapping, int]:
        """Returns the decision of step `state`."""
        leaves = {name: steps[state] for name, steps in self._leaves.items()}
        return arrdict(actions=_tree(self._space, leaves)), state + 1


def _tree(space, leaves, name="") -> Tree:
    if not isinstance(space, Mapping):
        return leaves[name]
    children = {k: _tree(v, leaves, f"{name}.{k}" if name else k) for k, v in space.items()}
    return arrdict(children)


class Table(NamedTuple):
    """An evaluation that can be played again.

    Attributes:
        path: of its .json.
        title: what it says of itself.
        checkpoint: the name of what was evaluated.
        cfg: its settings.
        env, geometry: what was played in.
        rows: those of the episodes of the run's agent.
    """

    path: Path
    title: str
    checkpoint: str
    cfg: settings.Evaluate
    env: settings.Env
    geometry: settings.Geometry
    rows: "list[Row]"

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
        self,
        rows: "Sequence[Row]",
        loaded: "Checkpoint",
        device: torch.device,
    ) -> "Iterator[tuple[Row, Env, PolicyLike, int]]":
        """Yields each of some rows with an environment, what plays there, and the lane in it. Rows
        of one rank's environment share it.

        Raises:
            UserError: the actions are missing, or those of another environment.
        """
        homes = factory.homes(self.env, self.geometry, self.cfg.split)
        parts, made = suite.parts_of(self.geometry, homes), {}
        sources = [source for source, _ in parts]
        with user_errors(f"{self.path.with_suffix('.npz')} cannot be used: ", (Exception,)):
            arrays = _arrays(self.path.with_suffix(".npz"))
            n_ranks = int(arrays["n_ranks"])
            where: dict[str, Any] = dict(seed=self.cfg.seed, device=device, films=True)
            n_agents = optional(factory.make_sample(self.env, homes, **where), "n_agents")
            for row in rows:
                part = sources.index(row["source"]) if sources != [None] else 0
                e, agent = divmod(row["episode"], n_agents)
                place = part, e % n_ranks
                if place not in made:
                    rank = place[1], n_ranks
                    stage = arena.Stage(
                        self.env, parts[part][1], self.cfg.episodes, rank=rank, **where
                    )
                    factory.load_wrappers(stage.env, loaded)
                    lanes = [x * n_agents + a for x in stage.shard.envs for a in range(n_agents)]
                    prefix = f"{part}-"
                    leaves = {
                        name[len(prefix) :]: steps[:, lanes]
                        for name, steps in arrays.items()
                        if name.startswith(prefix)
                    }
                    made[place] = stage.env, Replay(stage.env, leaves)
                yield row, *made[place], (e // n_ranks) * n_agents + agent


def newest(folder: Path, loaded: checkpoint.Checkpoint, is_trusted: bool) -> Table:
    """Returns the newest evaluation in a run's folder whose episodes can be played again.

    Args:
        loaded: a checkpoint of the run.
        is_trusted: import what an evaluation of another user's names.

    Raises:
        UserError: there is none, or it is damaged.
    """
    paths = [path.with_suffix(".json") for path in (folder / "evaluations").glob("*.npz")]
    paths = [path for path in paths if path.exists()]
    if not paths:
        command = folders.command_of("evaluate", "run", folder)
        raise UserError(f"{folder} has no evaluation yet with episodes to film; first {command}")
    path = max(paths, key=lambda path: path.stat().st_mtime)
    with user_errors(f"{path} cannot be used: ", (Exception,)):
        table = loads(strange_files.read_bytes(path, MAX_BYTES))
        names = trust.foreign_names(json.dumps({"train": table["evaluation"]}).encode())
        known = trust.foreign_names(json.dumps({"train": loaded.config["train"]}).encode())
        if (strange := {*names} - {*known}) and not is_trusted:
            raise ValueError(f"it would import {shortened(sorted(strange))}; trust=true allows it")
        cfg = check.check(settings.Evaluate, table["evaluation"])
        trained = factory.config_of(loaded)
        env = cfg.env or trained.env
        columns = table["episodes"]
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        rows = [row for row in rows if row["agent"] == rows[0]["agent"]]
        geometry = factory.typed_or(trained.geometry, cfg.geometry, env)
        name = Path(table["checkpoint"]).name
    return Table(path, str(table["title"]), name, cfg, env, geometry, rows)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """Returns the arrays of an .npz, none of which is more than a `Recorder` keeps."""
    content = io.BytesIO(strange_files.read_bytes(path, MAX_BYTES))
    with zipfile.ZipFile(content) as archive:
        n_bytes = sum(file.file_size for file in archive.infolist())
        if n_bytes > 2 * MAX_BYTES:
            raise ValueError(f"it has {n_bytes:,} bytes")
    with np.load(content, allow_pickle=False) as arrays:
        return dict(arrays)
