"""The precision that layers compute in."""

import torch


def compute_dtype(weight):
    """The dtype a matrix product with `weight` runs in: autocast's where that is on, else the
    weight's own.
    """
    device = weight.device.type
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else weight.dtype
