"""Random orders: each index once, the same for the same seed."""

import pytest
import torch

from megastep.agents.algorithms import order


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("n", [1, 33, 4096, 20_000])
def test_each_index_comes_once(device, n):
    device = torch.empty(0, device=device).device
    drawn = [
        order.random_order(n, torch.Generator(device).manual_seed(seed), device)
        for seed in (1, 1, 2)
    ]
    assert torch.equal(drawn[0], drawn[1])
    assert n == 1 or not torch.equal(drawn[0], drawn[2])
    assert torch.equal(drawn[0].sort().values.cpu(), torch.arange(n))


@pytest.mark.parametrize("n", [1, 31, 32, 100, 4096, 5000])
def test_a_gpu_orders_as_a_cpu_does(n, to_gpu):
    """Equal keys, too."""
    keys = torch.randint(max(1, n // 2), (n,), generator=torch.Generator().manual_seed(n)) / n
    assert torch.equal(order._order_on_gpu(to_gpu(keys)).cpu(), order.order(keys))
