"""Between agents by environment, (N, A, ...), and lanes, (B, ...): lane e A + a of the B = N A is
agent a of environment e. Both ways are views where the memory allows.
"""

import torch


def to_lanes(values: torch.Tensor) -> torch.Tensor:
    """(N, A, ...) to (B, ...)."""
    return values.flatten(0, 1)


def to_agents(values: torch.Tensor, n_agents: int) -> torch.Tensor:
    """(B,), or (B, 1) as actions are, to (N, A); what is (N, A) already stays so."""
    return values.reshape(-1, n_agents)
