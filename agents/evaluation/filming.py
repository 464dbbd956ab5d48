"""Films a trained policy, or random actions."""

import contextlib
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import torch

from megastep import recording
from megastep.agents import console, factory
from megastep.agents.errors import UserError, user_errors
from megastep.agents.evaluation import duels, eval_env, players, replay
from megastep.agents.factory import components, env_failures, settings
from megastep.agents.runs import folders, restore
from megastep.agents.selfplay.bots.random import RandomActions
from megastep.types import PolicyLike, optional


def run(cfg: settings.Record) -> Path:
    """Films agents of runs, or random actions. Returns the path of the video: `cfg.file`, or the
    first free name of `video.mp4`, `video-2.mp4`, ...
    """
    folder, device = Path(), factory.make_device(cfg.device)
    if cfg.worst is not None or cfg.episode is not None:
        return film_stored(cfg, device)
    env_settings, geometry = cfg.env, cfg.geometry
    names = (cfg.run,) if cfg.run is not None else cfg.runs or ()
    runs = [folders.load_checkpoint(folders.find(name), cfg.trust, device) for name in names]
    if runs:
        trained = factory.config_of(runs[0])
        env_settings = trained.env
        geometry = factory.typed_or(trained.geometry, geometry, env_settings)
        folder = folders.folder_of(runs[0].path)
    if cfg.against is not None:
        env_settings = settings.changed_known(env_settings, **eval_env.FOR_TWO)
    geometry = geometry or components.settings_for("geometry", components.HOMES)
    homes = factory.homes(env_settings, geometry, cfg.split)
    env_settings = settings.changed(env_settings, n_envs=1)
    shown = []
    for home in (cfg.home or 0,) if cfg.homes is None else cfg.homes:
        for loaded in runs or [None]:
            home_alone = _home(homes, home, cfg.split)
            env = factory.make_sample(
                env_settings, home_alone, seed=cfg.seed, device=device, films=True
            )
            policy, title = _player(cfg, loaded, runs, env_settings, env), cfg.title
            if cfg.homes is not None:
                title = f"home {home}" if title is None else f"{title}, home {home}"
            elif loaded is not None and len(runs) > 1:
                name = folders.name_of(loaded.path)
                title = name if title is None else f"{title}, {name}"
            shown.append(recording.Player(env, policy, title))
    path = film(cfg, shown, folder, cast("settings.Env", env_settings))
    console.say(f"Filmed {cfg.steps} steps: {path}")
    return path


def film_stored(cfg: settings.Record, device: torch.device) -> Path:
    """Films episodes of a run's newest evaluation once more. Returns the path of the video."""
    path = folders.find(str(cfg.run))
    loaded = folders.load_checkpoint(path, cfg.trust, device)
    folder = folders.folder_of(loaded.path)
    table = replay.newest(folder, loaded, cfg.trust)
    rows = table.chosen(cfg.worst, cfg.episode, cfg.home)
    if (evaluated := folder / "checkpoints" / table.checkpoint).exists():
        loaded = folders.load_checkpoint(evaluated, cfg.trust, device)
    shown = []
    for row, env, policy, lane in table.plays(rows, loaded, device):
        title = f"{cfg.title}, " if cfg.title else ""
        title += f"episode {row['episode']}" + (f", home {row['home']}" if "home" in row else "")
        title += f": return {row['return']:.4g}, {row['ended']}"
        frames = int(row["length"]) + 1
        shown.append(recording.Player(env, policy, title, lane, frames, row["return"]))
    path = film(cfg, shown, folder, table.env)
    lines = "\n".join(str(player.title) for player in shown)
    console.say(f"{table.title}\n{lines}\nFilmed: {path}")
    return path


def film(
    cfg: settings.Record,
    players: Sequence[recording.Player],
    folder: Path,
    env_settings: settings.Env,
) -> Path:
    """Films players into `cfg.file`, or a new file in a folder. Returns its path.

    Raises:
        UserError: it cannot be made. No file is left.
    """
    with contextlib.ExitStack() as undo:
        path = Path(cfg.file) if cfg.file else take_free_name(folder / "video.mp4")
        if not cfg.file:
            undo.callback(path.unlink, missing_ok=True)
        else:
            with user_errors(f"The video {path} could not be made: "):
                path.parent.mkdir(parents=True, exist_ok=True)
        # a video is the last thing that a run should fail for
        problem = f"The video {path} could not be made: "
        look = {name: getattr(cfg, name) for name in ("theme", "dpi", "speed", "trail", "axes")}
        with (
            env_failures.caught(env_settings, folder),
            user_errors(problem, (Exception,)),
        ):
            recording.film_all(players, path, cfg.steps, cfg.greedy, cfg.seed, **look)
        undo.pop_all()
    return path


def _home(homes, index, split) -> list[dict]:
    """Returns the home as a list, empty for environments without homes.

    Raises:
        UserError: there is no such home.
    """
    if index >= max(len(homes), 1):
        have = (
            f"split={split} has {len(homes)}, from home=0" if homes else "the environment has none"
        )
        raise UserError(f"There is no home {index}: {have}")
    return homes[index : index + 1]


def _player(cfg, loaded, runs, env_settings, env) -> PolicyLike:
    """Returns what plays: the agent of `loaded`, the duel with `cfg.against`, or random actions."""
    if loaded is None:
        return RandomActions(env.action_space)
    policy = players.load_player(loaded, env, runs[0]).policy
    restore.load_wrappers(env, loaded)
    if cfg.against is None:
        return policy
    eval_env.check_duels(env)
    opponent = players.find_player(cfg.against, loaded, env_settings, env, cfg.trust)
    console.say(f"The first agent is that of {loaded.path}, the other is {opponent.name}")
    seat = torch.zeros(env.n_envs, 1, dtype=torch.int64, device=env.device)
    return duels.duel_policy(policy, opponent.policy, seat, optional(env, "n_agents"))


def take_free_name(path: Path) -> Path:
    """Creates an empty file, `video.mp4` or else `video-2.mp4` and so on, and returns its path."""
    with user_errors(f"The video {path} could not be made: "):
        path.parent.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            name = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
            with contextlib.suppress(FileExistsError):
                name.touch(exist_ok=False)
                return name
    raise AssertionError("counting never ends")
