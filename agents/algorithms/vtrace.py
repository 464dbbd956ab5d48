"""V-trace actor-critic (IMPALA, Espeholt et al. 2018) for recurrent policies: learns from actions
that another policy took, one of some updates ago or, with a replay memory, of many.

Axes: T time, B lanes, M lanes of a minibatch. A minibatch is whole sequences of some lanes, and as
many more that are replayed as are asked for. Every mean is over valid steps: those that the
environment took, of lanes that learn. An update never synchronises.
"""

from typing import Annotated, Any, Literal

import torch
from pydantic import Field

from megastep.agents.algorithms import returns
from megastep.agents.algorithms.cuda_graph import CudaGraphUpdate
from megastep.agents.algorithms.gradient_steps import GradientSteps
from megastep.agents.algorithms.learner import (
    Coefficient,
    Fraction,
    Positive,
    check_minibatches,
    load_own_state,
    own_state,
)
from megastep.agents.algorithms.masked_stats import (
    effective_sample_size,
    explained_variance,
    masked_mean,
)
from megastep.agents.generator import SeededGenerator
from megastep.agents.storage import mixed_batches
from megastep.agents.storage.async_collector import AsyncCollector
from megastep.agents.storage.replay import Replay, ReplaySettings, bytes_per_observation
from megastep.agents.storage.rollout import (
    Collector,
    Rollout,
    bytes_per_step,
    make_rollout,
    without_last,
)
from megastep.settings import MAX_ENVS, checked

# ratios beyond e^20 count as that in metrics: their squares have to be numbers
_MAX_LOG_RATIO = 20.0
_REPLAY = ReplaySettings()


class VTrace:
    """Improves a policy, in place, from rollouts that it, or itself some updates ago, collected.

    Each minibatch is valued anew: the policy as it is now tells values and how likely each action
    is, and V-trace weighs what followed by the ratios, cut off at `rho_clip`. Advantages are
    divided by their root mean square, or by the floor where that is more: where all actions are
    about as good they stay small, as unlike PPO this has no clip to hold large steps back.

    n_steps           of a rollout
    lr                Adam's step size; `set_lr` changes it
    gamma, lambda_    discount per step, and the decay of the traces
    rho_clip          what the ratio of an action counts at most: at 1, good actions that are
                      likelier now teach as if they were as likely as then
    c_clip            what a ratio counts at most in the trace, which carries what is learnt back
    advantage_floor   the least that advantages are divided by, in standard deviations of the
                      return
    entropy_coef      what a nat of entropy is worth, in what advantages are measured in
    value_coef        weight of the value's squared error, the value measured in its own scale
    auxiliary_coef    weight of the policy's `prediction_error`, where its critic is asymmetric
    max_grad_norm     longer gradients are shortened to this
    n_epochs, n_minibatches  passes over a rollout, and the parts each is cut into by lanes
    lag               how many updates old the weights are that act: on a GPU with 1 or 2 a stream
                      of its own acts while the learner works (`megastep.agents.storage.async_collector`)
    buffer            "rollout": learns from each rollout once; "replay": also from what was
                      collected before
    replay            of the replay memory: `replay.ReplaySettings`
    graph             on a GPU, captures the update as a CUDA graph; always with one and the same
                      rollout then

    A rollout with a number that is not finite, or beyond `finite.LIMIT`, changes nothing: no
    weight, no statistic. `check` tells which it was, and how many updates were skipped in a row.
    """

    @checked
    def __init__(
        self,
        policy: Any,
        *,
        n_steps: Annotated[int, Field(ge=1, le=65_536)] = 32,
        lr: Positive = 3e-4,
        gamma: Fraction = 0.99,
        lambda_: Fraction = 0.95,
        rho_clip: Positive = 1.0,
        c_clip: Positive = 1.0,
        advantage_floor: Positive = 0.3,
        entropy_coef: Coefficient = 0.01,
        value_coef: Coefficient = 0.5,
        auxiliary_coef: Coefficient = 0.5,
        max_grad_norm: Positive = 0.5,
        n_epochs: Annotated[int, Field(ge=1, le=1000)] = 1,
        n_minibatches: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 4,
        lag: Annotated[int, Field(ge=0, le=2)] = 0,
        buffer: Literal["rollout", "replay"] = "rollout",
        replay: ReplaySettings = _REPLAY,
        graph: bool = False,
        seed: int = 1,
    ):
        if policy.critic is None:
            raise ValueError("V-trace needs a policy with a critic")
        if buffer == "rollout" and replay != _REPLAY:
            raise ValueError("replay's settings are those of buffer=replay: give that, too")
        if replay.sequence_steps(n_steps) != n_steps + replay.burn_in:
            raise ValueError(
                f"replay.length={replay.length} does not fit: V-trace joins what is replayed with "
                f"rollouts, so behind its burn-in a sequence is as long as one, n_steps={n_steps}; "
                "leave replay.length out"
            )
        self.policy, self.device, self.n_steps, self.lag = policy, policy.device, n_steps, lag
        self.traces = dict(gamma=gamma, lambda_=lambda_, rho_clip=rho_clip, c_clip=c_clip)
        self.advantage_floor, self.entropy_coef = advantage_floor, entropy_coef
        self.value_coef, self.auxiliary_coef = value_coef, auxiliary_coef
        self.n_epochs, self.n_minibatches = n_epochs, n_minibatches
        self.replay_settings = replay if buffer == "replay" else None
        self.replay = None  # made for an environment's lanes
        self.lr = lr
        self.steps = GradientSteps(policy.parameters(), lr, max_grad_norm, self.device)
        self.check, self.optimizer = self.steps.check, self.steps.optimizer
        self.random = SeededGenerator(seed)
        self.cuda_graph = CudaGraphUpdate(self._update, self.device, graph, (self.random,))

    def set_lr(self, lr: float) -> None:
        """Changes Adam's step size, also for a captured update."""
        self.steps.set_lr(lr)

    def collector(self, env: Any) -> Collector | AsyncCollector:
        """What acts in `env`, and the memory of `n_steps` steps of its lanes; makes the replay
        memory, too. ValueError if that holds no sequence of each lane, or if it shall act ahead
        where others are `opponents.Opponents`.
        """
        rollout = make_rollout(env, self.policy, self.n_steps, values=False)
        if self.replay_settings:
            self.replay = Replay(rollout, env.obs_space, env.action_space, self.replay_settings)
        if self.lag:
            return AsyncCollector(env, self.policy, rollout, self.lag)
        return Collector(env, self.policy, rollout)

    def bytes_per_env(self, env: Any) -> float:
        """About how many bytes the rollouts and a minibatch take per environment."""
        # a rollout for each update of lag; a minibatch's share of one and of what is replayed, and
        # of activations
        part = 1 / self.n_minibatches
        if self.replay_settings:
            part *= 1 + self.replay_settings.ratio
        each = bytes_per_step(env, self.policy) * (1 + self.lag + part)
        each += self.policy.activation_bytes * part
        return env.n_agents * (self.n_steps + 1) * each

    def replay_size(self, env: Any) -> tuple[int, float]:
        """How many observations are replayed, and bytes for each."""
        settings = self.replay_settings
        if settings is None:
            return 0, 0.0
        each = bytes_per_observation(env, self.policy, self.n_steps, settings)
        return settings.capacity, each

    def update(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """Learns from a rollout. Returns means over its minibatches as tensors () on the device,
        among them `loss/skipped_steps`, how many gradients were not finite and so were not
        followed. ValueError if its lanes cannot be cut into minibatches.
        """
        check_minibatches(self.n_minibatches, rollout.n_lanes)
        return {f"loss/{key}": value for key, value in self.cuda_graph(rollout).items()}

    def _update(self, rollout):
        is_fine = self.steps.begin(rollout.numbers())
        if self.replay is not None:
            self.replay.add(rollout, is_fine)
        valued = []
        for _ in range(self.n_epochs):
            order = torch.rand(
                rollout.n_lanes, generator=self.random.on(self.device), device=self.device
            ).argsort()
            for rows in order.tensor_split(self.n_minibatches):
                loss, metrics, estimates = self._losses(self._batch(rollout, rows), len(rows))
                self.steps.take(loss, metrics, estimates.valid.any())
                valued.append(estimates)
        # Only now: a rollout is learnt from as it was seen. One row of observations is enough, B
        # lanes again with every rollout.
        targets, valid = (torch.cat([e[key] for e in valued], 1) for key in ("targets", "valid"))
        self.policy.critic.output.update_stats(targets, valid & is_fine)
        last = rollout.world(-1)
        self.policy.update_stats(last.obs, last.get("privileged"), is_fine & rollout.learns[-1])
        return self.steps.end()

    def _batch(self, rollout, rows):
        batch = mixed_batches.fresh(rollout, rows)
        if self.replay is None:
            return batch
        n = max(1, round(self.replay_settings.ratio * len(rows)))
        generator = self.random.on(self.device)
        return mixed_batches.with_replayed(batch, self.replay, self.policy, n, generator)

    def _losses(self, batch, n_fresh):
        """The loss of a minibatch, what there is to say about it, each a tensor (), and what
        V-trace made of it.
        """
        output, privileged = self.policy.output, batch.get("privileged")
        now = self.policy.unroll(batch.obs, batch.starts, batch.state)
        value = self.policy.value(now.features, privileged)
        features, logits = without_last(now.features), without_last(now.logits)
        logprobs = output.logprob(logits, batch.actions)
        reset, weight = batch.starts[1:], batch.weight
        valid = ~reset & batch.learns[:-1]
        # a trace passes through what does not count as if the policy had acted there
        log_ratio = (logprobs.detach() - batch.logprobs).masked_fill(~valid, 0.0)
        estimates = returns.vtrace(
            log_ratio,
            batch.reward,
            *(value[:-1].detach(), value[-1].detach()),
            *(reset, batch.terminal, batch.truncated),
            **self.traces,
        )
        estimates["valid"] = valid
        scale = self.policy.critic.output.scale
        error = (value[:-1] - estimates.targets) / scale
        advantages = estimates.advantages / scale  # in standard deviations of the return
        size = masked_mean(advantages.square(), valid).sqrt()
        advantages = advantages / size.clamp(min=self.advantage_floor)
        metrics = dict(
            policy=-masked_mean(weight * logprobs * advantages, valid),
            value=masked_mean(weight * error.square(), valid),
            entropy=masked_mean(output.entropy(logits), valid),
            advantage=size,
            **self._of_ratios(log_ratio[:, :n_fresh], valid[:, :n_fresh]),
            explained_variance=explained_variance(value[:-1].detach(), estimates.targets, valid),
        )
        loss = (
            metrics["policy"]
            + self.value_coef * metrics["value"]
            - self.entropy_coef * metrics["entropy"]
        )
        if self.policy.privileged_space:
            wrong = self.policy.prediction_error(features, without_last(privileged))
            metrics["auxiliary"] = masked_mean(wrong, valid)
            loss = loss + self.auxiliary_coef * metrics["auxiliary"]
        if self.replay is not None:
            old = self._of_ratios(log_ratio[:, n_fresh:], valid[:, n_fresh:])
            metrics |= {f"replayed_{key}": value for key, value in old.items()}
            age = batch.age[n_fresh:].float().mean() + self.lag
            metrics["staleness"] = age * self.replay.is_ready
            mean_error = masked_mean(error.detach().abs(), valid, 0)[n_fresh:]
            self.replay.set_priorities(batch.index, mean_error)
        return loss, metrics, estimates

    def _of_ratios(self, log_ratio, valid):
        """How far the policy is from the one that acted."""
        log_ratio = log_ratio.clamp(max=_MAX_LOG_RATIO)
        ratio, rho_clip = log_ratio.exp(), self.traces["rho_clip"]
        return dict(
            kl=masked_mean(ratio - 1 - log_ratio, valid),
            rho=masked_mean(ratio.clamp(max=rho_clip), valid),
            clip_fraction=masked_mean((ratio > rho_clip).float(), valid),
            effective_samples=effective_sample_size(ratio, valid),
        )

    def state_dict(self) -> dict[str, Any]:
        """All that an update changes beside the policy's weights, and where the policy's random
        stream is: dicts of plain tensors and numbers. Rollouts that were collected ahead are not in
        it: who goes on from it acts anew, on the weights of then.
        """
        return own_state(self)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from a `state_dict`, taken on this device or another. ValueError if it is that of
        another kind of learner.
        """
        load_own_state(self, state)
