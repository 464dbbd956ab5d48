"""A twin of Explorer's step in plain PyTorch, an operation at a time. Shares no code with the
kernel but engine.unseen and engine.coverage, which have twins of their own.

N environments, A agents, B = N A lanes.
"""

import torch

from megastep import engine

UNITS = 200.0, 1000.0, 1000.0, 1000.0


def explorer_step(scenery, agents, newly_seen, seen, visible, ages, limits, ended, *, patience=200):
    """Returns {name: tensor} of all outputs of `megastep.envs.explorer.step.explorer_step` and of
    the new ``ages``, ``limits`` and ``ended``. Changes nothing.
    """
    reset, newly_seen = ended.clone(), newly_seen.flatten()
    limits = limits.masked_fill(reset, patience) + newly_seen
    ages = (ages + 1).masked_fill(reset, 0)
    truncated = ages >= limits
    ends = truncated.view(scenery.n_envs, -1)
    counts = engine.unseen(scenery, agents, seen, visible).view(len(ages), 1, -1)
    left = counts.sum((1, 2), dtype=torch.int32)
    columns = torch.stack([limits - ages, ages, limits - patience, left], -1)
    return dict(
        reward=(newly_seen / 64).masked_fill(reset, 0.0),
        reset=reset,
        terminal=torch.zeros_like(reset),
        truncated=truncated,
        coverage=engine.coverage(scenery, agents, seen, visible, ends).flatten(),
        episode=columns[:, None] / torch.tensor(UNITS, device=ages.device),
        # in double precision: PyTorch's float square roots differ in the last bit between devices
        unseen=(counts.double() / 64).sqrt().float(),
        ages=ages,
        limits=limits,
        ended=truncated,
    )
