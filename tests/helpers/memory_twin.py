"""A twin of Memory's step in plain Python, an environment at a time. Shares no code with the
kernel.

N environments, O objects.
"""

import torch

from megastep.engine import uniform


def draws(counts, seed):
    """Returns the uniform numbers (N, 4) of draw `counts` (N,) of each environment."""
    everyone = torch.ones(len(counts), dtype=torch.bool)
    return uniform(counts.clone(), everyone, seed, torch.zeros(len(counts), 4))


def memory_step(positions, radius, at, sizes, layout, arrangements, state, *, seed, limit, reach):
    """Returns (outputs, state, at) after a step, on the CPU. Changes nothing.

    Args:
        positions: (N, 2) metres, the agents'.
        radius: of the agents.
        at: (N, O, 2) metres, the objects; `sizes` (N, O) their radii.
        layout: (N,), `arrangements` (D, M, O, 2).
        state: {name: tensor (N,)}, as `megastep.envs.Memory` has them.
    """
    n, n_objects = at.shape[:2]
    at, state = at.clone(), {name: tensor.clone() for name, tensor in state.items()}
    numbers = draws(state["n_draws"], seed)
    reward, truncated, found_at_end = torch.zeros(n), torch.zeros(n, dtype=torch.bool), []
    reset = state["ended"].clone()
    for e in range(n):
        cue = int(state["cue"][e])
        if reset[e]:
            m = arrangements.shape[1]
            at[e] = arrangements[int(layout[e]), int(numbers[e, 1] * m)]
        away = (at[e] - positions[e]).square().sum(-1)
        touched = (away <= (radius + sizes[e] + reach).square()).tolist()
        hit = not reset[e] and touched[cue]
        if reset[e]:
            choices = [k for k in range(n_objects) if not touched[k]] or [*range(n_objects)]
        else:
            choices = [k for k in range(n_objects) if k != cue]
        if reset[e] or hit:
            cue = choices[int(numbers[e, 0] * len(choices))]
            state["n_draws"][e] += 1
        state["cue"][e] = cue
        state["found"][e] = 0 if reset[e] else state["found"][e] + hit
        state["ages"][e] = 0 if reset[e] else state["ages"][e] + 1
        truncated[e] = bool(not reset[e] and state["ages"][e] >= limit)
        reward[e] = float(hit)
        found_at_end.append(float(state["found"][e]) * float(truncated[e]))
    state["ended"] = truncated
    outputs = dict(
        reward=reward,
        reset=reset,
        terminal=torch.zeros_like(reset),
        truncated=truncated,
        metrics=torch.tensor(found_at_end),
    )
    return outputs, state, at
