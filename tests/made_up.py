"""Rollouts of random worlds, and what is compared after learning from them."""

import torch

from agents.policy import Policy
from agents.rollout import Rollout
from megastep import spaces

T, B, WIDTH = 8, 6, 16
OBS, MOVES = spaces.MultiVector(1, 4), spaces.MultiDiscrete(1, 3)
MORE = spaces.MultiVector(1, 2)  # what a critic may see beside


def made_up(seed=0, device="cpu", privileged=None, values=True):
    """A policy and a rollout of random worlds, acted in by that policy. Lanes 1 and 4 have resets
    in the middle.
    """
    policy = Policy(OBS, MOVES, privileged, width=WIDTH, seed=seed).to(device)
    with torch.no_grad():
        # a policy far from uniform, so that gradients differ by action
        policy.output.core.weight.mul_(100)
    state = policy.initial(B)
    rollout = Rollout(*(T, B, OBS, MOVES, state, device, privileged, torch.float32), values=values)
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator).to(device)

    rollout.obs[:] = normal(T + 1, B, 1, 4)
    rollout.starts[3, 1] = rollout.starts[5, 4] = True
    rollout.terminal[1, 1] = rollout.truncated[3, 4] = True
    rollout.reward[:] = normal(T, B)
    if privileged:
        rollout.privileged[:] = normal(T + 1, B, *privileged.shape)
    with torch.no_grad():
        out = policy.unroll(rollout.obs, rollout.starts, rollout.state)
        if values:
            rollout.values[:] = policy.value(out.features, rollout.privileged)
        rollout.actions[:] = policy.output.sample(out.logits[:-1], policy.random.on(policy.device))
        rollout.logprobs[:] = policy.output.logprob(out.logits[:-1], rollout.actions)
    return policy, rollout


def weights(policy):
    """All but the value's own layer, which `update_stats` changes with no prediction."""
    return torch.cat(
        [
            p.detach().flatten()
            for name, p in policy.named_parameters()
            if not name.startswith("critic.output")
        ]
    )
