"""Films a trained policy, or random actions.

`record --help`; `run(cfg)` is the same from Python.
"""

import collections
import contextlib
import functools
import itertools
from pathlib import Path
from typing import Any

import torch

from megastep import recording
from megastep.agents.cli import (
    command,
    console,
    evaluate,
    factory,
    program,
    runs,
    scripts,
    settings,
)
from megastep.agents.selfplay import duels
from megastep.agents.training.evaluation import RandomActions
from megastep.arrdict import numpyify
from megastep.types import n_lanes, optional

#: Where random actions are filmed unless geometry= says otherwise.
HOMES = "megastep.geometries.sources:homes"


def run(cfg: settings.Record) -> Path:
    """Films a run's agent, or random actions. Returns the path of the video: `cfg.file`, or the
    first free name of `video.mp4`, `video-2.mp4`, ...
    """
    folder, device = Path(), factory.make_device(cfg.device)
    env_settings, geometry = cfg.env, cfg.geometry
    if cfg.run is not None:
        loaded = runs.load_checkpoint(runs.find(cfg.run), cfg.trust, device)
        trained = factory.config_of(loaded)
        env_settings = trained.env
        geometry = factory.typed_or(trained.geometry, geometry, env_settings)
        folder = runs.folder_of(loaded.path)
    if cfg.against is not None:
        env_settings = factory.changed(env_settings, **evaluate.FOR_TWO)
    geometry = geometry or settings.kind_of("geometry", HOMES)(name=HOMES)
    homes = factory.homes(env_settings, geometry, cfg.split)
    homes = [homes[cfg.home % len(homes)]] if homes else []
    env_settings = factory.changed(env_settings, n_envs=1)
    env = factory.make_sample(env_settings, homes, seed=cfg.seed, device=device)
    random = RandomActions(env.action_space)
    policy = evaluate.load_player(loaded, env, loaded).policy if cfg.run else random
    if cfg.against is not None:
        opponent = evaluate.find_player(cfg.against, loaded, env_settings, env, cfg.trust)
        console.say(f"The first agent is that of {loaded.path}, the other is {opponent.name}")
        seat = torch.zeros(env.n_envs, 1, dtype=torch.int64, device=env.device)
        policy = duels.duel_policy(policy, opponent.policy, seat, env.n_agents)
    with contextlib.ExitStack() as undo:
        path = Path(cfg.file) if cfg.file else take_free_name(folder / "video.mp4")
        if not cfg.file:
            undo.callback(path.unlink, missing_ok=True)
        # a video is the last thing that a run should fail for
        with program.errors(f"The video {path} could not be made: ", (Exception,)):
            film(env, policy, path, cfg.steps, cfg.greedy, cfg.seed)
        undo.pop_all()
    console.say(f"Filmed {cfg.steps} steps: {path}")
    return path


def take_free_name(path: Path) -> Path:
    """Creates an empty file, `video.mp4` or else `video-2.mp4` and so on, and returns its path."""
    with program.errors(f"The video {path} could not be made: "):
        path.parent.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            name = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
            with contextlib.suppress(FileExistsError):
                name.touch(exist_ok=False)
                return name


@torch.no_grad()
def film(
    env: Any, policy: Any, path: str | Path, steps: int, greedy: bool = False, seed: int = 1
) -> Path:
    """Films environment 0 of `env` for some steps from its reset, each a frame, at the
    environment's own frames per second. Returns the path.

    Args:
        path: an .mp4, or a .png, which is the last frame.

    Raises:
        ValueError: for another kind of file, or an environment that cannot be drawn.
        RuntimeError: naming the first frame that failed.
    """
    if not (hasattr(env, "state") and hasattr(env, "plot_state")):
        raise ValueError(
            f"{type(env).__name__} cannot be drawn: it needs the methods state(e) and "
            "plot_state(state), which docs/new-environment.md shows"
        )
    path, states = Path(path), _states(env, policy, steps, greedy, seed)
    if path.suffix == ".png":
        from matplotlib.image import imsave  # a third of a second, which train.py needs not wait

        (last,) = collections.deque(states, maxlen=1)
        path.parent.mkdir(parents=True, exist_ok=True)
        imsave(path, recording.draw(env.plot_state, numpyify(last)))
        return path
    with recording.ParallelEncoder(env.plot_state, fps=optional(env, "fps")) as encoder:
        for state in states:
            encoder(state)
    return encoder.save(path)


def _states(env, policy, steps, greedy, seed):
    world, hidden = env.reset(), policy.initial(n_lanes(env), env.device)
    generator = torch.Generator(env.device).manual_seed(seed)
    yield env.state(0)
    for _ in range(steps - 1):
        decision, hidden = policy(world, hidden, sample=not greedy, generator=generator)
        world = env.step(decision)
        yield env.state(0)


#: Runs the script with words of a command line, by default this process's.
main = functools.partial(command.run_command, scripts.RECORD)
