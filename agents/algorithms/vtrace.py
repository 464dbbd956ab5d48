"""V-trace actor-critic (IMPALA, Espeholt et al. 2018) for recurrent policies.

Off-policy: with a replay buffer, the policy that acted may be many updates old.

T time, B lanes, M lanes of a minibatch. A minibatch holds whole sequences of some lanes, then
replayed sequences if there is a replay buffer. Means are over valid steps: those that the
environment took, of lanes that learn. An update never synchronises.
"""

from typing import Literal

import torch

from megastep.agents.algorithms import learner, returns
from megastep.agents.algorithms.masked_stats import (
    effective_sample_size,
    explained_variance,
    masked_mean,
    pooled_mean,
)
from megastep.agents.distributed.pooling import pool_moments
from megastep.agents.networks.policy import Policy
from megastep.agents.networks.running_norm import add_moments, masked_moments
from megastep.agents.storage.collector import Collector
from megastep.agents.storage.replay import ReplayBuffer, ReplaySettings, replay_size
from megastep.agents.storage.rollout import SEQUENCES, without_last
from megastep.arrdict import arrdict, cat
from megastep.dotdict import mapping
from megastep.settings import checked
from megastep.types import Env

# Metrics count larger ratios as e^20, so that their squares stay finite.
_MAX_LOG_RATIO = 20.0
_REPLAY = ReplaySettings()
_TRACES = "gamma", "lambda_", "rho_clip", "c_clip"
# Names that an `extra_loss` cannot have.
_METRICS = "policy", "value", "entropy", "kl", "rho", "advantage", "clip_fraction"


class VTrace(learner.ActorCritic):
    """Improves a policy, in place, from rollouts that it collected, and from replayed ones.

    Each minibatch is evaluated anew by the current policy, and V-trace corrects with truncated
    importance ratios. Advantages are divided by their root mean square, but by no less than
    `advantage_floor`: unlike in PPO, nothing clips large steps, so advantages must stay small where
    all actions are about equally good.

    Args:
        rho_clip: truncation of the ratios in the policy's gradient and the value's error. At 1,
            actions that became more likely have weight 1.
        c_clip: truncation of the ratios in the traces.
        advantage_floor: smallest divisor of advantages, in standard deviations of the return. Use
            about 0.3 for small batches.
        buffer: "rollout" learns from each rollout once; "replay" adds sequences of a replay buffer
            to each minibatch.
        replay: settings of the replay buffer.

    Metrics:
        loss/clip_fraction: fraction of ratios beyond `rho_clip`.
        loss/advantage: root mean square of the advantages, in standard deviations of the return.
        loss/rho: mean clipped ratio.
        loss/effective_samples: effective sample size as a fraction: near 1, samples are as good as
            on-policy ones.
        loss/replayed_NAME: kl, rho, clip_fraction and effective_samples of replayed sequences.
        loss/staleness: with replay, mean age of the replayed sequences, in updates.

    Other arguments and metrics are those of `ActorCritic` and `GradientLearner`.
    """

    @checked
    def __init__(
        self,
        policy: Policy,
        *,
        rho_clip: learner.ScheduledPositive = 1.0,
        c_clip: learner.ScheduledPositive = 1.0,
        advantage_floor: learner.Positive = 0.1,
        buffer: Literal["rollout", "replay"] = "rollout",
        replay: ReplaySettings = _REPLAY,
        **settings,
    ):
        if buffer == "rollout" and replay != _REPLAY:
            raise ValueError("replay settings need buffer=replay, but buffer=rollout")
        self.loss_coefficients = dict(rho_clip=rho_clip, c_clip=c_clip)
        super().__init__(policy, **settings)
        self.advantage_floor = advantage_floor
        self.replay_settings = replay if buffer == "replay" else None
        self.replay_buffer: ReplayBuffer | None = None  # allocated by `collector`

    def collector(self, env: Env, values: bool = False) -> Collector:
        """Returns a collector of rollouts of `n_steps` steps, and allocates the replay buffer.
        ValueError if that is too small.
        """
        collect = super().collector(env, values)  # allocates the rollout's optional parts
        if self.replay_settings:
            self.replay_buffer = ReplayBuffer(collect.rollout, self.replay_settings)
        return collect

    def minibatch_rows(self) -> float:
        """Returns the rows of a minibatch per lane of the environment, replayed ones included."""
        ratio = self.replay_settings.ratio if self.replay_settings else 0.0
        return (1 + ratio) * super().minibatch_rows()

    def replay_size(self, env: Env) -> tuple[int, float]:
        """Returns how many observations the replay buffer holds, and bytes of each, or zeros."""
        if self.replay_settings is None:
            return 0, 0.0
        return replay_size(env, self.policy, self.n_steps, self.replay_settings)

    def _update(self, rollout) -> dict[str, torch.Tensor]:
        of_own_rewards = masked_moments(~rollout.reset, rollout.reward)
        is_finite, (of_rewards,) = self.steps.begin(rollout.floats(), *of_own_rewards)
        if self.replay_buffer is not None:
            self.replay_buffer.add(rollout, is_finite)
        # The first rollout with rewards tells only their size. It counts as skipped if not finite.
        _, mean, variance = of_rewards
        is_unknown = self.critic.output.is_clear & ((mean != 0) | (variance > 0))
        is_enabled = ~(is_unknown & is_finite)
        all_estimates = []
        for _ in range(self.n_epochs):
            for lanes in self.minibatches(rollout.n_lanes):
                loss, metrics, estimates = self._losses(self._batch(rollout, lanes), len(lanes))
                kl = self.steps.backward(loss, metrics, estimates.valid.sum())["kl"]
                if self.desired_kl is not None:
                    self.steps.follow_kl(kl, self.desired_kl)
                self.steps.take(is_enabled)
                all_estimates.append(estimates)
        # Statistics change only now, so the whole update saw the normalisation that acted. One row
        # of observations is enough: every rollout brings another B.
        targets, valid = (
            torch.cat([estimates[key] for estimates in all_estimates], 1)
            for key in ("targets", "valid")
        )
        last = rollout.world(-1)
        own_obs = self.policy.moments(last.obs, last.get("privileged"), rollout.learns[-1])
        of_targets, *of_obs = pool_moments(*masked_moments(valid, targets), *own_obs)
        self.critic.output.add(of_targets, is_finite)
        add_moments(self.policy.norms, of_obs, is_finite)
        return self.steps.end()

    def _batch(self, rollout, lanes) -> arrdict:
        """Returns sequences of some lanes, then replayed ones, which have `learns` false until the
        buffer is ready; and `index` of these.
        """
        batch, replay = rollout.sequences(lanes), self.replay_buffer
        batch = arrdict(batch, weight=torch.ones_like(batch.reward[0]), age=torch.zeros_like(lanes))
        if replay is None:
            return batch
        n, n_burnt = max(1, round(replay.settings.ratio * len(lanes))), replay.settings.burn_in
        replayed = replay.sample(n, self.generator.on(self.device))
        if n_burnt:
            first, rest = mapping(lambda x: x[:n_burnt]), mapping(lambda x: x[n_burnt:])
            sequence = first(replayed.obs), first(replayed.starts)
            state = self.policy.warm_up(*sequence, replayed.state)
            parts = {key: rest(x) if key in SEQUENCES else x for key, x in replayed.items()}
            replayed = arrdict(parts, state=state)
        replayed["learns"] = replayed.learns & replay.is_ready
        joined = {key: cat([batch[key], replayed[key]], int(key in SEQUENCES)) for key in batch}
        return arrdict(joined, index=replayed.index)

    def _losses(self, batch, n_fresh) -> tuple[torch.Tensor, dict[str, torch.Tensor], arrdict]:
        """Returns loss, metrics () and V-trace's estimates; the first `n_fresh` lanes are new."""
        policy, privileged, numbers = self.policy, batch.get("privileged"), self.coefficients
        reset, weight = batch.starts[1:], batch.weight
        batch["valid"] = valid = ~reset & batch.learns[:-1]
        extra, own = None, {}
        with policy.compute_dtype():  # one, so that weights are cast once
            now = policy.unroll(batch.obs, batch.starts, batch.state, mask=batch.get("mask"))
            logprobs, entropies = policy.output.terms(without_last(now.logits), batch.actions)
            value = policy.value(now.features, privileged)
            if policy.privileged_space or self.has_extra_loss:
                extra, own = self.extra_terms(without_last(now.features), batch, _METRICS)
        # traces pass through invalid steps as if the current policy had acted there
        log_ratio = (logprobs.detach() - batch.logprobs).masked_fill(~valid, 0.0)
        estimates = returns.vtrace(
            log_ratio,
            batch.reward,
            *(value[:-1].detach(), value[-1].detach()),
            *(reset, batch.terminal, batch.truncated),
            **{name: numbers[name] for name in _TRACES},
        )
        estimates["valid"] = valid
        scale = self.critic.output.scale
        error = (value[:-1] - estimates.targets) / scale
        advantages = estimates.advantages / scale  # in standard deviations of the return
        size = pooled_mean(advantages.square(), valid).sqrt()
        advantages = advantages / size.clamp(min=self.advantage_floor)
        metrics = dict(
            policy=-masked_mean(weight * logprobs * advantages, valid),
            value=masked_mean(weight * error.square(), valid),
            entropy=masked_mean(entropies, valid),
            advantage=size,
            **self._ratio_metrics(log_ratio[:, :n_fresh], valid[:, :n_fresh]),
            explained_variance=explained_variance(value[:-1].detach(), estimates.targets, valid),
        )
        loss = (
            metrics["policy"]
            + numbers["value_coef"] * metrics["value"]
            - numbers["entropy_coef"] * metrics["entropy"]
        )
        if extra is not None:
            loss, metrics = loss + extra, metrics | own
        if self.replay_buffer is not None:
            replayed = self._ratio_metrics(log_ratio[:, n_fresh:], valid[:, n_fresh:])
            metrics |= {f"replayed_{name}": value for name, value in replayed.items()}
            age = batch.age[n_fresh:].float().mean()
            metrics["staleness"] = age * self.replay_buffer.is_ready
            mean_error = masked_mean(error.detach().abs(), valid, 0)[n_fresh:]
            self.replay_buffer.set_priorities(batch.index, mean_error)
        return loss, metrics, estimates

    def _ratio_metrics(self, log_ratio, valid) -> dict[str, torch.Tensor]:
        """Returns measures of how far the current policy is from the one that acted."""
        log_ratio = log_ratio.clamp(max=_MAX_LOG_RATIO)
        ratio, rho_clip = log_ratio.exp(), self.coefficients["rho_clip"]
        return dict(
            kl=masked_mean(ratio - 1 - log_ratio, valid),
            rho=masked_mean(ratio.clamp(max=rho_clip), valid),
            clip_fraction=masked_mean((ratio > rho_clip).float(), valid),
            effective_samples=effective_sample_size(ratio, valid),
        )
