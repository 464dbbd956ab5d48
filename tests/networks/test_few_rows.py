"""Products of few rows on a GPU against their plain form in float64."""

import pytest
import torch
from torch.nn import functional

from megastep.agents.networks import few_rows
from megastep.agents.networks import linear as chosen


def matrix(n_rows, n_columns, scale=1.0, n_more=8):
    """Returns a matrix of bfloat16, some columns of a wider one."""
    return (torch.randn(n_rows, n_columns + n_more) * scale).bfloat16()[:, :n_columns]


def product_inputs(n, k, m, where="cpu"):
    """Returns rows x (N, K), weight (M, K), bias (M,), and gradients or addends (N, M), (N, K)."""
    torch.manual_seed(0)
    x, weight, d = matrix(n, k), matrix(m, k, k**-0.5), matrix(n, m)
    bias, onto = torch.randn(m).bfloat16(), torch.randn(n, k).bfloat16()
    return [leaf.to(where) for leaf in (x, weight, bias, d, onto)]


def products(x, weight, bias, d, addend):
    """Returns what each function does."""
    onto = d.clone()
    return (
        few_rows.multiply(x, weight, bias),
        few_rows.multiply(x, weight, bias, has_relu=True),
        few_rows.multiply(x, weight, addend=onto, out=onto),
        few_rows.multiply(d, weight, of_inputs=True),
        few_rows.multiply(d, weight, addend=addend, of_inputs=True),
    )


def plain_products(x, weight, bias, d, addend):
    x, weight, bias, d, addend = (leaf.double() for leaf in (x, weight, bias, d, addend))
    outputs = functional.linear(x, weight, bias)
    results = outputs, outputs.relu(), d + x @ weight.T, d @ weight, addend + d @ weight
    return [result.bfloat16() for result in results]


def check_products(inputs, results):
    for result, expected in zip(results, plain_products(*inputs), strict=True):
        torch.testing.assert_close(result, expected, rtol=1e-2, atol=1e-2)


PRODUCTS = pytest.mark.parametrize("n, k, m", [(1, 8, 8), (37, 264, 24), (260, 72, 136)])


def test_kernels_take_few_rows_of_whole_words(cuda_on_cpu, monkeypatch):
    capability = [9, 0]
    cuda_on_cpu.install(monkeypatch)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: tuple(capability))

    def takes(*matrices):
        return few_rows.fits(*map(cuda_on_cpu.tensor, matrices))

    most, weight = torch.zeros(few_rows.MAX_ROWS, 16).bfloat16(), torch.zeros(24, 16).bfloat16()
    assert takes(most, weight) and takes(most[:1], weight) and takes(most[:, 8:], weight[:, 8:])
    assert not takes(torch.cat([most, most[:1]]), weight) and not takes(most[:0], weight)
    assert not takes(most.float(), weight) and not takes(most, weight.float())
    assert not takes(most[:, :12], weight[:, :12]) and not takes(most[:, 1:9], weight[:, :8])
    assert not takes(weight.T, weight)
    assert not few_rows.fits(most, weight)  # on a CPU
    capability[0] = 7
    assert not takes(most, weight)


@pytest.mark.parametrize("is_few", [False, True])
def test_products_are_the_same_by_kernels_and_by_pytorch(cuda_on_cpu, monkeypatch, is_few):
    """In float64, but for the kernels."""
    inputs = x, weight, bias, d, addend = product_inputs(21, 16, 24)
    if is_few:
        cuda_on_cpu.install(monkeypatch)
        monkeypatch.setattr(few_rows, "fits", lambda *matrices: True)
    else:
        x, weight, bias, d, addend = (leaf.double() for leaf in inputs)
    onto = d.clone()
    chosen.product(x, weight, None, onto=onto)
    results = [
        chosen.product(x.view(3, 7, -1), weight, bias).flatten(0, 1),
        chosen.product(x, weight, bias, has_relu=True),
        onto,
        chosen.gradient_of_inputs(d.view(3, 7, -1), weight).flatten(0, 1),
        chosen.gradient_of_inputs(d, weight, addend.clone()),
    ]
    check_products(inputs, [result.bfloat16() for result in results])
    expected = inputs[3].double().T @ inputs[0].double()
    weights = chosen.gradient_of_weights(d, x).double()
    torch.testing.assert_close(weights, expected, rtol=1e-2, atol=1e-2)


@PRODUCTS
def test_products_match_the_plain_form_in_every_order(cuda_on_cpu, monkeypatch, n, k, m):
    inputs = product_inputs(n, k, m)
    cuda_on_cpu.install(monkeypatch)
    check_products(inputs, cuda_on_cpu.in_every_order(lambda: products(*inputs)))
    assert cuda_on_cpu.launched == {"product_of_layer", "product_of_inputs"}


@pytest.mark.cuda
@pytest.mark.parametrize("n, k, m", [(1, 8, 8), (256, 264, 128), (2048, 128, 512), (1100, 72, 136)])
def test_products_match_the_plain_form_and_are_repeatable(n, k, m):
    inputs = product_inputs(n, k, m, "cuda")
    results = products(*inputs)
    check_products(inputs, results)
    assert all(map(torch.equal, results, products(*inputs)))
