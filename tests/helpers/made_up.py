"""A random environment, random rollouts, and the weights to compare after learning from them."""

import torch

from megastep import spaces
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.rollout import Rollout
from megastep.arrdict import arrdict

T, B, WIDTH = 8, 6, 16
OBS, MOVES = spaces.MultiVector(1, 4, dtype=torch.float32), spaces.MultiDiscrete(1, 3)
PRIVILEGED = spaces.MultiVector(1, 2)


class Numbers:
    """Random observations; action 1 is rewarded with their first number. Episodes are truncated
    after 7 steps. Observations do not depend on actions, so one different action changes little.

    Args:
        device: device of the environment.
        bad_steps: steps, from 1, in which lane 3 gets a reward of NaN.
    """

    obs_space, action_space = spaces.MultiVector(1, 3), spaces.MultiDiscrete(1, 3)
    n_envs = B

    def __init__(self, device="cpu", bad_steps=()):
        self.n_steps, self.bad_steps = 0, bad_steps
        self.device = torch.device(device)
        self.generator = torch.Generator(device).manual_seed(1)
        self.age = torch.zeros(B, dtype=torch.int64, device=device)
        self.obs = torch.zeros(B, 1, 3, device=device)

    def reset(self):
        return self._world(torch.ones_like(self.age, dtype=torch.bool), torch.zeros_like(self.age))

    def step(self, decision):
        world = self._world(self.age == 7, decision["actions"][:, 0] == 1)
        if self.bad_steps:
            self.n_steps += 1
            world.reward[3] *= torch.nan if self.n_steps in self.bad_steps else 1.0
        return world

    def _world(self, reset, is_taken):
        reward = (self.obs[:, 0, 0] * is_taken).masked_fill(reset, 0.0)
        self.age = (self.age + 1).masked_fill(reset, 0)
        self.obs = torch.randn(B, 1, 3, generator=self.generator, device=self.device) + 2
        ended = self.age == 7
        metrics = arrdict(age=self.age.float())
        flags = dict(reset=reset, terminal=torch.zeros_like(ended), truncated=ended)
        return arrdict(obs=self.obs, reward=reward, metrics=metrics, **flags)


def made_up(seed=0, device="cpu", privileged=None, values=True, width=WIDTH):
    """Returns a policy and a random rollout with its actions. Lanes 1 and 4 have a reset each."""
    policy = Policy(OBS, MOVES, privileged, width=width, seed=seed).to(device)
    with torch.no_grad():
        # a policy far from uniform, so that gradients differ by action
        policy.output.linear.weight.mul_(100)
    state = policy.initial(B)
    rollout = Rollout(T, B, OBS, MOVES, state, device, privileged, values=values)
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
        rollout.actions[:] = policy.output.sample(
            out.logits[:-1], policy.generator.on(policy.device)
        )
        rollout.logprobs[:] = policy.output.logprob(out.logits[:-1], rollout.actions)
    return policy, rollout


def weights(policy):
    """Returns all weights, except the value's linear layer, which PopArt rescales."""
    return torch.cat(
        [
            p.detach().flatten()
            for name, p in policy.named_parameters()
            if not name.startswith("critic.output")
        ]
    )
