"""Optimizers by name: Adam, plain gradient descent, and those of other packages."""

from collections.abc import Callable, Iterable, Mapping

import torch

from megastep.agents.algorithms.adam import Adam
from megastep.agents.types import StateDict
from megastep.imports import import_object

#: Adam's weight decay is decoupled, so that with one it is AdamW.
NAMES = ("adam", "adamw", "sgd")
_Factors = Mapping[torch.nn.Parameter, float]


def make_optimizer(
    name: str,
    parameters: Iterable[torch.nn.Parameter],
    lr: torch.Tensor,
    lr_factors: _Factors,
    weight_decays: _Factors,
) -> "Adam | SGD | Imported":
    """Returns an optimizer; arguments are those of `Adam`.

    Args:
        name: one of `NAMES`, or the import path of a class like those of `torch.optim`.
    """
    settings = parameters, lr, lr_factors, weight_decays
    if name == "sgd":
        return SGD(*settings)
    if name in NAMES:
        return Adam(parameters, lr, lr_factors=lr_factors, weight_decays=weight_decays)
    return Imported(*settings, import_object(name), name)


class SGD:
    """Gradient descent without momentum, as a few operations that a CUDA graph can repeat."""

    capturable = True

    def __init__(
        self,
        parameters: Iterable[torch.nn.Parameter],
        lr: torch.Tensor,
        lr_factors: _Factors,
        weight_decays: _Factors,
    ):
        self.parameters, self.lr = list(parameters), lr
        self.lr_factors, self.weight_decays = lr_factors, weight_decays
        self.n_steps = torch.zeros((), device=lr.device)

    def grad_norm(self) -> torch.Tensor:
        """Returns the norm () of all gradients together."""
        return torch.nn.utils.get_total_norm(_gradients(self.parameters))

    @torch.no_grad()
    def step(
        self, is_taken: torch.Tensor, grad_norm: torch.Tensor | None = None, max_norm: float = 0.0
    ) -> None:
        """Takes one step, as `Adam.step` does."""
        self.n_steps += is_taken
        if grad_norm is not None:
            torch.nn.utils.clip_grads_with_norm_(self.parameters, max_norm, grad_norm)
        for p in self.parameters:
            if p.grad is None:
                continue
            change = p.grad + self.weight_decays.get(p, 0.0) * p
            change = (self.lr * self.lr_factors.get(p, 1.0)) * change
            p.sub_(change.masked_fill_(~is_taken, 0.0))  # its gradient may be NaN

    def zero_grad(self) -> None:
        """Frees the gradients."""
        for p in self.parameters:
            p.grad = None

    def state_dict(self) -> StateDict:
        """Returns the number of steps."""
        return dict(n_steps=self.n_steps)

    def load_state_dict(self, state: StateDict) -> None:
        """Continues from a `state_dict`, in place."""
        self.n_steps.copy_(state["n_steps"])


class Imported(SGD):
    """An optimizer of another package. Its steps read conditions and the learning rate on the host,
    so an update is not a CUDA graph.

    Args:
        make: takes groups of parameters, as dicts with `params`, `lr` and, if not 0,
            `weight_decay`.
        name: of it, in messages.

    Raises:
        ValueError: it cannot be made so.
    """

    capturable = False

    def __init__(
        self,
        parameters: Iterable[torch.nn.Parameter],
        lr: torch.Tensor,
        lr_factors: _Factors,
        weight_decays: _Factors,
        make: Callable,
        name: str,
    ):
        super().__init__(parameters, lr, lr_factors, weight_decays)
        groups: dict[tuple[float, float], list] = {}
        for p in self.parameters:
            key = lr_factors.get(p, 1.0), weight_decays.get(p, 0.0)
            groups.setdefault(key, []).append(p)
        self.factors, rate = [factor for factor, _ in groups], float(lr)
        settings = [
            {"params": members, "lr": rate * factor, **({"weight_decay": decay} if decay else {})}
            for (factor, decay), members in groups.items()
        ]
        try:
            self.inner = make(settings)
            methods = self.inner.step, self.inner.state_dict, self.inner.load_state_dict
            assert all(map(callable, methods))
            assert len(self.inner.param_groups) == len(settings)
        except Exception as error:
            problem = f"{type(error).__name__}: {error}".rstrip(": ")
            raise ValueError(
                f"optimizer={name} cannot be made from groups of parameters, as those of "
                f"torch.optim can ({problem})"
            ) from None

    @torch.no_grad()
    def step(
        self, is_taken: torch.Tensor, grad_norm: torch.Tensor | None = None, max_norm: float = 0.0
    ) -> None:
        """Takes one step, if it is taken."""
        if not bool(is_taken):
            return
        self.n_steps += 1
        if grad_norm is not None:
            torch.nn.utils.clip_grads_with_norm_(self.parameters, max_norm, grad_norm)
        for group, factor in zip(self.inner.param_groups, self.factors, strict=True):
            group["lr"] = float(self.lr) * factor
        with torch.enable_grad():
            self.inner.step()

    def state_dict(self) -> StateDict:
        """Returns the number of steps and the optimizer's own state by parameter."""
        state = self.inner.state_dict()["state"]
        return dict(n_steps=self.n_steps, state={str(key): value for key, value in state.items()})

    def load_state_dict(self, state: StateDict) -> None:
        """Continues from a `state_dict`."""
        super().load_state_dict(state)
        own = {int(key): value for key, value in state["state"].items()}
        groups = self.inner.state_dict()["param_groups"]
        self.inner.load_state_dict({"state": own, "param_groups": groups})


def _gradients(parameters) -> list[torch.Tensor]:
    return [p.grad for p in parameters if p.grad is not None]
