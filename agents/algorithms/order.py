"""Random orders of lanes."""

import torch

from megastep.agents.algorithms.kernels import LIBRARY
from megastep.kernels.build.launch import WARP, launch

_MAX_COUNTED = 16_384  # keys; counting takes the square of their number


def random_order(n: int, generator: torch.Generator, device: torch.device) -> torch.Tensor:
    """Returns a random order (n,) int64 of 0 to n - 1. On a GPU in two kernels.

    Args:
        n: how many, at least 1.
        generator: on the device.
        device: where the order is.
    """
    keys = torch.rand(n, generator=generator, device=device)
    return _order_on_gpu(keys) if keys.is_cuda and n <= _MAX_COUNTED else order(keys)


def order(keys: torch.Tensor) -> torch.Tensor:
    """Returns the indices of keys (n,) from the smallest on, equal ones in their order."""
    return keys.argsort(stable=True)


def _order_on_gpu(keys) -> torch.Tensor:
    """Does `order` in one kernel."""
    n, result = len(keys), torch.empty_like(keys, dtype=torch.int64)
    launch(LIBRARY, "order", keys.device, n * WARP, keys=keys, order=result, n=n)
    return result
