"""A seeded source of random numbers that an object can own, take to another device, and save."""

from typing import Any

import torch


class SeededGenerator:
    """A torch.Generator made from a seed on the device where it is first used.

    Its state is saved as plain numbers and tensors. On a device of another type, where such a state
    means nothing, the sequence starts again from the seed.
    """

    def __init__(self, seed: int):
        self.seed = seed
        self._generator = None

    def on(self, device: torch.device) -> torch.Generator:
        """The generator on this device, which is named as tensors name theirs: a GPU with its
        number.
        """
        if self._generator is None or self._generator.device != device:
            self._generator = torch.Generator(device).manual_seed(self.seed)
        return self._generator

    def state_dict(self) -> dict[str, Any]:
        """The seed and, once the generator was used, its device's type and its state."""
        state = {"seed": self.seed}
        if self._generator is not None:
            state["device"] = self._generator.device.type
            state["generator"] = self._generator.get_state()
        return state

    def load_state_dict(self, state: dict[str, Any], device: torch.device) -> None:
        """Goes on from a `state_dict`, which may have been moved to any device."""
        self.seed, self._generator = state["seed"], None
        if state.get("device") == device.type:
            # a generator takes its state from the CPU, also on a GPU
            self.on(device).set_state(state["generator"].cpu())
