"""Arrays of subarrays of different lengths, laid end to end in one backing array.

``Ragged(vals, widths)`` makes a RaggedTorch of a tensor and a RaggedNumpy of anything else::

    r = Ragged(np.array([0., 1., 2., 3., 4., 5.]), np.array([3, 1, 2]))
    r[1]    # array([3.])
    r[:2]   # RaggedNumpy([3 1])
"""

from functools import cached_property
from typing import TYPE_CHECKING, Any

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

    def __new__(cls, *args: object) -> "Self":
        if cls is Ragged:
            kind = RaggedTorch if isinstance(args[0], torch.Tensor) else RaggedNumpy
            return super().__new__(kind)  # pyright: ignore[reportArgumentType]
        return super().__new__(cls)

    def __init__(self, vals: Array, widths: Array):
        integers: Any = np.zeros(0, int) if len(widths) == 0 else widths
        is_torch = isinstance(self, RaggedTorch)
        if is_torch:
            self.vals = torch.as_tensor(vals)
            integers = torch.as_tensor(integers, device=self.vals.device)
        else:
            self.vals = np.asarray(vals)
            integers = integers.cpu() if isinstance(integers, torch.Tensor) else integers
            integers = np.asarray(integers)
        if self.vals.ndim == 0:
            raise ValueError("the vals of a Ragged need at least one axis, but are a single number")
        if integers.ndim != 1:
            shape = tuple(integers.shape)
            raise ValueError(
                f"the widths of a Ragged need exactly one axis, but have shape {shape}"
            )
        listed = np.asarray(integers.tolist() or np.zeros(0, int))
        if listed.dtype.kind not in "iu":
            raise ValueError(f"the widths of a Ragged must be integers, but are {integers.dtype}")
        if (listed < 0).any():
            i = int(listed.argmin())
            raise ValueError(
                f"the widths of a Ragged must not be negative, but widths[{i}] is {listed[i]}"
            )
        if listed.sum() != len(self.vals):
            raise ValueError(
                f"the widths of a Ragged must add up to its {len(self.vals)} vals, but add up to "
                f"{listed.sum()}"
            )
        self.widths = integers.long() if is_torch else integers.astype(np.int64, copy=False)

    @cached_property
    def ends(self) -> Array:
        """(D,) index into ``vals`` after each subarray's last element."""
        return self.widths.cumsum(0)

    @cached_property
    def starts(self) -> Array:
        """(D,) index into ``vals`` of each subarray's first element."""
        return self.ends - self.widths

    @cached_property
    def inverse(self) -> Any:
        """(V,) the subarray that each element of ``vals`` belongs to."""
        if isinstance(self, RaggedTorch):
            return torch.arange(len(self), device=self.vals.device).repeat_interleave(self.widths)
        return np.arange(len(self)).repeat(self.widths)

    @cached_property
    def _host(self) -> tuple[list[int], list[int]]:
        """Starts and ends as lists, so that only the first indexing synchronises."""
        return self.starts.tolist(), self.ends.tolist()

    def __len__(self) -> int:
        return len(self.widths)

    def __getitem__(self, index: int | slice) -> "Array | Ragged":
        starts, ends = self._host
        try:
            selected = range(len(self))[index]
        except IndexError:
            n = len(self)
            raise IndexError(
                f"index {index} is out of range for a Ragged of {n} subarrays"
            ) from None
        except TypeError:
            raise TypeError(
                f"a Ragged is indexed with an integer or a slice, not a {type(index).__name__}"
            ) from None
        if isinstance(selected, int):
            return self.vals[starts[selected] : ends[selected]]
        if not selected:
            return Ragged(self.vals[:0], self.widths[:0])
        if selected.step == 1:
            vals = self.vals[starts[selected[0]] : ends[selected[-1]]]
            return Ragged(vals, self.widths[selected.start : selected.stop])
        joined = torch.cat if isinstance(self, RaggedTorch) else np.concatenate
        vals = joined([self.vals[starts[i] : ends[i]] for i in selected])
        return Ragged(vals, self.widths[list(selected)])

    def __repr__(self) -> str:
        return f"{type(self).__name__}({np.array(self.widths.tolist(), int)})"

    def __reduce__(self) -> tuple:
        return Ragged, (self.vals, self.widths)

    def torchify(self) -> "RaggedTorch":
        """Returns it on tensors: itself, or on the CPU. float64 becomes float32."""
        if isinstance(self, RaggedTorch):
            return self
        vals = self.vals.astype(np.float32) if self.vals.dtype == np.float64 else self.vals
        return RaggedTorch(torch.as_tensor(vals), torch.as_tensor(self.widths))

    def numpyify(self) -> "RaggedNumpy":
        """Returns it on numpy arrays: itself, or a copy of it. bfloat16 becomes float32."""
        if isinstance(self, RaggedNumpy):
            return self
        vals = self.vals.detach().cpu()
        vals = vals.float() if vals.dtype == torch.bfloat16 else vals
        return RaggedNumpy(vals.numpy(), self.widths.cpu().numpy())


class RaggedNumpy(Ragged):
    """A Ragged of numpy arrays."""

    vals: np.ndarray
    widths: np.ndarray


class RaggedTorch(Ragged):
    """A Ragged of tensors on the device of ``vals``."""

    vals: torch.Tensor
    widths: torch.Tensor

    @property
    def device(self) -> torch.device:
        """The device of ``vals``."""
        return self.vals.device

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
