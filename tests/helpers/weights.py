"""Weights of modules and of runs: copies, and comparisons."""

import copy
import io

import torch

from megastep.agents.runs import checkpoint


def of_run(folder):
    """Returns the policy's weights in a run's last checkpoint."""
    return checkpoint.load_latest(folder / "checkpoints").state["policy"]


def copied(module):
    return {name: value.clone() for name, value in module.state_dict().items()}


def reloaded(state):
    """Returns a state that was saved and loaded as a checkpoint's is."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def moved(module, to_gpu):
    """Returns a copy of a module with its tensors on a GPU."""
    module = copy.deepcopy(module)
    for part in module.modules():
        for name, buffer in [*part.named_buffers(recurse=False)]:
            setattr(part, name, to_gpu(buffer))
        for name, leaf in [*part.named_parameters(recurse=False)]:
            setattr(part, name, torch.nn.Parameter(to_gpu(leaf.detach())))
    return module


def same(a, b):
    return all(torch.equal(a[name], b[name]) for name in a)
