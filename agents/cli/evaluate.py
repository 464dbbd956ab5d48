"""The command that measures a trained policy. `evaluate --help` lists the choices."""

import dataclasses
from pathlib import Path

from megastep.agents import console
from megastep.agents.cli.command import Command, with_member
from megastep.agents.factory import settings
from megastep.agents.factory.check import Tree
from megastep.agents.runs import folders

HELP = """Measures what a run's agent earns in the first episode of each lane, with a 95 %
interval over homes. Prints a table and writes it to the run's folder: evaluations/*.md.

The most common words:
  run=RUN              a run folder, one of its checkpoints, latest, or a pretrained agent
  member=3             an agent of a population, whose folder is run=; without it, the best
  split=training       the homes it was trained in, instead of unseen ones
  geometry=bench       other homes
  env=pong             another environment with the same spaces: after self-play, the tracker
  greedy=true          the most likely actions instead of sampled ones
  episodes=256         fewer episodes
  baseline=random,bot  further rows for others in its homes: random, bot, explorer, hunter, walker,
                       an import path, another run; none for none
  against=RUN,bot      duels instead: with other runs or checkpoints, the environment's bot, hunter,
                       explorer, walker, random, or an import path
  ratings=true         ratings of the run's snapshots, by duels of each with each"""


def prepare(tree: Tree, typed: list[str]) -> Tree:
    """Returns the tree with a population's member, and without settings of training alone."""
    tree = with_member(tree, "run")
    kinds = settings.Train, settings.Played
    train, played = ({field.name for field in dataclasses.fields(kind)} for kind in kinds)
    absent = train - played - {key.split(".")[0] for key in typed}
    return {key: value for key, value in tree.items() if key not in absent}


def ready(cfg: settings.Evaluate | settings.Record) -> None:
    """Raises UserError if a run does not exist."""
    for run in (cfg.run, *(getattr(cfg, "runs", None) or ())):
        if run is not None:
            folders.find(run)


def run(cfg: settings.Evaluate) -> Path:
    """Evaluates a run; see `megastep.agents.evaluation.evaluate_run.run`."""
    from megastep.agents.evaluation import evaluate_run  # with PyTorch

    with console.counting("episodes"):
        return evaluate_run.run(cfg)


COMMAND = Command("evaluate", run, HELP, settings.Evaluate, prepare, ready, has_ranks=True)
main = COMMAND.main
