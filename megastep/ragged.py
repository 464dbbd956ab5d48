"""Arrays of subarrays of different lengths, laid end to end in one backing array.

``Ragged(vals, widths)`` makes a RaggedTorch of a tensor and a RaggedNumpy of anything else::

    r = Ragged(np.array([0., 1., 2., 3., 4., 5.]), np.array([3, 1, 2]))
    r[1]    # array([3.])
    r[:2]   # RaggedNumpy([3 1])
"""

import operator
from functools import cached_property
from typing import TYPE_CHECKING, Any, SupportsIndex

import numpy as np
import torch

from megastep.read_only import SetOnce

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["Ragged", "RaggedNumpy", "RaggedTorch"]

Array = np.ndarray | torch.Tensor


class Ragged(SetOnce):
    """D subarrays of ``widths`` elements each, laid end to end in ``vals``.

    An integer index returns a subarray, a slice returns a Ragged. Both share memory with ``vals``,
    except for slices with a step. Write into ``vals`` in place; it cannot be replaced.

    Args:
        vals: (V, ...) backing array.
        widths: (D,) integers, not negative, that add up to V. They become int64.
    """

    vals: Any
    widths: Any
    inverse: Any

    def __new__(cls, *args: object) -> "Self":
        if cls is Ragged:
            kind = RaggedTorch if isinstance(args[0], torch.Tensor) else RaggedNumpy
            return super().__new__(kind)  # pyright: ignore[reportArgumentType]
        return super().__new__(cls)

    def __init__(self, vals: Array, widths: Array):
        widths = np.zeros(0, int) if len(widths) == 0 else widths
        if isinstance(self, RaggedTorch):
            self.vals = torch.as_tensor(vals)
            widths = torch.as_tensor(widths, device=self.vals.device)
        else:
            self.vals = np.asarray(vals)
            widths = np.asarray(widths.cpu() if isinstance(widths, torch.Tensor) else widths)
        _check(self.vals, widths)
        integers: Any = widths
        is_tensor = isinstance(integers, torch.Tensor)
        self.widths = integers.long() if is_tensor else integers.astype(np.int64, copy=False)

    @cached_property
    def ends(self) -> Array:
        """(D,) index into ``vals`` after each subarray's last element."""
        return self.widths.cumsum(0)

    @cached_property
    def starts(self) -> Array:
        """(D,) index into ``vals`` of each subarray's first element."""
        return self.ends - self.widths

    @cached_property
    def _host(self) -> tuple[list[int], list[int]]:
        """Starts and ends as lists, so that only the first indexing synchronises."""
        return self.starts.tolist(), self.ends.tolist()

    def __len__(self) -> int:
        return len(self.widths)

    def __getitem__(self, index: int | slice) -> "Array | Ragged":
        starts, ends = self._host
        if isinstance(index, slice):
            selected = range(len(self))[index]
            if not selected:
                return Ragged(self.vals[:0], self.widths[:0])
            if selected.step == 1:
                return Ragged(
                    self.vals[starts[selected[0]] : ends[selected[-1]]],
                    self.widths[selected.start : selected.stop],
                )
            parts = [self.vals[starts[i] : ends[i]] for i in selected]
            joined = torch.cat if isinstance(self, RaggedTorch) else np.concatenate
            return Ragged(joined(parts), self.widths[list(selected)])
        i = self._index(index)
        return self.vals[starts[i] : ends[i]]

    def _index(self, index: SupportsIndex) -> int:
        try:
            i = operator.index(index)
        except TypeError:
            raise TypeError(
                f"a Ragged is indexed with an integer or a slice, not a {type(index).__name__}"
            ) from None
        if not -len(self) <= i < len(self):
            raise IndexError(f"index {i} is out of range for a Ragged of {len(self)} subarrays")
        return i % len(self)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({np.array(self.widths.tolist(), int)})"

    def __reduce__(self) -> tuple:
        return Ragged, (self.vals, self.widths)


class RaggedNumpy(Ragged):
    """A Ragged of numpy arrays."""

    vals: np.ndarray
    widths: np.ndarray

    @cached_property
    def inverse(self) -> np.ndarray:
        """(V,) the subarray that each element of ``vals`` belongs to."""
        return np.repeat(np.arange(len(self)), self.widths)

    def torchify(self) -> "RaggedTorch":
        """Returns the same Ragged on CPU tensors. float64 becomes float32."""
        vals = self.vals.astype(np.float32) if self.vals.dtype == np.float64 else self.vals
        return RaggedTorch(torch.as_tensor(vals), torch.as_tensor(self.widths))

    def numpyify(self) -> "RaggedNumpy":
        """Returns itself."""
        return self


class RaggedTorch(Ragged):
    """A Ragged of tensors on the device of ``vals``."""

    vals: torch.Tensor
    widths: torch.Tensor

    @cached_property
    def inverse(self) -> torch.Tensor:
        """(V,) the subarray that each element of ``vals`` belongs to."""
        return torch.repeat_interleave(torch.arange(len(self), device=self.device), self.widths)

    @property
    def device(self) -> torch.device:
        """The device of ``vals``."""
        return self.vals.device

    def torchify(self) -> "RaggedTorch":
        """Returns itself."""
        return self

    def numpyify(self) -> RaggedNumpy:
        """Returns the same Ragged on numpy arrays. bfloat16 becomes float32."""
        vals = self.vals.detach().cpu()
        return RaggedNumpy(
            (vals.float() if vals.dtype == torch.bfloat16 else vals).numpy(),
            self.widths.cpu().numpy(),
        )

    def to(self, *args: Any, **kwargs: Any) -> "RaggedTorch":
        """Returns a Ragged of ``vals.to(...)``, with the widths on the same device."""
        vals = self.vals.to(*args, **kwargs)
        return RaggedTorch(vals, self.widths.to(vals.device))

    def cpu(self) -> "RaggedTorch":
        """Returns it on the CPU."""
        return self.to("cpu")

    def cuda(self, device: torch.device | str = "cuda") -> "RaggedTorch":
        """Returns it on a GPU."""
        return self.to(device)

    def clone(self) -> "RaggedTorch":
        """Returns a copy with tensors of its own."""
        return RaggedTorch(self.vals.clone(), self.widths.clone())


def _check(vals: Array, widths: Array) -> None:
    if vals.ndim == 0:
        raise ValueError("the vals of a Ragged need at least one axis, but are a single number")
    if widths.ndim != 1:
        raise ValueError(
            f"the widths of a Ragged need exactly one axis, but have shape {tuple(widths.shape)}"
        )
    listed = np.asarray(widths.tolist() or np.zeros(0, int))
    if listed.dtype.kind not in "iu":
        raise ValueError(f"the widths of a Ragged must be integers, but are {widths.dtype}")
    if (listed < 0).any():
        i = int(listed.argmin())
        raise ValueError(
            f"the widths of a Ragged must not be negative, but widths[{i}] is {listed[i]}"
        )
    if listed.sum() != len(vals):
        raise ValueError(
            f"the widths of a Ragged must add up to its {len(vals)} vals, but add up to "
            f"{listed.sum()}"
        )
