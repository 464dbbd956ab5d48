"""Conversion between agents by environment, (N, A, ...), and lanes, (B, ...) with B = N A.

Lane e * A + a is agent a of environment e. Both functions return views where possible.
"""

import torch


def to_lanes(values: torch.Tensor) -> torch.Tensor:
    """Returns (N, A, ...) as (B, ...)."""
    return values.flatten(0, 1)


def to_agents(values: torch.Tensor, n_agents: int) -> torch.Tensor:
    """Returns (B,), (B, 1) or (N, A) as (N, A)."""
    return values.reshape(-1, n_agents)
