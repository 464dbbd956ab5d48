"""Films a trained policy, or random actions. `python record.py --help`; `run(cfg)` is the same
from Python.
"""

import collections
import dataclasses
from pathlib import Path
from typing import Any

import torch

from megastep.agents.cli import arena, factory, run_folders
from megastep.agents.cli.command import Script, run_command
from megastep.agents.cli.console import say
from megastep.agents.cli.errors import UserError
from megastep.agents.cli.settings import GROUPS, Record
from megastep.agents.selfplay import duels
from megastep.agents.selfplay.mixed_policy import MixedPolicy
from megastep.agents.training.checkpoint import Checkpoint
from megastep.agents.training.evaluation import RandomActions
from megastep.agents.training.optional_packages import not_installed
from megastep.arrdict import numpyify

HELP = """Films a run's agent in one home: the plan with what it has seen, and its view.

The commonest:
  run=RUN          a run folder, one of its checkpoints, or latest
  env=explorer     random actions in an environment, without a run
  steps=400        frames
  against=RUN      its duel with another run's agent, `bot`, or an import path, in one home
  home=3           another of the unseen homes; split=training: one it was trained in
  file=out.mp4     instead of video.mp4 in the run folder; out.png: the last frame alone"""

#: Where random actions are filmed unless geometry= says otherwise.
HOMES = {"name": "megastep.geometries.sources:homes"}


def run(cfg: Record) -> Path:
    """Films as `cfg` says. Returns the path of the video."""
    if not (cfg.file or "").endswith(".png"):
        try:
            import av  # noqa: F401, what the recorder encodes with
        except ImportError:
            raise UserError(not_installed("av")) from None
    device, folder = factory.make_device(cfg.device), Path()
    chosen, geometry, loaded = cfg.env, cfg.geometry or GROUPS["geometry"].settings(HOMES), None
    if cfg.run is not None:
        path = run_folders.find(cfg.run)
        folder, loaded = run_folders.folder_of(path), factory.load_checkpoint(path, device)
        trained = factory.config_of(loaded)
        chosen, geometry = trained.env, cfg.geometry or trained.geometry
    if cfg.against is not None:
        chosen = arena.for_duels(chosen)
    homes = factory.homes(chosen, geometry, cfg.split)
    home = [homes[cfg.home % len(homes)]] if homes else []
    env = factory.make_sample(dataclasses.replace(chosen, n_envs=1), home, cfg.seed, device)
    if loaded is None:
        policy = RandomActions(env.action_space)
    else:
        policy = factory.make_actor(trained.agent, env)
        factory.load_weights(policy, env, loaded)
    if cfg.against is not None:
        policy = against(cfg.against, chosen, env, policy, loaded)

    place = Path(cfg.file) if cfg.file else folder / "video.mp4"
    try:
        film(env, policy, place, cfg.steps, cfg.greedy, cfg.seed)
    except Exception as error:  # a video is the last thing that a run should fail for
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(f"The video {place} could not be made: {reason}") from error
    say(f"Filmed {cfg.steps} steps: {place}")
    return place


def against(name: str, chosen: Any, env: Any, policy: Any, loaded: Checkpoint) -> MixedPolicy:
    """The policy of a run's checkpoint as the first agent, and another, by name, as all others."""
    arena.check_agents(env)
    opponent = arena.Players(loaded, chosen, env).named(name)
    say(f"The first agent is that of {loaded.path}, the other {opponent.name}")
    seat = torch.zeros(env.n_envs, 1, dtype=torch.int64, device=env.device)
    return duels.duel_policy(policy, opponent.policy, seat, env.n_agents)


@torch.no_grad()
def film(
    env: Any, policy: Any, path: str | Path, steps: int, greedy: bool = False, seed: int = 1
) -> Path:
    """Films environment 0 of `env` for some steps from its reset, each a frame, at the
    environment's own frames per second; an image, .png, is the last frame. Returns the path of the
    mp4 or the image.

    ValueError for another kind of file; RuntimeError that names the first frame that failed.
    """
    from megastep.recording import ParallelEncoder, draw

    states = _states(env, policy, steps, greedy, torch.Generator(env.device).manual_seed(seed))
    if Path(path).suffix == ".png":
        (last,) = collections.deque(states, maxlen=1)
        return _save_image(path, draw(env.plot_state, numpyify(last)))
    with ParallelEncoder(env.plot_state, fps=env.fps) as encoder:
        for state in states:
            encoder(state)
    return encoder.save(path)


def _states(env, policy, steps, greedy, generator):
    """What there is to see of environment 0, at its reset and after each of `steps` - 1 steps."""
    world, memory = env.reset(), policy.initial(env.n_envs * env.n_agents, env.device)
    yield env.state(0)
    for _ in range(steps - 1):
        decision, memory = policy(world, memory, sample=not greedy, generator=generator)
        world = env.step(decision)
        yield env.state(0)


def _save_image(path, image):
    from matplotlib.image import imsave

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    imsave(path, image)
    return path


def main(argv: list[str] | None = None) -> int:
    return run_command(Script("record", Record, run, HELP), argv)
