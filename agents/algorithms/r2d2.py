"""Recurrent replay distributed deep Q-learning (R2D2, Kapturowski et al. 2019), on one device.

Axes: T steps of a rollout, B lanes, L steps of a sequence, M sequences of a minibatch. Every mean
is over valid steps: those that the environment took, of lanes that learn. An update never
synchronises.
"""

from typing import Annotated, Any

import torch
from pydantic import Field

from megastep.agents.algorithms import returns
from megastep.agents.algorithms.cuda_graph import CudaGraphUpdate
from megastep.agents.algorithms.gradient_steps import GradientSteps
from megastep.agents.algorithms.learner import Fraction, Positive, load_own_state, own_state
from megastep.agents.algorithms.masked_stats import effective_sample_size, masked_mean
from megastep.agents.generator import SeededGenerator
from megastep.agents.networks.running_norm import store
from megastep.agents.storage.replay import Replay, ReplaySettings, bytes_per_observation
from megastep.agents.storage.rollout import (
    Collector,
    Rollout,
    bytes_per_step,
    make_rollout,
    without_last,
)
from megastep.arrdict import arrdict
from megastep.dotdict import mapping
from megastep.settings import MAX_ENVS, checked

_REPLAY = ReplaySettings(burn_in=8, alpha=0.9)


class EpsilonGreedy:
    """Acts as a policy of action values does, but draws each action with the probability of its
    lane: epsilon (B,).
    """

    def __init__(self, policy: Any, epsilon: torch.Tensor):
        self.policy, self.epsilon = policy, epsilon
        self.initial, self.compute_dtype = policy.initial, policy.compute_dtype

    def __call__(self, world: arrdict, state: arrdict) -> tuple[arrdict, arrdict]:
        policy = self.policy
        decision, state = policy(world, state, sample=False)
        generator = policy.random.on(policy.device)
        actions = policy.output.sample(decision.logits, generator, epsilon=self.epsilon)
        return arrdict(actions=actions), state


def epsilons(n_lanes: int, most: float, spread: float) -> torch.Tensor:
    """(B,): most ** (1 + spread i / (B - 1)) of lane i, from most to almost greedy (Horgan et al.
    2018).
    """
    return most ** (1 + spread * torch.linspace(0, 1, n_lanes))


class R2D2:
    """Improves a policy of action values (`agent.output=duelling`), in place, from rollouts that it
    collected, each of them learnt from many times.

    Each gradient step draws sequences from a replay memory, warms up the memory of the policy from
    the state that was stored, and moves the values of the actions taken towards n-step returns.
    These go on with the value that a target network gives the best action (double Q-learning, van
    Hasselt et al. 2016). Values are learnt in a scale where large ones differ less
    (`returns.rescaled`).

    n_steps           of a rollout
    lr                Adam's step size; `set_lr` changes it
    gamma             discount per step
    return_steps      rewards that a return counts before it goes on with a value
    target_period     gradient steps between two copies of the network to the target's
    epsilon, epsilon_spread  of lane i of B epsilon ** (1 + epsilon_spread i / (B - 1)) of the
                      actions are drawn by chance
    eta               a sequence's priority is that of its largest error with this weight, and of
                      its mean error with the rest
    max_grad_norm     longer gradients are shortened to this
    gradient_steps    per rollout
    replay            of the replay memory: `replay.ReplaySettings`
    graph             on a GPU, captures the update as a CUDA graph; always with one and the same
                      rollout then

    A rollout with a number that is not finite, or beyond `finite.LIMIT`, changes nothing: no
    weight, no statistic, and nothing is drawn from it. What the memory holds is not part of
    `state_dict`: a resumed run fills it anew before it learns on.
    """

    @checked
    def __init__(
        self,
        policy: Any,
        *,
        n_steps: Annotated[int, Field(ge=1, le=65_536)] = 32,
        lr: Positive = 3e-4,
        gamma: Fraction = 0.99,
        return_steps: Annotated[int, Field(ge=1, le=1000)] = 5,
        target_period: Annotated[int, Field(ge=1, le=10**6)] = 100,
        epsilon: Annotated[float, Field(gt=0, le=1)] = 0.4,
        epsilon_spread: Annotated[float, Field(ge=0, le=100)] = 7.0,
        eta: Fraction = 0.9,
        max_grad_norm: Positive = 10.0,
        gradient_steps: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 4,
        replay: ReplaySettings = _REPLAY,
        graph: bool = False,
        seed: int = 1,
    ):
        if getattr(policy, "output_kind", None) != "duelling":
            raise ValueError("R2D2 needs a policy of action values: agent.output=duelling")
        self.policy, self.device, self.n_steps = policy, policy.device, n_steps
        self.gamma, self.return_steps = gamma, return_steps
        self.target_period, self.eta = target_period, eta
        self.epsilon, self.epsilon_spread = epsilon, epsilon_spread
        self.gradient_steps, self.replay_settings = gradient_steps, replay
        self.length = replay.sequence_steps(n_steps)
        self.replay = None  # made for an environment's lanes
        self.lr = lr
        self.target = policy.actor()
        own = policy.state_dict()
        self._copies = [(t, own[name]) for name, t in self.target.state_dict().items()]
        self.n_taken = torch.zeros((), dtype=torch.int64, device=self.device)
        self.steps = GradientSteps(policy.parameters(), lr, max_grad_norm, self.device)
        self.check, self.optimizer = self.steps.check, self.steps.optimizer
        self.random = SeededGenerator(seed)
        self.cuda_graph = CudaGraphUpdate(self._update, self.device, graph, (self.random,))

    def set_lr(self, lr: float) -> None:
        """Changes Adam's step size, also for a captured update."""
        self.steps.set_lr(lr)

    def collector(self, env: Any) -> Collector:
        """What acts in `env`, with a memory of `n_steps` steps of its lanes; makes the replay
        memory. ValueError if that holds no sequence of each lane, or a gradient step would be of
        less than one.
        """
        rollout = make_rollout(env, self.policy, self.n_steps, values=False)
        ratio, lanes = self.replay_settings.ratio, rollout.n_lanes
        if ratio * lanes < self.gradient_steps:
            raise ValueError(
                f"replay.ratio={ratio:g} of {lanes:,} lanes is less than a sequence for each of "
                f"{self.gradient_steps:,} gradient steps: give fewer gradient_steps, or more lanes"
            )
        spaces_of = env.obs_space, env.action_space
        self.replay = Replay(rollout, *spaces_of, self.replay_settings, logprobs=False)
        epsilon = epsilons(rollout.n_lanes, self.epsilon, self.epsilon_spread).to(self.device)
        return Collector(env, EpsilonGreedy(self.policy, epsilon), rollout)

    def bytes_per_env(self, env: Any) -> float:
        """About how many bytes a rollout and a minibatch take per environment."""
        # a minibatch's share of what is replayed for a rollout, and of the activations of two
        # networks
        part = self.replay_settings.ratio / self.gradient_steps
        rollout = (self.n_steps + 1) * bytes_per_step(env, self.policy)
        each = bytes_per_step(env, self.policy) + 2 * self.policy.activation_bytes
        return env.n_agents * (rollout + part * (self.length + 1) * each)

    def replay_size(self, env: Any) -> tuple[int, float]:
        """How many observations are replayed, and bytes for each."""
        settings = self.replay_settings
        each = bytes_per_observation(env, self.policy, self.n_steps, settings, logprobs=False)
        return settings.capacity, each

    def update(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """Stores a rollout that its collector gave, and learns from what is stored. Returns means
        over its gradient steps as tensors () on the device, 0 before learning starts, among them
        `loss/skipped_steps`, how many gradients were not finite and so were not followed, and the
        largest and the mean priority of what is stored.
        """
        return {f"loss/{key}": value for key, value in self.cuda_graph(rollout).items()}

    def _update(self, rollout):
        is_fine = self.steps.begin(rollout.numbers())
        self.replay.add(rollout, is_fine)
        is_ready = self.replay.is_ready
        generator = self.random.on(self.device)
        ratio = self.replay_settings.ratio
        n_sequences = round(ratio * rollout.n_lanes / self.gradient_steps)
        for _ in range(self.gradient_steps):
            store(self.n_taken % self.target_period == 0, self._copies)
            batch = self.replay.sample(n_sequences, generator)
            loss, metrics, priorities, valid = self._losses(batch)
            # a bad rollout counts as skipped, also where it is why there is nothing to draw
            self.n_taken += self.steps.take(loss, metrics, valid.any(), is_ready | ~is_fine)
            self.replay.set_priorities(batch.index, priorities)
        last = rollout.world(-1)
        self.policy.update_stats(last.obs, taken=is_fine & rollout.learns[-1])
        priorities = self.replay.tree.priorities
        return {
            **{name: mean.nan_to_num(0.0) for name, mean in self.steps.end().items()},
            "priority_max": priorities.amax().float(),
            "priority_mean": (priorities.sum() / self.replay.n_available.clamp(min=1)).float(),
        }

    def _losses(self, batch):
        """The loss of a minibatch, what there is to say about it, each a tensor (), the sequences'
        priorities (M,) and which steps are valid.
        """
        burn_in = self.replay_settings.burn_in
        states = self._warmed_up(batch, burn_in)
        skip = mapping(lambda leaf: leaf[burn_in:])
        obs, starts, actions = map(skip, (batch.obs, batch.starts, batch.actions))
        names = "reward", "terminal", "truncated"
        outcome = {name: batch[name][burn_in:] for name in names}
        reset = starts[1:]
        valid = ~reset & batch.learns[burn_in:-1]

        output = self.policy.output
        q = self.policy.unroll(obs, starts, states[0]).logits
        with torch.no_grad():
            later = self.target.unroll(obs, starts, states[1]).logits
            value = returns.unscaled(output.action_value(later, output.greedy(q)))
            aims = returns.n_step(
                **outcome,
                value=value[:-1],
                last_value=value[-1],
                reset=reset,
                gamma=self.gamma,
                n=self.return_steps,
            )
        chosen = output.action_value(without_last(q), actions)
        error = (returns.rescaled(aims) - chosen).masked_fill(~valid, 0.0)
        loss = masked_mean(batch.weight * error.square(), valid)
        with torch.no_grad():
            size = error.abs()
            mean = masked_mean(size, valid, 0)
            priorities = self.eta * size.amax(0) + (1 - self.eta) * mean
            every = torch.ones_like(batch.weight, dtype=torch.bool)
            metrics = dict(
                td=loss,
                td_error=masked_mean(size, valid),
                q=masked_mean(returns.unscaled(chosen), valid),
                staleness=batch.age.float().mean(),
                effective_samples=effective_sample_size(batch.weight, every),
            )
        return loss, metrics, priorities, valid

    @torch.no_grad()
    def _warmed_up(self, batch, burn_in):
        """The states of both networks after the burn-in."""
        if not burn_in:
            return batch.state, batch.state
        first = mapping(lambda leaf: leaf[:burn_in])
        obs, starts = first(batch.obs), first(batch.starts)
        networks = self.policy, self.target
        return [network.unroll(obs, starts, batch.state).state for network in networks]

    def state_dict(self) -> dict[str, Any]:
        """All that an update changes beside the policy's weights and what is replayed, and where
        the policy's random stream is: dicts of plain tensors and numbers.
        """
        return dict(own_state(self), target=self.target.state_dict(), n_taken=self.n_taken.clone())

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from a `state_dict`, taken on this device or another. ValueError if it is that of
        another kind of learner.
        """
        load_own_state(self, state)
        self.target.load_state_dict(state["target"])
        self.n_taken.copy_(state["n_taken"])
