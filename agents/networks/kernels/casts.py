"""Rounding weights to bfloat16 on a GPU."""

import torch

from megastep.agents.networks.kernels.library import LIBRARY
from megastep.kernels.build.launch import Blocks, launch

_MAX_ROWS, _THREADS = LIBRARY.constants["CAST_ROWS"], LIBRARY.constants["CAST_THREADS"]


def cast(weights: list[torch.Tensor], multiple: int) -> list[torch.Tensor]:
    """Returns weights in bfloat16, in one launch for up to `CAST_ROWS`.

    Args:
        weights: (N, ...) float32 each, contiguous.
        multiple: of 8. Rows of zeros are added until there are a multiple of this.
    """
    shapes = [(len(weight) + -len(weight) % multiple, *weight.shape[1:]) for weight in weights]
    sizes = [torch.Size(shape).numel() for shape in shapes]
    memory = torch.empty(sum(sizes), dtype=torch.bfloat16, device=weights[0].device)
    targets = memory.split(sizes)
    for start in range(0, len(weights), _MAX_ROWS):
        some, rows, n_blocks = slice(start, start + _MAX_ROWS), [], 0
        for weight, target in zip(weights[some], targets[some], strict=True):
            rows.append(
                LIBRARY.params.CastRowParams(
                    source=weight,
                    target=target,
                    n=weight.numel(),
                    n_padded=target.numel(),
                    first_block=n_blocks,
                )
            )
            n_blocks += max(1, -(-target.numel() // (8 * _THREADS)))
        launch(
            *(LIBRARY, "cast", memory.device, Blocks(n_blocks, threads=_THREADS)),
            rows=b"".join(rows),
            n_rows=len(rows),
        )
    return [target.view(shape) for target, shape in zip(targets, shapes, strict=True)]
