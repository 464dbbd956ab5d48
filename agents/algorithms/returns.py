"""Advantages and returns: GAE, V-trace and n-step returns as pure functions.

Axes: T time, B lanes. Everything is (T, B); row t is the action of time t, and `reward`, `reset`,
`terminal`, `truncated` at row t belong to the world that followed it, t+1. `value` at row t is V_t,
the value of the observation *before* the action, and `last_value` (B,) is V_T, that of the last
observation, so V_{t+1} is the next row.

An action is *valid* if the environment took it: valid_t = not reset_{t+1}. An episode's last
observation has `terminal` (nothing follows: V counts as 0) or `truncated` (something would have
followed: V counts) set; no sum crosses either.
"""

import torch

from megastep import arrdict
from megastep.agents.networks.scan import scan


def discounted_sum(terms: torch.Tensor, discounts: torch.Tensor) -> torch.Tensor:
    """x_t = terms_t + discounts_t x_{t+1}, x_T = 0, along the first axis. A discount of 0, which is
    how an episode ends, is exact.
    """
    return scan(terms, discounts, reverse=True)


def _following(value, last_value):
    return torch.cat([value[1:], last_value[None]])


def gae(
    reward: torch.Tensor,
    value: torch.Tensor,
    last_value: torch.Tensor,
    reset: torch.Tensor,
    terminal: torch.Tensor,
    truncated: torch.Tensor,
    *,
    gamma: float,
    lambda_: float,
) -> arrdict.arrdict:
    """Generalised advantage estimates (Schulman et al. 2016), and the lambda returns A + V for the
    value to fit.

        delta_t = r_{t+1} + gamma (1 - terminal_{t+1}) V_{t+1} - V_t
        A_t     = delta_t + gamma lambda (1 - done_{t+1}) A_{t+1},   done = terminal or truncated

    A is 0 where the action was not valid. Returns arrdict(advantages, targets, valid), each (T, B).
    """
    delta = reward + gamma * _following(value, last_value).masked_fill(terminal, 0.0) - value
    delta = delta.masked_fill(reset, 0.0)
    discounts = torch.full_like(value, gamma * lambda_).masked_fill_(
        terminal | truncated | reset, 0.0
    )
    advantages = discounted_sum(delta, discounts)
    return arrdict.arrdict(advantages=advantages, targets=advantages + value, valid=~reset)


def vtrace(
    log_ratio: torch.Tensor,
    reward: torch.Tensor,
    value: torch.Tensor,
    last_value: torch.Tensor,
    reset: torch.Tensor,
    terminal: torch.Tensor,
    truncated: torch.Tensor,
    *,
    gamma: float,
    lambda_: float = 1.0,
    rho_clip: float = 1.0,
    c_clip: float = 1.0,
) -> arrdict.arrdict:
    """V-trace (Espeholt et al. 2018, IMPALA): returns and advantages of a policy pi from the
    actions of another, mu.

    With `log_ratio` = log pi(a_t) - log mu(a_t), rho_t = min(rho_clip, pi/mu), c_t = lambda
    min(c_clip, pi/mu):

        delta_t   = rho_t (r_{t+1} + gamma (1 - terminal_{t+1}) V_{t+1} - V_t)
        v_t - V_t = delta_t + gamma c_t (1 - done_{t+1}) (v_{t+1} - V_{t+1}),           v_T = V_T
        A_t       = rho_t (r_{t+1} + gamma (1 - terminal_{t+1}) v'_{t+1} - V_t),        v' = V at a
        truncation, else v

    The targets v are what the value should fit; A weighs the policy's gradient. Where the action
    was not valid v = V and A = 0. Returns arrdict(advantages, targets, valid), each (T, B).
    """
    following = _following(value, last_value)
    ratio = log_ratio.exp()
    rho = ratio.clamp(max=rho_clip)
    delta = rho * (reward + gamma * following.masked_fill(terminal, 0.0) - value)
    delta = delta.masked_fill(reset, 0.0)
    discounts = (gamma * lambda_ * ratio.clamp(max=c_clip)).masked_fill(
        terminal | truncated | reset, 0.0
    )
    targets = value + discounted_sum(delta, discounts)

    beyond = torch.where(truncated, following, _following(targets, last_value)).masked_fill(
        terminal, 0.0
    )
    advantages = rho * (reward + gamma * beyond - value)
    return arrdict.arrdict(
        advantages=advantages.masked_fill(reset, 0.0), targets=targets, valid=~reset
    )


def n_step(
    reward: torch.Tensor,
    value: torch.Tensor,
    last_value: torch.Tensor,
    reset: torch.Tensor,
    terminal: torch.Tensor,
    truncated: torch.Tensor,
    *,
    gamma: float,
    n: int,
) -> torch.Tensor:
    """n-step returns (T, B): G^n with

        G^0_t = V_t
        G^k_t = r_{t+1} + gamma (1 - terminal_{t+1}) G',    G' = V_{t+1} at a truncation and at the
        last row, else G^{k-1}_{t+1}

    So fewer steps count where an episode or the rows end. Where the action was not valid it is V.
    """
    following = _following(value, last_value)
    total = value
    for _ in range(n):
        beyond = torch.where(truncated, following, _following(total, last_value))
        total = reward + gamma * beyond.masked_fill(terminal, 0.0)
        total = torch.where(reset, value, total)
    return total


def rescaled(x: torch.Tensor, eps: float = 1e-3) -> torch.Tensor:
    """h(x) = sign(x) (sqrt(|x| + 1) - 1) + eps x, in which large returns differ less and small ones
    as much (Pohlen et al. 2018).
    """
    return x.sign() * ((x.abs() + 1).sqrt() - 1) + eps * x


def unscaled(y: torch.Tensor, eps: float = 1e-3) -> torch.Tensor:
    """The inverse of `rescaled`, in the form that is exact for large values; near 0 it is off by a
    float's last digit of 1.
    """
    size = y.abs()
    root = 2 * (size + 1 + eps) / ((1 + 4 * eps * (size + 1 + eps)).sqrt() + 1)
    return y.sign() * (root.square() - 1)
