"""Columns of the replay buffer: one tensor each, stored in a smaller dtype where possible."""

import torch

from megastep import spaces
from megastep.types import Space


class Column:
    """Rows (R, ...) of one tensor of the experience.

    Args:
        n_rows: R.
        shape: shape of a row.
        dtype: dtype that `read` returns.
        stored: dtype of the storage; None: `dtype`.
        device: device of the rows.
    """

    def __init__(
        self,
        n_rows: int,
        shape: tuple[int, ...],
        dtype: torch.dtype,
        stored: torch.dtype | None,
        device: torch.device,
    ):
        self.dtype = dtype
        self.rows = torch.zeros(n_rows, *shape, dtype=stored or dtype, device=device)

    def write(self, index: torch.Tensor, values: torch.Tensor) -> None:
        """Stores the first m of values (>= m, ...) at rows index (m,)."""
        values = cast(values[: len(index)], self.rows.dtype)
        self.rows.index_copy_(0, index, values)

    def read(self, index: torch.Tensor) -> torch.Tensor:
        """Returns entries (..., *) of rows (R, B, *). Entry r B + b is lane b of row r."""
        rows = self.rows.flatten(0, 1).index_select(0, index.flatten())
        return cast(rows, self.dtype).unflatten(0, index.shape)


def stored_dtype(space: Space, images: str) -> torch.dtype | None:
    """Returns the dtype in which values of a leaf space are stored; None if it does not change.

    Integers are stored in the smallest dtype that holds them.
    """
    if isinstance(space, spaces.MultiDiscrete):
        dtypes = torch.uint8, torch.int16, torch.int32
        return next(dtype for dtype in dtypes if space.n_actions - 1 <= torch.iinfo(dtype).max)
    if isinstance(space, spaces.MultiImage) and images == "uint8":
        return torch.uint8
    return None


def cast(values: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """Returns values in another dtype. Fractions from 0 to 1 become integers from 0 to 255 and
    back; float16 is clipped to its range.
    """
    source = values.dtype
    if source.is_floating_point and dtype == torch.uint8:
        return (values * 255).round_().clamp_(0, 255).to(dtype)
    if source == torch.uint8 and dtype.is_floating_point:
        return values.to(dtype) / 255
    if dtype == torch.float16 and source != dtype:
        largest = torch.finfo(dtype).max
        return values.clamp(-largest, largest).to(dtype)
    return values.to(dtype)
