"""Records rollouts, so that a non-finite number of an environment can be replayed.

A `RolloutRecorder` keeps the environment's state at the start of a rollout, and the rollout's
actions, until it is known whether the rollout is finite. It writes those of the bad environments,
for `nonfinite_replay`.

N environments of A agents, B = N A lanes, T steps.
"""

import io
import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import torch

from megastep import spaces
from megastep.agents.algorithms.nonfinite import NonFiniteCheck, NonFiniteValue
from megastep.agents.runs.atomic_files import write_atomically
from megastep.agents.storage.collector import Collector
from megastep.agents.storage.copies import copy_all
from megastep.agents.storage.rollout import Rollout
from megastep.agents.training.nonfinite_replay import FORMAT, env_axis, rows_of
from megastep.capture import state_tree
from megastep.types import Env, n_lanes, optional

#: Tensors that all environments share are kept up to this size. Larger ones, such as floor plans,
#: do not change, and are made again from the configuration.
MAX_SHARED_BYTES = 2**20
#: What a run without a recorder says in place of a command.
NOT_RECORDED = (
    "Nothing was recorded to see it again: recording does not work with learner.lag, with a "
    "learner's own collector, in environments that step on the host, or for rollouts before a "
    "resume"
)


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
        device, kept = self.check.record.device, {}
        for path, leaf in state_tree(self.env).items():
            if isinstance(leaf, torch.Generator):
                host[path] = leaf.get_state()
            elif self._axis(leaf) is not None or leaf.nbytes <= MAX_SHARED_BYTES:
                if leaf.device == device:
                    kept[path] = leaf
                else:
                    host[path] = leaf.clone()
        _keep(self.state, kept, self.check.found)

    @torch.no_grad()
    def end(self, rollout: Rollout) -> None:
        """Copies the actions. Call after each rollout, before it is checked."""
        actions = self.played or spaces.leaves(rollout.actions, "actions")
        _keep(self.actions, actions, self.check.found)

    def watch(self, opponents: Any, n_steps: int) -> None:
        """Has opponents report the actions of all lanes, as rollouts of T steps store some only."""
        for path, space in spaces.leaves(self.env.action_space, "actions").items():
            shape = n_steps, n_lanes(self.env), *space.shape
            dtype = getattr(space, "dtype", torch.int64)
            self.played[path] = torch.zeros(shape, dtype=dtype, device=self.env.device)
        opponents.on_actions = self._play

    def _play(self, actions):
        for path, leaf in spaces.leaves(actions, "actions").items():
            self.played[path][self.n_played].copy_(leaf)
        # a CUDA graph is captured over whole rollouts, and must leave this number as it was
        self.n_played = (self.n_played + 1) % len(self.played[path])

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
            format=FORMAT,
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
        return env_axis(leaf, self.env)

    def _rows(self, envs, size):
        return rows_of(envs, size // self.env.n_envs)


def _keep(copies, tensors, found):
    """Copies tensors by path, unless a non-finite number was found: then the last copies stay."""
    pairs = []
    for path, leaf in tensors.items():
        copy = copies.get(path)
        if copy is None or (copy.shape, copy.dtype) != (leaf.shape, leaf.dtype):
            copies[path] = leaf.clone()
        else:
            pairs.append((copy, leaf))
    copy_all(pairs, condition=~found)


def make_recorder(
    env: Env, opponents: Any, check: NonFiniteCheck | None, collect: Any
) -> RolloutRecorder | None:
    """Returns a recorder of what `collect` collects, or None where steps cannot be repeated: an
    async collector starts rollouts before the earlier ones are checked, a learner's own collector
    may do anything, and what steps on the host keeps its state elsewhere than in tensors.

    Args:
        env: the environment.
        opponents: `env`, if it is an `Opponents`.
    """
    if not isinstance(collect, Collector) or check is None or not optional(env, "capturable"):
        return None
    if opponents is None:
        return RolloutRecorder(env, check)
    recorder = RolloutRecorder(env.env, check)
    recorder.watch(opponents, collect.rollout.n_steps)
    return recorder


def command(path: Path) -> str:
    """Returns the command that replays a file."""
    return f"python -m megastep replay {shlex.quote(str(path))}"


def _as_array(leaf):
    leaf = leaf.detach().cpu()
    return (leaf.float() if leaf.dtype == torch.bfloat16 else leaf).numpy()
