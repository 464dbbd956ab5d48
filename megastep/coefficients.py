"""Numbers that may change while training, on the device where kernels read them."""

import math
import numbers
from typing import cast

import torch

from megastep.schedules import Number, called, schedule_of


class Coefficients:
    """Numbers that may change while training, also those that a CUDA graph reads.

        coefficients = Coefficients(device, gamma=0.99, entropy_coef={"from": 0.02, "to": 0.001})
        coefficients.follow(0.5)  # half of the budget is spent
        coefficients.set(gamma=0.995)  # from outside

    Attributes:
        values: the present numbers by name.
        tensors: the same as tensors (), float32, which keep their place in memory.
        schedules: functions of the fraction of the budget, of those that have one.
    """

    IS_STATELESS = True  # whatever sets them does so again; see `megastep.engine.state_tree`

    def __init__(self, device: torch.device | str, **settings: Number):
        self.schedules, self.values = {}, {}
        for name, value in settings.items():
            if (function := schedule_of(value)) is not None:
                self.schedules[name], value = function, called(function, 0.0)
            self.values[name] = float(cast(float, value))
        vector = torch.tensor([*self.values.values()], dtype=torch.float32, device=device)
        self.tensors: dict = dict(zip(self.values, vector.unbind()))
        self.is_on_gpu = vector.is_cuda

    def __getitem__(self, name: str) -> "float | torch.Tensor":
        """The number for an update: on a GPU the tensor, which a graph reads, on a CPU a float."""
        return self.tensors[name] if self.is_on_gpu else self.values[name]

    def set(self, **values: float) -> None:
        """Changes numbers, without waiting for the device. Raises ValueError for other names."""
        for name, value in values.items():
            if name not in self.values:
                raise ValueError(f"{name} is no coefficient; there are {', '.join(self.values)}")
            self.values[name] = value
            self.tensors[name].fill_(value)

    def follow(self, fraction: float) -> dict[str, float]:
        """Sets those with a schedule by the fraction of the budget that is spent, and returns them
        by name. Raises ValueError if a function fails, or gives no finite number.
        """
        values = {name: called(function, fraction) for name, function in self.schedules.items()}
        for name, value in values.items():
            if not isinstance(value, numbers.Real) or not math.isfinite(value):
                raise ValueError(f"the schedule of {name} gave {value!r} at {fraction:g}")
        values = {name: float(value) for name, value in values.items()}
        self.set(**values)
        return values


def on_device(number: "float | torch.Tensor", device: torch.device) -> torch.Tensor:
    """Returns a number as a tensor () float32 on a device, where a kernel reads it."""
    if isinstance(number, torch.Tensor):
        return number
    return torch.full((), number, dtype=torch.float32, device=device)
