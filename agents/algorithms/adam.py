"""Adam through PyTorch's fused operation.

`torch.optim.Adam` imports PyTorch's compiler first, which takes more than a second.
"""

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

import torch

_NONE = MappingProxyType({})


class Adam:
    """Adam (Kingma and Ba 2015), with decoupled weight decay (AdamW, Loshchilov and Hutter 2019).

    A step skips parameters without a gradient: frozen or unused ones.

    Args:
        parameters: parameters to optimise. They share one count of steps, as if every step had
            had a gradient for each.
        lr: step size, a tensor () on their device that may be changed in place.
        betas: decay of the running means of gradients and of squared gradients.
        eps: added to the denominator.
        lr_factors: factors of `lr` for some of the parameters; 1 for the others.
        weight_decays: weight decays of some of the parameters, from each of which a step also
            subtracts step size x decay x parameter; 0 for the others.
    """

    def __init__(
        self,
        parameters: Iterable[torch.nn.Parameter],
        lr: torch.Tensor,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-5,
        lr_factors: Mapping[torch.nn.Parameter, float] = _NONE,
        weight_decays: Mapping[torch.nn.Parameter, float] = _NONE,
    ):
        self.parameters, self.lr = list(parameters), lr
        self.betas, self.eps = betas, eps
        self.n_steps = torch.zeros((), device=lr.device)
        self.means = [torch.zeros_like(p) for p in self.parameters]
        self.squares = [torch.zeros_like(p) for p in self.parameters]
        # those of one step size and one decay are updated by one operation
        self._groups: dict[tuple[float, float], list] = {}
        for row in zip(self.parameters, self.means, self.squares, strict=True):
            key = lr_factors.get(row[0], 1.0), weight_decays.get(row[0], 0.0)
            self._groups.setdefault(key, []).append(row)

    @torch.no_grad()
    def step(self, is_taken: torch.Tensor) -> None:
        """Takes one step if `is_taken`, a bool () on the device; otherwise changes nothing."""
        self.n_steps += is_taken
        found_inf = (~is_taken).float()
        for (factor, weight_decay), members in self._groups.items():
            rows = [(p, p.grad, *moments) for p, *moments in members if p.grad is not None]
            if rows:
                torch._fused_adamw_(
                    *map(list, zip(*rows)),
                    [],
                    [self.n_steps] * len(rows),
                    lr=self.lr if factor == 1 else self.lr * factor,
                    beta1=self.betas[0],
                    beta2=self.betas[1],
                    weight_decay=weight_decay,
                    eps=self.eps,
                    amsgrad=False,
                    maximize=False,
                    found_inf=found_inf,
                )

    def zero_grad(self) -> None:
        """Frees the gradients."""
        for p in self.parameters:
            p.grad = None

    def state_dict(self) -> dict[str, Any]:
        """Returns the number of steps and both running means."""
        return dict(n_steps=self.n_steps, means=self.means, squares=self.squares)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from a `state_dict`, in place."""
        self.n_steps.copy_(state["n_steps"])
        saved = state["means"] + state["squares"]
        for target, source in zip(self.means + self.squares, saved):
            target.copy_(source)
