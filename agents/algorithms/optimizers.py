"""Optimizers by name: Adam, and those of other packages.

Adam is PyTorch's fused operation on a CPU, on a GPU one kernel for all parameters that also clips
their gradients. PyTorch's takes ten times as long there for networks this small, and
`torch.optim.Adam` imports PyTorch's compiler first, which takes more than a second.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from types import MappingProxyType

import torch

from megastep.agents.algorithms.kernels import LIBRARY
from megastep.agents.networks.fused import fused, is_plain_on_gpu
from megastep.agents.types import StateDict
from megastep.imports import import_object
from megastep.kernels.build.launch import Blocks, launch

#: Adam's weight decay is decoupled, so that with one it is AdamW.
NAMES = ("adam", "adamw")
#: Decay of the running means of gradients and of squared gradients.
BETAS = 0.9, 0.999
#: Added to the denominator.
EPS = 1e-5
Factors = Mapping[torch.nn.Parameter, float]
_MAX_ROWS = LIBRARY.constants["ADAM_ROWS"]
THREADS = LIBRARY.constants["ADAM_THREADS"]
_NONE = MappingProxyType({})


class _Optimizer:
    """Base: parameters, of which groups have factors of the step size and weight decays."""

    def __init__(self, parameters, lr: torch.Tensor, lr_factors: Factors, weight_decays: Factors):
        self.parameters, self.lr = list(parameters), lr
        self.n_steps: torch.Tensor = torch.zeros((), device=lr.device)
        self.groups: dict[tuple[float, float], list] = {}
        for p in self.parameters:
            key = lr_factors.get(p, 1.0), weight_decays.get(p, 0.0)
            self.groups.setdefault(key, []).append(p)

    @torch.no_grad()
    def grad_norm(self) -> torch.Tensor:
        """Returns the norm () of all gradients together."""
        gradients = [p.grad for p in self.parameters if p.grad is not None]
        return torch.nn.utils.get_total_norm(gradients)


class Adam(_Optimizer):
    """Adam (Kingma and Ba 2015), with decoupled weight decay (AdamW, Loshchilov and Hutter 2019).

    A step skips parameters without a gradient: frozen or unused ones. All share one count of steps.

    Args:
        parameters: parameters to optimise.
        lr: step size, a tensor () on their device that may be changed in place.
        lr_factors: factors of `lr` for some of the parameters; 1 for the others.
        weight_decays: weight decays of some of the parameters, from each of which a step also
            subtracts step size x decay x parameter; 0 for the others.
    """

    capturable = True

    def __init__(
        self,
        parameters: Iterable[torch.nn.Parameter],
        lr: torch.Tensor,
        lr_factors: Factors = _NONE,
        weight_decays: Factors = _NONE,
    ):
        super().__init__(parameters, lr, lr_factors, weight_decays)
        self.means = [torch.zeros_like(p) for p in self.parameters]
        self.squares = [torch.zeros_like(p) for p in self.parameters]

    def rows(self) -> Iterator[tuple[float, float, list[tuple[torch.Tensor, ...]]]]:
        """Yields each group's factor, weight decay, and (parameter, gradient, running means)."""
        moments = dict(zip(self.parameters, zip(self.means, self.squares), strict=True))
        for (factor, weight_decay), members in self.groups.items():
            rows = [(p, p.grad, *moments[p]) for p in members if p.grad is not None]
            if rows:
                yield factor, weight_decay, rows

    def step(self, is_taken: torch.Tensor, grad_norm: torch.Tensor, max_norm: float) -> None:
        """Takes one step, or changes nothing if `is_taken`, () bool on the device, is false. Longer
        gradients than `max_norm` are scaled down to it; their norm is `grad_norm` ().
        """
        self.n_steps += is_taken
        self.update(is_taken, grad_norm, max_norm)

    @torch.no_grad()
    @fused(lambda *inputs: _update_on_gpu(*inputs), lambda self, *_: has_kernels(self))
    def update(self, is_taken: torch.Tensor, grad_norm: torch.Tensor, max_norm: float) -> None:
        """Takes a `step` that `n_steps` counts already."""
        torch.nn.utils.clip_grads_with_norm_(self.parameters, max_norm, grad_norm)
        for factor, weight_decay, rows in self.rows():
            torch._fused_adamw_(  # pyright: ignore[reportPrivateImportUsage]
                *map(list, zip(*rows)),
                max_exp_avg_sqs=[],
                state_steps=[self.n_steps] * len(rows),
                lr=self.lr if factor == 1 else self.lr * factor,
                beta1=BETAS[0],
                beta2=BETAS[1],
                weight_decay=weight_decay,
                eps=EPS,
                amsgrad=False,
                maximize=False,
                found_inf=(~is_taken).float(),
            )

    def state_dict(self) -> StateDict:
        """Returns the number of steps and both running means."""
        return dict(n_steps=self.n_steps, means=self.means, squares=self.squares)

    def load_state_dict(self, state: StateDict) -> None:
        """Continues from a `state_dict`, in place."""
        self.n_steps.copy_(state["n_steps"])
        saved = state["means"] + state["squares"]
        for target, source in zip(self.means + self.squares, saved):
            target.copy_(source)


class Imported(_Optimizer):
    """An optimizer of another package, by the import path of a class like those of `torch.optim`,
    which takes groups of parameters. Its steps read conditions and the learning rate on the host,
    so an update is not a CUDA graph. ValueError if it cannot be made so.
    """

    capturable = False

    def __init__(
        self,
        name: str,
        parameters: Iterable[torch.nn.Parameter],
        lr: torch.Tensor,
        lr_factors: Factors,
        weight_decays: Factors,
    ):
        super().__init__(parameters, lr, lr_factors, weight_decays)
        settings = [
            dict(params=ps, lr=float(lr) * factor, **(dict(weight_decay=decay) if decay else {}))
            for (factor, decay), ps in self.groups.items()
        ]
        try:
            self.inner = import_object(name)(settings)
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
    def step(self, is_taken: torch.Tensor, grad_norm: torch.Tensor, max_norm: float) -> None:
        """Takes one step, as `Adam.step` does."""
        if not bool(is_taken):
            return
        self.n_steps += 1
        torch.nn.utils.clip_grads_with_norm_(self.parameters, max_norm, grad_norm)
        for group, (factor, _) in zip(self.inner.param_groups, self.groups, strict=True):
            group["lr"] = float(self.lr) * factor
        with torch.enable_grad():
            self.inner.step()

    def state_dict(self) -> StateDict:
        """Returns the number of steps and the optimizer's own state by parameter."""
        state = self.inner.state_dict()["state"]
        return dict(n_steps=self.n_steps, state={str(key): value for key, value in state.items()})

    def load_state_dict(self, state: StateDict) -> None:
        """Continues from a `state_dict`."""
        self.n_steps.copy_(state["n_steps"])
        own = {int(key): value for key, value in state["state"].items()}
        groups = self.inner.state_dict()["param_groups"]
        self.inner.load_state_dict({"state": own, "param_groups": groups})


# ---- On a GPU ----


def has_kernels(adam: Adam) -> bool:
    """Returns whether kernels take the parameters and their present gradients."""
    gradients = [p.grad for p in adam.parameters if p.grad is not None]
    return bool(gradients) and is_plain_on_gpu(*adam.parameters, *gradients)


def squared_norms(adam: Adam) -> torch.Tensor:
    """Returns (n,) numbers that add up to the square of the norm of all gradients."""
    parts = list(_launches(adam))
    sums, first_sum = adam.n_steps.new_empty(sum(n for _, n in parts)), 0
    for rows, n_blocks in parts:
        launch(
            *(LIBRARY, "squared_norm", sums.device, Blocks(n_blocks, threads=THREADS)),
            **dict(rows=b"".join(rows), sums=sums, n_rows=len(rows), first_sum=first_sum),
        )
        first_sum += n_blocks
    return sums


def _update_on_gpu(adam, is_taken, grad_norm, max_norm) -> None:
    for rows, n_blocks in _launches(adam):
        launch(
            *(LIBRARY, "adam", adam.lr.device, Blocks(n_blocks, threads=THREADS)),
            **dict(rows=b"".join(rows), n_rows=len(rows), lr=adam.lr, n_steps=adam.n_steps),
            **dict(grad_norm=grad_norm, is_taken=is_taken, max_norm=max_norm),
            **dict(beta1=BETAS[0], beta2=BETAS[1], eps=EPS),
        )


def _launches(adam) -> Iterator[tuple[list[bytes], int]]:
    names = "parameter", "gradient", "mean", "square"
    rows = (
        (dict(zip(names, tensors)), dict(lr_factor=factor, weight_decay=weight_decay))
        for factor, weight_decay, members in adam.rows()
        for tensors in members
    )
    return launches(LIBRARY.params.AdamRowParams, rows)


def launches(
    pack_row: Callable[..., bytes], rows: Iterable[tuple[dict, dict]]
) -> Iterator[tuple[list[bytes], int]]:
    """Yields the packed rows of a launch and its number of blocks. A row is its tensors, of equally
    many numbers, and its other fields.
    """
    packed, n_blocks = [], 0
    for tensors, fields in rows:
        if len(packed) == _MAX_ROWS:
            yield packed, n_blocks
            packed, n_blocks = [], 0
        n = next(iter(tensors.values())).numel()
        is_aligned = int(not any(x.data_ptr() % 16 for x in tensors.values()))
        place = dict(n=n, first_block=n_blocks, is_aligned=is_aligned)
        packed.append(pack_row(**tensors, **place, **fields))
        n_blocks += max(1, -(-n // (4 * THREADS)))
    yield packed, n_blocks
