"""Adam, as PyTorch's fused operation.

PyTorch's own class imports its compiler before it does anything, which takes more than a second.
"""

from collections.abc import Iterable
from typing import Any

import torch


class Adam:
    """Adam (Kingma and Ba 2015) over parameters that always have a gradient.

    `lr` is a tensor () on their device, changed in place from outside.
    """

    def __init__(
        self,
        parameters: Iterable[torch.nn.Parameter],
        lr: torch.Tensor,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-5,
    ):
        self.parameters, self.lr = list(parameters), lr
        self.betas, self.eps = betas, eps
        self.n_steps = torch.zeros((), device=lr.device)
        self.means = [torch.zeros_like(p) for p in self.parameters]
        self.squares = [torch.zeros_like(p) for p in self.parameters]

    @torch.no_grad()
    def step(self, is_taken: torch.Tensor) -> None:
        """Follows the gradients, or changes nothing at all unless `is_taken`, a bool () on the
        device.
        """
        self.n_steps += is_taken
        torch._fused_adam_(
            self.parameters,
            [p.grad for p in self.parameters],
            self.means,
            self.squares,
            [],
            [self.n_steps] * len(self.parameters),
            lr=self.lr,
            beta1=self.betas[0],
            beta2=self.betas[1],
            weight_decay=0.0,
            eps=self.eps,
            amsgrad=False,
            maximize=False,
            found_inf=(~is_taken).float(),
        )

    def zero_grad(self) -> None:
        for p in self.parameters:
            p.grad = None

    def state_dict(self) -> dict[str, Any]:
        return dict(n_steps=self.n_steps, means=self.means, squares=self.squares)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.n_steps.copy_(state["n_steps"])
        for own, saved in zip(self.means + self.squares, state["means"] + state["squares"]):
            own.copy_(saved)
