"""What a notebook does: loads, makes, trains, evaluates and films without Hydra and the command
line.
"""

import os
import subprocess
import sys

from tests.helpers.pages import ROOT

NOTEBOOK = """
import sys
from pathlib import Path
from megastep import envs, geometries, recording
from megastep.agents import pretrained
from megastep.agents.factory import make as factory
from megastep.agents.evaluation import playing, statistics
from megastep.agents.factory import components
from megastep.agents.runs.saver import Saver
from megastep.agents.training.budget import Budget
from megastep.agents.training.trainer import Trainer

homes = geometries.sample("box", 4)
policy = pretrained.load("explorer_anywhere", device="cpu")
env = envs.Explorer(4, homes, device="cpu")
(row,) = statistics.summaries(playing.first_episodes(env, policy, max_steps=20))
assert row["lanes"] == 4

name = "megastep.agents.algorithms.ppo:PPO"
chosen = components.settings_for("learner", name, n_steps=4, n_minibatches=2, lr=1e-3)
policy = factory.make_policy(components.settings_for("agent", width=16), env, critic="plain")
learner = factory.make_learner(chosen, policy)
saver = Saver(Path("checkpoints"), {})
trainer = Trainer(env, policy, learner, Budget(samples=64), saver=saver)
trainer.train()
assert trainer.samples == 64 and [*Path("checkpoints").glob("step_64")]

recording.film(env, policy, "film.png", steps=2)
assert Path("film.png").exists()
unwanted = "hydra", "omegaconf", "megastep.agents.cli"
unwanted += "sympy", "tensorboard", "megastep.envs.minigrid"  # which take a second to import
assert not [name for name in sys.modules if name.startswith(unwanted)]
"""


def test_a_notebook_imports_neither_hydra_nor_the_command_line(tmp_path):
    paths = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    subprocess.run(
        [sys.executable, "-c", NOTEBOOK],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": paths},
        check=True,
        timeout=300,
    )
