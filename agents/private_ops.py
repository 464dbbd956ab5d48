"""PyTorch's private operations, with public ones in their place where a version has them no more.

The private ones are faster: one kernel in place of several. No other file calls `torch._...`;
`torch._C`, which has no public name for what is taken from it, is no operation.
"""

from collections.abc import Sequence

import torch

__all__ = ["adamw_", "copy_all_", "linear_relu", "scale_all", "standard_gamma"]

#: The names in `torch`.
OPERATIONS = tuple(
    "_addmm_activation _foreach_copy_ _foreach_mul _fused_adamw_ _standard_gamma".split()
)
# Rounds of rejection sampling. One accepts with 95 % or more, so all fail once in 10**20 samples.
_ROUNDS = 16


def linear_relu(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
    """Returns the linear layer `weight` (out, in), `bias` (out,) with a ReLU: (N, in) -> (N, out).

    All are of one dtype, in which sums are rounded.
    """
    if fused := getattr(torch, "_addmm_activation", None):
        return fused(bias, x, weight.T)
    return torch.addmm(bias, x, weight.T).relu()


def copy_all_(targets: Sequence[torch.Tensor], sources: Sequence[torch.Tensor]) -> None:
    """Copies tensors into others of the same shapes, in place."""
    if fused := getattr(torch, "_foreach_copy_", None):
        fused(targets, sources)
        return
    for target, source in zip(targets, sources, strict=True):
        target.copy_(source)


def scale_all(tensors: Sequence[torch.Tensor], factor: torch.Tensor) -> Sequence[torch.Tensor]:
    """Returns tensors times `factor`, ()."""
    if fused := getattr(torch, "_foreach_mul", None):
        return fused(tensors, factor)
    return [tensor * factor for tensor in tensors]


def standard_gamma(alpha: torch.Tensor, generator: torch.Generator | None = None) -> torch.Tensor:
    """Returns samples of Gamma(alpha, 1), one for each `alpha` of at least 1.

    The public operations draw by Marsaglia and Tsang (2000), and so other samples than the private
    one.
    """
    if fused := getattr(torch, "_standard_gamma", None):
        return fused(alpha, generator=generator)
    scale = alpha - 1 / 3
    spread, samples = (9 * scale).rsqrt(), scale.clone()
    is_drawn = torch.zeros_like(alpha, dtype=torch.bool)
    for _ in range(_ROUNDS):
        normal = torch.empty_like(alpha).normal_(generator=generator)
        uniform = torch.empty_like(alpha).uniform_(generator=generator)
        cube = (1 + spread * normal) ** 3
        log_ratio = 0.5 * normal**2 + scale * (1 - cube + cube.log())  # NaN below 0: not accepted
        is_accepted = (uniform.log() < log_ratio) & ~is_drawn
        samples = torch.where(is_accepted, scale * cube, samples)
        is_drawn |= is_accepted
    return samples


def adamw_(
    rows: Sequence[tuple[torch.Tensor, ...]],
    n_steps: torch.Tensor,
    lr: torch.Tensor,
    betas: tuple[float, float],
    weight_decay: float,
    eps: float,
    is_taken: torch.Tensor,
) -> None:
    """Takes a step of AdamW, in place.

    Args:
        rows: parameter, gradient, and the means of gradients and of their squares.
        n_steps: (), the number of steps, with this one.
        lr: (), the step size.
        betas: decay of the means.
        weight_decay: times the step size, the fraction that a parameter loses.
        eps: added to the denominator.
        is_taken: () bool. If false, nothing changes.
    """
    (beta1, beta2), found_inf = betas, (~is_taken).float()
    if fused := getattr(torch, "_fused_adamw_", None):
        options = dict(amsgrad=False, maximize=False, found_inf=found_inf)
        options |= dict(beta1=beta1, beta2=beta2, weight_decay=weight_decay, eps=eps)
        fused(*map(list, zip(*rows)), [], [n_steps] * len(rows), lr=lr, **options)
        return
    for parameter, gradient, mean, square in rows:
        new_mean = mean.lerp(gradient, 1 - beta1)
        new_square = square.lerp(gradient.square(), 1 - beta2)
        root = (new_square / (1 - beta2**n_steps)).sqrt() + eps
        update = new_mean / (1 - beta1**n_steps) / root
        new = parameter * (1 - lr * weight_decay) - lr * update
        for old, value in ((parameter, new), (mean, new_mean), (square, new_square)):
            old.copy_(torch.where(is_taken, value, old))
