"""Trained agents that come with megastep, and how to load them without the command line.

Each is a file NAME.safetensors in this folder, with a card NAME.md beside it. On the command line
its name stands for a run: `evaluate.py run=NAME`; in Python `megastep.load(NAME)` does.
"""

from megastep import devices
from megastep.agents.errors import user_errors
from megastep.agents.networks.policy import Policy
from megastep.agents.runs import folders, restore


def load(name: str, device: str = "auto") -> Policy:
    """Returns a trained policy, ready to act: `decision, state = policy(world, state)`. Raises
    UserError: there is none; or it names modules outside megastep that you have not trained with
    here.

    It acts only: it has no critic, and its weights need no gradient. On a CPU this sets the number
    of threads that PyTorch uses, as training does.

    Args:
        name: of an agent; or the path of such a file, a run's folder or a checkpoint, or `latest`.
            A path comes first.
        device: `auto`, `cpu`, `cuda` or `cuda:1`; `auto` is a GPU if there is one.
    """
    with user_errors(kinds=(devices.EngineError,)):
        where = devices.device(device)
    loaded = folders.load_checkpoint(folders.find(name), False, where)
    return restore.policy_of(loaded, device=where)
