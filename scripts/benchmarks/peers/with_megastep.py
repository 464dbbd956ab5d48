"""Explorer with megastep's trainer, as `python train.py` trains it, with reports and checkpoints.

Recipe: PPO, captured as CUDA graphs; Adam. A linear encoder, an LSTM and an asymmetric critic of
256 units with an auxiliary loss, in bfloat16 on a GPU.
"""

import tempfile
from pathlib import Path

import explorer

from megastep.agents.cli import console, factory, train


def main() -> None:
    given = explorer.arguments()
    clock = explorer.Clock(given)
    with tempfile.TemporaryDirectory() as folder:
        cfg = explorer.settings(given, f"agent.bf16={given.precision == 'bfloat16'}")
        device = factory.make_device(cfg.device)
        trainer = train.make_trainer(cfg, Path(folder), device, console.Progress())
        trainer.train(lambda: clock.is_done(trainer.samples))
        trainer.close()


main()
