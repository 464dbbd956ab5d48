"""Random number generators that objects own, move between devices, and save."""

import contextlib
import hashlib
import math
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from itertools import chain, repeat

import torch

_MAX_NUMBERS = 2**22  # of a block, 16 MiB
# calls that a block is for, whether a CUDA graph is being recorded, what is left of each block
_AHEAD: ContextVar[tuple[int, bool, dict]] = ContextVar("ahead", default=(1, False, {}))


def stream_seed(seed: int, name: str) -> int:
    """Returns the seed of one of a run's random streams, from 0 to 2**63 - 1, by the name of what
    draws from it, such as "policy". Streams of different names or seeds are independent.
    """
    digest = hashlib.sha256(f"{seed} {name}".encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def seed_of(kind: str, number: int, seed: int) -> int:
    """Returns the seed of a "rank" or a "member" of a run: of number 0 the run's, of each other one
    its own, below 2**31.
    """
    return seed if number == 0 else stream_seed(seed, f"{kind} {number}") % 2**31


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Inside, PyTorch's generator on the CPU has this seed, and one thread computes: orthogonal
    weights of a seed differ with the number of threads, and so from host to host.
    """
    n_threads = torch.get_num_threads()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(n_threads)


@contextlib.contextmanager
def drawn_ahead(n_calls: int) -> Iterator[None]:
    """Inside, `draw` draws the numbers of so many calls in two kernels. More than 1 take a GPU."""
    is_recording = n_calls > 1 and torch.cuda.is_current_stream_capturing()
    token = _AHEAD.set((n_calls, is_recording, {}))
    try:
        yield
    finally:
        _AHEAD.reset(token)


def draw(
    owner: object, fill: Callable, shape: tuple, generator: torch.Generator | None, device
) -> torch.Tensor:
    """Returns new random numbers, float32, filled in by a method such as `torch.Tensor.normal_`.
    Each owner, such as a policy's output, has blocks of its own, on whichever stream it runs.
    """
    n_calls, was_recording, blocks = _AHEAD.get()
    # a graph that is recorded inside would read a block from outside again in every replay
    if n_calls == 1 or torch.cuda.is_current_stream_capturing() != was_recording:
        return fill(torch.empty(shape, device=device), generator=generator)
    # first for this call alone, as the next may have another shape
    rows = chain((1,), repeat(min(n_calls - 1, 1 + _MAX_NUMBERS // (1 + math.prod(shape)))))
    drawn = (fill(torch.empty(n, *shape, device=device), generator=generator) for n in rows)
    # an owner on two streams has two blocks, as streams do not wait for each other
    stream = torch.cuda.current_stream(device) if device.type == "cuda" else None
    key = owner, fill, shape, generator, stream
    return next(blocks.setdefault(key, chain.from_iterable(drawn)))


class SeededGenerator:
    """A `torch.Generator` that is created from a seed on the device where it is first used. A state
    that was saved on another type of device is left out: there, the sequence starts again.
    """

    def __init__(self, seed: int):
        self.seed = seed
        self._generator: torch.Generator | None = None

    def on(self, device: torch.device) -> torch.Generator:
        """Returns the generator for a device, a GPU with its number (`cuda:0`)."""
        if self._generator is None or self._generator.device != device:
            self._generator = torch.Generator(device).manual_seed(self.seed)
        return self._generator

    def state_dict(self) -> dict:
        """Returns the seed and, once the generator was used, its type of device and its state."""
        state = {"seed": self.seed}
        if self._generator is not None:
            state["device"] = self._generator.device.type
            state["generator"] = self._generator.get_state()
        return state

    def load_state_dict(self, state: dict, device: torch.device) -> None:
        """Continues from a `state_dict`, whose tensors may be on any device."""
        self.seed, self._generator = state["seed"], None
        if state.get("device") == device.type:
            # set_state takes a CPU tensor, also for a generator on a GPU
            self.on(device).set_state(state["generator"].cpu())
