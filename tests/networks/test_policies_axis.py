"""Kernels with weights or statistics take several policies: each gets, bit for bit, what it gets
alone.

Functions run for each of P policies alone, and their launches are recorded. Then each launch is
repeated once for all policies, with their tensors stacked and P times as many blocks along y.
"""

import functools
import sys
from types import SimpleNamespace
from typing import NamedTuple

import pytest
import torch

from megastep.agents.algorithms.gradient_steps import GradientSteps
from megastep.agents.algorithms.kernels import LIBRARY as ALGORITHMS
from megastep.agents.algorithms.ppo_loss import Coefficients, ppo_loss
from megastep.agents.networks.kernels import (
    casts,
    conv,
    duelling,
    heads,
    layers,
    mingru_step,
    moments,
)
from megastep.agents.networks.kernels.library import LIBRARY
from megastep.agents.networks.running_norm import RunningNorm
from megastep.agents.networks.value_output import ValueOutput
from megastep.arrdict import arrdict
from megastep.kernels.build.launch import BLOCK, Blocks, launch
from megastep.spaces import MultiVector

P = 3
BF16 = torch.bfloat16
STATISTICS = 4, 5  # of two leaves of observations


def by_leaf(stacked):
    """From the order of the kernel `moments`, (2, P, n) of each leaf, to a row per policy."""
    parts = stacked.flatten().split([2 * P * n for n in STATISTICS])
    rows = [part.view(2, P, -1).transpose(0, 1).reshape(P, -1) for part in parts]
    return torch.cat(rows, 1)


#: Fields in which policies are not the first axis: (to the kernel's order, back from it).
LAYOUTS = {
    ("duelling_act", "noise"): (lambda x: x.movedim(0, 1).contiguous(), lambda x: x.movedim(1, 0)),
    ("moments", "moments"): (torch.clone, by_leaf),  # an output
}


class Launch(NamedTuple):
    """A launch of one policy. Fields are {name: value}, those of packed structs {(i, name): value},
    and tensors are copies.
    """

    library: object
    operation: str
    device: torch.device
    blocks: Blocks
    before: dict
    after: dict
    structs: str | None  # the field that has them
    packers: list


class Recorder:
    """Stands in for `launch` and records it.

    Args:
        run: what launches.
    """

    def __init__(self, run):
        self.run, self.launches, self.packed, self.known = run, [], [], {}

    def pack(self, packer, /, **fields):
        self.packed.append((packer, fields))
        return packer(fields)

    def __call__(self, library, operation, device, shape, /, **fields):
        packed, self.packed = self.packed, []
        leaves = {name: value for name, value in fields.items() if not isinstance(value, bytes)}
        structs = next((name for name in fields if name not in leaves), None)
        for i, (_, values) in enumerate(packed):
            leaves |= {(i, name): self.known.get(value, value) for name, value in values.items()}
        before = copied(leaves)
        self.run(library, operation, device, shape, **fields)
        blocks = shape if isinstance(shape, Blocks) else Blocks(-(-shape // BLOCK))
        packers = [packer for packer, _ in packed]
        case = library, operation, device, blocks, before, copied(leaves), structs, packers
        self.launches.append(Launch(*case))

    def of(self, function, i, operations):
        """Returns the launches of some operations for policy i."""
        self.launches = []
        function(i)
        assert operations <= {one.operation for one in self.launches}
        return [one for one in self.launches if one.operation in operations]

    def check_together(self, launches):
        """Repeats one launch of each policy as one of all."""
        library, operation, device, blocks, before, _, structs, packers = launches[0]
        stacked = {}
        for key, value in before.items():
            values = [one.before[key] for one in launches]
            if torch.is_tensor(value):
                to_kernel, _ = LAYOUTS.get((operation, key), (torch.clone, None))
                stacked[key] = to_kernel(torch.stack(values))
            else:
                assert values == P * [value], key
                stacked[key] = value
        fields = {key: value for key, value in stacked.items() if isinstance(key, str)}
        if structs:
            rows = [{} for _ in packers]
            for key in stacked.keys() - fields.keys():
                rows[key[0]][key[1]] = stacked[key]
            fields[structs] = b"".join(packer(row) for packer, row in zip(packers, rows))
        self.run(library, operation, device, blocks._replace(y=P * blocks.y), **fields)
        for key in stacked:
            if torch.is_tensor(stacked[key]):
                _, back = LAYOUTS.get((operation, key), (None, torch.clone))
                alone = torch.stack([one.after[key] for one in launches])
                torch.testing.assert_close(
                    back(stacked[key]).view_as(alone), alone, rtol=0, atol=0, equal_nan=True
                )


def copied(leaves):
    return {k: v.detach().clone() if torch.is_tensor(v) else v for k, v in leaves.items()}


@pytest.fixture(
    params=[
        pytest.param("cuda", marks=pytest.mark.cuda),
        pytest.param("cpu", marks=pytest.mark.slow),
    ]
)
def recorder(request, monkeypatch):
    """Records launches on a GPU, or on a CPU with kernels compiled for it."""
    run = launch
    if request.param == "cpu":
        run = request.getfixturevalue("cuda_on_cpu")
        run.install(monkeypatch)
        sizes = dict.fromkeys(("block_optin", "multiprocessor"), 2**20)
        sizes = {f"shared_memory_per_{name}": size for name, size in sizes.items()}
        gpu = SimpleNamespace(major=9, multi_processor_count=2, **sizes)
        monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: gpu)
        monkeypatch.setattr(torch.Tensor, "is_cuda", True)
    recorder = Recorder(run)
    for path, module in list(sys.modules.items()):
        if path.startswith("megastep.") and vars(module).get("launch") is run:
            monkeypatch.setattr(module, "launch", recorder)
    for library in (LIBRARY, ALGORITHMS):
        packers = library.packers.items()
        params = {name: functools.partial(recorder.pack, packer) for name, packer in packers}
        monkeypatch.setattr(library, "params", SimpleNamespace(**params))
    torch.manual_seed(0)
    with torch.device(request.param):
        yield recorder


# ---- The cases: each returns a function of a policy's number ----


def randn(*shape):
    return torch.randn(P, *shape)


def at(i, tensors):
    return [tensor[i] for tensor in tensors]


def intake():
    leaves = [randn(4, 9, 16).half(), randn(4, 9, 5)]
    means, scales = [randn(4), randn(5)], [randn(4).abs() + 0.1, randn(5).abs() + 0.1]
    lanes = torch.stack([torch.randperm(9)[:7] for _ in range(P)])
    return lambda i: layers.normalise(at(i, leaves), at(i, means), at(i, scales), 24, lanes[i])


def convolutions(n_channels, n_columns):
    rows = randn(100, n_channels, n_columns).to(BF16)
    if not conv.is_supported(rows[0]):
        pytest.skip("needs a GPU with clusters")
    shapes = (32, n_channels, 8), (32,), (32, 32, 4), (32,)
    weights = [randn(*shape).to(BF16) for shape in shapes]
    return lambda i: conv.conv_forward(rows[i], *at(i, weights))


def gradients_of_convolutions():
    rows = randn(50, 3, 128).to(BF16)
    if not conv.is_supported(rows[0]):
        pytest.skip("needs a GPU with clusters")
    features, d_features = randn(50, 32 * conv.n_outputs(128)).relu(), randn(50, 32 * 17)
    inputs = d_features, features, rows, randn(32, 3, 8), randn(32), randn(32, 32, 4)
    inputs = [tensor.to(BF16) for tensor in inputs]
    return lambda i: conv.conv_backward(*at(i, inputs))


def mingru(n_lanes, width):
    x, start = randn(1, n_lanes, width).to(BF16), randn(n_lanes, width)
    if not mingru_step.is_supported(x[0]):
        pytest.skip("needs a GPU with clusters")
    weight = (randn(2 * width, width) / width**0.5).to(BF16)
    inputs = x, weight, randn(2 * width).to(BF16), randn(1, n_lanes) < 0, start
    return lambda i: mingru_step.forward(*at(i, inputs), is_residual=True)


def statistics_of_observations():
    """One policy counts no lane, and another's numbers of one leaf are not finite."""
    leaves = [randn(50, 16).half(), randn(50, 5)]
    leaves[1][2, 7, 3] = torch.nan
    is_counted = torch.rand(P, 50) < 0.7
    is_counted[1], is_counted[2, 7] = False, True
    norms = [[RunningNorm(MultiVector(1, n)) for n in STATISTICS] for _ in range(P)]
    for count, of_policy in enumerate(norms, 1):
        for norm in of_policy:
            norm.mean.normal_()
            norm.scale.uniform_(0.1, 2)
            norm.count.fill_(count)
    are_added = torch.tensor([False, True, True])

    def alone(i):
        n, *parts = moments.moments(at(i, leaves), list(STATISTICS), is_counted[i])
        of_norms = [(n, *part) for part in zip(*parts, strict=True)]
        for flag in (None, are_added[i]):
            moments.add_moments(norms[i], of_norms, flag)

    return alone


def statistics_of_returns():
    """Policies have different valid returns; one does not count its own."""
    arrays, valid = [randn(5000), 3 * randn(5000) + 1], torch.rand(P, 5000) < 0.6
    outputs, is_counted = [ValueOutput(40) for _ in range(P)], torch.tensor([True, False, True])

    def alone(i):
        count, results = moments.masked_moments(at(i, arrays), valid[i])
        moments.normalise_masked(arrays[1][i], valid[i], *results[1])
        outputs[i].add((count, *results[1]), is_counted[i])

    return alone


def bias_gradient(n_columns):
    d, activated = randn(300, n_columns).to(BF16), randn(300, n_columns).to(BF16).relu()
    return lambda i: layers.bias_gradient(d[i], activated[i])


def cast():
    """Numbers after a weight are zeros."""
    weights = randn(3), randn(77, 5), randn(70_000)
    return lambda i: casts.cast(at(i, weights), 8)


def categorical_actions():
    features, noise = randn(37, 64).to(BF16), randn(37, 2, 5).abs()
    weight, bias = randn(10, 64).to(BF16), randn(10).to(BF16)
    return lambda i: layers.act(features[i], weight[i], bias[i], (2, 5), noise[i])


def policy_heads():
    sizes = heads.Sizes(11, 2, 5, 264)
    first_score, _, n_columns = sizes.starts
    inputs = randn(300, n_columns).to(BF16), randn(300, first_score).to(BF16)
    actions = torch.randint(5, (P, 300, 2))
    value, gradients = (randn(1, 264), randn(1), randn(), randn()), randn(4, 300)

    def alone(i):
        of_policy = *at(i, inputs), actions[i], heads.Value(*at(i, value)), sizes
        heads.forward(*of_policy)
        heads.backward(*of_policy, tuple(gradients[i]))

    return alone


def adam():
    """Each policy has its own step size, count of steps and norm; one takes no step."""
    all_steps, n_steps = [], (2.0, 7.0, 1.0)
    for lr in (0.1, 0.01, 0.3):
        params = [torch.nn.Parameter(torch.randn(*shape)) for shape in ((5, 3), (70_000,), (1,))]
        device = params[0].device
        steps = GradientSteps(params, lr, 0.7, device, weight_decays={params[0]: 0.1})
        for tensor in steps.optimizer.means + steps.optimizer.squares:
            tensor.normal_().abs_()
        for param in params:
            param.grad = torch.randn_like(param)
        all_steps.append(steps)

    def alone(i):
        steps = all_steps[i]
        steps.optimizer.n_steps.fill_(n_steps[i])
        steps._is_finite, steps._n_valid = torch.tensor(i < 2), torch.tensor([4, 1, 4][i])
        steps._metrics = dict(lr=steps._lr)
        assert steps.take(torch.tensor(True)) == (i < 2)

    alone.tensors = []
    for optimizer in (steps.optimizer for steps in all_steps):
        gradients = [param.grad for param in optimizer.parameters]
        alone.tensors += [*optimizer.parameters, *gradients, *optimizer.means, *optimizer.squares]
    return alone


def losses_of_ppo():
    settings, shape = Coefficients(0.2, 0.3, 0.5, 0.01, 0.7), (5, 61)
    inputs = [randn(*shape) for _ in range(4)]  # logprobs, entropies, values, errors
    batch = arrdict(
        logprobs=inputs[0] + 0.3 * randn(*shape),
        old_value=randn(*shape),
        advantages=randn(*shape),
        targets=randn(*shape),
        valid=randn(*shape) > -1,
    )
    batch["n_valid"], value_scale = batch.valid.sum((1, 2)), randn().abs() + 0.5
    return lambda i: ppo_loss(*at(i, inputs), batch[i], value_scale[i], settings)


def duelling_values():
    n_rows, width, shape = 21, 16, (2, 3)
    hidden, noise = randn(n_rows, 2 * width).relu().to(BF16), torch.rand(P, 2, n_rows, 2)
    weights, epsilon = (randn(2, width), randn(2), randn(6, width), randn(6)), torch.rand(P, n_rows)
    d_values = randn(n_rows, *shape)

    def alone(i):
        value_weight, _, advantage_weight, _ = of_policy = at(i, weights)
        duelling.act(hidden[i], of_policy, shape, noise[i], epsilon[i], 0.05)
        duelling.backward(hidden[i], value_weight, advantage_weight, d_values[i])

    return alone


@pytest.mark.parametrize(
    "case, sizes, operations",
    [
        (intake, (), {"normalise"}),
        (convolutions, (3, 128), {"conv_forward_4"}),
        (convolutions, (5, 37), {"conv_forward_8"}),
        (gradients_of_convolutions, (), {"conv_backward_4"}),
        (mingru, (37, 256), {"mingru_step_256"}),
        (mingru, (300, 64), {"mingru_step_64"}),
        (statistics_of_observations, (), {"moments", "add_moments"}),
        (
            statistics_of_returns,
            (),
            {"masked_parts", "masked_moments", "normalise_masked", "add_returns"},
        ),
        (bias_gradient, (8,), {"bias_gradient"}),
        (bias_gradient, (264,), {"bias_gradient"}),  # two blocks of columns
        (cast, (), {"cast"}),
        (categorical_actions, (), {"categorical_act_bfloat16"}),
        (policy_heads, (), {"heads_forward", "heads_backward"}),
        (adam, (), {"squared_norm", "judge", "adam"}),
        (losses_of_ppo, (), {"ppo_loss"}),
        (duelling_values, (), {"duelling_act", "duelling_backward"}),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_each_policy_gets_what_it_gets_alone(recorder, case, sizes, operations):
    alone = case(*sizes)
    recorder.known = {tensor.data_ptr(): tensor for tensor in getattr(alone, "tensors", ())}
    for launches in zip(*[recorder.of(alone, i, operations) for i in range(P)], strict=True):
        recorder.check_together(launches)
