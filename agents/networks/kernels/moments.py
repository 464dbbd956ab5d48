"""Statistics on a GPU: of observations, and of numbers of which some are valid.

All tensors are contiguous and on one GPU. B lanes.
"""

from collections.abc import Sequence

import torch

from megastep.agents.networks.kernels.library import LIBRARY
from megastep.kernels.build.launch import Blocks, launch

MAX_LEAVES = LIBRARY.constants["MAX_LEAVES"]
MAX_ARRAYS = LIBRARY.constants["MASKED_ARRAYS"]
_THREADS = LIBRARY.constants["MASKED_THREADS"]
_MOMENTS_THREADS = LIBRARY.constants["MOMENTS_THREADS"]


def moments(
    leaves: list[torch.Tensor], n_statistics: list[int], is_counted: torch.Tensor
) -> tuple[torch.Tensor, list[torch.Tensor], list[torch.Tensor]]:
    """Returns the number of lanes that count, () int64, and each leaf's means and variances.

    Args:
        leaves: at most `MAX_LEAVES`, (B, F) float16 or float32 each.
        n_statistics: of each leaf, each of F / n neighbouring features.
        is_counted: (B,) bool, lanes to count.
    """
    total, device = sum(n_statistics), leaves[0].device
    results = torch.empty(2 * total, device=device)
    n_counted = torch.empty((), dtype=torch.int64, device=device)
    packed = [
        LIBRARY.params.IntakeLeafParams(
            values=leaf,
            mean=None,
            scale=None,
            n_features=leaf.shape[1],
            group=leaf.shape[1] // n,
            is_half=int(leaf.dtype == torch.float16),
        )
        for leaf, n in zip(leaves, n_statistics, strict=True)
    ]
    launch(
        *(LIBRARY, "moments", device, Blocks(total, threads=_MOMENTS_THREADS)),
        leaves=b"".join(packed),
        is_counted=is_counted.contiguous(),
        moments=results,
        n_counted=n_counted,
        n_lanes=len(leaves[0]),
    )
    means, variances = zip(
        *(part.chunk(2) for part in results.split([2 * n for n in n_statistics]))
    )
    return n_counted, list(means), list(variances)


def add_moments(
    norms: Sequence, all_moments: Sequence[tuple], is_counted: torch.Tensor | None = None
) -> None:
    """Adds moments to the statistics of norms, at most `MAX_LEAVES`.

    Args:
        norms: `RunningNorm`s.
        all_moments: of each norm: the number of lanes () int64, means and variances.
        is_counted: () bool; if false, nothing changes. None: true.
    """
    packed, kept = [], []
    for norm, (n_counted, mean, variance) in zip(norms, all_moments, strict=True):
        mean, variance, n_counted = mean.contiguous(), variance.contiguous(), n_counted.long()
        kept += [mean, variance, n_counted]  # until the launch
        packed.append(
            LIBRARY.params.RunningNormParams(
                mean=norm.mean,
                scale=norm.scale,
                count=norm.count,
                new_mean=mean,
                new_variance=variance,
                n_counted=n_counted,
                n=mean.numel(),
            )
        )
    blocks = Blocks(len(packed), threads=_MOMENTS_THREADS)
    launch(
        *(LIBRARY, "add_moments", norms[0].mean.device, blocks),
        norms=b"".join(packed),
        is_counted=is_counted,
    )


def masked_moments(
    arrays: Sequence[torch.Tensor], valid: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the number of valid entries, () int64, and means and variances (n, 2).

    Args:
        arrays: n, at most `MAX_ARRAYS`, float32 each, of fewer than 2^31 numbers.
        valid: bool, of the same shape.
    """
    n_numbers, tensor = arrays[0].numel(), arrays[0]
    n_parts = max(1, -(-n_numbers // (_THREADS * LIBRARY.constants["MASKED_NUMBERS"])))
    parts = tensor.new_empty(len(arrays), n_parts, 3)
    moments = tensor.new_empty(len(arrays), 2)
    n_valid = torch.empty((), dtype=torch.int64, device=tensor.device)
    pack = LIBRARY.params.MaskedArrayParams
    launch(
        *(LIBRARY, "masked_parts", tensor.device, Blocks(n_parts, len(arrays), _THREADS)),
        arrays=b"".join(pack(values=array) for array in arrays),
        valid=valid,
        parts=parts,
        n=n_numbers,
    )
    launch(
        *(LIBRARY, "masked_moments", tensor.device, Blocks(1, len(arrays), _THREADS)),
        parts=parts,
        moments=moments,
        n_valid=n_valid,
        n_parts=n_parts,
    )
    return n_valid, moments


def normalise_masked(
    x: torch.Tensor, valid: torch.Tensor, mean: torch.Tensor, variance: torch.Tensor
) -> torch.Tensor:
    """Returns (x - mean) / sqrt(variance), 0 where invalid.

    Args:
        x: float32, of fewer than 2^31 numbers.
        valid: bool, of the same shape.
        mean: () float32.
        variance: () float32.
    """
    normalised = torch.empty_like(x)
    launch(
        *(LIBRARY, "normalise_masked", x.device, x.numel()),
        **dict(values=x, valid=valid, mean=mean, variance=variance),
        normalised=normalised,
        n=x.numel(),
    )
    return normalised


def add_returns(output, moments: tuple, is_counted: torch.Tensor | None, min_rate: float) -> None:
    """Adds moments to the statistics of a `ValueOutput`.

    Args:
        output: whose tensors are float32.
        moments: the number of returns () int64, their mean and variance, () float32 each.
        is_counted: () bool. None: true.
        min_rate: smallest weight of the moments.
    """
    n_valid, mean, variance = moments
    launch(
        *(LIBRARY, "add_returns", output.mean.device, Blocks(1, threads=_THREADS)),
        weight=output.linear.weight,
        bias=output.linear.bias,
        mean=output.mean,
        scale=output.scale,
        count=output.count,
        new_mean=mean,
        new_variance=variance,
        n_valid=n_valid,
        is_counted=is_counted,
        width=output.linear.in_features,
        min_rate=min_rate,
        min_scale=output.min_scale,
    )
