"""Averages gradients on a GPU, in one kernel before the sum over the ranks and one after it."""

from collections.abc import Sequence
from pathlib import Path

import torch

from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import Blocks, launch

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
_MAX_ROWS, _THREADS = LIBRARY.constants["PACK_ROWS"], LIBRARY.constants["PACK_THREADS"]
# The bucket's length is a multiple of this.
_MULTIPLE = 64


class Layout:
    """Where arrays are in a bucket of float32: each begins at a multiple of 16 bytes, for Adam's
    vector loads; then come single numbers.

    Args:
        sizes: numbers in each array.
        n_numbers: number of single numbers.

    Attributes:
        n: the bucket's length.
        count: index of the sum of `n_valid`.
    """

    def __init__(self, sizes: Sequence[int], n_numbers: int):
        self.sizes, self.padded = sizes, [n + -n % 4 for n in sizes]
        self.count = sum(self.padded) + n_numbers
        self.n = self.count + 1 + -(self.count + 1) % _MULTIPLE

    def pack(
        self,
        bucket: torch.Tensor,
        arrays: Sequence[torch.Tensor],
        numbers: Sequence[torch.Tensor],
        n_valid: torch.Tensor,
    ) -> None:
        """Fills the bucket with arrays, single numbers and 1, all times `n_valid`.

        Args:
            bucket: (n,) float32.
            arrays: float32, contiguous.
            numbers: () float32 each.
            n_valid: () int64 or float32.
        """
        ones = self.n - self.count  # zeros follow
        rows = [*zip(arrays, self.sizes, self.padded), *((number, 1, 1) for number in numbers)]
        rows, first = [*rows, (None, 1, ones)], 0
        for start in range(0, len(rows), _MAX_ROWS):
            packed, n_blocks = [], 0
            for source, n, n_padded in rows[start : start + _MAX_ROWS]:
                row = dict(source=source, first=first, n=n, n_padded=n_padded)
                packed.append(LIBRARY.params.PackRowParams(**row, first_block=n_blocks))
                n_blocks += max(1, -(-n_padded // (4 * _THREADS)))
                first += n_padded
            launch(
                *(LIBRARY, "pack", bucket.device, Blocks(n_blocks, threads=_THREADS)),
                rows=b"".join(packed),
                n_valid=n_valid,
                bucket=bucket,
                n_rows=len(packed),
                is_float=int(n_valid.dtype == torch.float32),
            )

    def divide(self, bucket: torch.Tensor) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        """Divides a bucket by its sum of `n_valid`, or by 1 if that is less.

        Returns:
            The arrays and the single numbers; the last of these is the sum of `n_valid`.
        """
        average = torch.empty_like(bucket)
        launch(
            *(LIBRARY, "divide", bucket.device, Blocks(-(-self.n // 1024), threads=256)),
            **dict(bucket=bucket, average=average, n=self.n, count=self.count),
        )
        *parts, numbers = average[: self.count + 1].split(
            [*self.padded, self.count + 1 - sum(self.padded)]
        )
        arrays = [part[:n] for part, n in zip(parts, self.sizes, strict=True)]
        return arrays, list(numbers.unbind())
