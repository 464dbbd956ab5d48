"""Lanes whose steps and resets are CUDA graphs show what plain ones do, in any order of calls. The
graphs are of PyTorch operations on a CPU; test_adapters.py has real ones.
"""

import pytest
import torch
from torch.utils._pytree import tree_leaves

from megastep import adapters, capture, contract, engine, spaces
from megastep.adapters import lane_steps
from megastep.adapters.lane_steps import Lanes
from megastep.arrdict import arrdict
from megastep.kernels.build import copies
from tests.helpers import graphs_on_cpu

N = 5


class Sums:
    """Adds actions to a number that its counter of draws gives. Lane i ends after 2 + i steps."""

    n_envs, device = N, torch.device("cpu")
    obs_space, action_space = spaces.MultiVector(1, 2), spaces.MultiDiscrete(1, 3)

    def __init__(self):
        self.counts, self.ages = torch.zeros(N, dtype=torch.int32), torch.zeros(N)
        self.ended, self.sums = torch.zeros(N, dtype=torch.bool), torch.zeros(N)
        self.resets = engine.Resets()

    def reset(self, seed=None, mask=None):
        return self.resets(self, self.begin, seed, mask)

    def begin(self, mask):
        self.ended.copy_(mask)
        return self.world(torch.ones(N, 1))

    def step(self, decision):
        return self.resets.keep(self.world(decision.actions))

    def world(self, actions):
        begins = self.ended.clone()
        self.counts.add_(begins)
        self.ages.add_(1).masked_fill_(begins, 0)
        start = (self.counts % 977).float()
        self.sums.copy_(torch.where(begins, start, self.sums + actions[:, 0]))
        self.ended.copy_(self.ages >= 2 + torch.arange(N))
        return arrdict(
            obs=torch.stack([self.sums, self.ages], 1)[:, None],
            reward=(~begins).float(),
            reset=begins,
            terminal=torch.zeros_like(begins),
            truncated=self.ended.clone(),
        )


def recorded(same_step, monkeypatch):
    """Lanes that step by graphs, as on a GPU."""
    graphs_on_cpu.install(monkeypatch)
    lanes = Lanes(Sums(), same_step)
    lanes._on_gpu = True
    return lanes


def test_the_environment_keeps_the_contract():
    contract.rollout(Sums(), 20)


@pytest.mark.parametrize("same_step", (False, True))
def test_any_order_of_calls_shows_what_plain_lanes_do(same_step, monkeypatch):
    plain, graphs = Lanes(Sums(), same_step), recorded(same_step, monkeypatch)
    generator, kinds = torch.Generator().manual_seed(1), torch.tensor([4.0, 2, 1, 1, 1])
    plain.reset(3)
    graphs.reset(3)
    for _ in range(60):
        kind = int(torch.multinomial(kinds, 1, generator=generator))
        mask = torch.rand(N, generator=generator) < 0.4
        actions = torch.randint(3, (N,), generator=generator)
        calls = [
            lambda lanes, a=actions: lanes.step(a),
            lambda lanes, m=mask: lanes.reset(mask=m),
            lambda lanes, m=mask: lanes.reset([9, 8, 7, 6, 5], m),
            lambda lanes: lanes.reset(),
            lambda lanes: lanes.reset(4),
        ]
        expected, shown = (calls[kind](lanes) for lanes in (plain, graphs))
        pairs = zip(expected, shown) if kind == 0 else [(expected, shown)]
        assert all(contract.same({"": one}, {"": other}) for one, other in pairs)
    recordings = [graphs._step, *graphs._resets.values()]  # a reset with seeds and one without
    assert len(recordings) == 3 and all(isinstance(one, capture.Graph) for one in recordings)


@pytest.mark.parametrize("same_step", (False, True))
def test_copies_of_a_graph_stay_as_they_were(same_step, monkeypatch, cuda_on_cpu):
    """In blocks of three rows, and after a step that was interrupted behind the graph."""
    graphs_on_cpu.install(monkeypatch)
    monkeypatch.setattr(lane_steps, "BLOCK_ROWS", 3)

    def launch(*args, **fields):
        if graphs_on_cpu.GraphOnCpu.is_recording:
            graphs_on_cpu.GraphOnCpu.recorded.append((cuda_on_cpu, args, fields, None))
        else:
            cuda_on_cpu(*args, **fields)

    monkeypatch.setattr(copies, "launch", launch)
    mode = "same_step" if same_step else "next_step"
    plain, graphs = (adapters.VectorEnv(Sums(), mode, to_numpy=False) for _ in range(2))
    for name, leaf in vars(graphs.env).items():
        if isinstance(leaf, torch.Tensor):
            setattr(graphs.env, name, cuda_on_cpu.tensor(leaf))
    graphs.lanes._on_gpu, kept = True, []
    plain.reset(seed=3)
    graphs.reset(seed=3)
    for i in range(20):
        actions = torch.arange(N) % 3
        expected = plain.step(actions)
        shown = graphs.step(actions)
        assert graphs.lanes.copies and isinstance(graphs.lanes._step, capture.Graph)
        kept.append((expected, shown))
        if i == 10:
            plain.step(actions)
            graphs.lanes.step(actions)
    for expected, shown in kept:
        pairs = zip(*map(tree_leaves, (expected, shown)), strict=True)
        assert all(torch.equal(one, other) for one, other in pairs)
