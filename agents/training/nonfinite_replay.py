"""Replays the steps that led to a non-finite number of an environment, in another copy of it.

N environments of A agents, B = N A lanes, T steps.
"""

import json
import zipfile
from pathlib import Path

import numpy as np
import torch

from megastep import spaces
from megastep.agents.algorithms.nonfinite import NonFiniteCheck, NonFiniteValue
from megastep.agents.storage.rollout import Rollout
from megastep.arrdict import arrdict
from megastep.capture import restore, state_tree
from megastep.dotdict import mapping
from megastep.types import Env, n_lanes, optional

#: The format of the files.
FORMAT = 1
#: What reading another file raises.
UNREADABLE = (
    zipfile.BadZipFile,
    ValueError,
    KeyError,
    TypeError,
    EOFError,
    RecursionError,  # a header of many brackets
)


class ReplayError(ValueError):
    """A file cannot be replayed. The message names what does not fit."""


class Recording:
    """A file that a `nonfinite_recorder.RolloutRecorder` wrote.

    Args:
        path: the file.

    Attributes:
        header: what the file says about itself.
        place: tensor, lane and step of the number.
        device: kind of the device that wrote it.

    Raises:
        ReplayError, OSError: it is no such file, or cannot be read.
    """

    def __init__(self, path: Path):
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = dict(file)
            self.header = json.loads(str(arrays.pop("header")))
            if self.header["format"] != FORMAT:
                raise ReplayError(
                    f"{path} has format {self.header['format']}, and this megastep reads format "
                    f"{FORMAT}: use the megastep that wrote it"
                )
            self.place, self.device = tuple(self.header["place"]), self.header["device"]
        except UNREADABLE as error:
            if isinstance(error, ReplayError):
                raise
            raise ReplayError(f"{path} is no file of a non-finite number, or damaged") from error
        self.arrays = {name: torch.from_numpy(array) for name, array in arrays.items()}

    def restore(self, env: Env) -> None:
        """Writes the state into the same rows of another copy of the environment.

        Raises:
            ReplayError: naming what differs.
        """
        tree, state = state_tree(env), {}
        saved = {k.removeprefix("state"): v for k, v in self.arrays.items() if k[:5] == "state"}
        for path, value in saved.items():
            leaf = tree.get(path)
            if isinstance(leaf, torch.Tensor):
                value = value.to(leaf.device, leaf.dtype)
                if (axis := env_axis(leaf, env)) is not None:
                    envs = torch.tensor(self.header["envs"], device=leaf.device)
                    rows = rows_of(envs, leaf.shape[axis] // env.n_envs)
                    if leaf.index_select(axis, rows).shape != value.shape:
                        raise ReplayError(
                            f"its {path[1:]} is {tuple(value.shape)}, which are no rows of "
                            f"{tuple(leaf.shape)}"
                        )
                    value = leaf.detach().clone().index_copy_(axis, rows, value)
            state[path] = value
        try:
            restore(env, state)
        except (ValueError, RuntimeError, TypeError) as error:
            raise ReplayError(f"its state does not fit: {error}") from error

    @torch.no_grad()
    def replay(self, env: Env) -> NonFiniteValue | None:
        """Returns the first non-finite number in the same environments when they take the same
        steps, with those of their other lanes; None if there is none.

        Args:
            env: another copy of the environment, not stepped yet.

        Raises:
            ReplayError: naming what differs between the environments.
        """
        if env.n_envs != self.header["n_envs"]:
            raise ReplayError(
                f"it was written with env.n_envs={self.header['n_envs']}, and this environment has "
                f"{env.n_envs}"
            )
        stored = torch.zeros(n_lanes(env), dtype=torch.bool, device=env.device)
        envs = torch.tensor(self.header["envs"], device=env.device)
        stored[rows_of(envs, optional(env, "n_agents"))] = True
        rollout = Rollout(
            self.header["n_steps"],
            int(stored.sum()),
            env.obs_space,
            env.action_space,
            arrdict(),
            env.device,
            optional(env, "privileged_space") if self.header["privileged"] else None,
            learners=stored,
            values=False,
        )
        for path, leaf in spaces.leaves(rollout.actions, "actions").items():
            if path not in self.arrays or self.arrays[path].shape != leaf.shape:
                raise ReplayError(f"its {path} do not fit the environment's action_space")
            leaf.copy_(self.arrays[path])
        rollout.store_world(0, rollout.select_lanes(env.reset()))
        env.step(_decision(rollout, 0))  # may make tensors that `reset` does not
        self.restore(env)
        for t in range(rollout.n_steps):
            world = rollout.select_lanes(env.step(_decision(rollout, t)))
            rollout.store_transition(t, world)
            rollout.store_world(t + 1, world)
        check = NonFiniteCheck(torch.device(env.device))
        check.record[0] = self.header["rollout"] - 1
        lanes = self.header["lanes"]  # the others are opponents'
        columns = [i for i, lane in enumerate(stored.nonzero()[:, 0].tolist()) if lane in lanes]
        floats = {name: leaf[:, columns] for name, leaf in rollout.floats().items()}
        check(floats)
        value, _ = check.read(floats)
        return value and value.in_env(lanes, optional(env, "n_agents"))


def _decision(rollout, t):
    actions = mapping(lambda leaf: leaf[t])(rollout.actions)
    return arrdict(actions=rollout.scatter_actions(actions))


def env_axis(leaf, env):
    """Returns the first axis of environments or lanes of a tensor, or None if all share it."""
    sizes = env.n_envs, n_lanes(env)
    return next((i for i, size in enumerate(leaf.shape) if size in sizes), None)


def rows_of(envs, n_per_env):
    """Returns the rows of some environments, `n_per_env` each."""
    return (envs[:, None] * n_per_env + torch.arange(n_per_env, device=envs.device)).flatten()
