"""Rollouts from a dataset: whole episodes one after the other in each lane, as an environment has
them. T steps, B lanes, R rows of all episodes.
"""

import concurrent.futures
from collections.abc import Mapping

import numpy as np
import torch

from megastep import spaces
from megastep.agents.generator import stream_seed
from megastep.agents.storage.rollout import Rollout, copy_tree
from megastep.agents.types import StateDict
from megastep.data import Episodes, episodes

#: Threads that read files; more would wait for Python's lock.
READERS = 4


class DatasetCollector:
    """Fills a rollout with the next T steps of episodes in B lanes. Each lane goes on with a new
    episode where one ends; all are taken once, in a random order, before one is taken again.
    Everything is on the device; nothing synchronises.

    Args:
        dataset: the episodes.
        rollout: overwritten and returned by every call. Its hidden state is the learner's to keep.
        gamma: discount of `returns`.
        seed: of the order.

    Attributes:
        returns: (T, B) float32, the discounted rewards from each action to the episode's end.

    Raises:
        ValueError: the dataset has no episode.
    """

    def __init__(self, dataset: Episodes, rollout: Rollout, gamma: float, seed: int):
        self.rollout, self.codec, device = rollout, dataset.codec, rollout.reward.device
        columns, lengths = _read(dataset)
        columns["returns"] = _returns(columns["reward"], lengths, gamma)
        self.columns = {name: torch.from_numpy(c).to(device) for name, c in columns.items()}
        firsts = np.cumsum([0, *lengths])
        self.firsts = torch.from_numpy(firsts[:-1]).to(device)
        self.lasts = torch.from_numpy(firsts[1:] - 1).to(device)
        self.columns["starts"] = torch.zeros(int(firsts[-1]), dtype=torch.bool, device=device)
        self.columns["starts"][self.firsts] = True
        generator = torch.Generator().manual_seed(stream_seed(seed, "dataset"))
        self.order = torch.randperm(len(lengths), generator=generator).to(device)
        lanes = torch.arange(rollout.n_lanes, device=device)
        chosen = self.order[lanes % len(self.order)]
        self.row, self.last = self.firsts[chosen], self.lasts[chosen]
        self.n_taken = torch.full((), rollout.n_lanes, device=device)
        self.returns = torch.zeros_like(rollout.reward)
        masks = {name: rows for name, rows in self.columns.items() if name.startswith("mask")}
        if masks:
            shape = rollout.n_steps + 1, rollout.n_lanes
            ones = {k: v.new_ones(*shape, *torch.atleast_2d(v[0]).shape) for k, v in masks.items()}
            rollout.mask = spaces.nested(ones)["mask"]

    @torch.no_grad()
    def __call__(self) -> Rollout:
        rollout, rows = self.rollout, [self.row]
        for _ in range(rollout.n_steps):
            is_over = self.row == self.last
            numbers = self.n_taken + is_over.cumsum(0) - 1
            chosen = self.order[numbers % len(self.order)]
            self.row = torch.where(is_over, self.firsts[chosen], self.row + 1)
            self.last = torch.where(is_over, self.lasts[chosen], self.last)
            self.n_taken = self.n_taken + is_over.sum()
            rows.append(self.row)
        index = torch.stack(rows)
        leaves = spaces.leaves({"obs": rollout.obs, "actions": rollout.actions})
        for path, name in self.codec.names.items():
            if path.startswith("obs"):
                found = self.codec.decode(path, self.columns[name][index], n_axes=2)
            else:  # a row has the action that led there
                found = self.columns[name][index[1:]]
            leaves[path].copy_(found)
        for name in episodes.OUTCOMES:
            getattr(rollout, name).copy_(self.columns[name][index[1:]])
        rollout.starts.copy_(self.columns["starts"][index])
        self.returns.copy_(self.columns["returns"][index[:-1]])
        if rollout.mask is not None:
            for name, leaf in spaces.leaves(rollout.mask, "mask").items():
                leaf.copy_(self.columns[name][index].view_as(leaf))
        return rollout

    def state_dict(self) -> StateDict:
        """Returns where each lane is, and its hidden state."""
        names = "row", "last", "n_taken"
        return {n: getattr(self, n).clone() for n in names} | {"state": self.rollout.state}

    def load_state_dict(self, state: StateDict) -> None:
        """Continues from a `state_dict`, from any device."""
        copy_tree(self.rollout.state, state["state"])
        for name in "row", "last", "n_taken":
            setattr(self, name, state[name].to(self.row.device))


def _read(dataset) -> tuple[dict[str, np.ndarray], list[int]]:
    """Returns what a learner needs of all episodes, (R, ...) each, and the rows of each episode."""
    if not len(dataset):
        raise ValueError(f"{dataset.folder} has no episode")
    names = {*dataset.codec.names.values(), *episodes.OUTCOMES}

    def read(path) -> Mapping[str, np.ndarray]:
        arrays = episodes.read(path)
        return {k: v for k, v in arrays.items() if k in names or k.startswith("mask")}

    with concurrent.futures.ThreadPoolExecutor(READERS) as pool:
        parts = [*pool.map(read, dataset.files)]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in [*parts[0]]}
    for path, name in dataset.codec.names.items():
        if path.startswith("actions"):
            columns[name] = dataset.codec.decode(path, torch.from_numpy(columns[name])).numpy()
    return columns, [len(part["reward"]) for part in parts]


def _returns(reward, lengths, gamma) -> np.ndarray:
    """Returns the discounted sum of the rewards that follow each row of an episode, (R,)."""
    found, lengths = np.zeros_like(reward), np.array(lengths)
    firsts = lengths.cumsum() - lengths
    for t in reversed(range(lengths.max() - 1)):
        rows = firsts[lengths > t + 1] + t
        found[rows] = reward[rows + 1] + gamma * found[rows + 1]
    return found
