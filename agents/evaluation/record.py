"""Films a trained policy, or random actions."""

import contextlib
import itertools
from pathlib import Path
from typing import cast

import torch

from megastep import recording
from megastep.agents import console, factory
from megastep.agents.errors import user_errors
from megastep.agents.evaluation import arena, duels
from megastep.agents.factory import env_failures, settings
from megastep.agents.runs import folders
from megastep.agents.runs.atomic_files import make_folders, remove_folders
from megastep.agents.selfplay.bots.random import RandomActions
from megastep.types import PolicyLike, optional

#: Where random actions are filmed unless geometry= says otherwise.
HOMES = "megastep.geometries.sources:homes"


def run(cfg: settings.Record) -> Path:
    """Films a run's agent, or random actions. Returns the path of the video: `cfg.file`, or the
    first free name of `video.mp4`, `video-2.mp4`, ...
    """
    folder, device = Path(), factory.make_device(cfg.device)
    env_settings, geometry = cfg.env, cfg.geometry
    if cfg.run is not None:
        loaded = folders.load_checkpoint(folders.find(cfg.run), cfg.trust, device)
        trained = factory.config_of(loaded)
        env_settings = trained.env
        geometry = factory.typed_or(trained.geometry, geometry, env_settings)
        folder = folders.folder_of(loaded.path)
    if cfg.against is not None:
        env_settings = settings.changed(env_settings, **arena.FOR_TWO)
    geometry = geometry or settings.kind_of("geometry", HOMES)(name=HOMES)
    homes = factory.homes(env_settings, geometry, cfg.split)
    homes = [homes[cfg.home % len(homes)]] if homes else []
    env_settings = settings.changed(env_settings, n_envs=1)
    env = factory.make_sample(env_settings, homes, seed=cfg.seed, device=device, films=True)
    random = RandomActions(env.action_space)
    policy: PolicyLike = random
    if cfg.run:
        policy = arena.load_player(loaded, env, loaded).policy
        factory.load_wrappers(env, loaded)
    if cfg.against is not None:
        arena.check_duels(env)
        opponent = arena.find_player(cfg.against, loaded, env_settings, env, cfg.trust)
        console.say(f"The first agent is that of {loaded.path}, the other is {opponent.name}")
        seat = torch.zeros(env.n_envs, 1, dtype=torch.int64, device=env.device)
        policy = duels.duel_policy(policy, opponent.policy, seat, optional(env, "n_agents"))
    with contextlib.ExitStack() as undo:
        path = Path(cfg.file) if cfg.file else take_free_name(folder / "video.mp4")
        if not cfg.file:
            undo.callback(path.unlink, missing_ok=True)
        else:
            with user_errors(f"The video {path} could not be made: "):
                undo.callback(remove_folders, make_folders(path.parent))
        # a video is the last thing that a run should fail for
        problem = f"The video {path} could not be made: "
        with (
            env_failures.told(cast("settings.Env", env_settings), folder),
            user_errors(problem, (Exception,)),
        ):
            recording.film(env, policy, path, cfg.steps, cfg.greedy, cfg.seed)
        undo.pop_all()
    console.say(f"Filmed {cfg.steps} steps: {path}")
    return path


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
