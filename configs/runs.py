"""Run folders, and the objects a run is made of: what train.py, evaluate.py and record.py have in
common.
"""

import dataclasses
import difflib
import json
import math
import os
import shutil
import time
from contextlib import contextmanager
from pathlib import Path

import yaml

from configs.settings import Fault, Train, as_tree, build

RUNS = Path("runs")
SWEEPS = Path("sweeps")
#: Environments in the small one that tells how much memory an environment takes.
PROBE = 65


# ---- Folders ----


def fresh(path):
    """Makes a new folder and returns it; a taken name gets -2, -3, ... Fault unless it can be
    written to.
    """
    path, number = Path(path), 2
    place = path
    while place.exists():
        place, number = path.with_name(f"{path.name}-{number}"), number + 1
    try:
        place.mkdir(parents=True)
    except OSError as error:
        raise Fault(
            f"The run folder {place} cannot be made ({error.strerror}); choose another with folder="
        ) from error
    return place


def new(cfg):
    """The folder of a new run: `cfg.folder`, which must be new or empty, or one named after time
    and settings.
    """
    if cfg.folder is None:
        return fresh(
            RUNS
            / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}-{cfg.env.name}-{cfg.geometry.name}-{cfg.seed}"
        )
    path = Path(cfg.folder)
    if path.exists() and not path.is_dir():
        raise Fault(f"The run folder {path} is a file; choose another with folder=")
    if not path.is_dir():
        return fresh(path)
    if not os.access(path, os.W_OK | os.X_OK):
        raise Fault(f"The run folder {path} cannot be written to; choose another with folder=")
    if any(path.iterdir()):
        raise Fault(
            f"The run folder {path} is not empty; choose another with folder=, or go on with "
            f"resume={path}"
        )
    return path


@contextmanager
def vanishing(folder):
    """Deletes a new folder again if setting up fails, so that nothing half-written stays behind."""
    try:
        yield
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def find(name):
    """An existing run's folder, from a path, `latest`, or one of its checkpoints. Fault that names
    the nearest run.
    """
    known = sorted(
        (p.parent for p in [*RUNS.glob("*/checkpoints"), *SWEEPS.glob("*/*/checkpoints")]),
        key=lambda p: p.stat().st_mtime,
    )
    if name == "latest":
        if not known:
            raise Fault(f"There is no run in {RUNS}/ or {SWEEPS}/ yet; python train.py makes one")
        return known[-1]
    path = Path(name)
    if is_checkpoint(path) or (path / "checkpoints").is_dir():
        return path
    if path.exists():
        raise Fault(f"{path} is no run: it has no folder named checkpoints")
    near = difflib.get_close_matches(str(path), [str(k) for k in known], n=1, cutoff=0.4)
    raise Fault(f"There is no run {path}" + (f"; did you mean {near[0]}?" if near else ""))


def is_checkpoint(path):
    return (path / "manifest.json").exists()


def folder_of(path):
    """The run folder that a path given by `find` belongs to."""
    return path.parent.parent if is_checkpoint(path) else path


def headline(folder):
    """What a finished run achieved, in a few words: its evaluated return, else the last one seen in
    training.
    """
    from agents.metrics import read

    try:
        row = json.loads((folder / "evaluation.json").read_text())["rows"][0]
        return f"{row['return']:.2f} ({row['low']:.2f} to {row['high']:.2f})"
    except (OSError, TypeError):
        pass
    try:
        returns = [
            row["episode/return"]
            for row in read(folder / "metrics.jsonl")
            if "episode/return" in row
        ]
        return f"{returns[-1]:.2f} in training" if returns else ""
    except (OSError, TypeError):
        return ""


def write_config(folder, cfg):
    """Writes the composed configuration, config.yaml."""
    (folder / "config.yaml").write_text(yaml.safe_dump(as_tree(cfg), sort_keys=False))


# ---- What a run is made of ----


@contextmanager
def faults():
    """Turns what the library says about bad arguments, files, devices and memory into a Fault. For
    setting up only.
    """
    import torch

    from agents.checkpoint import CheckpointError
    from megastep.engine import EngineError

    try:
        yield
    except (
        ValueError,
        EngineError,
        CheckpointError,
        FileNotFoundError,
        torch.OutOfMemoryError,
    ) as error:
        raise Fault(str(error).splitlines()[0]) from error


def make_device(name):
    """The device called `name`; a GPU becomes PyTorch's current one, on which graphs are
    captured.
    """
    import torch

    from megastep import engine

    with faults():
        chosen = engine.device(name)
    if chosen.type == "cuda":
        torch.cuda.set_device(chosen)
    return chosen


def homes(geometry, split, most=None):
    """The different geometries of a split, in order, at most `most`; the source repeats them when
    it runs out.
    """
    from megastep import geometries

    with faults():
        found = geometries.sample(
            geometry.name, geometry.n, split=split, seed=geometry.seed, **geometry.options
        )
    return list({id(home): home for home in found}.values())[:most]


def make_env(settings, homes, seed, device, bytes_beside=lambda env: 0):
    """The environment that `settings` (such as settings.Explorer) describe, in these homes.

    Fault that says how many environments fit, if these are too many for the memory;
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

    with faults():
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

    with faults():
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


def make_rollout(cfg, env):
    from agents.buffers import Rollout

    with faults():
        return Rollout(
            cfg.learner.n_steps,
            env.n_envs * env.n_agents,
            env.obs_space,
            env.action_space,
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

    with faults():
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
    """Loads a checkpoint's weights into a policy made for `env`. Fault that names what differs if
    they do not fit.
    """
    saved, present = checkpoint.config["spaces"], spaces_of(env)
    differing = [
        f"{name} was {saved.get(name, 'absent')} and is {present.get(name, 'absent')}"
        for name in {**saved, **present}
        if saved.get(name) != present.get(name)
    ]
    if differing:
        raise Fault(
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
        raise Fault(
            f"The weights of {checkpoint.path} do not fit this agent: {shapes[0]}; choose the "
            f"agent it has"
        )
    policy.load_state_dict(weights)
