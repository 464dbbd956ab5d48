"""The dtype that layers compute in."""

import torch


def compute_dtype(weight: torch.Tensor) -> torch.dtype:
    """Returns the dtype of a matrix product with `weight`: autocast's if it is on, else the
    weight's own.
    """
    device = weight.device.type
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else weight.dtype
