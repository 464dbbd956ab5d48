"""Returns and advantages against hand calculations, and loops that share no code with returns.py.
tests/test_laws.py has recursions and identities.
"""

import pytest
import torch

from megastep.agents.algorithms import returns

# two orders of summing the same few hundred float64 numbers
F64_CLOSE = dict(rtol=1e-10, atol=1e-10)


def column(*values):
    """Returns one lane over time, (T, 1)."""
    return torch.tensor(values, dtype=torch.float64)[:, None]


def flags(*values):
    return torch.tensor(values, dtype=torch.bool)[:, None]


def lane(value, last_value, reward, reset=None, terminal=None, truncated=None):
    none = torch.zeros(len(value), 1, dtype=torch.bool)
    return dict(
        value=column(*value),
        last_value=torch.tensor([last_value], dtype=torch.float64),
        reward=column(*reward),
        reset=none if reset is None else flags(*reset),
        terminal=none if terminal is None else flags(*terminal),
        truncated=none if truncated is None else flags(*truncated),
    )


def episodes(T=37, B=64, seed=0):
    """Returns random transitions and log ratios like those of an environment: the step after an end
    is a reset.
    """
    generator = torch.Generator().manual_seed(seed)
    reset, terminal, truncated = (torch.zeros(T, B, dtype=torch.bool) for _ in range(3))
    ended = torch.rand(B, generator=generator) < 0.3
    for t in range(T):
        reset[t] = ended
        end = ~reset[t] & (torch.rand(B, generator=generator) < 0.25)
        terminal[t] = end & (torch.rand(B, generator=generator) < 0.5)
        truncated[t] = end & ~terminal[t]
        ended = end

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return dict(
        reward=torch.where(reset, 0.0, normal(T, B)),
        value=normal(T, B),
        last_value=normal(B),
        reset=reset,
        terminal=terminal,
        truncated=truncated,
    ), normal(T, B)


def test_gae_matches_hand_calculation():
    # gamma = lambda = 1/2. Backwards: delta_2 = 4 + 8/2 - 2 = 6, delta_1 = 2 + 2/2 - 4 = -1,
    # delta_0 = 1 + 4/2 - 1 = 2. A_2 = 6, A_1 = -1 + 6/4 = 1/2, A_0 = 2 + 1/8.
    r = returns.gae(**lane(value=[1, 4, 2], last_value=8, reward=[1, 2, 4]), gamma=0.5, lambda_=0.5)
    assert r.advantages[:, 0].tolist() == [2.125, 0.5, 6.0]
    assert r.targets[:, 0].tolist() == [3.125, 4.5, 8.0]
    assert r.valid.all()


def test_gae_of_lanes_that_do_not_learn_is_not_valid():
    case = lane(value=[1, 4, 2], last_value=8, reward=[1, 2, 4], reset=[0, 1, 0])
    r = returns.gae(**case, learns=flags(True, True, False), gamma=0.5, lambda_=0.5)
    assert r.valid[:, 0].tolist() == [True, False, False]
    everyone = returns.gae(**case, gamma=0.5, lambda_=0.5)
    assert torch.equal(r.advantages, everyone.advantages)
    assert everyone.valid[:, 0].tolist() == [True, False, True]


def test_gae_bootstraps_from_truncated_not_terminal():
    # the episode ends after row 1; row 2 is the reset
    case = dict(value=[1, 4, 100, 6], last_value=8, reward=[1, 2, 0, 3], reset=[0, 0, 1, 0])
    died = returns.gae(**lane(**case, terminal=[0, 1, 0, 0]), gamma=0.5, lambda_=0.5)
    # A_3 = 3 + 4 - 6 = 1, A_2 is masked, A_1 = 2 - 4 = -2, A_0 = 1 + 2 - 1 - 2/4 = 1.5
    assert died.advantages[:, 0].tolist() == [1.5, -2.0, 0.0, 1.0]
    cut = returns.gae(**lane(**case, truncated=[0, 1, 0, 0]), gamma=0.5, lambda_=0.5)
    # A_1 = 2 + .5*100 - 4 = 48, A_0 = 2 + 48/4 = 14
    assert cut.advantages[:, 0].tolist() == [14.0, 48.0, 0.0, 1.0]
    assert died.valid[:, 0].tolist() == cut.valid[:, 0].tolist() == [True, True, False, True]


def test_vtrace_matches_hand_calculation():
    # gamma = 1, ratios 2, 1/2, 4: rho = c = 1, 1/2, 1.
    # delta_2 = 4 + 8 - 2 = 10, delta_1 = (2 + 2 - 4)/2 = 0, delta_0 = 1 + 4 - 1 = 4.
    # v - V: 10; 0 + 10/2 = 5; 4 + 5 = 9. So v = 10, 9, 12 and A = 1 + 9 - 1, (2 + 12 - 4)/2, 4 + 8
    # - 2.
    case = lane(value=[1, 4, 2], last_value=8, reward=[1, 2, 4])
    r = returns.vtrace(column(2, 0.5, 4).log(), **case, gamma=1.0)
    torch.testing.assert_close(r.targets[:, 0], column(10, 9, 12)[:, 0], **F64_CLOSE)
    torch.testing.assert_close(r.advantages[:, 0], column(9, 5, 10)[:, 0], **F64_CLOSE)


def test_vtrace_ignores_actions_of_probability_zero():
    case, _ = episodes()
    r = returns.vtrace(torch.full_like(case["reward"], -torch.inf), **case, gamma=0.9)
    assert torch.equal(r.targets, case["value"]) and not r.advantages.any()


def split(case, b):
    """Yields the valid rows of each of lane b's episodes, as lists."""
    rows = []
    for t in range(len(case["reward"])):
        if case["reset"][t, b]:
            if rows:
                yield rows
            rows = []
        else:
            rows.append(t)
    if rows:
        yield rows


def beyond(case, t, b):
    """Returns the value of the observation after row t: 0 if terminal."""
    last = t + 1 == len(case["reward"])
    value = case["last_value"][b] if last else case["value"][t + 1, b]
    return 0.0 if case["terminal"][t, b] else value.item()


def test_vtrace_matches_definition_in_paper():
    """Section 4.1: v_s = V_s + sum_{t >= s} gamma^{t-s} (prod_{i=s}^{t-1} c_i) rho_t (r_t + gamma
    V_{t+1} - V_t), by episodes.
    """
    case, log_ratio = episodes(seed=2)
    gamma, lambda_, rho_clip, c_clip = 0.97, 0.9, 1.3, 0.8
    r = returns.vtrace(
        log_ratio, **case, gamma=gamma, lambda_=lambda_, rho_clip=rho_clip, c_clip=c_clip
    )
    ratio = log_ratio.exp()
    targets, advantages = case["value"].clone(), torch.zeros_like(case["value"])
    for b in range(case["reward"].shape[1]):
        for rows in split(case, b):
            for i, s in enumerate(rows):
                for j, t in enumerate(rows[i:]):
                    product = 1.0
                    for k in rows[i : i + j]:
                        product *= lambda_ * min(c_clip, ratio[k, b].item())
                    rho = min(rho_clip, ratio[t, b].item())
                    delta = rho * (
                        case["reward"][t, b] + gamma * beyond(case, t, b) - case["value"][t, b]
                    )
                    targets[s, b] += gamma**j * product * delta
            for i, s in enumerate(rows):
                following = targets[rows[i + 1], b] if i + 1 < len(rows) else beyond(case, s, b)
                rho = min(rho_clip, ratio[s, b].item())
                advantages[s, b] = rho * (
                    case["reward"][s, b] + gamma * following - case["value"][s, b]
                )
    torch.testing.assert_close(r.targets, targets, **F64_CLOSE)
    torch.testing.assert_close(r.advantages, advantages, **F64_CLOSE)


def test_invalid_rows_are_ignored():
    """Not even a NaN in a row whose action was ignored may leak."""
    case, log_ratio = episodes(seed=3)
    corrupted = dict(case, reward=torch.where(case["reset"], torch.nan, case["reward"]))
    clean, dirty = (returns.n_step_returns(**c, gamma=0.9, n=3) for c in (case, corrupted))
    assert torch.equal(clean, dirty)
    for f in (returns.gae, lambda **k: returns.vtrace(log_ratio, **k)):
        clean, dirty = (f(**c, gamma=0.9, lambda_=0.8) for c in (case, corrupted))
        assert torch.equal(clean.advantages, dirty.advantages) and torch.equal(
            clean.targets, dirty.targets
        )


def test_n_step_returns_match_hand_calculation():
    # gamma = 1/2, n = 2: G_0 = 1 + 2/2 + 2/4, G_1 = 2 + 4/2 + 8/4; row 2 has one step only, 4 + 8/2
    case = lane(value=[1, 4, 2], last_value=8, reward=[1, 2, 4])
    result = returns.n_step_returns(**case, gamma=0.5, n=2)
    assert result[:, 0].tolist() == [2.5, 6.0, 8.0]
    assert returns.n_step_returns(**case, gamma=0.5, n=1)[:, 0].tolist() == [3.0, 3.0, 8.0]
    whole, longer = (returns.n_step_returns(**case, gamma=0.5, n=n) for n in (3, 2**63))
    assert torch.equal(whole, longer), "no return is longer than the rows"


@pytest.mark.parametrize("n", [1, 2, 5, 40])
def test_n_step_returns_stop_at_episode_end(n):
    case, _ = episodes()
    result, gamma = returns.n_step_returns(**case, gamma=0.9, n=n), 0.9
    for b in range(case["reward"].shape[1]):
        for rows in split(case, b):
            for i, t in enumerate(rows):
                steps = rows[i : i + n]
                total = sum(gamma**k * case["reward"][s, b] for k, s in enumerate(steps))
                if not case["terminal"][steps[-1], b]:
                    total = total + gamma ** len(steps) * beyond(case, steps[-1], b)
                torch.testing.assert_close(result[t, b], total, **F64_CLOSE)
    assert torch.equal(result[case["reset"]], case["value"][case["reset"]])


def test_inverse_rescale_in_float32():
    assert returns.rescale(torch.tensor(3.0)).item() == pytest.approx(1 + 3e-3)
    x = torch.tensor([0.0, 1e-4, 1e-2, 1, 30, 1e4])
    x = torch.cat([-x, x])
    y = returns.rescale(x)
    assert (y[6:].diff() > 0).all() and torch.equal(y[:6], -y[6:])
    # sqrt(1 + x) is rounded to 1e-7, and the inverse squares it
    torch.testing.assert_close(returns.inverse_rescale(y), x, rtol=1e-6, atol=1e-6)


def transposed(leaf):
    """Returns an equal tensor with another memory layout."""
    return leaf.T.contiguous().T if leaf.dim() == 2 else leaf


@pytest.mark.parametrize("change", [torch.clone, transposed, torch.Tensor.double])
@pytest.mark.parametrize("n_steps, n_lanes", [(1, 1), (32, 1000)])
def test_a_gpu_computes_the_same_of_any_layout_and_dtype(n_steps, n_lanes, change, to_gpu):
    torch.manual_seed(0)
    log_ratio, reward, value = torch.randn(3, n_steps, n_lanes)
    reset, terminal, truncated, learns = torch.rand(4, n_steps, n_lanes) < 0.1
    inputs = reward, value, torch.randn(n_lanes), reset, terminal, truncated & ~terminal
    settings = dict(gamma=0.95, lambda_=0.9)
    clips = dict(rho_clip=1.2, c_clip=0.9, **settings)
    for function, arguments, numbers in (
        (returns.gae, (*inputs, ~learns), settings),
        (returns.vtrace, (log_ratio, *inputs), clips),
    ):
        there = [to_gpu(x) for x in arguments]
        there = [change(x) if x.is_floating_point() else transposed(x) for x in there]
        fused = function(*there, **numbers)
        for name, leaf in function(*arguments, **numbers).items():
            other = fused[name].cpu().to(leaf.dtype)
            torch.testing.assert_close(other, leaf, rtol=1e-5, atol=1e-5, check_stride=False)
