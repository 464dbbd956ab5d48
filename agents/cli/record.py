"""The command that films a trained policy. `record --help` lists the choices."""

from pathlib import Path

from megastep.agents import console
from megastep.agents.cli import evaluate
from megastep.agents.cli.command import Command
from megastep.agents.factory import settings

HELP = """Films a run's agent in one home: the plan with what it has seen, and its view.
It makes one environment, whatever env.n_envs is.

The most common words:
  run=RUN          a run folder, one of its checkpoints, latest, or a pretrained agent
  env=explorer     random actions in an environment, without a run
  steps=400        frames
  against=RUN      its duel with another run's agent, a bot, or an import path, in one home
  home=3           another of the unseen homes; split=training: one it was trained in
  homes=[1,2,3,4]  several homes in a grid
  runs=[A,B]       several runs side by side, in one home from the same spawn
  theme=dark       also title=, dpi=200, speed=2, trail=0
  file=out.mp4     this file, overwritten if it exists; out.gif: a GIF, of at most 50 frames/s;
                   out.png, out.svg or out.pdf: the last frame only. Otherwise video.mp4 in the
                   run folder, or video-2.mp4, ... if there is one"""


def run(cfg: settings.Record) -> Path:
    """Films an agent; see `megastep.agents.evaluation.filming.run`."""
    from megastep.agents.evaluation import filming  # with PyTorch

    with console.counting("frames"):
        return filming.run(cfg)


COMMAND = Command("record", run, HELP, settings.Record, evaluate.prepare, evaluate.ready)
main = COMMAND.main
