"""Intakes and outputs made from spaces, and distributions of actions."""

import math

import pytest
import torch
from torch import nn

from megastep import spaces
from megastep.agents.networks import encoders, heads, intake_cpu, running_norm
from megastep.arrdict import arrdict

IMAGE = spaces.MultiImage(2, 3, 1, 16)
DEPTH = spaces.MultiImage(2, 1, 1, 16)
VECTOR = spaces.MultiVector(2, 5)
TREE = arrdict(eyes=arrdict(rgb=IMAGE, d=DEPTH), imu=VECTOR, team=spaces.MultiDiscrete(2, 4))
MOVES = arrdict(movement=spaces.MultiDiscrete(2, 7), fire=spaces.MultiDiscrete(2, 2))
WIDTH = 24


def random_obs(space, *lead, seed=0, dtype=torch.float32):
    """Returns a random observation of a space."""
    generator = torch.Generator().manual_seed(seed)

    def leaf(child):
        if isinstance(child, spaces.MultiDiscrete):
            return torch.randint(child.n_actions, (*lead, *child.shape), generator=generator)
        return torch.rand(*lead, *child.shape, generator=generator).to(dtype)

    return space.map(leaf) if isinstance(space, dict) else leaf(space)


@pytest.mark.parametrize("encoder", encoders.ENCODERS)
@pytest.mark.parametrize(
    "space", [IMAGE, VECTOR, spaces.MultiDiscrete(2, 4), TREE, spaces.MultiImage(1, 3, 4, 1)]
)
@pytest.mark.parametrize("lead", [(), (6,), (3, 6)])
def test_intake_shape(space, encoder, lead):
    intake = heads.intake(space, WIDTH, encoder)
    out = intake(random_obs(space, *lead))
    assert out.shape == (*lead, WIDTH) and out.dtype == torch.float32 and out.isfinite().all()


@pytest.mark.parametrize("encoder", encoders.ENCODERS)
def test_every_pixel_and_leaf_has_a_gradient(encoder):
    torch.manual_seed(0)
    intake = heads.intake(TREE, 512, encoder)
    obs = random_obs(TREE, 1)
    for leaf in (obs.eyes.rgb, obs.eyes.d, obs.imu):
        leaf.requires_grad_()
    intake(obs).sum().backward()
    for leaf in (obs.eyes.rgb, obs.eyes.d, obs.imu):
        assert (leaf.grad != 0).all()
    other = arrdict({**obs, "team": (obs.team + 1) % 4})
    assert not torch.equal(intake(other), intake(obs))


def test_tanh_bounds_features_that_relu_does_not():
    obs = random_obs(TREE, 6)
    far = arrdict({**obs, "imu": obs.imu * 1e3})
    for activation, is_bounded in ("tanh", True), ("relu", False):
        features = heads.intake(TREE, WIDTH, activation=activation)(far)
        assert (features.abs().max() <= 1) == is_bounded


def test_order_of_keys_does_not_matter():
    intake = heads.intake(TREE, WIDTH)
    obs = random_obs(TREE, 6)
    backwards = arrdict({key: obs[key] for key in reversed(obs)})
    assert torch.equal(intake(backwards), intake(obs))


def test_float16_observations():
    intake = heads.intake(TREE, WIDTH)
    half = random_obs(TREE, 6, dtype=torch.float16)
    single = half.map(lambda leaf: leaf.float() if leaf.is_floating_point() else leaf)
    assert torch.equal(intake(half), intake(single))


def test_autocast_changes_features_not_logits():
    intake, output = heads.intake(TREE, WIDTH), heads.output(MOVES, WIDTH)
    with torch.autocast("cpu", torch.bfloat16):
        x = intake(random_obs(TREE, 6, dtype=torch.float16))
        assert x.dtype == torch.bfloat16
        assert output(x).movement.dtype == torch.float32


def test_key_that_modules_use_is_refused():
    with pytest.raises(ValueError, match="^an action space cannot have the key 'type',.*type_$"):
        heads.output(arrdict(type=spaces.MultiDiscrete(1, 2)), WIDTH)


def test_leaves_have_equal_initial_weight():
    # an image of 3 x 64 numbers and a vector of 3, all 1: each leaf's part of the sum has variance
    # 1
    torch.manual_seed(0)
    intake = heads.intake(
        arrdict(rgb=spaces.MultiImage(1, 3, 1, 64), imu=spaces.MultiVector(1, 3)), 4096
    )
    rgb, imu, padding = intake.project.weight.split([192, 3, 5], dim=1)
    assert not padding.any()
    for block in (rgb, imu):  # 4096 samples: 4.5 standard errors
        assert block.sum(1).var().item() == pytest.approx(1, abs=0.1)


def test_shapes_of_logits_and_actions():
    intake, output = heads.intake(TREE, WIDTH), heads.output(MOVES, WIDTH)
    logits = nn.Sequential(intake, output)(random_obs(TREE, 6))
    assert logits.movement.shape == (6, 2, 7) and logits.fire.shape == (6, 2, 2)
    torch.testing.assert_close(logits.movement.exp().sum(-1), torch.ones(6, 2))
    actions = output.sample(logits)
    assert actions.movement.shape == actions.fire.shape == (6, 2)
    assert actions.fire.dtype == torch.int64
    assert output.logprob(logits, actions).shape == output.entropy(logits).shape == (6,)


def test_bare_action_space():
    output = heads.output(spaces.MultiDiscrete(1, 7), WIDTH)
    logits = output(torch.randn(3, 5, WIDTH))
    assert logits.shape == (3, 5, 1, 7) and output.sample(logits).shape == (3, 5, 1)


def test_logprob_and_entropy_match_hand_calculation():
    output = heads.output(MOVES, WIDTH)
    even = arrdict(
        movement=torch.full((1, 2, 7), 1 / 7).log(),
        fire=torch.tensor([[[0.25, 0.75], [0.5, 0.5]]]).log(),
    )
    actions = arrdict(movement=torch.tensor([[6, 0]]), fire=torch.tensor([[1, 0]]))
    # two agents move uniformly among 7; one fires with probability 3/4, the other with 1/2
    assert output.logprob(even, actions).item() == pytest.approx(
        2 * math.log(1 / 7) + math.log(0.75) + math.log(0.5)
    )
    uneven = -0.25 * math.log(0.25) - 0.75 * math.log(0.75)
    assert output.entropy(even).item() == pytest.approx(2 * math.log(7) + uneven + math.log(2))
    assert output.greedy(even).fire.tolist() == [[1, 0]]


def test_initial_policy_is_almost_uniform():
    output = heads.output(spaces.MultiDiscrete(1, 7), WIDTH)
    assert output.entropy(output(torch.randn(100, WIDTH))).min().item() == pytest.approx(
        math.log(7), abs=0.01
    )


def test_sample_frequencies_match_probabilities():
    probabilities = torch.tensor([0.5, 0.3, 0.15, 0.05])
    output, n = heads.output(spaces.MultiDiscrete(1, 4), WIDTH), 100_000
    logits = probabilities.log().expand(n, 1, 4)
    sampled = (
        output.sample(logits, torch.Generator().manual_seed(0)).flatten().bincount(minlength=4) / n
    )
    error = (probabilities * (1 - probabilities) / n).sqrt()
    assert ((sampled - probabilities).abs() < 4 * error).all()


def test_probability_zero_is_never_sampled():
    output = heads.output(spaces.MultiDiscrete(1, 3), WIDTH)
    logits = torch.tensor([0.0, 1.0, 0.0]).log().expand(100_000, 1, 3)
    assert (output.sample(logits, torch.Generator().manual_seed(0)) == 1).all()


def test_generator_determines_samples():
    output = heads.output(MOVES, WIDTH)
    logits = output(torch.randn(50, WIDTH))
    torch.manual_seed(0)
    before = torch.get_rng_state()
    first, second = (output.sample(logits, torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first.movement, second.movement) and torch.equal(first.fire, second.fire)
    assert torch.equal(before, torch.get_rng_state())


def test_duelling_is_value_plus_centred_advantages():
    output = heads.output(spaces.MultiDiscrete(2, 3), WIDTH, "duelling")
    x = torch.randn(5, WIDTH)
    hidden = output.hidden(x).relu()
    value = hidden[:, :WIDTH] @ output.value.weight.T + output.value.bias
    q = output(x)
    torch.testing.assert_close(q.mean(-1), value)
    advantage = (hidden[:, WIDTH:] @ output.advantage.weight.T).view(5, 2, 3)
    torch.testing.assert_close(q.diff(dim=-1), advantage.diff(dim=-1))


def test_joint_action_value_is_sum():
    output = heads.output(MOVES, WIDTH, "duelling")
    logits = output(torch.randn(4, 6, WIDTH))
    actions = output.greedy(logits)
    best = sum(logits[key].amax(-1).sum(-1) for key in logits)
    torch.testing.assert_close(output.action_value(logits, actions), best)
    other = arrdict(actions, fire=1 - actions.fire)
    loss = logits.fire.diff(dim=-1).abs().sum((-1, -2))
    torch.testing.assert_close(output.action_value(logits, other), best - loss)


def test_duelling_sample_is_epsilon_greedy():
    n = 100_000
    output = heads.output(spaces.MultiDiscrete(1, 4), WIDTH, "duelling")
    logits = torch.tensor([0.1, 0.9, 0.3, -2.0]).expand(n, 1, 4)
    epsilon = torch.tensor([0.0, 0.5]).repeat_interleave(n // 2)
    generator = torch.Generator().manual_seed(0)
    actions = output.sample(logits, generator, epsilon=epsilon)
    assert (actions[: n // 2] == 1).all()
    shares = actions[n // 2 :].flatten().bincount(minlength=4) / (n / 2)
    expected = torch.tensor([0.125, 0.625, 0.125, 0.125])
    torch.testing.assert_close(shares, expected, rtol=0, atol=0.008)  # 4 standard errors
    shares = output.sample(logits, generator).flatten().bincount(minlength=4) / n
    likely = output.logprob(logits[:4], torch.arange(4)[:, None]).exp()
    torch.testing.assert_close(likely, torch.tensor([0.0125, 0.9625, 0.0125, 0.0125]))
    torch.testing.assert_close(shares, likely, rtol=0, atol=0.0025)


def test_action_values_are_float32_under_autocast():
    output = heads.output(spaces.MultiDiscrete(1, 4), WIDTH, "duelling")
    with torch.no_grad():
        output.value.bias += 300.0
        with torch.autocast("cpu", torch.bfloat16):
            values = output(torch.randn(50, WIDTH))
    assert values.dtype == torch.float32
    # near 300, bfloat16 numbers are 2 apart
    assert 0.01 < values.std() < 1 and len(values.mean(-1).unique()) > 40


def test_zero_features_have_a_gradient():
    output = heads.output(spaces.MultiDiscrete(1, 4), WIDTH, "duelling")
    x = torch.zeros(1, WIDTH, requires_grad=True)
    output(x)[0, 0, 1].backward()
    assert x.grad.abs().sum() > 0


@pytest.mark.parametrize(
    "make, error",
    [
        (lambda: heads.intake("images", WIDTH), "observation space itself = 'images'"),
        (lambda: heads.intake(arrdict(imu=VECTOR, x=3), WIDTH), "observation space x = 3"),
        (lambda: heads.intake(arrdict(nothing=spaces.MultiEmpty()), WIDTH), "nothing in it"),
        (lambda: heads.intake(IMAGE, WIDTH, "resnet"), "'resnet'.*cnn, conv, linear, module:Class"),
        (lambda: heads.output(VECTOR, WIDTH), "MultiContinuous or dicts of them"),
        (lambda: heads.output(arrdict(), WIDTH), "MultiContinuous or dicts of them"),
    ],
)
def test_unknown_spaces_raise(make, error):
    with pytest.raises(ValueError, match=error):
        make()


def update(intake, obs):
    norms = intake.running_norms
    running_norm.add_moments(norms, running_norm.moments_of(norms, intake.normalised_leaves(obs)))


def test_normalises_images_per_channel_and_vectors_per_number():
    space = arrdict(rgb=spaces.MultiImage(1, 2, 1, 3), imu=spaces.MultiVector(1, 2))
    intake = heads.intake(space, WIDTH)
    rgb = (
        torch.tensor([[1.0, 2.0, 3.0], [10.0, 10.0, 40.0]])
        .view(1, 1, 2, 1, 3)
        .expand(4, -1, -1, -1, -1)
    )
    imu = torch.tensor([[5.0, 0.0], [7.0, 0.0], [5.0, 0.0], [7.0, 0.0]])[:, None]
    update(intake, arrdict(rgb=rgb.half(), imu=imu.half()))
    rgb_norm, imu_norm = intake.norms
    torch.testing.assert_close(
        rgb_norm(rgb)[0, 0, 0, 0], torch.tensor([-(1.5**0.5), 0.0, 1.5**0.5])
    )  # std sqrt 2/3
    torch.testing.assert_close(
        rgb_norm(rgb)[0, 0, 1, 0], torch.tensor([-(0.5**0.5), -(0.5**0.5), 2**0.5])
    )
    torch.testing.assert_close(imu_norm(imu)[:, 0, 0], torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    assert not imu_norm(imu)[..., 1].any()  # a constant divides by min_scale, not by 0

    # the second call has weight 1/2: mean (6 + 10) / 2, mean square (37 + 100) / 2
    update(intake, arrdict(rgb=rgb, imu=torch.full((4, 1, 2), 10.0)))
    assert imu_norm.mean[0, 0].item() == 8
    assert imu_norm.scale[0, 0].item() == pytest.approx((137 / 2 - 64) ** 0.5)


def test_statistics_are_saved_with_weights():
    intake, other, obs = heads.intake(TREE, WIDTH), heads.intake(TREE, WIDTH), random_obs(TREE, 6)
    update(intake, obs)
    other.load_state_dict(intake.state_dict())
    assert torch.equal(other(obs), intake(obs))


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32], ids=str)
@pytest.mark.parametrize("lead", [(), (6,), (3, 6)])
def test_normalisation_on_cpu_has_the_bits_of_pytorch(monkeypatch, lead, dtype):
    torch.manual_seed(0)
    space = arrdict(rgb=IMAGE, imu=VECTOR)
    intake, obs = heads.intake(space, WIDTH), random_obs(space, *lead, dtype=dtype)
    for norm in intake.norms:
        norm.mean.normal_()
        norm.scale.uniform_(0.1, 2)
    fits = intake_cpu.fits
    assert fits([obs.rgb, obs.imu], intake.norms, intake.encoders)
    encoded = intake.encode(obs)
    monkeypatch.setattr(intake_cpu, "fits", lambda *arguments: False)
    assert torch.equal(encoded, intake.encode(obs))
    obs.imu.requires_grad_()
    assert not fits([obs.rgb, obs.imu], intake.norms, intake.encoders)
