"""Proximal policy optimisation (Schulman et al. 2017) for recurrent policies.

Axes: T time, B lanes, M lanes of a minibatch. A minibatch is whole sequences of some lanes. Every
mean is over valid steps: those that the environment took, of lanes that learn. An update never
synchronises: what would be an `if` is a flag on the device.
"""

import math
from typing import Annotated, Any

import torch
from pydantic import Field

from agents import returns
from agents.adam import Adam
from agents.finite import FiniteCheck
from agents.random_stream import RandomStream
from agents.rollout import Collector, Rollout
from megastep.arrdict import arrdict
from megastep.dotdict import leaves
from megastep.settings import MAX_ENVS, checked

_AVERAGED = ("policy", "value", "entropy", "kl", "clip_fraction", "grad_norm")
# updates done eagerly, and for real, before one is captured: libraries set themselves up in the
# first
_WARM_UPS = 2
Coefficient = Annotated[float, Field(ge=0, le=10**6)]
Positive = Annotated[float, Field(gt=0, le=10**6)]
Fraction = Annotated[float, Field(ge=0, le=1)]


def masked_mean(x: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """The mean of x where valid; 0 where nothing is."""
    return x.masked_fill(~valid, 0.0).sum() / valid.sum().clamp(min=1)


def normalised(x: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """x less its mean, over its standard deviation, both over the valid; 0 elsewhere."""
    centred = (x - masked_mean(x, valid)).masked_fill(~valid, 0.0)
    return centred / (masked_mean(centred.square(), valid).sqrt() + 1e-8)


def explained_variance(
    value: torch.Tensor, targets: torch.Tensor, valid: torch.Tensor
) -> torch.Tensor:
    """How much of the targets' variance the value explains: 1 all, 0 no more than their mean,
    negative: less than it.
    """
    error, spread = targets - value, targets - masked_mean(targets, valid)
    error = error - masked_mean(error, valid)
    return 1 - masked_mean(error.square(), valid) / masked_mean(spread.square(), valid).clamp(
        min=1e-8
    )


def _itemsize(space, otherwise):
    """Bytes of one number of a space, `otherwise` where it names no dtype."""
    dtype = getattr(space, "dtype", None)
    return dtype.itemsize if dtype else otherwise


class PPO:
    """Improves a policy, in place, from rollouts it collected.

    n_steps           of a rollout
    lr                Adam's step size; `set_lr` changes it
    gamma, lambda_    discount per step, and the decay of GAE
    clip              how far the probability of an action may move, as a ratio, before the gradient
                      stops
    entropy_coef      what a nat of entropy is worth, in standard deviations of advantage
    value_coef        weight of the value's squared error, the value measured in its own scale
    auxiliary_coef    weight of the policy's `prediction_error`, where its critic is asymmetric
    max_grad_norm     longer gradients are shortened to this
    n_epochs, n_minibatches  passes over a rollout, and the parts each is cut into by lanes
    target_kl         once a minibatch finds the policy further than this (nats) from the one that
                      acted, the rest of the update is left out; None for never
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
        clip: Positive = 0.2,
        entropy_coef: Coefficient = 0.01,
        value_coef: Coefficient = 0.5,
        auxiliary_coef: Coefficient = 0.5,
        max_grad_norm: Positive = 0.5,
        n_epochs: Annotated[int, Field(ge=1, le=1000)] = 1,
        n_minibatches: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 4,
        target_kl: Positive | None = None,
        graph: bool = False,
        seed: int = 1,
    ):
        if policy.critic is None:
            raise ValueError("PPO needs a policy with a critic")
        self.policy, self.device, self.n_steps = policy, policy.device, n_steps
        self.gamma, self.lambda_, self.clip, self.entropy_coef = gamma, lambda_, clip, entropy_coef
        self.value_coef, self.auxiliary_coef = value_coef, auxiliary_coef
        self.max_grad_norm = max_grad_norm
        self.n_epochs, self.n_minibatches = n_epochs, n_minibatches
        self.target_kl = float("inf") if target_kl is None else target_kl
        self.lr = lr
        self._lr = torch.tensor(lr, device=self.device)
        self.optimizer = Adam(policy.parameters(), self._lr)
        self.random = RandomStream(seed)
        self.check = FiniteCheck(self.device)
        self._averaged = _AVERAGED
        if policy.privileged_space:
            self._averaged += ("auxiliary",)
        # the stream of warming up and capturing, on the policy's own GPU
        is_captured = graph and self.device.type == "cuda"
        self._stream = torch.cuda.Stream(self.device) if is_captured else None
        self._warm_ups, self._captured = _WARM_UPS, None

    def set_lr(self, lr: float) -> None:
        """Changes Adam's step size, also for a captured update."""
        self._lr.fill_(lr)

    def collector(self, env: Any) -> Collector:
        """What acts in `env`, and the memory of `n_steps` steps of all its lanes, or of those that
        learn where others are `opponents.Opponents`.
        """
        learners = getattr(env, "learners", None)
        n_lanes = env.n_envs * env.n_agents if learners is None else int(learners.sum())
        rollout = Rollout(
            self.n_steps,
            n_lanes,
            env.obs_space,
            env.action_space,
            self.policy.initial(n_lanes),
            env.device,
            self.policy.privileged_space,
            learners=learners,
        )
        return Collector(env, self.policy, rollout)

    def bytes_per_env(self, env: Any) -> float:
        """About how many bytes a rollout and a minibatch of it take per environment."""
        seen, privileged = (
            sum(math.prod(space.shape) * _itemsize(space, size) for space in leaves(tree or {}))
            for tree, size in ((env.obs_space, 2), (self.policy.privileged_space, 4))
        )
        # numbers of observations, of what is privileged, and about 64 bytes of the rest; a
        # minibatch's share of those, and of some 24 activations of 4 bytes per unit; the features
        # that values are made of
        each, parts = seen + privileged + 64, self.n_minibatches
        each = each * (1 + 1 / parts) + (96 / parts + 4) * self.policy.width
        return env.n_agents * (self.n_steps + 1) * each

    def update(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """Learns from a rollout. Returns means over its minibatches as tensors () on the device,
        among them `loss/skipped_steps`, how many gradients were not finite and so were not
        followed. ValueError if its lanes cannot be cut into minibatches.
        """
        if rollout.n_lanes < self.n_minibatches:
            raise ValueError(
                f"{rollout.n_lanes} lanes cannot be cut into {self.n_minibatches} minibatches of "
                f"whole lanes; use fewer minibatches or more lanes"
            )
        metrics = self._update(rollout) if self._stream is None else self._replay(rollout)
        return {f"loss/{key}": value for key, value in metrics.items()}

    def _update(self, rollout):
        is_fine = self.check(rollout.numbers())
        transitions = rollout.transitions()
        estimates = returns.gae(**transitions, gamma=self.gamma, lambda_=self.lambda_)
        estimates["valid"] = estimates.valid & rollout.learns[:-1]
        self.policy.critic.output.update_stats(estimates.targets, estimates.valid & is_fine)
        explained = explained_variance(transitions["value"], estimates.targets, estimates.valid)
        estimates["advantages"] = normalised(estimates.advantages, estimates.valid)

        totals = torch.zeros(len(self._averaged) + 2, device=self.device)
        stopped = torch.zeros((), dtype=torch.bool, device=self.device)
        for _ in range(self.n_epochs):
            order = torch.rand(
                rollout.n_lanes, generator=self.random.on(self.device), device=self.device
            ).argsort()
            for rows in order.tensor_split(self.n_minibatches):
                batch = arrdict(
                    {**rollout.lanes(rows), **estimates.map(torch.index_select, 1, rows)}
                )
                row, stopped = self._step(batch, is_fine, stopped)
                totals = totals + row
        # Only now: a rollout is learnt from as it was seen. One row is enough, B lanes again with
        # every rollout.
        last = rollout.world(-1)
        self.policy.update_stats(last.obs, last.get("privileged"), is_fine & rollout.learns[-1])
        *sums, n_taken, n_skipped = totals.unbind()
        self.check.count((n_taken == 0) & (n_skipped > 0))
        means = {key: total / n_taken for key, total in zip(self._averaged, sums, strict=True)}
        return {**means, "explained_variance": explained, "skipped_steps": n_skipped}

    def _losses(self, batch):
        """The loss of a minibatch, and what there is to say about it, each a tensor ()."""
        now = self.policy.unroll(batch.obs, batch.starts, batch.state)
        valid, output = batch.valid, self.policy.output
        log_ratio = output.logprob(now.logits, batch.actions) - batch.logprobs
        log_ratio = log_ratio.masked_fill(~valid, 0.0)  # or its exp may overflow, and 0 inf be nan
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1 - self.clip, 1 + self.clip)
        gain = torch.minimum(ratio * batch.advantages, clipped * batch.advantages)
        estimate = self.policy.value(now.features, batch.get("privileged"))
        error = (estimate - batch.targets) / self.policy.critic.output.scale

        policy = -masked_mean(gain, valid)
        value = masked_mean(error.square(), valid)
        entropy = masked_mean(output.entropy(now.logits), valid)
        with torch.no_grad():
            # >= 0 term by term, unlike the mean log ratio
            kl = masked_mean(ratio - 1 - log_ratio, valid)
            clip_fraction = masked_mean((ratio != clipped).float(), valid)
        loss = policy + self.value_coef * value - self.entropy_coef * entropy
        metrics = dict(
            policy=policy, value=value, entropy=entropy, kl=kl, clip_fraction=clip_fraction
        )
        if self.policy.privileged_space:
            error = self.policy.prediction_error(now.features, batch.privileged)
            metrics["auxiliary"] = masked_mean(error, valid)
            loss = loss + self.auxiliary_coef * metrics["auxiliary"]
        return loss, metrics

    def _step(self, batch, is_fine, stopped):
        """One gradient step, unless `stopped`, or the KL is too large (which stops the next ones
        too), or no row is valid, or the rollout or the gradient is not finite. Returns the metrics,
        with how many steps were taken (0 or 1) and skipped, and `stopped`.
        """
        loss, metrics = self._losses(batch)
        self.optimizer.zero_grad()
        loss.backward()
        metrics["grad_norm"] = torch.nn.utils.clip_grad_norm_(
            self.optimizer.parameters, self.max_grad_norm
        )
        finite = metrics["grad_norm"].isfinite() & is_fine
        stopped = stopped | (metrics["kl"] > self.target_kl)
        taken = finite & ~stopped & batch.valid.any()
        self.optimizer.step(taken)
        row = torch.stack([metrics[key].detach() for key in self._averaged])
        return torch.cat(
            [row.masked_fill(~taken, 0.0), torch.stack([taken, ~finite & ~stopped]).float()]
        ), stopped

    def _replay(self, rollout):
        """`_update` as a CUDA graph, after some for real on the stream that captures."""
        with torch.cuda.device(self.device):
            if self._warm_ups:
                self._warm_ups -= 1
                return self._warm_up(rollout)
            if self._captured is None or self._captured[0] is not rollout:
                self._captured = self._capture(rollout)
            _, graph, metrics = self._captured
            graph.replay()
            return {key: value.clone() for key, value in metrics.items()}

    def _warm_up(self, rollout):
        # PyTorch would warn that gradients were first added up on another stream, which this waits
        # for
        torch.autograd.graph.set_warn_on_accumulate_grad_stream_mismatch(False)
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            metrics = self._update(rollout)
        torch.cuda.current_stream().wait_stream(self._stream)
        return metrics

    def _capture(self, rollout):
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(self.random.on(self.device))
        try:
            with torch.cuda.graph(graph, stream=self._stream):
                metrics = self._update(rollout)
        except RuntimeError as error:
            # the end of a capture that failed fails as well: the first error is the one to tell
            raise error.__context__ or error from None
        return rollout, graph, metrics

    def state_dict(self) -> dict[str, Any]:
        """All that an update changes beside the policy's weights, and where the policy's random
        stream is: dicts of plain tensors and numbers.
        """
        return dict(
            optimizer=self.optimizer.state_dict(),
            lr=self._lr.clone(),
            random=self.random.state_dict(),
            policy_random=self.policy.random.state_dict(),
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from a `state_dict`, taken on this device or another."""
        self.optimizer.load_state_dict(state["optimizer"])
        self._lr.copy_(state["lr"])
        self.random.load_state_dict(state["random"], self.device)
        self.policy.random.load_state_dict(state["policy_random"], self.device)
        self._warm_ups, self._captured = _WARM_UPS, None
