"""Recurrent replay distributed DQN (R2D2, Kapturowski et al. 2019), on one device.

T steps of a rollout, B lanes, L steps of a sequence, M sequences of a minibatch. Means are over
valid steps: those that the environment took, of lanes that learn. An update never synchronises.
"""

from typing import Annotated, Any, NamedTuple, cast

import torch
from pydantic import Field
from torch.autograd.function import once_differentiable

from megastep.agents.algorithms import learner, returns
from megastep.agents.algorithms.kernels import LIBRARY
from megastep.agents.algorithms.masked_stats import effective_sample_size, masked_mean
from megastep.agents.networks import side_stream
from megastep.agents.networks.fused import fused
from megastep.agents.networks.heads import Output
from megastep.agents.networks.policy import Policy
from megastep.agents.networks.running_norm import masked_moments
from megastep.agents.storage.collector import Collector
from megastep.agents.storage.copies import copy_all
from megastep.agents.storage.replay import ReplayBuffer, ReplaySettings, defaults_from, replay_size
from megastep.agents.storage.rollout import copy_tree, make_rollout, without_last
from megastep.agents.types import StateDict
from megastep.arrdict import arrdict
from megastep.coefficients import on_device
from megastep.dotdict import mapping
from megastep.kernels.build.launch import Blocks, launch
from megastep.settings import MAX_ENVS, checked
from megastep.types import Env, Tree

#: R2D2's default replay settings. A configuration that sets some of them keeps the others.
REPLAY = ReplaySettings(capacity=8_000_000, burn_in=32, ratio=4.0, alpha=0.9)
#: Between these root mean squares, rewards stay as they are.
_USUAL = 1e-2, 1e2
#: Parts of a minibatch with a time axis that the loss needs.
_STEPS = "actions", "reward", "terminal", "truncated", "starts", "learns"
_METRICS = "td", "td_error", "q", "staleness", "effective_samples"
_ENDS = "reward", "terminal", "truncated"
_EPS = 1e-3  # of `returns.rescale`
_THREADS = LIBRARY.constants["TD_THREADS"]
_SEQUENCES = LIBRARY.constants["TD_SEQUENCES"]
_N_SUMS, _N_METRICS = (LIBRARY.constants[f"N_TD_{name}"] for name in ("SUMS", "METRICS"))


class Result(NamedTuple):
    """What a minibatch gives: a loss (), metrics (), priorities (M,), and the number () of valid
    steps.
    """

    loss: torch.Tensor
    metrics: dict[str, torch.Tensor]
    priorities: torch.Tensor
    n_valid: torch.Tensor


class _Loss(torch.autograd.Function):
    """The gradient of the sum over valid steps is left for the backward pass."""

    @staticmethod
    def forward(
        ctx, q, target_q, batch, gamma, return_steps, eta
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        n_rows, n_sequences, n_agents, n_choices = q.shape
        n_blocks = -(-n_sequences // _SEQUENCES)
        d_q = torch.empty_like(q, memory_format=torch.contiguous_format)
        values, priorities = q.new_empty(n_rows, n_sequences), q.new_empty(n_sequences)
        sums, metrics = q.new_empty(n_blocks, _N_SUMS), q.new_empty(_N_METRICS)
        names = *_ENDS, "actions", "starts", "learns", "weight", "age"
        tensors = {name: batch[name].contiguous() for name in names}
        launch(
            *(LIBRARY, "td_loss", q.device, Blocks(n_blocks, threads=_THREADS)),
            **dict(q=q.contiguous(), target_q=target_q.contiguous(), **tensors),
            **dict(values=values, d_q=d_q, priorities=priorities, sums=sums),
            **dict(n_steps=n_rows - 1, n_sequences=n_sequences),
            **dict(n_agents=n_agents, n_choices=n_choices),
            **dict(gamma=on_device(gamma, q.device), eta=eta, eps=_EPS),
            n_return_steps=return_steps,
        )
        launch(
            *(LIBRARY, "td_metrics", q.device, Blocks(1, threads=_THREADS)),
            **dict(sums=sums, metrics=metrics, n_blocks=n_blocks, n_sequences=n_sequences),
        )
        ctx.save_for_backward(d_q, metrics)
        ctx.mark_non_differentiable(metrics, priorities)
        return metrics[0].clone(), metrics, priorities

    @staticmethod
    @once_differentiable
    def backward(ctx, d_loss, d_metrics, d_priorities) -> tuple[torch.Tensor | None, ...]:
        d_q, metrics = ctx.saved_tensors
        return d_q * (d_loss * metrics[-1]), *[None] * 5


def _loss_on_gpu(q, target_q, batch, output, *, gamma, return_steps, eta) -> Result:
    loss, metrics, priorities = _Loss.apply(q, target_q, batch, gamma, return_steps, eta)
    *values, n_valid, _ = metrics.unbind()
    return Result(loss, dict(zip(_METRICS, values, strict=True)), priorities, n_valid)


@fused(
    _loss_on_gpu,
    lambda q, *_, **__: isinstance(q, torch.Tensor) and q.is_cuda and q.dtype == torch.float32,
)
def td_loss(
    q: Tree,
    target_q: Tree,
    batch: arrdict,
    output: Output,
    *,
    gamma: float | torch.Tensor,
    return_steps: int,
    eta: float,
) -> Result:
    """Computes the error of action values from n-step returns of a target network (Kapturowski et
    al. 2019, section 2.3): the mean of the weighted squared errors over the valid steps.

    Args:
        q: (T+1, M, A, n) of the online network, or a tree of these.
        target_q: those of the target network, without a gradient.
        batch: has `actions`, `reward`, `terminal` and `truncated`, (T, M, ...) each, `starts` and
            `learns` (T+1, M), `weight` and `age` (M,).
        output: the policy's output.
        gamma, return_steps, eta: see `R2D2`.
    """
    reset = batch.starts[1:]
    valid = ~reset & batch.learns[:-1]
    with torch.no_grad():
        value = returns.inverse_rescale(output.action_value(target_q, output.greedy(q)), _EPS)
        targets = returns.n_step_returns(
            **{name: batch[name] for name in _ENDS},
            value=value[:-1],
            last_value=value[-1],
            reset=reset,
            gamma=gamma,
            n=return_steps,
        )
    q_taken = output.action_value(without_last(q), batch.actions)
    error = (returns.rescale(targets, _EPS) - q_taken).masked_fill(~valid, 0.0)
    loss = masked_mean(batch.weight * error.square(), valid)
    with torch.no_grad():
        size = error.abs()
        priorities = eta * size.amax(0) + (1 - eta) * masked_mean(size, valid, 0)
        all_sequences = torch.ones_like(batch.weight, dtype=torch.bool)
        metrics = dict(
            td=loss,
            td_error=masked_mean(size, valid),
            q=masked_mean(returns.inverse_rescale(q_taken, _EPS), valid),
            staleness=batch.age.float().mean(),
            effective_samples=effective_sample_size(batch.weight, all_sequences),
        )
    return Result(loss, metrics, priorities, valid.sum())


class EpsilonGreedy:
    """A policy of action values that takes random actions with a probability per lane, (B,)."""

    def __init__(self, policy: Policy, epsilon: torch.Tensor):
        self.policy, self.epsilon = policy, epsilon
        self.initial, self.compute_dtype = policy.initial, policy.compute_dtype

    def __call__(self, *arguments: Any, **options: Any) -> tuple[arrdict, arrdict]:
        decision, state = self.policy(*arguments, **options, epsilon=self.epsilon)
        return arrdict(actions=decision.actions), state


def epsilons(n_lanes: int, epsilon: float, spread: float) -> torch.Tensor:
    """Returns epsilon ** (1 + spread i / (B - 1)) for lane i, (B,) (Horgan et al. 2018)."""
    return epsilon ** (1 + spread * torch.linspace(0, 1, n_lanes))


class R2D2(learner.GradientLearner):
    """Improves a policy of action values (`agent.output=duelling`), in place, from replayed
    sequences of rollouts that it collected.

    Each gradient step draws sequences from the replay buffer and warms up the hidden state from the
    stored one. Then it moves the values of the actions taken towards n-step returns, which
    bootstrap from the target network's value of the online network's best action (double
    Q-learning, van Hasselt et al. 2016). Networks predict values transformed by `returns.rescale`.

    Rewards whose root mean square is far from 1, in the first rollout that has any, are divided by
    it, so that learning does not depend on their units.

    Args:
        policy: a policy with `output="duelling"`.
        return_steps: n of the n-step returns, the rewards summed before bootstrapping.
        target_period: gradient steps between two copies of the weights to the target network.
        epsilon: probability of a random action in lane 0.
        epsilon_spread: lane i of B uses epsilon ** (1 + epsilon_spread i / (B - 1)).
        eta: weight of the largest error in a sequence's priority; the mean error has 1 - eta.
        gradient_steps: gradient steps per rollout. Together they draw `replay.ratio` x B sequences.
        replay: settings of the replay buffer.

    Metrics:
        loss/td: squared TD error, in rescaled values.
        loss/td_error: mean absolute TD error.
        loss/q: mean Q-value of the actions taken, in units of reward.
        loss/staleness: mean age of the replayed sequences, in updates.
        loss/effective_samples: effective sample size of the importance weights, as a fraction.
        loss/priority_max: largest priority of the stored sequences.
        loss/priority_mean: mean priority of the stored sequences.

    A rollout with a number that is not finite is never drawn. Other arguments and metrics are those
    of `GradientLearner`.
    """

    n_networks = 2

    @checked
    def __init__(
        self,
        policy: Policy,
        *,
        return_steps: Annotated[int, Field(ge=1, le=1000)] = 10,
        target_period: Annotated[int, Field(ge=1, le=10**6)] = 200,
        epsilon: Annotated[float, Field(gt=0, le=1)] = 0.4,
        epsilon_spread: Annotated[float, Field(ge=0, le=100)] = 3.0,
        eta: Annotated[float, Field(ge=0, le=1)] = 0.9,
        max_grad_norm: learner.Positive = 10.0,
        gradient_steps: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 16,
        replay: Annotated[ReplaySettings, defaults_from(REPLAY)] = REPLAY,
        **settings,
    ):
        if policy.output_kind != "duelling":
            raise ValueError("R2D2 needs a policy of action values: use agent.output=duelling")
        super().__init__(policy, max_grad_norm=max_grad_norm, **settings)
        self.target_period, self.return_steps, self.eta = target_period, return_steps, eta
        self.epsilon, self.epsilon_spread = epsilon, epsilon_spread
        self.gradient_steps, self.replay_settings = gradient_steps, replay
        self.length = self.n_steps + replay.burn_in
        self.replay_buffer: ReplayBuffer | None = None  # allocated by `collector`
        self.target = policy.actor()
        weights = policy.state_dict()
        self._target_copies = [
            (target, weights[name]) for name, target in self.target.state_dict().items()
        ]
        self.reward_scale = torch.zeros((), device=self.device)  # 0: there was no reward yet
        self.n_taken = torch.zeros((), dtype=torch.int64, device=self.device)  # gradient steps

    def collector(self, env: Env, values: bool = False) -> Collector:
        """Returns an epsilon-greedy collector of rollouts of `n_steps` steps, and allocates the
        replay buffer. ValueError if that is too small, or a gradient step has no sequence.
        """
        self.policy.clear_stats()
        rollout = make_rollout(env, self.policy, self.n_steps, values)
        ratio, n_lanes = self.replay_settings.ratio, rollout.n_lanes
        if ratio * n_lanes < self.gradient_steps:
            raise ValueError(
                f"replay.ratio={ratio:g} of {n_lanes:,} lanes is less than a sequence for each of "
                f"{self.gradient_steps:,} gradient steps: use fewer gradient_steps or more lanes"
            )
        epsilon = epsilons(n_lanes, self.epsilon, self.epsilon_spread).to(self.device)
        policy = EpsilonGreedy(self.policy, epsilon)
        collect = Collector(env, policy, rollout)  # allocates the rollout's optional parts
        self.replay_buffer = ReplayBuffer(rollout, self.replay_settings, logprobs=False)
        return collect

    def minibatch_rows(self) -> float:
        """Returns the rows of a minibatch per lane of the environment."""
        return self.replay_settings.ratio / self.gradient_steps * (self.length + 1)

    def replay_size(self, env: Env) -> tuple[int, float]:
        """Returns how many observations the replay buffer will hold, and the bytes of each."""
        settings = self.replay_settings
        return replay_size(env, self.policy, self.n_steps, settings, logprobs=False)

    def _update(self, rollout) -> dict[str, torch.Tensor]:
        replay = self.replay_buffer
        assert replay is not None
        own = masked_moments(~rollout.reset & rollout.learns[:-1], rollout.reward)
        is_finite, ((_, mean, variance),) = self.steps.begin(rollout.floats(), *own)
        replay.add(rollout, is_finite)
        size = (variance + mean.square()).sqrt()
        is_first = is_finite & (self.reward_scale == 0) & (size > 0)
        size = size.masked_fill((size > _USUAL[0]) & (size < _USUAL[1]), 1.0)
        self.reward_scale.copy_(torch.where(is_first, size, self.reward_scale))
        # A non-finite rollout counts as skipped even while the replay buffer is not ready.
        is_enabled = replay.is_ready | ~is_finite
        generator = self.generator.on(self.device)
        ratio = self.replay_settings.ratio
        n_sequences = round(ratio * rollout.n_lanes / self.gradient_steps)
        for _ in range(self.gradient_steps):
            copy_all(self._target_copies, self.n_taken % self.target_period == 0)
            batch = replay.sample(n_sequences, generator)
            result = self._losses(batch)
            self.steps.backward(result.loss, result.metrics, result.n_valid)
            self.n_taken += self.steps.take(is_enabled)
            replay.set_priorities(batch.index, result.priorities)
        last = rollout.world(-1)
        self.policy.update_stats(last.obs, is_counted=is_finite & rollout.learns[-1])
        priorities = replay.tree.priorities
        n_available = replay.n_available.clamp(min=1)
        return {
            **self.steps.end(),  # NaN until the replay buffer is ready, as no step is taken
            "priority_max": priorities.amax().float(),
            "priority_mean": (priorities.sum() / n_available).float(),
        }

    def _losses(self, batch) -> Result:
        burn_in = self.replay_settings.burn_in
        sequence = batch.obs, batch.starts, batch.state
        # each network's LSTM leaves multiprocessors idle, where the other's products can run
        with side_stream.fork(side_stream.fork_point(self.device)) as stream:
            with torch.no_grad(), torch.cuda.stream(stream):
                target_q = self.target.unroll(*sequence, burn_in=burn_in).logits
            now = self.policy.unroll(*sequence, burn_in=burn_in, mask=batch.get("mask"))
        q = now.logits
        rest = mapping(lambda leaf: leaf[burn_in:])
        learned = rest(arrdict({name: batch[name] for name in _STEPS}))
        scale = self.reward_scale.masked_fill(self.reward_scale == 0, 1.0)
        learned = arrdict(
            learned, reward=learned.reward / scale, weight=batch.weight, age=batch.age
        )
        settings = dict(return_steps=self.return_steps, eta=self.eta)
        result = td_loss(
            q, target_q, learned, self.policy.output, gamma=self.coefficients["gamma"], **settings
        )
        result.metrics["q"] = result.metrics["q"] * scale
        if self.has_extra_loss:
            learned["obs"] = rest(batch.obs)
            learned["valid"] = ~learned.starts[1:] & learned.learns[:-1]
            with self.policy.compute_dtype():
                extra, own = self.extra_terms(now.features[:-1], learned, result.metrics)
            result = result._replace(loss=result.loss + extra, metrics=result.metrics | own)
        return result

    def _own(self) -> StateDict:
        return dict(
            target=self.target.state_dict(), n_taken=self.n_taken, reward_scale=self.reward_scale
        )

    def copy_from(self, other: learner.GradientLearner) -> None:
        """Takes over what another learner has learnt, its target network too. In place."""
        super().copy_from(other)
        copy_tree(self._own(), cast(R2D2, other)._own())

    def state_dict(self) -> StateDict:
        """Returns the base's state, the target network and what an update counts."""
        return dict(super().state_dict(), **mapping(torch.clone)(self._own()))

    def load_state_dict(self, state: StateDict) -> None:
        """Continues from a `state_dict`."""
        super().load_state_dict(state)
        copy_tree(self._own(), state)
