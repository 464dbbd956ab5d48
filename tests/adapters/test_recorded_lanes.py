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

    n_envs = N
    obs_space, action_space = spaces.MultiVector(1, 2), spaces.MultiDiscrete(1, 3)

    def __init__(self, device="cpu"):
        self.device = torch.device(device)
        self.ages, self.sums = (torch.zeros(self.n_envs, device=device) for _ in range(2))
        self.counts, self.ended = self.ages.int(), self.ages.bool()
        self.limits = 2 + torch.arange(self.n_envs, device=device) % 50
        self.resets = engine.Resets()

    def reset(self, seed=None, mask=None):
        return self.resets(self, self.begin, seed, mask)

    def begin(self, mask):
        self.ended.copy_(mask)
        return self.world(torch.ones_like(self.ages)[:, None])

    def step(self, decision):
        return self.resets.keep(self.world(decision.actions))

    def world(self, actions):
        begins = self.ended.clone()
        self.counts.add_(begins)
        self.ages.add_(1).masked_fill_(begins, 0)
        start = (self.counts % 977).float()
        self.sums.copy_(torch.where(begins, start, self.sums + actions[:, 0]))
        self.ended.copy_(self.ages >= self.limits)
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


class Replaces(Sums):
    """Replaces its tensors in each step, those of a dict and of a tuple with these."""

    def __init__(self):
        super().__init__()
        self.state, self.pair = {"sums": self.sums}, (self.ages, self.counts)

    def world(self, actions):
        (self.ages, self.counts), self.ended = (leaf + 0 for leaf in self.pair), self.ended.clone()
        self.sums = self.state["sums"].clone()
        self.state, self.pair = {"sums": self.sums}, (self.ages, self.counts)
        return super().world(actions)


@pytest.mark.parametrize("kind", (Sums, Replaces))
def test_the_environment_keeps_the_contract(kind):
    contract.rollout(kind(), 20)


@pytest.mark.parametrize("same_step", (False, True))
def test_lanes_that_do_not_begin_keep_state_that_is_replaced(same_step):
    lanes, others = Lanes(Sums(), same_step), Lanes(Replaces(), same_step)
    generator = torch.Generator().manual_seed(1)
    lanes.reset(3)
    others.reset(3)
    for _ in range(40):
        actions = torch.randint(3, (N,), generator=generator)
        for one, other in zip(lanes.step(actions), others.step(actions), strict=True):
            assert contract.same({"": one}, {"": other})
        mask = torch.rand(N, generator=generator) < 0.2
        assert contract.same(lanes.reset(mask=mask), others.reset(mask=mask))


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


class ManyParts(Sums):
    """Of more parts than one launch copies, some of which begin at odd addresses."""

    n_envs = 1501

    def world(self, actions):
        rows = (self.sums * torch.arange(25, device=self.device)[:, None]).unbind()
        return arrdict(super().world(actions), metrics=arrdict(zip(map(str, range(25)), rows)))


def kernels_on_cpu(env, cuda_on_cpu, monkeypatch):
    """Has an environment count as on a GPU, and graphs repeat kernels that copy."""

    def launch(*args, **fields):
        if graphs_on_cpu.GraphOnCpu.is_recording:
            graphs_on_cpu.GraphOnCpu.recorded.append((cuda_on_cpu, args, fields, None))
        if not graphs_on_cpu.GraphOnCpu.is_recording or fields.get("row") is None:
            cuda_on_cpu(*args, **fields)

    graphs_on_cpu.install(monkeypatch)
    monkeypatch.setattr(copies, "launch", launch)
    empty = torch.empty
    pageable = lambda *sizes, pin_memory=False, **where: empty(*sizes, **where)  # noqa: E731
    monkeypatch.setattr(torch, "empty", pageable)
    for name, leaf in vars(env).items():
        if isinstance(leaf, torch.Tensor):
            setattr(env, name, cuda_on_cpu.tensor(leaf))


@pytest.mark.parametrize("device", ("cpu", pytest.param("cuda", marks=pytest.mark.cuda)))
@pytest.mark.parametrize(
    "mode, in_numpy",
    [("next_step", False), ("same_step", False), ("disabled", False), ("next_step", True)],
)
def test_copies_of_a_graph_stay_as_they_were(mode, in_numpy, device, monkeypatch, request):
    """In blocks of few rows, most of which are dropped early, beside another graph's; after steps
    that are interrupted before and behind the graph; in inference mode or not.
    """
    monkeypatch.setattr(lane_steps, "BLOCK_BYTES", 700_000)
    plain, *others = (ManyParts(where) for where in ("cpu", device, device))
    if device == "cpu":
        for env in others:
            kernels_on_cpu(env, request.getfixturevalue("cuda_on_cpu"), monkeypatch)
    plain = adapters.VectorEnv(plain, mode, to_numpy=in_numpy)
    with torch.inference_mode():
        others = [adapters.VectorEnv(env, mode, to_numpy=in_numpy) for env in others]
    vectors, kept = (plain, *others), []
    for vector in vectors:
        vector.lanes._on_gpu = vector is not plain
        vector.reset(seed=3)
    for i in range(30):
        actions = (torch.arange(plain.num_envs) + i) % 3
        if i in (10, 20):
            copied = others[0].lanes.copies
            if i == 20:
                copied._blank.clear()
            with pytest.raises(KeyboardInterrupt), monkeypatch.context() as patch:
                patch.setattr(copied, "take" if i == 10 else "_row", Interrupted(device))
                others[0].step(actions)
            if i == 10:
                plain.step(actions)
                others[1].step(actions)
        with torch.inference_mode(i % 4 == 1):
            shown = [vector.step(actions) for vector in vectors]
        if mode == "disabled":
            mask = shown[0][2] | shown[0][3]
            shown += [vector.reset(options={"reset_mask": mask}) for vector in vectors]
        kept += [shown] * (i % 3 == 0 or i in (10, 20))
    for vector in others:
        assert vector.lanes.copies and isinstance(vector.lanes._step, capture.Graph)
    for shown in kept:
        for start in range(0, len(shown), 3):
            expected, *ours = map(tree_leaves, shown[start : start + 3])
            for leaves in ours:
                pairs = zip(expected, leaves, strict=True)
                for one, other in pairs:
                    assert torch.equal(*(torch.as_tensor(leaf).cpu() for leaf in (one, other)))


class Interrupted:
    def __init__(self, device):
        self.device = torch.device(device)

    def __call__(self, *args, **kwargs):
        raise KeyboardInterrupt

    zero_ = __call__


class Late(torch.Tensor):
    """As on a GPU: a copy to the CPU that nobody waits for is not there yet."""

    def to(self, *args, non_blocking=False):
        there = self.as_subclass(torch.Tensor).to(*args, copy=True)
        return torch.full_like(there, 7) if non_blocking else there


def test_actions_on_a_gpu_are_waited_for_where_the_cpu_reads_them():
    lanes = Lanes(Sums(), to_numpy=True)
    actions = (torch.arange(N) % 3).as_subclass(Late)
    assert lanes._decision(actions).actions[:, 0].tolist() == [0, 1, 2, 0, 1]
