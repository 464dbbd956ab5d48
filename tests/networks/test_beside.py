"""Work on a second stream beside an LSTM's sequence."""

import contextlib
from typing import cast

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from megastep import engine, spaces
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.networks import beside, lstm
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.rollout import Rollout
from tests.helpers.made_up import MOVES, OBS, weights


def test_work_is_done_by_the_first_sequence():
    done = []
    with beside.meanwhile(lambda: done.append("work")):
        beside.waiting()()
        assert beside.waiting() is None
    with beside.meanwhile(lambda: done.append("other work")):
        pass
    assert done == ["work"] and beside.waiting() is None


class Marked(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return 2 * x

    @staticmethod
    def backward(ctx, d):
        return beside.mark(2 * d)


class Reader(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, found):
        ctx.found = found
        return x.clone()

    @staticmethod
    def backward(ctx, d):
        ctx.found.append(beside.ready(d))
        return d, None


@pytest.mark.parametrize("other", ["none", "before", "after"])
def test_a_gradient_is_ready_if_nothing_is_added_to_it(monkeypatch, other):
    monkeypatch.setattr(beside, "now", lambda device: "an event")
    found = []
    y = Reader.apply(torch.ones(3, requires_grad=True), found)
    terms = [Marked.apply(y), *[y.square()] * (other != "none")]
    sum(term.sum() for term in (terms if other == "after" else terms[::-1])).backward()
    assert found == ["an event" if other == "none" else None]


def chained(layers, x, reset, states):
    for layer, state in zip(layers, states, strict=True):
        x, _ = layer(x, reset, state, is_residual=True)
    return x


def test_sequences_of_lower_layers_wait_for_gradients_alone(monkeypatch):
    events, waited = [None], []

    @contextlib.contextmanager
    def second_stream(after):
        waited.append(after)
        yield None

    monkeypatch.setattr(beside, "now", lambda device: events.append(object()) or events[-1])
    monkeypatch.setattr(beside, "second_stream", second_stream)
    layers = [lstm.LSTM(16) for _ in range(3)]
    reset, x = torch.zeros(2, 5, dtype=torch.bool), torch.randn(2, 5, 16, requires_grad=True)
    y = chained(layers, x, reset, [layer.initial(5) for layer in layers]).sum()
    y.backward(retain_graph=True)
    assert waited == events[:3] and len(events) == 4
    y.backward()  # the first one may still read the memory for gradients
    assert waited[3:] == [None] * 3


class Nothing(TorchDispatchMode):
    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        raise AssertionError(f"{function} may allocate memory that is still read")


def test_a_sequence_allocates_nothing_on_its_stream(monkeypatch):
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: Nothing())
    monkeypatch.setattr(lstm, "launch", lambda *_, **__: None)
    monkeypatch.setattr(lstm, "sum_rows", lambda rows: rows.sum(0))
    x = torch.zeros(2, 50, 128, dtype=torch.bfloat16)
    weights = (torch.zeros(512, 128), torch.zeros(512), torch.zeros(512, 128))
    leaves = [leaf.requires_grad_() for leaf in (*weights, *torch.zeros(2, 50, 128).unbind())]
    reset = torch.zeros(2, 50, dtype=torch.bool)
    y, *_ = lstm._Sequence.apply(True, x, *leaves[:3], reset, *leaves[3:], True)
    gradients = [torch.autograd.grad(y.sum(), leaves, retain_graph=True) for _ in range(2)]
    assert len({x.data_ptr() for x in (*gradients[0], *gradients[1])}) == 10


@pytest.mark.cuda
@pytest.mark.parametrize("width", [128, 256])
def test_gradients_of_layers_are_the_same_on_one_stream(width):
    torch.manual_seed(1)
    layers = [lstm.LSTM(width).cuda() for _ in range(4)]
    states = [layer.initial(4096, "cuda") for layer in layers]
    x, d = torch.randn(2, 16, 4096, width, device="cuda").bfloat16()
    reset = torch.rand(16, 4096, device="cuda") < 0.1
    leaves = [x.requires_grad_(), *(leaf for layer in layers for leaf in layer.parameters())]

    def gradients():
        with torch.autocast("cuda", torch.bfloat16):
            y = chained(layers, x, reset, states)
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


def test_each_stream_has_its_own_second_one(monkeypatch):
    """Memory freed on it would go to another stream, which does not wait for the first."""
    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "stream", contextlib.nullcontext)
    streams, event = [Stream(), Stream()], cast(torch.cuda.Event, Stream())
    for current in (*streams, *streams):
        monkeypatch.setattr(torch.cuda, "current_stream", lambda device, stream=current: stream)
        with beside.second_stream(event) as second, torch.cuda.stream(second):
            pass
    seconds = [stream.waited_for for stream in streams]
    assert [len(set(each)) for each in seconds] == [1, 1] and seconds[0][0] is not seconds[1][0]
    assert all(each[0].waited_for == [event] * 2 for each in seconds)


@pytest.mark.cuda
@pytest.mark.parametrize("layers, width", [(1, 256), (3, 256), (3, 128)])
def test_an_update_is_the_same_on_one_stream(layers, width):
    """Where streams share a GPU there is no second one."""
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
            if is_shared:
                with engine.without_early_starts():
                    learner.update(rollout)
            else:
                learner.update(rollout)
        ends.append(weights(policy))
    assert torch.equal(*ends) and ends[0].isfinite().all()
