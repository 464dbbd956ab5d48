"""The objects a run is made of, from its settings: device, homes, environment, policy, learner,
rollout, weights.
"""

import dataclasses
import math
from contextlib import contextmanager

from agents.cli.build import build
from agents.cli.errors import UserError
from agents.cli.run_folders import is_checkpoint
from agents.cli.settings import Train

#: Environments in the small one that tells how much memory an environment takes.
PROBE = 65


@contextmanager
def errors():
    """Turns what the library says about bad arguments, files, devices and memory into a UserError.
    For setting up only.
    """
    import torch

    from agents.checkpoint import CheckpointError
    from agents.metrics import MetricsError
    from megastep.engine import EngineError

    try:
        yield
    except (
        ValueError,
        EngineError,
        CheckpointError,
        MetricsError,
        FileNotFoundError,
        torch.OutOfMemoryError,
    ) as error:
        raise UserError(str(error).splitlines()[0]) from error


def make_device(name):
    """The device called `name`; a GPU becomes PyTorch's current one, on which graphs are
    captured.
    """
    import torch

    from megastep import engine

    with errors():
        chosen = engine.device(name)
    if chosen.type == "cuda":
        torch.cuda.set_device(chosen)
    return chosen


def homes(geometry, split, most=None):
    """The different geometries of a split, in order, at most `most`; the source repeats them when
    it runs out.
    """
    from megastep import geometries

    with errors():
        found = geometries.sample(
            geometry.name, geometry.n, split=split, seed=geometry.seed, **geometry.options
        )
    return list({id(home): home for home in found}.values())[:most]


def make_env(settings, homes, seed, device, bytes_beside=lambda env: 0):
    """The environment that `settings` (such as settings.Explorer) describe, in these homes.

    UserError that says how many environments fit, if these are too many for the memory;
    `bytes_beside(env)` is what each needs beside its own, in a rollout. Before a large one is made,
    two small ones tell what one environment takes.
    """
    from megastep import engine, envs
    from megastep.capture import state_tree

    arguments = {
        k: v for k, v in dataclasses.asdict(settings).items() if k not in ("name", "n_envs")
    }

    def made(n_envs, homes):
        return envs.ENVS[settings.name](n_envs, homes, seed=seed, device=device, **arguments)

    with errors():
        if settings.n_envs > PROBE:
            few, many = made(1, homes[:1]), made(PROBE, homes[:1])
            sizes = [
                sum(getattr(leaf, "nbytes", 0) for leaf in state_tree(env).values())
                for env in (few, many)
            ]
            each = (sizes[1] - sizes[0]) / (PROBE - 1) + bytes_beside(few)
            engine.fit(settings.n_envs, each, device)
        return made(settings.n_envs, homes)


def make_policy(agent, env, seed=1):
    from agents.policy import Policy

    with errors():
        return Policy(env.obs_space, env.action_space, seed=seed, **dataclasses.asdict(agent)).to(
            env.device
        )


def make_learner(learner, policy, seed=1):
    from agents.ppo import PPO

    arguments = {
        k: v
        for k, v in dataclasses.asdict(learner).items()
        if k not in ("name", "n_steps", "anneal")
    }
    return PPO(policy, graph=True, seed=seed, **arguments)


def make_rollout(cfg, env, policy):
    from agents.rollout import Rollout

    n_lanes = env.n_envs * env.n_agents
    with errors():
        return Rollout(
            cfg.learner.n_steps,
            n_lanes,
            env.obs_space,
            env.action_space,
            policy.initial(n_lanes),
            env.device,
        )


def rollout_bytes(cfg, env):
    """About how many bytes a settings.Train learns from at once for each of env's worlds."""
    from megastep.dotdict import leaves

    numbers = sum(math.prod(space.shape) for space in leaves(env.obs_space))
    steps, width, parts = cfg.learner.n_steps + 1, cfg.agent.width, cfg.learner.n_minibatches
    # observations of 2 bytes and about 64 of the rest, a minibatch's share of those and of some 16
    # activations a unit
    return env.n_agents * steps * ((2 * numbers + 64) * (1 + 1 / parts) + 64 * width / parts)


def load(path, device="cpu"):
    """The checkpoint of a run found with `find`; damaged ones are named in warnings and passed
    over.
    """
    from agents import checkpoint

    with errors():
        return checkpoint.load(path if is_checkpoint(path) else path / "checkpoints", device)


def config_of(checkpoint):
    """The settings.Train that a checkpoint was trained with."""
    return build(Train, checkpoint.config["train"])


def spaces_of(env):
    """What an environment shows and takes, by name, as plain text: {'obs.rgb': 'MultiImage(...)',
    ...}.
    """

    def flat(space, name):
        if not isinstance(space, dict):
            return {name: repr(space)}
        return {
            k: v for key, child in space.items() for k, v in flat(child, f"{name}.{key}").items()
        }

    return {**flat(env.obs_space, "obs"), **flat(env.action_space, "actions")}


def load_weights(policy, env, checkpoint):
    """Loads a checkpoint's weights into a policy made for `env`. UserError that names what differs
    if they do not fit.
    """
    saved, present = checkpoint.config["spaces"], spaces_of(env)
    differing = [
        f"{name} was {saved.get(name, 'absent')} and is {present.get(name, 'absent')}"
        for name in {**saved, **present}
        if saved.get(name) != present.get(name)
    ]
    if differing:
        raise UserError(
            f"{checkpoint.path} was trained in another environment: {'; '.join(differing)}; "
            "choose the env it was trained in"
        )
    weights, own = checkpoint.state["policy"], policy.state_dict()
    shapes = {name: tuple(weights[name].shape) if name in weights else "absent" for name in own}
    shapes = [
        f"{name} is {shapes[name]} and should be {tuple(value.shape)}"
        for name, value in own.items()
        if shapes[name] != tuple(value.shape)
    ]
    if shapes:
        raise UserError(
            f"The weights of {checkpoint.path} do not fit this agent: {shapes[0]}; choose the "
            f"agent it has"
        )
    policy.load_state_dict(weights)
