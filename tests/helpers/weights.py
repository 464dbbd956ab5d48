"""Weights of modules and of runs, to compare."""

import torch

from megastep.agents.runs import checkpoint


def of_run(folder):
    """Returns the policy's weights in a run's last checkpoint."""
    return checkpoint.load_latest(folder / "checkpoints").state["policy"]


def copied(module):
    return {name: value.clone() for name, value in module.state_dict().items()}


def same(a, b):
    return all(torch.equal(a[name], b[name]) for name in a)
