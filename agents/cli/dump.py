"""The command that writes datasets. `megastep dump --help` lists the choices."""

from pathlib import Path

from megastep.agents import console
from megastep.agents.cli import evaluate
from megastep.agents.cli.command import Command
from megastep.agents.factory import settings

HELP = """Writes whole episodes as a dataset, with all T + 1 observations of each. Killed, it goes
on where it stopped when it is repeated. The same words give the same dataset.

The most common words:
  run=RUN              who plays: a run folder, one of its checkpoints, latest, or a packaged agent
  bot=explorer         or a bot: explorer, random, walker, oracle, ..., bot, module:Class
  env=memory           where; without it, as the run was trained. geometry=, split=: other homes
  episodes=30000       how many
  max_steps=1000       cut off longer ones
  truth=true           also what no agent sees: poses, objects, goals, floor plans
  format=npz           a file per episode, as Memory Maze's offline set; minari; lerobot (v3)
  folder=data          a new folder, or one to go on with"""


def run(cfg: settings.Dump) -> Path:
    """Writes a dataset; see `megastep.agents.evaluation.dumping.run`."""
    from megastep.agents.evaluation import dumping  # with PyTorch

    with console.counting("episodes"):
        return dumping.run(cfg)


COMMAND = Command("dump", run, HELP, settings.Dump, evaluate.prepare, evaluate.ready)
main = COMMAND.main
