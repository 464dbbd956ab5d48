"""Explorer with megastep's trainer, as `python train.py` trains it, with reports and checkpoints.

Recipe: PPO, captured as CUDA graphs; Adam. A linear encoder, an LSTM and an asymmetric critic of
256 units with an auxiliary loss, in bfloat16 on a GPU.
"""

import tempfile
from pathlib import Path

import explorer

from megastep.agents import factory
from megastep.agents.factory.trainer import make_trainer


def main() -> None:
    given = explorer.arguments()
    clock = explorer.Clock(given)
    with tempfile.TemporaryDirectory() as folder:
        cfg = explorer.settings(given, f"agent.bf16={given.precision == 'bfloat16'}")
        device = factory.make_device(cfg.device)
        trainer = make_trainer(cfg, Path(folder), device)
        trainer.train(lambda: clock.is_done(trainer.samples))
        trainer.close()


main()
