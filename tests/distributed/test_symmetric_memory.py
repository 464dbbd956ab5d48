"""Gradients averaged on GPUs: packed and divided by kernels, summed in memory that ranks share."""

import threading

import pytest
import torch

from megastep.agents.distributed import pooling, process_group, segments, symmetric_memory
from tests.helpers import ranks

SHAPES = (256, 130), (7,), (), (3, 5), (1024,), (0, 3)


def case(to, n_valid, n_copies=1, seed=0):
    """Returns parameters with gradients, `n_valid` and two metrics."""
    generator = torch.Generator().manual_seed(seed)
    parameters = []
    for shape in SHAPES * n_copies:
        parameters.append(torch.nn.Parameter(to(torch.zeros(shape))))
        parameters[-1].grad = to(torch.randn(shape, generator=generator))
    parameters += [torch.nn.Parameter(to(torch.zeros(4))) for _ in range(2)]  # one has no gradient
    parameters[-1].grad = to(torch.full((5,), 1e-40))[1:]  # unaligned and subnormal
    means = [to(torch.tensor(0.1)), to(torch.tensor(7))]
    return parameters, to(n_valid), means


def averaged(parameters, n_valid, means):
    """Returns all numbers that averaging returns or changes."""
    n, means = pooling.average_gradients(parameters, n_valid, means)
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    return [torch.Tensor.cpu(x).clone() for x in (n, *means, *gradients)]


@pytest.mark.parametrize("is_shared", [False, True])
@pytest.mark.parametrize("n_valid", [torch.tensor(37), torch.tensor(3.0), torch.tensor(0)])
def test_kernels_have_the_bits_of_operations(cuda_on_cpu, monkeypatch, is_shared, n_valid):
    shared = {}

    def buffer(n, device):
        return shared.setdefault(n, torch.full((n,), torch.nan)) if is_shared else None

    monkeypatch.setattr(pooling, "n_ranks", lambda: 2)
    monkeypatch.setattr(pooling, "all_reduce", lambda bucket: bucket.mul_(3))
    monkeypatch.setattr(symmetric_memory, "all_reduce_", lambda bucket: bucket.mul_(3))
    monkeypatch.setattr(symmetric_memory, "buffer", buffer)
    expected = averaged(*case(lambda tensor: tensor, n_valid, n_copies=20))
    cuda_on_cpu.install(monkeypatch)
    found = cuda_on_cpu.in_every_order(
        lambda: averaged(*case(cuda_on_cpu.tensor, n_valid, n_copies=20))
    )
    assert cuda_on_cpu.launched == {"pack", "divide"} and bool(shared) == is_shared
    assert len(found) == len(expected) == 3 + 20 * len(SHAPES) + 1
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.shape == theirs.shape
        assert torch.equal(ours.view(torch.int32), theirs.view(torch.int32))


@pytest.fixture
def set_up(monkeypatch):
    """Returns a function of this rank's memory, how it is opened, and another rank's machine and
    success, which returns two results of `buffer`.
    """

    def call(memory, opens, machine=None, other=True):
        answers = iter([(machine or symmetric_memory._machine(), True), other])
        gather = lambda value: [value, next(answers)]  # noqa: E731
        monkeypatch.setattr(symmetric_memory, "gather_objects", gather)
        monkeypatch.setattr(symmetric_memory, "_allocate", lambda *_: memory)
        monkeypatch.setattr(symmetric_memory, "_sum", opens)
        monkeypatch.setattr(symmetric_memory, "_buffers", {})
        return [symmetric_memory.buffer(8, torch.device("cpu")) for _ in range(2)]

    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: False)
    monkeypatch.setattr(symmetric_memory, "SETUP_SECONDS", 0.2)
    return call


def test_all_ranks_share_memory_or_none_does(set_up):
    memory, opened = torch.zeros(8), []
    assert set_up(memory, lambda x: opened.append(len(x))) == [memory, memory] and opened == [0]

    def fails(x):
        raise RuntimeError("no peer access")

    for opens in (fails, lambda x: threading.Event().wait(60)):
        assert set_up(memory, opens) == [None, None]
    assert set_up(memory, lambda x: None, other=False) == [None, None]
    assert set_up(memory, lambda x: None, machine=("other", "")) == [None, None]
    assert set_up(None, lambda x: None) == [None, None]


def on_two_gpus():
    """Returns whether NCCL was replaced, and whether each call and replay gave NCCL's bits."""
    rank = process_group.rank()
    torch.cuda.set_device(rank)
    inputs = case(torch.Tensor.cuda, torch.tensor(5 + 2 * rank), seed=rank)
    gradients = [parameter.grad for parameter in inputs[0]]

    def once():
        for parameter, gradient in zip(inputs[0], gradients, strict=True):
            parameter.grad = gradient
        n, means = pooling.average_gradients(*inputs)
        return [n, *means, *(p.grad for p in inputs[0] if p.grad is not None)]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(symmetric_memory, "buffer", lambda n, device: None)
        expected = [x.clone() for x in once()]
    results = [[x.clone() for x in once()] for _ in range(3)]
    graph = segments.SegmentedGraph(once, torch.cuda.Stream())
    for _ in range(100):
        graph.replay()
    results.append([x.clone() for x in graph.output])
    are_equal = [all(map(torch.equal, result, expected)) for result in results]
    is_shared = [memory is not None for memory in symmetric_memory._buffers.values()]
    return is_shared, len(graph.parts), are_equal


@pytest.mark.cuda
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_two_gpus_have_the_bits_of_nccl():
    for is_shared, n_parts, are_equal in ranks.call(on_two_gpus):
        assert is_shared == [True] and n_parts == 1
        assert are_equal == [True] * 4
    for is_shared, n_parts, are_equal in ranks.call(on_two_gpus, NCCL_P2P_DISABLE="1"):
        assert is_shared == [False] and n_parts == 3
        assert are_equal == [True] * 4
