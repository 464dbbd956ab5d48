"""A child that is forked while OpenMP threads run can step environments and use PyTorch."""

import multiprocessing

import pytest
import torch

from megastep import envs

HUNG = 30  # seconds; a hundred times what the child needs


@pytest.fixture
def two_threads():
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(1)


def test_forked_child_computes_the_same_bits(two_threads):
    env = envs.Minimal(64, device="cpu")
    env.reset()
    decision = dict(actions=torch.full((64, 1), 3))
    env.step(decision)

    def compute():
        large = torch.linspace(0, 1, 10**6).exp().sum()
        return torch.get_num_threads(), float(large), env.step(decision).obs.numpy()

    def child():
        sender.send(compute())

    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=child)
    process.start()
    try:
        assert receiver.poll(HUNG), "the child hangs"
        in_child = receiver.recv()
    finally:
        process.kill()
        process.join()
    in_parent = compute()
    assert in_child[:2] == in_parent[:2] and (in_child[2] == in_parent[2]).all()
    assert in_child[0] == 2, "the child has as many threads"
