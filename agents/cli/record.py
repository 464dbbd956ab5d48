"""Films a trained policy. `python record.py --help`; `run(cfg)` is the same from Python."""

import dataclasses
from pathlib import Path

import torch

from agents.cli import components, run_folders
from agents.cli.command import run_command
from agents.cli.console import say
from agents.cli.errors import UserError
from agents.cli.settings import Record
from agents.metrics import missing

HELP = """Films a run's agent in one home: the plan with what it has seen, and its view.

The commonest:
  run=RUN          a run folder, one of its checkpoints, or latest
  steps=400        frames
  home=3           another of the unseen homes; split=training: one it was trained in
  file=out.mp4     instead of video.mp4 in the run folder"""


def run(cfg):
    """Films as `cfg`, a settings.Record, says. Returns the path of the video."""
    try:
        import av  # noqa: F401, what the recorder encodes with
    except ImportError:
        raise UserError(missing("av")) from None
    from megastep.recording import ParallelEncoder

    device, path = components.make_device(cfg.device), run_folders.find(cfg.run)
    loaded = components.load(path, device)
    trained = components.config_of(loaded)
    homes = components.homes(cfg.geometry or trained.geometry, cfg.split)
    env = components.make_env(
        dataclasses.replace(trained.env, n_envs=1), [homes[cfg.home % len(homes)]], cfg.seed, device
    )
    policy = components.make_policy(trained.agent, env)
    components.load_weights(policy, env, loaded)

    place = Path(cfg.file) if cfg.file else run_folders.folder_of(path) / "video.mp4"
    try:
        with ParallelEncoder(env.plot_state, fps=trained.env.fps) as encoder:
            for state in states(env, policy, cfg):
                encoder(state)
        encoder.save(place)
    except (RuntimeError, OSError) as error:
        raise UserError(
            f"The video {place} could not be made: {str(error).splitlines()[0]}"
        ) from error
    say(f"Filmed {cfg.steps} steps: {place}")
    return place


@torch.no_grad()
def states(env, policy, cfg):
    """The environment's state after each of `cfg.steps` steps."""
    generator = torch.Generator(env.device).manual_seed(cfg.seed)
    world, memory = env.reset(), policy.initial(env.n_agents, env.device)
    for _ in range(cfg.steps):
        yield env.state(0)
        decision, memory = policy(world, memory, sample=not cfg.greedy, generator=generator)
        world = env.step(decision)


def main(argv=None):
    return run_command("record", Record, run, HELP, argv)
