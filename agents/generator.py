"""Random number generators that objects own, move between devices, and save."""

import hashlib

import torch


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
