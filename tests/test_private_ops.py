"""PyTorch's private operations, and the public ones in their place."""

import pathlib
import re

import pytest
import torch

from megastep.agents import private_ops

ROOT = pathlib.Path(__file__).parents[1]
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


def randn(*shape, generator, device):
    return torch.randn(shape, generator=generator).to(device)


def linear_relu(generator, device):
    shapes = (7, 5), (3, 5), (3,)
    x, weight, bias = (randn(*shape, generator=generator, device=device) for shape in shapes)
    return [private_ops.linear_relu(x, weight, bias)]


def copy_all(generator, device):
    targets = [torch.zeros(shape, device=device) for shape in ((2, 3), (4,), ())]
    sources = [randn(*t.shape, generator=generator, device=device).double() for t in targets]
    private_ops.copy_all_(targets, sources)
    return targets


def scale_all(generator, device):
    tensors = tuple(randn(n, 3, generator=generator, device=device) for n in (2, 4))
    return private_ops.scale_all(tensors, torch.tensor(0.3, device=device))


def adamw(generator, device):
    rows = [
        tuple(randn(*shape, generator=generator, device=device) for _ in range(4))
        for shape in ((5, 3), (4,))
    ]
    for row in rows:
        row[3].abs_()
    steps, lr = torch.tensor(3.0, device=device), torch.tensor(0.1, device=device)
    results = []
    for is_taken in (True, False):
        if not is_taken:
            rows[0][1].fill_(torch.nan)
        arguments = (0.8, 0.99), 0.5, 1e-4, torch.tensor(is_taken, device=device)
        private_ops.adamw_(rows, steps, lr, *arguments)
        results += [part.clone() for row in rows for part in (row[0], *row[2:])]
    return results


CALLS = {
    "_addmm_activation": linear_relu,
    "_foreach_copy_": copy_all,
    "_foreach_mul": scale_all,
    "_fused_adamw_": adamw,
}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", CALLS)
def test_private_and_public_operations_agree(name, device, monkeypatch):
    private = CALLS[name](torch.Generator().manual_seed(0), device)
    monkeypatch.delattr(torch, name)
    public = CALLS[name](torch.Generator().manual_seed(0), device)
    for one, other in zip(private, public, strict=True):
        # sums of float32 in another order
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("is_private", [True, False])
def test_gamma_samples_have_their_mean_and_variance(is_private, device, monkeypatch):
    """Both are alpha."""
    if not is_private:
        monkeypatch.delattr(torch, "_standard_gamma")
    n, alpha = 100_000, torch.tensor([1.0, 1.5, 4.0, 30.0], device=device)
    generator = torch.Generator(device).manual_seed(1)
    samples = private_ops.standard_gamma(alpha.expand(n, 4), generator)
    # within six standard errors
    assert ((samples.mean(0) - alpha).abs() < 6 * (alpha / n).sqrt()).all()
    error = ((2 * alpha**2 + 6 * alpha) / n).sqrt()
    assert ((samples.var(0) - alpha).abs() < 6 * error).all()


def test_no_other_file_calls_private_operations():
    files = [*(ROOT / "agents").rglob("*.py"), *(ROOT / "megastep").rglob("*.py")]
    private = re.compile(r"\btorch\._(?!C\b|_)\w+|\baten\._\w+")
    calls = {
        str(path.relative_to(ROOT)): private.findall(path.read_text())
        for path in files
        if path.name != "private_ops.py"
    }
    assert not {path: found for path, found in calls.items() if found}
