"""Proximal policy optimisation (Schulman et al. 2017) for recurrent policies.

Axes: T time, B lanes, M lanes of a minibatch. A minibatch is whole sequences of some lanes. Every
mean is over valid steps. Nothing in an update asks the GPU a question: what would be an `if` is a
flag on the device.
"""

import torch

from agents import returns
from agents.random_stream import RandomStream
from megastep.arrdict import arrdict

_AVERAGED = ("policy", "value", "entropy", "kl", "clip_fraction", "grad_norm")
# updates done eagerly, and for real, before one is captured: libraries set themselves up in the
# first
_WARM_UPS = 2


def masked_mean(x, valid):
    """The mean of x where valid; 0 where nothing is."""
    return x.masked_fill(~valid, 0.0).sum() / valid.sum().clamp(min=1)


def normalised(x, valid):
    """x less its mean, over its deviation, both over the valid; 0 elsewhere."""
    centred = (x - masked_mean(x, valid)).masked_fill(~valid, 0.0)
    return centred / (masked_mean(centred.square(), valid).sqrt() + 1e-8)


def explained_variance(value, targets, valid):
    """How much of the targets' variance the value tells: 1 all, 0 no more than their mean,
    negative: worse than it.
    """
    error, spread = targets - value, targets - masked_mean(targets, valid)
    error = error - masked_mean(error, valid)
    return 1 - masked_mean(error.square(), valid) / masked_mean(spread.square(), valid).clamp(
        min=1e-8
    )


class PPO:
    """Improves a policy, in place, from rollouts it collected.

    lr              Adam's step size; `set_lr` changes it
    gamma, lambda_  discount per step, and how far GAE looks before it trusts the value
    clip            how far the probability of an action may move, as a ratio, before the gradient
    stops
    entropy         what a nat of entropy is worth, in norm deviations of advantage
    value_coef    weight of the value's squared error, the value measured in its own scale
    max_grad_norm   longer gradients are shortened to this
    n_epochs, n_minibatches  passes over a rollout, and the parts each is cut into by lanes
    target_kl       once a minibatch finds the policy further than this (nats) from the one that
    acted, the rest of the
                    update is left out; None for never
    graph           on a GPU, captures the update as a CUDA graph; always with one and the same
    rollout then
    """

    def __init__(
        self,
        policy,
        *,
        lr=3e-4,
        gamma=0.99,
        lambda_=0.95,
        clip=0.2,
        entropy_coef=0.01,
        value_coef=0.5,
        max_grad_norm=0.5,
        n_epochs=1,
        n_minibatches=4,
        target_kl=None,
        graph=False,
        seed=1,
    ):
        self.policy, self.device = policy, policy.device
        self.gamma, self.lambda_, self.clip, self.entropy_coef = gamma, lambda_, clip, entropy_coef
        self.value_coef, self.max_grad_norm = value_coef, max_grad_norm
        self.n_epochs, self.n_minibatches = n_epochs, n_minibatches
        self.target_kl = float("inf") if target_kl is None else target_kl
        on_gpu = self.device.type == "cuda"
        self.lr = lr
        self._lr = torch.tensor(lr, device=self.device)
        # Fused Adam does nothing at all, to its moments neither, where its flag `found_inf` is set
        # on the device
        self._fixed = dict(lr=self._lr, fused=True, capturable=on_gpu)
        self.optimizer = torch.optim.Adam(policy.parameters(), eps=1e-5, **self._fixed)
        self.random = RandomStream(seed)
        self.graph, self._captured = graph and on_gpu, None
        self._warm_ups = _WARM_UPS

    def set_lr(self, lr):
        """Changes Adam's step size, also for a captured update."""
        self._lr.fill_(lr)

    def update(self, rollout):
        """Learns from a rollout. Returns means over its minibatches as tensors () on the device,
        among them `loss/skipped_steps`, how many gradients were not finite and so were not
        followed. ValueError if its lanes cannot be cut into minibatches.
        """
        if rollout.n_lanes < self.n_minibatches:
            raise ValueError(
                f"{rollout.n_lanes} lanes cannot be cut into {self.n_minibatches} minibatches of "
                f"whole "
                "lanes; use fewer minibatches or more lanes"
            )
        metrics = self._replay(rollout) if self.graph else self._update(rollout)
        return {f"loss/{key}": value for key, value in metrics.items()}

    def _update(self, rollout):
        outcome = rollout.transitions()
        judged = returns.gae(**outcome, gamma=self.gamma, lambda_=self.lambda_)
        self.policy.value.update_stats(judged.targets, judged.valid)
        explained = explained_variance(outcome["value"], judged.targets, judged.valid)
        judged["advantages"] = normalised(judged.advantages, judged.valid)

        totals = torch.zeros(len(_AVERAGED) + 2, device=self.device)
        stopped = torch.zeros((), dtype=torch.bool, device=self.device)
        for _ in range(self.n_epochs):
            order = torch.rand(
                rollout.n_lanes, generator=self.random.on(self.device), device=self.device
            ).argsort()
            for rows in order.tensor_split(self.n_minibatches):
                batch = arrdict({**rollout.lanes(rows), **judged.map(torch.index_select, 1, rows)})
                row, stopped = self._step(batch, stopped)
                totals = totals + row
        # Only now: a rollout is learned from as it was seen. One row is plenty, B lanes again with
        # every rollout.
        self.policy.intake.update_stats(rollout.obs[-1])
        *sums, n_taken, n_skipped = totals.unbind()
        means = {key: total / n_taken for key, total in zip(_AVERAGED, sums, strict=True)}
        return {**means, "explained_variance": explained, "skipped_steps": n_skipped}

    def _losses(self, batch):
        """The loss of a minibatch, and what there is to say about it, each a tensor ()."""
        seen = self.policy.unroll(batch.obs, batch.starts, batch.state)
        valid, output = batch.valid, self.policy.output
        log_ratio = output.logprob(seen.logits, batch.actions) - batch.logprobs
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1 - self.clip, 1 + self.clip)
        gain = torch.minimum(ratio * batch.advantages, clipped * batch.advantages)
        error = (seen.value - batch.targets) / self.policy.value.scale

        policy = -masked_mean(gain, valid)
        value = masked_mean(error.square(), valid)
        entropy = masked_mean(output.entropy(seen.logits), valid)
        with torch.no_grad():
            kl = masked_mean(
                ratio - 1 - log_ratio, valid
            )  # >= 0 term by term, unlike the mean log ratio
            clip_fraction = masked_mean((ratio != clipped).float(), valid)
        loss = policy + self.value_coef * value - self.entropy_coef * entropy
        return loss, dict(
            policy=policy, value=value, entropy=entropy, kl=kl, clip_fraction=clip_fraction
        )

    def _step(self, batch, stopped):
        """One gradient step, unless `stopped`, or the KL is too large (which stops the next ones
        too), or the gradient is not finite. Returns the metrics, with how many steps were taken (0
        or 1) and skipped, and `stopped`.
        """
        loss, metrics = self._losses(batch)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        metrics["grad_norm"] = torch.nn.utils.clip_grad_norm_(
            self.policy.parameters(), self.max_grad_norm
        )
        finite = metrics["grad_norm"].isfinite()
        stopped = stopped | (metrics["kl"] > self.target_kl)
        taken = finite & ~stopped
        self.optimizer.found_inf = (~taken).float()
        self.optimizer.step()
        row = torch.stack([metrics[key].detach() for key in _AVERAGED])
        return torch.cat(
            [row.masked_fill(~taken, 0.0), torch.stack([taken, ~finite & ~stopped]).float()]
        ), stopped

    def _replay(self, rollout):
        """`_update` as a CUDA graph, after some for real on the stream a capture would use."""
        if self._warm_ups:
            self._warm_ups -= 1
            # PyTorch would warn that gradients were first added up on another stream, which this
            # waits for
            torch.autograd.graph.set_warn_on_accumulate_grad_stream_mismatch(False)
            side = torch.cuda.Stream(self.device)
            side.wait_stream(torch.cuda.current_stream(self.device))
            with torch.cuda.stream(side):
                metrics = self._update(rollout)
            torch.cuda.current_stream(self.device).wait_stream(side)
            return metrics
        if self._captured is None or self._captured[0] is not rollout:
            graph = torch.cuda.CUDAGraph()
            graph.register_generator_state(self.random.on(self.device))
            with torch.cuda.graph(graph):
                metrics = self._update(rollout)
            self._captured = rollout, graph, metrics
        _, graph, metrics = self._captured
        graph.replay()
        return {key: value.clone() for key, value in metrics.items()}

    def state_dict(self):
        """All that an update changes beside the policy's weights, and how far the policy's draws
        have come: dicts of plain tensors and numbers.
        """
        return dict(
            optimizer=self.optimizer.state_dict(),
            lr=self._lr.clone(),
            random=self.random.state_dict(),
            policy_random=self.policy.random.state_dict(),
        )

    def load_state_dict(self, state):
        """Goes on from a `state_dict`, taken on this device or another."""
        self.optimizer.load_state_dict(state["optimizer"])
        self._lr.copy_(state["lr"])
        for group in self.optimizer.param_groups:
            group.update(self._fixed)
        self.random.load_state_dict(state["random"], self.device)
        self.policy.random.load_state_dict(state["policy_random"], self.device)
        self._captured, self._warm_ups = None, _WARM_UPS
