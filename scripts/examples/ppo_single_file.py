"""Proximal policy optimisation (PPO, Schulman et al. 2017) for recurrent policies, in one file.

    python scripts/examples/ppo_single_file.py
    python scripts/examples/ppo_single_file.py --env megastep.envs.pong:Pong --samples 200_000
    python scripts/examples/ppo_single_file.py --env my_package.rover:Rover speed=2.0

The algorithm of `train.py learner=ppo`, to read and to change. It earns the same, in any
environment and with any actions, but does less: it saves nothing, uses one device, makes no CUDA
graph of the update, and does not skip NaN. Words such as speed=2.0 are arguments of the
environment's class. Defaults are for a CPU; on a GPU use more environments and a larger network:

    --n-envs 4096 --width 256 --lr 1e-3 --gamma 0.995 --entropy-coef 0.01 --samples 100_000_000

T time, B lanes (a lane is one agent in one environment), M lanes of a minibatch.
"""

import argparse
import ast
import dataclasses
import inspect
import sys
import time

import torch

from megastep import engine
from megastep.agents.algorithms import returns
from megastep.agents.algorithms.masked_stats import (
    explained_variance,
    masked_mean,
    pooled_normalise,
)
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.collector import Collector
from megastep.agents.storage.rollout import make_rollout, without_last
from megastep.agents.training.episode_stats import EpisodeStats
from megastep.geometries import sources
from megastep.imports import import_object
from megastep.types import n_lanes, optional


@dataclasses.dataclass
class Settings:
    env: str = "megastep.envs.explorer:Explorer"  # import path of the environment's class
    homes: int = 512  # floor plans, for environments that take geometries
    device: str = "auto"  # auto, cpu or cuda
    seed: int = 1
    samples: int = 1_000_000  # environment steps of all lanes
    log_every: int = 8  # updates between two lines of output
    # the policy
    width: int = 64  # units of each layer
    core: str = "lstm"  # lstm, gru, mingru, none
    # the algorithm
    n_envs: int = 256
    n_steps: int = 32  # T
    lr: float = 3e-3  # falls to 0
    gamma: float = 0.98
    lambda_: float = 0.95
    clip: float = 0.2
    entropy_coef: float = 0.02
    value_coef: float = 0.5
    max_grad_norm: float = 0.5
    n_epochs: int = 1
    n_minibatches: int = 4


def make_env(settings, arguments):
    """Constructs the environment, with those of our arguments that its class takes."""
    constructor = import_object(settings.env)
    taken = inspect.signature(constructor).parameters
    ours = dict(n_envs=settings.n_envs, seed=settings.seed, device=engine.device(settings.device))
    if "geometries" in taken:
        ours["geometries"] = sources.homes(settings.homes)
    return constructor(**{k: v for k, v in ours.items() if k in taken} | arguments)


def train(settings, env):
    """Trains a policy. Returns it and what was printed, a dict for each line."""
    torch.manual_seed(settings.seed)  # of the order of minibatches
    if env.device.type == "cpu":  # in small layers, more threads of PyTorch only wait
        engine.set_threads(engine.threads())
        torch.set_num_threads(max(1, min(engine.threads(), settings.width // 128)))

    # Spaces decide which layers take the observations, and which give logits and take actions.
    policy = Policy(
        env.obs_space,
        env.action_space,
        optional(env, "privileged_space"),
        width=settings.width,
        core=settings.core,
        seed=settings.seed,
    ).to(env.device)
    optimizer = torch.optim.Adam(policy.parameters(), settings.lr, eps=1e-5)

    # The collector acts for T steps and stores them in the rollout, always the same one. On a GPU
    # it replays a CUDA graph.
    policy.clear_stats()  # observations and values are 0 until the first rollout tells their units
    rollout = make_rollout(env, policy, settings.n_steps)
    collect = Collector(env, policy, rollout)
    has_random_ages = optional(env, "desync") is not None
    if has_random_ages:  # else all lanes would end their first episodes together
        env.desync()
    stats = EpisodeStats(rollout.n_lanes, env.device, [*rollout.metrics], None, has_random_ages)

    samples_per_update = settings.n_steps * rollout.n_lanes
    n_updates = max(1, round(settings.samples / samples_per_update))
    reports, start = [], time.monotonic()
    for update in range(n_updates):
        optimizer.param_groups[0]["lr"] = settings.lr * (1 - update / n_updates)
        collect()
        done = rollout.terminal | rollout.truncated
        stats.add(rollout.reward, rollout.reset, done, rollout.learns[:-1], metrics=rollout.metrics)
        losses = learn(settings, policy, optimizer, rollout)

        if (update + 1) % settings.log_every == 0 or update + 1 == n_updates:
            report = {name: loss.item() for name, loss in losses.items()}
            report |= {name.removeprefix("episode/"): x for name, x in stats.pop().items()}
            report["samples"] = (update + 1) * samples_per_update
            report["rate"] = report["samples"] / (time.monotonic() - start)
            reports.append(report)
            shown = ("return", "length", "entropy", "kl", "explained_variance")
            numbers = [f"{name} {report[name]:.3g}" for name in shown if name in report]
            rate = f"{report['samples']:,} samples  {report['rate']:,.0f}/s"
            print("  ".join([rate, *numbers]), flush=True)
    return policy, reports


def learn(settings, policy, optimizer, rollout):
    """Improves the policy with a rollout. Returns losses, tensors ()."""
    # Advantages and targets, (T, B). A transition is invalid if it only began a new episode (its
    # action was ignored), or if it is an opponent's.
    estimates = returns.gae(**rollout.transitions(), gamma=settings.gamma, lambda_=settings.lambda_)
    estimates["valid"] = estimates.valid & rollout.learns[:-1]
    explained = explained_variance(rollout.values[:-1], estimates.targets, estimates.valid)
    estimates["advantages"] = pooled_normalise(estimates.advantages, estimates.valid)
    # The critic predicts returns that are normalised by their running mean and standard deviation.
    policy.critic.output.update_stats(estimates.targets, estimates.valid)

    for _ in range(settings.n_epochs):
        order = torch.randperm(rollout.n_lanes, device=policy.device)
        for lanes in order.tensor_split(settings.n_minibatches):
            # Whole sequences of some lanes, since the policy is recurrent, and its hidden state
            # before them. Observations have a row more than actions.
            batch = rollout.sequences(lanes)
            valid = estimates.valid[:, lanes]
            advantages, targets = estimates.advantages[:, lanes], estimates.targets[:, lanes]
            obs, starts = without_last(batch.obs), without_last(batch.starts)
            now = policy.unroll(obs, starts, batch.state)

            # The clipped objective
            logprobs = policy.output.logprob(now.logits, batch.actions)
            log_ratio = (logprobs - batch.logprobs).masked_fill(~valid, 0.0)
            ratio = log_ratio.exp()
            clipped = ratio.clamp(1 - settings.clip, 1 + settings.clip)
            surrogate = torch.minimum(ratio * advantages, clipped * advantages)
            policy_loss = -masked_mean(surrogate, valid)

            # The critic's error in standard deviations of the return, and the entropy bonus
            value = policy.value(now.features, without_last(batch.get("privileged")))
            error = (value - targets) / policy.critic.output.scale
            value_loss = masked_mean(error.square(), valid)
            entropy = masked_mean(policy.output.entropy(now.logits), valid)

            loss = policy_loss + settings.value_coef * value_loss - settings.entropy_coef * entropy
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), settings.max_grad_norm)
            optimizer.step()

    # Observations are normalised, too. Their statistics change only after the update, which so sees
    # them as the policy did when it acted.
    last = rollout.world(-1)
    policy.update_stats(last.obs, last.get("privileged"), rollout.learns[-1])
    kl = masked_mean(ratio - 1 - log_ratio, valid)
    return dict(
        policy=policy_loss, value=value_loss, entropy=entropy, kl=kl, explained_variance=explained
    )


def parse(words=None):
    """Returns the settings and the environment's arguments from words of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for field in dataclasses.fields(Settings):
        flag = "--" + field.name.strip("_").replace("_", "-")
        parser.add_argument(flag, dest=field.name, type=field.type, default=field.default)
    parser.add_argument("arguments", nargs="*", metavar="key=value", help="of the environment")
    flags = vars(parser.parse_args(words))
    arguments = {}
    for word in flags.pop("arguments"):
        key, _, value = word.partition("=")
        try:
            arguments[key] = ast.literal_eval(value)
        except (ValueError, SyntaxError):  # a plain word
            arguments[key] = value
    return Settings(**flags), arguments


if __name__ == "__main__":
    settings, arguments = parse()
    try:
        env = make_env(settings, arguments)
        if n_lanes(env) < settings.n_minibatches:
            raise ValueError(f"{n_lanes(env)} lanes cannot be split into more minibatches")
    except (ValueError, TypeError, engine.EngineError) as error:
        print(f"ppo_single_file.py: {error}", file=sys.stderr)
        sys.exit(2)
    train(settings, env)
