"""Read-only tensors, and objects whose attributes cannot be replaced."""

from typing import NoReturn

import numpy as np
import torch
from torch.utils._pytree import tree_leaves, tree_map_only

_WRITING = ("__setitem__", "__delitem__", "__set__", "__delete__")
# Names that start like in-place operators, but only read.
_READING = ("__index__", "__int__", "__invert__", "__init__", "__init_subclass__", "__iter__")


class ReadOnlyTensor(torch.Tensor):
    """A tensor that cannot be written, nor can its views. Results of operations are plain tensors;
    ``numpy()`` returns a read-only array, ``untyped_storage()`` a copy. A write raises ValueError
    with the message `refusal`.
    """

    refusal: str

    def __new__(cls, tensor: torch.Tensor, refusal: str) -> "ReadOnlyTensor":
        self = tensor.as_subclass(cls)
        self.refusal = refusal
        return self

    @classmethod
    def __torch_function__(cls, function, types, args=(), kwargs=None) -> object:
        kwargs = kwargs or {}
        name = getattr(function, "__name__", "")
        in_place = name.endswith("_") and not name.endswith("__") or name.startswith("__i")
        writes = (in_place or name in _WRITING) and name not in _READING
        for tensor in tree_leaves([kwargs.get("out"), args[:1] if writes else None]):
            if isinstance(tensor, cls):
                raise ValueError(tensor.refusal)
        refusals = {}

        def plain(tensor: ReadOnlyTensor) -> torch.Tensor:
            with torch._C.DisableTorchFunctionSubclass():
                plain = tensor.as_subclass(torch.Tensor)
                refusals[plain.untyped_storage()._cdata] = tensor.refusal
                return plain.clone() if name == "__dlpack__" else plain

        def guarded(tensor: torch.Tensor) -> torch.Tensor:
            refusal = refusals.get(tensor.untyped_storage()._cdata)
            return cls(tensor, refusal) if refusal else tensor

        out = function(*tree_map_only(cls, plain, args), **tree_map_only(cls, plain, kwargs))
        if isinstance(out, np.ndarray):
            out.setflags(write=False)
        if isinstance(out, (torch.UntypedStorage, torch.TypedStorage)):
            return out.clone()
        if isinstance(out, torch.Size) or name == "tolist":  # which hold no tensors
            return out
        return tree_map_only(torch.Tensor, guarded, out)

    def set_(
        self, *args: object, **kwargs: object
    ) -> NoReturn:  # the one method that skips __torch_function__
        raise ValueError(self.refusal)


class SetOnce:
    """An object whose attributes are set once. Tensors may be written in place but not replaced,
    because the engine and CUDA graphs hold their addresses.
    """

    _replaceable: tuple[str, ...] = ()

    def __setattr__(self, name: str, value: object) -> None:
        current = self.__dict__.get(name, value)
        if current is not value and name not in self._replaceable:
            raise AttributeError(self._refusal(name))
        super().__setattr__(name, value)

    def __delattr__(self, name: str) -> None:
        raise AttributeError(self._refusal(name))

    def _refusal(self, name: str) -> str:
        kind = type(self).__name__
        if isinstance(self.__dict__.get(name), torch.Tensor):
            return f"{name} of a {kind} cannot be replaced: write into it, .{name}[...] = ..."
        return f"{name} of a {kind} cannot be changed: make another {kind}"
