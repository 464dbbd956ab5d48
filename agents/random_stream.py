"""A seeded source of random numbers that an object can own, take to another device, and save."""

import torch


class RandomStream:
    """A torch.Generator made from a seed on the device where it is first asked for.

    Its state travels as plain numbers and tensors. On a device of another type, where a state means
    nothing, the sequence starts again from the seed.
    """

    def __init__(self, seed):
        self.seed = seed
        self._generator = None

    def on(self, device):
        """The generator on this device, a torch.device as tensors give it: a GPU with its
        number.
        """
        if self._generator is None or self._generator.device != device:
            self._generator = torch.Generator(device).manual_seed(self.seed)
        return self._generator

    def state_dict(self):
        drawn = (
            {}
            if self._generator is None
            else {"device": self._generator.device.type, "generator": self._generator.get_state()}
        )
        return {"seed": self.seed, **drawn}

    def load_state_dict(self, state, device):
        self.seed, self._generator = state["seed"], None
        if state.get("device") == device.type:
            self.on(device).set_state(state["generator"])
