"""The global generators of NumPy, Python and PyTorch, one set for each environment that draws from
them: its numbers then do not depend on which others step in the same process, or on how many.

Workers import it, so PyTorch's is one of them only where PyTorch is imported.
"""

from __future__ import annotations

import contextlib
import copy
import random
import sys
from collections.abc import Collection, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import torch

KINDS = "numpy", "python", "torch"
_NUMPY: Any = np.random  # whose types leave out the functions that exchange its bit generator


class GlobalGenerators:
    """The global generators as one environment finds them, each at a place of its own."""

    def __init__(self, seed: Sequence[int]):
        sequence = np.random.SeedSequence([*seed, 1])  # a 0 at the end would count for nothing
        self.numpy = np.random.Generator(np.random.MT19937(sequence))
        self.python = random.Random(int(sequence.generate_state(1)[0]))
        self.torch, self.torch_seed = None, int(sequence.generate_state(2)[1])
        if torch := sys.modules.get("torch"):
            self.torch = torch.Generator().manual_seed(self.torch_seed)

    def drop(self, kinds: Collection[str]) -> None:
        """Forgets generators of some of `KINDS`."""
        for kind in kinds:
            setattr(self, kind, None)

    def states(self) -> dict[str, object]:
        """Returns the states by kind, equal where nothing was drawn in between."""
        return dict(
            numpy=repr(self.numpy.bit_generator.state),
            python=self.python.getstate(),
            torch=self.torch and self.torch.get_state().tolist(),
        )

    @contextlib.contextmanager
    def installed(self, kinds: Collection[str]) -> Iterator[None]:
        """Draws inside come from these generators, of some of `KINDS`. Others stay as they are."""
        torch = sys.modules.get("torch") if "torch" in kinds else None
        with contextlib.ExitStack() as undo:
            if "numpy" in kinds:
                undo.callback(_NUMPY.set_bit_generator, _NUMPY.get_bit_generator())
                _NUMPY.set_bit_generator(self.numpy.bit_generator)
            if "python" in kinds:
                undo.callback(random.setstate, random.getstate())
                random.setstate(self.python.getstate())
                undo.callback(lambda: self.python.setstate(random.getstate()))
            if torch is not None:
                own = self.torch or torch.Generator().manual_seed(self.torch_seed)
                self.torch = own
                undo.callback(torch.set_rng_state, torch.get_rng_state())
                torch.set_rng_state(own.get_state())
                undo.callback(lambda: own.set_state(torch.get_rng_state()))
            yield


@contextlib.contextmanager
def kept() -> Iterator[None]:
    """Draws inside leave the global generators as they were."""
    outside = Held.current()
    outside.copied().install()
    try:
        yield
    finally:
        outside.install()


class Held(NamedTuple):
    """Global generators that are not the current ones: PyTorch's and Python's as states, and
    NumPy's as the generator itself, since exchanging states takes it thirty times as long.
    """

    numpy: object
    python: tuple
    torch: torch.Tensor | None

    @classmethod
    def current(cls) -> Held:
        """Returns the current ones."""
        torch = sys.modules.get("torch")
        return cls(_NUMPY.get_bit_generator(), random.getstate(), torch and torch.get_rng_state())

    def copied(self) -> Held:
        """Returns ones that go on alike and apart."""
        return self._replace(numpy=copy.deepcopy(self.numpy))

    def install(self) -> None:
        """Makes them the current ones."""
        _NUMPY.set_bit_generator(self.numpy)
        random.setstate(self.python)
        if self.torch is not None:
            sys.modules["torch"].set_rng_state(self.torch)
