"""The actor-critic: an intake, a memory, and two outputs, one to act and one to judge.

Axes: T time, B lanes. On a GPU matrix products run in bfloat16 with float32 weights, on the CPU in
float32.
"""

import torch
from torch import nn

from agents import heads
from agents.random_stream import RandomStream
from agents.recurrent import LSTM
from megastep.arrdict import arrdict
from megastep.dotdict import mapping


class Policy(nn.Module):
    """Acts on worlds and remembers: `decision, state = policy(world, state)`, starting from
    `policy.initial(B)`.

    `seed` decides the first weights and, where no generator is given, the actions drawn. The
    weights are in `state_dict()`; how far the drawing has come is `random.state_dict()`, which a
    learner saves.
    """

    def __init__(self, obs_space, action_space, *, width=128, encoder="linear", bf16=True, seed=1):
        super().__init__()
        if width < 1:
            raise ValueError(f"width is {width}; a policy needs at least 1")
        self.bf16 = bf16
        self.random = RandomStream(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.intake = heads.intake(obs_space, width, encoder)
            self.memory = LSTM(width)
            self.output = heads.output(action_space, width)
            self.value = heads.ValueOutput(width)

    @property
    def device(self):
        return self.value.mean.device

    def initial(self, n_lanes, device=None):
        """The state of B lanes that remember nothing: arrdict of (B, width) float32."""
        return self.memory.initial(n_lanes, self.device if device is None else device)

    def forward(self, world, state, sample=True, generator=None):
        """One step for all lanes: (decision, state) from world.obs and world.reset, which clears a
        lane's memory.

        decision is arrdict(actions, logits, logprobs (B,), value (B,)); value is the return
        expected from this world on. Actions are drawn from `generator`, by default the policy's
        own, or are the likeliest if not `sample`.
        """
        seen = self.unroll(mapping(torch.unsqueeze)(world["obs"], 0), world["reset"][None], state)
        logits = mapping(torch.squeeze)(seen["logits"], 0)
        if sample:
            actions = self.output.sample(
                logits, self.random.on(self.device) if generator is None else generator
            )
        else:
            actions = self.output.greedy(logits)
        decision = arrdict(
            actions=actions,
            logits=logits,
            logprobs=self.output.logprob(logits, actions),
            value=seen["value"][0],
        )
        return decision, seen["state"]

    def unroll(self, obs, reset, state):
        """Many steps for all lanes: obs (T, B, ...), reset (T, B) and the state before them. Memory
        is cleared inside the sequence where reset. Returns arrdict(logits (T, B, ...), value (T,
        B), state after the last step).
        """
        with torch.autocast(
            self.device.type, torch.bfloat16, enabled=self.bf16 and self.device.type == "cuda"
        ):
            seen = self.intake(obs)
            remembered, state = self.memory(seen, reset, state)
            thought = (
                seen + remembered
            )  # what needs no memory need not wait until the memory lets it through
            return arrdict(logits=self.output(thought), value=self.value(thought), state=state)
