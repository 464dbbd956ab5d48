"""The actor-critic: an intake (the encoder of observations), an LSTM, and two outputs, one to act
and one for the value.

Axes: T time, B lanes. On a GPU matrix products run in bfloat16 with float32 weights, on the CPU in
float32.
"""

from typing import Any

import torch
from torch import nn

from agents import heads
from agents.random_stream import RandomStream
from agents.recurrent import LSTM
from agents.value import ValueOutput
from megastep.arrdict import arrdict
from megastep.dotdict import mapping


class Policy(nn.Module):
    """Acts on worlds: `decision, state = policy(world, state)`, starting from `policy.initial(B)`.
    A world is what an environment's `step` returns, a decision what it takes.

    `seed` decides the first weights and, where no generator is given, the sampled actions. The
    weights are in `state_dict()`; where the random stream is, is in `random.state_dict()`, which a
    learner saves. ValueError if the width is less than 1 or a space is of no known kind.
    """

    def __init__(
        self,
        obs_space: Any,
        action_space: Any,
        *,
        width: int = 128,
        encoder: str = "linear",
        bf16: bool = True,
        seed: int = 1,
    ):
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
            self.value = ValueOutput(width)

    @property
    def device(self) -> torch.device:
        return self.value.mean.device

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """The state of B lanes at the start of an episode: arrdict of (B, width) float32."""
        return self.memory.initial(n_lanes, self.device if device is None else device)

    def forward(
        self,
        world: arrdict,
        state: arrdict,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[arrdict, arrdict]:
        """One step for all lanes: (decision, state) from world.obs and world.reset, which clears a
        lane's state.

        decision is arrdict(actions, logits, logprobs (B,), value (B,)); value is the return
        expected from this world on. Actions are sampled with `generator`, by default the policy's
        own, or are the likeliest if not `sample`.
        """
        out = self.unroll(mapping(torch.unsqueeze)(world["obs"], 0), world["reset"][None], state)
        logits = mapping(torch.squeeze)(out["logits"], 0)
        if sample:
            generator = self.random.on(self.device) if generator is None else generator
            actions = self.output.sample(logits, generator)
        else:
            actions = self.output.greedy(logits)
        decision = arrdict(
            actions=actions,
            logits=logits,
            logprobs=self.output.logprob(logits, actions),
            value=out["value"][0],
        )
        return decision, out["state"]

    def unroll(self, obs: Any, reset: torch.Tensor, state: arrdict) -> arrdict:
        """Many steps for all lanes: obs (T, B, ...), reset (T, B) and the state before them. The
        state is cleared inside the sequence where reset. Returns arrdict(logits (T, B, ...), value
        (T, B), state after the last step).
        """
        with torch.autocast(
            self.device.type, torch.bfloat16, enabled=self.bf16 and self.device.type == "cuda"
        ):
            encoded = self.intake(obs)
            outputs, state = self.memory(encoded, reset, state)
            # what needs no memory does not have to pass through it
            features = encoded + outputs
            return arrdict(logits=self.output(features), value=self.value(features), state=state)
