"""Advantages and returns as pure functions: GAE, V-trace and n-step returns.

T time, B lanes; tensors are (T, B) unless noted. Row t is the action of time t. `reward`, `reset`,
`terminal` and `truncated` at row t come from the world that followed it, t+1. `value` at row t is
V_t, of the observation *before* the action; `last_value` (B,) is V_T, of the last observation.
`gamma`, `lambda_` and the clips are numbers, or tensors () on the device.

An action is *valid* if the environment took it: valid_t = not reset_{t+1}. After a terminal step
the value is 0; after a truncated step returns bootstrap from V. No sum crosses an episode's end.
"""

import torch

from megastep import arrdict
from megastep.agents.algorithms.kernels import LIBRARY
from megastep.agents.networks.fused import fused
from megastep.agents.networks.linear import linear_scan
from megastep.coefficients import on_device
from megastep.kernels.build.launch import launch


def _following(value, last_value) -> torch.Tensor:
    return torch.cat([value[1:], last_value[None]])


def _gae_on_gpu(
    reward, value, last_value, reset, terminal, truncated, learns=None, *, gamma, lambda_
) -> arrdict.arrdict:
    (n_steps, n_lanes), device = reward.shape, value.device
    advantages, targets = reward.new_empty(2, n_steps, n_lanes)
    valid = torch.empty_like(advantages, dtype=torch.bool)
    inputs = dict(reward=reward, values=value, last_value=last_value, reset=reset)
    inputs |= dict(terminal=terminal, truncated=truncated)
    launch(
        *(LIBRARY, "gae", device, n_lanes),
        **{name: leaf.contiguous() for name, leaf in inputs.items()},
        learns=None if learns is None else learns.contiguous(),
        **dict(advantages=advantages, targets=targets, valid=valid),
        **dict(gamma=on_device(gamma, device), lambda_=on_device(lambda_, device)),
        **dict(n_steps=n_steps, n_lanes=n_lanes),
    )
    return arrdict.arrdict(advantages=advantages, targets=targets, valid=valid)


@fused(
    _gae_on_gpu,
    lambda reward, value, *_, **__: value.is_cuda and reward.dtype == value.dtype == torch.float32,
)
def gae(
    reward: torch.Tensor,
    value: torch.Tensor,
    last_value: torch.Tensor,
    reset: torch.Tensor,
    terminal: torch.Tensor,
    truncated: torch.Tensor,
    learns: torch.Tensor | None = None,
    *,
    gamma: float | torch.Tensor,
    lambda_: float | torch.Tensor,
) -> arrdict.arrdict:
    """Computes generalised advantage estimates (GAE, Schulman et al. 2016, eq. 16).

        delta_t = r_{t+1} + gamma (1 - terminal_{t+1}) V_{t+1} - V_t
        A_t     = delta_t + gamma lambda (1 - done_{t+1}) A_{t+1},   done = terminal or truncated

    Returns arrdict(advantages, targets, valid), each (T, B). Targets are the lambda returns A + V,
    which the value should fit. A is 0 where the environment ignored the action. Transitions without
    `learns`, (T, B) bool, are not valid. None: all.
    """
    delta = reward + gamma * _following(value, last_value).masked_fill(terminal, 0.0) - value
    delta = delta.masked_fill(reset, 0.0)
    ends = terminal | truncated | reset
    discounts = (torch.ones_like(value) * (gamma * lambda_)).masked_fill(ends, 0.0)
    advantages = linear_scan(delta, discounts, reverse=True)
    valid = ~reset if learns is None else ~reset & learns
    return arrdict.arrdict(advantages=advantages, targets=advantages + value, valid=valid)


def _vtrace_on_gpu(
    log_ratio, reward, value, last_value, reset, terminal, truncated, **numbers
) -> arrdict.arrdict:
    (n_steps, n_lanes), device = value.shape, value.device
    advantages, targets = value.new_empty(2, n_steps, n_lanes)
    steps = dict(log_ratio=log_ratio, reward=reward, reset=reset, terminal=terminal)
    numbers = {**dict.fromkeys(("lambda_", "rho_clip", "c_clip"), 1.0), **numbers}
    launch(
        *(LIBRARY, "vtrace", device, n_lanes),
        **{name: leaf.contiguous() for name, leaf in (steps | dict(truncated=truncated)).items()},
        values=torch.cat([value, last_value[None]]),
        **dict(advantages=advantages, targets=targets),
        **{name: on_device(number, device) for name, number in numbers.items()},
        **dict(n_steps=n_steps, n_lanes=n_lanes),
    )
    return arrdict.arrdict(advantages=advantages, targets=targets, valid=~reset)


@fused(
    _vtrace_on_gpu,
    lambda log_ratio, reward, value, *_, **__: (
        value.is_cuda and log_ratio.dtype == reward.dtype == value.dtype == torch.float32
    ),
)
def vtrace(
    log_ratio: torch.Tensor,
    reward: torch.Tensor,
    value: torch.Tensor,
    last_value: torch.Tensor,
    reset: torch.Tensor,
    terminal: torch.Tensor,
    truncated: torch.Tensor,
    *,
    gamma: float | torch.Tensor,
    lambda_: float | torch.Tensor = 1.0,
    rho_clip: float | torch.Tensor = 1.0,
    c_clip: float | torch.Tensor = 1.0,
) -> arrdict.arrdict:
    """Computes V-trace returns and advantages of a policy pi from actions of another policy, mu
    (IMPALA, Espeholt et al. 2018, section 4.1). With rho_t = min(rho_clip, pi/mu) and
    c_t = lambda min(c_clip, pi/mu):

        delta_t   = rho_t (r_{t+1} + gamma (1 - terminal_{t+1}) V_{t+1} - V_t)
        v_t - V_t = delta_t + gamma c_t (1 - done_{t+1}) (v_{t+1} - V_{t+1}),      v_T = V_T
        A_t       = rho_t (r_{t+1} + gamma (1 - terminal_{t+1}) v'_{t+1} - V_t),   v' = V at a
                                                                             truncation, else v

    Returns arrdict(advantages, targets, valid), each (T, B), from log_ratio = log pi(a_t) -
    log mu(a_t). The value should fit the targets v; the policy's gradient is weighted by A. Where
    the action was not valid, v = V and A = 0.
    """
    following = _following(value, last_value)
    ratio = log_ratio.exp()
    rho = ratio.clamp(max=rho_clip)
    delta = rho * (reward + gamma * following.masked_fill(terminal, 0.0) - value)
    delta = delta.masked_fill(reset, 0.0)
    ends = terminal | truncated | reset
    discounts = (gamma * lambda_ * ratio.clamp(max=c_clip)).masked_fill(ends, 0.0)
    targets = value + linear_scan(delta, discounts, reverse=True)
    beyond = torch.where(truncated, following, _following(targets, last_value))
    advantages = rho * (reward + gamma * beyond.masked_fill(terminal, 0.0) - value)
    advantages = advantages.masked_fill(reset, 0.0)
    return arrdict.arrdict(advantages=advantages, targets=targets, valid=~reset)


def n_step_returns(
    reward: torch.Tensor,
    value: torch.Tensor,
    last_value: torch.Tensor,
    reset: torch.Tensor,
    terminal: torch.Tensor,
    truncated: torch.Tensor,
    *,
    gamma: float | torch.Tensor,
    n: int,
) -> torch.Tensor:
    """Computes n-step returns (T, B), G^n in

        G^0_t = V_t
        G^k_t = r_{t+1} + gamma (1 - terminal_{t+1}) G',    G' = V_{t+1} at a truncation and at the
                                                            last row, else G^{k-1}_{t+1}

    Returns are shorter where an episode or the rows end. Where the action was not valid, G = V.
    """
    following = _following(value, last_value)
    total = value
    for _ in range(min(n, len(reward))):  # no return is longer than the rows
        beyond = torch.where(truncated, following, _following(total, last_value))
        total = reward + gamma * beyond.masked_fill(terminal, 0.0)
        total = torch.where(reset, value, total)
    return total


def rescale(x: torch.Tensor, eps: float = 1e-3) -> torch.Tensor:
    """Returns h(x) = sign(x) (sqrt(|x| + 1) - 1) + eps x (value rescaling, Pohlen et al. 2018)."""
    return x.sign() * ((x.abs() + 1).sqrt() - 1) + eps * x


def inverse_rescale(y: torch.Tensor, eps: float = 1e-3) -> torch.Tensor:
    """Returns the inverse of `rescale`."""
    size = y.abs()
    root = 2 * (size + 1 + eps) / ((1 + 4 * eps * (size + 1 + eps)).sqrt() + 1)
    return y.sign() * (root.square() - 1)
