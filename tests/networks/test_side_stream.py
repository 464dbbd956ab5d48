"""An LSTM's sequence on a side stream, and what overlaps with it."""

import contextlib
import functools

import pytest
import torch
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from megastep import engine, spaces
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.networks import lstm, side_stream
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.rollout import Rollout
from tests.helpers.made_up import MOVES, OBS, weights


def test_work_is_done_by_the_first_sequence():
    with side_stream.overlap("work"):
        assert [side_stream.take_work() for _ in range(2)] == ["work", None]
    with side_stream.overlap("work"):
        pass
    assert side_stream.take_work() is None


class Marked(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return 2 * x

    @staticmethod
    def backward(ctx, d):
        return side_stream.mark_ready(2 * d)


class Reader(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, found):
        ctx.found = found
        return x.clone()

    @staticmethod
    def backward(ctx, d):
        ctx.found.append(side_stream.ready_event(d))
        return d, None


@pytest.mark.parametrize("other", ["none", "before", "after"])
def test_a_gradient_is_ready_if_nothing_is_added_to_it(monkeypatch, other):
    monkeypatch.setattr(side_stream, "fork_point", lambda device: "an event")
    found = []
    y = Reader.apply(torch.ones(3, requires_grad=True), found)
    terms = [Marked.apply(y), *[y.square()] * (other != "none")]
    sum(term.sum() for term in (terms if other == "after" else terms[::-1])).backward()
    assert found == ["an event" if other == "none" else None]


def outputs(layers, x, reset):
    for layer in layers:
        x, _ = layer(x, reset, layer.initial(x.shape[1], x.device), is_residual=True)
    return x


def with_hooks(call):
    """As `torch.utils.checkpoint` does it."""
    with torch.autograd.graph.save_on_cpu():
        return call()


def in_backward(call):
    """As functions that compute a part of a network again do it."""
    x, results = torch.ones((), requires_grad=True), []
    x.register_hook(torch.enable_grad()(lambda _: results.append(call())))
    x.backward()
    return results[0]


@pytest.mark.parametrize("way", [None, with_hooks, in_backward])
def test_sequences_of_lower_layers_wait_for_gradients_alone(monkeypatch, way):
    """And for what is computed or copied again before they run."""
    waited, events = [], [object() for _ in range(6)]
    points, nothing = iter(events), contextlib.nullcontext()
    monkeypatch.setattr(side_stream, "fork_point", lambda device: next(points))
    monkeypatch.setattr(side_stream, "fork", lambda after: waited.append(after) or nothing)
    reset, x = torch.zeros(2, 5, dtype=torch.bool), torch.randn(2, 5, 16, requires_grad=True)
    call = functools.partial(outputs, [lstm.LSTM(16) for _ in range(3)], x, reset)
    y = (way(call) if way else call()).sum()
    y.backward(retain_graph=True)
    assert waited == [None, *([None] * 2 if way else events[:2])]
    y.backward()  # the first one may still read the memory for gradients
    assert waited[3:] == [None] * 3


class Nothing(TorchDispatchMode):
    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        raise AssertionError(f"{function} may allocate memory that is still read")


def test_a_sequence_allocates_nothing_on_its_stream(monkeypatch):
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: Nothing())
    monkeypatch.setattr(lstm, "launch", lambda *_, **__: None)
    monkeypatch.setattr(lstm, "sum_rows", lambda rows: rows.sum(0))
    shapes = (512, 128), (512,), (512, 128), (50, 128), (50, 128)
    leaves = [torch.zeros(shape, requires_grad=True) for shape in shapes]
    x, reset = torch.zeros(2, 50, 128).bfloat16(), torch.zeros(2, 50, dtype=torch.bool)
    y, *_ = lstm._Sequence.apply(True, x, *leaves[:3], reset, *leaves[3:], True)
    gradients = [torch.autograd.grad(y.sum(), leaves, retain_graph=True) for _ in range(2)]
    assert len({x.data_ptr() for x in (*gradients[0], *gradients[1])}) == 2 * len(leaves)


@pytest.mark.cuda
@pytest.mark.parametrize("width", lstm.WIDTHS)
def test_gradients_of_layers_are_the_same_on_one_stream(width):
    torch.manual_seed(1)
    layers = nn.ModuleList(lstm.LSTM(width) for _ in range(4)).cuda()
    x, d = torch.randn(2, 16, 4096, width, device="cuda").bfloat16()
    leaves, reset = [x.requires_grad_(), *layers.parameters()], x[..., 0] > 1

    def gradients():
        with torch.autocast("cuda", torch.bfloat16):
            y = outputs(layers, x, reset)
        torch.cuda._sleep(10**7)  # so that all is launched before any of it runs
        return torch.autograd.grad(y, leaves, d)

    with engine.without_early_starts():
        expected = gradients()
    for _ in range(5):
        assert all(map(torch.equal, gradients(), expected))


class Stream:
    """Stands for one of a GPU."""

    def __init__(self, device="cuda", priority=0):
        self.device, self.waited_for = device, []

    def wait_event(self, event):
        self.waited_for.append(event)

    wait_stream = wait_event


def test_each_stream_has_a_side_stream_of_its_own(monkeypatch):
    """Memory freed on it would go to another stream, which does not wait for the first."""
    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    streams, event = [Stream(), Stream()], Stream()
    for current in (*streams, *streams):
        monkeypatch.setattr(torch.cuda, "current_stream", lambda device, stream=current: stream)
        with contextlib.suppress(MemoryError), side_stream.fork(event):
            raise MemoryError  # the side stream may still use what is freed now
    sides = [stream.waited_for for stream in streams]
    assert [len(set(each)) for each in sides] == [1, 1] and sides[0][0] is not sides[1][0]
    assert all(each[0].waited_for == [event] * 2 for each in sides)


@pytest.mark.cuda
@pytest.mark.parametrize("layers, width", [(1, 256), (3, 256), (3, 128)])
def test_an_update_is_the_same_on_one_stream(layers, width):
    """Where streams share a GPU there is no side stream."""
    privileged, n_lanes, ends = spaces.MultiVector(1, 12), 4096, []
    for is_shared in (True, False):
        torch.manual_seed(1)
        policy = Policy(OBS, MOVES, privileged, width=width, layers=layers).cuda()
        state = policy.initial(n_lanes)
        rollout = Rollout(16, n_lanes, OBS, MOVES, state, "cuda", privileged)
        for leaf in (rollout.obs, rollout.privileged, rollout.reward):
            leaf.normal_()
        learner = PPO(policy, n_minibatches=2, lr=1e-2, graph=True)
        for _ in range(6):
            with engine.without_early_starts() if is_shared else contextlib.nullcontext():
                learner.update(rollout)
        ends.append(weights(policy))
    assert torch.equal(*ends) and ends[0].isfinite().all()
