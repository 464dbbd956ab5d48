"""Files that replay a non-finite number of an environment.

A `RolloutRecorder` keeps the environment's state at the start of a rollout, and the rollout's
actions, until it is known whether the rollout is finite. It writes those of the bad environments,
and `replay` takes the same steps in another copy of the environment.

N environments of A agents, B = N A lanes, T steps.
"""

import io
import json
import shlex
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from megastep import spaces
from megastep.agents.algorithms.nonfinite import NonFiniteCheck, NonFiniteValue
from megastep.agents.storage.collector import Collector
from megastep.agents.storage.rollout import Rollout
from megastep.agents.training.atomic_files import write_atomically
from megastep.arrdict import arrdict
from megastep.capture import restore, state_tree
from megastep.dotdict import mapping
from megastep.types import Env, n_lanes, optional

#: Tensors that all environments share are kept up to this size. Larger ones, such as floor plans,
#: do not change, and are made again from the configuration.
MAX_SHARED_BYTES = 2**20
#: What a run without a recorder says in place of a command.
NOT_RECORDED = (
    "Nothing was recorded to see it again: steps are not with learner.lag, with a learner's own "
    "collector, and before a resume"
)
_FORMAT = 1


class ReplayError(ValueError):
    """A file cannot be replayed. The message names what does not fit."""


class RolloutRecorder:
    """Keeps the start and the actions of the latest rollout, and of the first non-finite one until
    it is written. Only the first `start` and `write` synchronise.

    A copy is one pass over the environment's state per rollout: in the built-in environments 0.1
    to 1.5 kB per environment.

    Args:
        env: the environment that the rollouts are collected in, without opponents around it.
        check: the learner's check of the same rollouts.

    Attributes:
        played: the actions of all lanes by path, (T, B, ...), of a rollout with opponents.
    """

    def __init__(self, env: Env, check: NonFiniteCheck):
        self.env, self.check = env, check
        self.state, self.actions, self.played, self.n_played = {}, {}, {}, 0
        self.on_host = {}  # rollout -> what the host holds of the state: generators, tensors
        self.first_rollout = self.n_rollouts = None

    @torch.no_grad()
    def start(self) -> None:
        """Copies the state. Call before each rollout, from the thread that collects it."""
        if self.n_rollouts is None:
            self.n_rollouts = int(self.check.record[0])
            self.first_rollout = self.n_rollouts + 1
        self.n_rollouts += 1
        self.n_played = 0
        host = self.on_host[self.n_rollouts] = {}
        device = self.check.record.device
        for path, leaf in state_tree(self.env).items():
            if isinstance(leaf, torch.Generator):
                host[path] = leaf.get_state()
            elif self._axis(leaf) is not None or leaf.nbytes <= MAX_SHARED_BYTES:
                if leaf.device == device:
                    self._keep(self.state, path, leaf)
                else:
                    host[path] = leaf.clone()

    @torch.no_grad()
    def end(self, rollout: Rollout) -> None:
        """Copies the actions. Call after each rollout, before it is checked."""
        actions = self.played or spaces.leaves(rollout.actions, "actions")
        for path, leaf in actions.items():
            self._keep(self.actions, path, leaf)

    def watch(self, opponents: Any, n_steps: int) -> None:
        """Has opponents report the actions of all lanes, as rollouts of T steps store some only."""
        for path, space in spaces.leaves(self.env.action_space, "actions").items():
            shape = n_steps, n_lanes(self.env), *space.shape
            self.played[path] = torch.zeros(shape, dtype=torch.int64, device=self.env.device)
        opponents.on_actions = self._play

    def _play(self, actions):
        for path, leaf in spaces.leaves(actions, "actions").items():
            self.played[path][self.n_played].copy_(leaf)
        # a CUDA graph is captured over whole rollouts, and must leave this number as it was
        self.n_played = (self.n_played + 1) % len(self.played[path])

    def _keep(self, copies, path, leaf):
        copy = copies.get(path)
        if copy is None or (copy.shape, copy.dtype) != (leaf.shape, leaf.dtype):
            copies[path] = leaf.clone()
        else:
            torch.where(self.check.found, copy, leaf, out=copy)

    def has(self, value: NonFiniteValue) -> bool:
        """Returns False if the number is of a rollout before the first `start`, of a resumed run.

        Args:
            value: of `check.read`.
        """
        return self.first_rollout is not None and value.rollout >= self.first_rollout

    def close(self) -> None:
        """Drops the copies. A CUDA graph may still write into `played`."""
        self.state, self.actions, self.on_host = {}, {}, {}

    def forget(self) -> None:
        """Drops what the host kept of rollouts. Call after each `check.read`."""
        self.on_host.clear()

    def write(self, path: Path, value: NonFiniteValue, rollout: Rollout) -> None:
        """Writes the start and the actions of the environments of a non-finite number.

        Args:
            path: the file, an .npz.
            value: the number, with lanes of the environment, as `check.read` returned it after the
                latest rollout.
            rollout: any rollout, whose shape is used.

        Raises:
            OSError: the disk is full or not writable.
        """
        envs = sorted({one.env for one in (value, *value.others)})
        rows = torch.tensor(envs, device=rollout.reward.device)
        lanes = self._rows(rows, n_lanes(self.env))
        arrays = {k: leaf.index_select(1, lanes) for k, leaf in self.actions.items()}
        for name, leaf in (self.state | self.on_host.get(value.rollout, {})).items():
            axis = self._axis(leaf)
            if axis is not None:
                index = self._rows(rows, leaf.shape[axis]).to(leaf.device)
                leaf = leaf.index_select(axis, index)
            arrays[f"state{name}"] = leaf
        is_checked = torch.ones(n_lanes(self.env), dtype=torch.bool)
        is_checked = is_checked if rollout.learners is None else rollout.learners.cpu()
        header = dict(
            format=_FORMAT,
            place=(value.name, value.lane, value.step),
            rollout=value.rollout,
            device=self.check.record.device.type,
            envs=envs,
            lanes=[lane for lane in lanes.tolist() if is_checked[lane]],
            n_envs=self.env.n_envs,
            n_steps=rollout.n_steps,
            privileged=rollout.privileged is not None,
        )
        file = io.BytesIO()
        arrays = {name: _as_array(leaf) for name, leaf in arrays.items()}
        np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)
        write_atomically(path, file.getvalue())

    def _axis(self, leaf):
        return _env_axis(leaf, self.env)

    def _rows(self, envs, size):
        return _rows(envs, size // self.env.n_envs)


def make_recorder(
    env: Env, opponents: Any, check: NonFiniteCheck | None, collect: Any
) -> RolloutRecorder | None:
    """Returns a recorder of what `collect` collects, or None where steps cannot be repeated: an
    async collector starts rollouts before the earlier ones are checked, and a learner's own
    collector may do anything.

    Args:
        env: the environment.
        opponents: `env`, if it is an `Opponents`.
    """
    if not isinstance(collect, Collector) or check is None:
        return None
    if opponents is None:
        return RolloutRecorder(env, check)
    recorder = RolloutRecorder(env.env, check)
    recorder.watch(opponents, collect.rollout.n_steps)
    return recorder


def command(path: Path) -> str:
    """Returns the command that replays a file."""
    return f"python -m megastep replay {shlex.quote(str(path))}"


class Recording:
    """A file of a `RolloutRecorder`.

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
            if self.header["format"] != _FORMAT:
                raise ReplayError(
                    f"{path} has format {self.header['format']}, and this megastep reads format "
                    f"{_FORMAT}: use the megastep that wrote it"
                )
            self.place, self.device = tuple(self.header["place"]), self.header["device"]
        except (zipfile.BadZipFile, ValueError, KeyError, TypeError, EOFError) as error:
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
                if (axis := _env_axis(leaf, env)) is not None:
                    envs = torch.tensor(self.header["envs"], device=leaf.device)
                    rows = _rows(envs, leaf.shape[axis] // env.n_envs)
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
        stored[_rows(envs, optional(env, "n_agents"))] = True
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


def _env_axis(leaf, env):
    """Returns the first axis of environments or lanes of a tensor, or None if all share it."""
    sizes = env.n_envs, n_lanes(env)
    return next((i for i, size in enumerate(leaf.shape) if size in sizes), None)


def _rows(envs, n_per_env):
    """Returns the rows of some environments, `n_per_env` each."""
    return (envs[:, None] * n_per_env + torch.arange(n_per_env, device=envs.device)).flatten()


def _as_array(leaf):
    leaf = leaf.detach().cpu()
    return (leaf.float() if leaf.dtype == torch.bfloat16 else leaf).numpy()
