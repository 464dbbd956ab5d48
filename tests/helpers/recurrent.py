"""Shared by the tests of recurrent cores that have kernels."""

import torch


def assert_close(names, results, expected, slack):
    """Compares tensors with a tolerance of `slack` times their largest magnitude."""
    for name, tensor, expected_tensor in zip(names, results, expected, strict=True):
        torch.testing.assert_close(
            *(tensor, expected_tensor),
            rtol=0,
            atol=slack * expected_tensor.abs().max().item(),
            msg=lambda text, name=name: f"{name}: {text}",
        )
