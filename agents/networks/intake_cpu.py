"""The intake's normalisation on a CPU: a kernel writes each leaf into its columns of one matrix.

`...` any leading axes, such as (B,) lanes or (T, B) time and lanes.
"""

import math
from collections.abc import Sequence

import torch
from torch import nn

from megastep.agents.networks.encoders import Flat
from megastep.agents.networks.kernels.library import LIBRARY, is_built_for_cpu
from megastep.agents.networks.running_norm import RunningNorm
from megastep.engine.devices import threads
from megastep.kernels.build.launch import launch

DTYPES = torch.float16, torch.float32


def fits(
    leaves: Sequence[torch.Tensor], norms: Sequence[nn.Module], encoders: Sequence[nn.Module]
) -> bool:
    """Returns whether `normalised` can take these leaves: float ones that are only flattened, and
    need no gradient.
    """
    return is_built_for_cpu() and all(
        leaf.device.type == "cpu"
        and leaf.dtype in DTYPES
        and not leaf.requires_grad
        and type(norm) is RunningNorm
        and type(encoder) is Flat
        for leaf, norm, encoder in zip(leaves, norms, encoders, strict=True)
    )


def normalised(
    leaves: Sequence[torch.Tensor], norms: Sequence[RunningNorm], n_padding: int = 0
) -> torch.Tensor:
    """Returns all leaves, normalised, flattened and concatenated: (..., n_features + n_padding)
    float32. The padding is 0. The bits are those of PyTorch's operations.
    """
    shapes = [leaf.shape[leaf.dim() - norm.mean.dim() :] for leaf, norm in zip(leaves, norms)]
    sizes = [math.prod(shape) for shape in shapes]
    lead = leaves[0].shape[: leaves[0].dim() - norms[0].mean.dim()]
    n_columns, n_rows, first = sum(sizes) + n_padding, math.prod(lead), 0
    out = torch.empty((*lead, n_columns))
    for leaf, norm, size in zip(leaves, norms, sizes, strict=True):
        n_channels = norm.mean.numel()
        leaf = leaf.contiguous()
        launch(
            *(LIBRARY, "normalise_leaf", out.device, 0),
            obs=leaf,
            mean=norm.mean,
            scale=norm.scale,
            out=out.data_ptr() + 4 * first,
            row_stride=n_columns,
            n_rows=n_rows,
            n_channels=n_channels,
            n_pixels=size // n_channels,
            is_half=leaf.dtype == torch.float16,
            n_threads=threads(),
        )
        first += size
    if n_padding:
        out[..., first:] = 0.0
    return out
