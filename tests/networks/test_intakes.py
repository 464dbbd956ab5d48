"""Intakes made from spaces, and their kernels against PyTorch."""

import pytest
import torch

from megastep import spaces
from megastep.agents.networks import heads, intakes, running_norm
from megastep.agents.networks.fused import plain_operations
from megastep.agents.networks.linear import ComputeDtype
from megastep.arrdict import arrdict

IMAGE = spaces.MultiImage(2, 3, 1, 16)
DEPTH = spaces.MultiImage(2, 1, 1, 16)
VECTOR = spaces.MultiVector(2, 5)
TREE = arrdict(eyes=arrdict(rgb=IMAGE, d=DEPTH), imu=VECTOR, team=spaces.MultiDiscrete(2, 4))
WIDTH = 24


def random_obs(space, *lead, seed=0, dtype=torch.float32):
    """Returns a random observation of a space."""
    generator = torch.Generator().manual_seed(seed)

    def leaf(child):
        if isinstance(child, spaces.MultiDiscrete):
            return torch.randint(child.n_actions, (*lead, *child.shape), generator=generator)
        return torch.rand(*lead, *child.shape, generator=generator).to(dtype)

    return space.map(leaf) if isinstance(space, dict) else leaf(space)


NUMERIC = sorted({*intakes.ENCODERS} - {"categories"})


@pytest.mark.parametrize("encoder", NUMERIC)
@pytest.mark.parametrize(
    "space", [IMAGE, VECTOR, spaces.MultiDiscrete(2, 4), TREE, spaces.MultiImage(1, 3, 4, 1)]
)
@pytest.mark.parametrize("lead", [(), (6,), (3, 6)])
def test_intake_shape(space, encoder, lead):
    intake = heads.intake(space, WIDTH, encoder)
    out = intake(random_obs(space, *lead))
    assert out.shape == (*lead, WIDTH) and out.dtype == torch.float32 and out.isfinite().all()


@pytest.mark.parametrize("encoder", NUMERIC)
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


def test_float16_observations():
    intake = heads.intake(TREE, WIDTH)
    half = random_obs(TREE, 6, dtype=torch.float16)
    single = half.map(lambda leaf: leaf.float() if leaf.is_floating_point() else leaf)
    assert torch.equal(intake(half), intake(single))


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


def test_categories_are_one_hot_whatever_was_seen_before():
    cells = torch.tensor(
        [[4, 5, 2], [10, 0, 3], [0, 0, 0]], dtype=torch.uint8
    )  # kind, colour, state
    image = cells.T.reshape(1, 1, 3, 1, 3)
    space = arrdict(image=spaces.MultiImage(1, 3, 1, 3), direction=spaces.MultiDiscrete(1, 4))
    intake = heads.intake(space, WIDTH, "categories")
    obs = arrdict(image=image, direction=torch.tensor([[2]]))
    update(intake, obs)
    features = intake.encode(obs)[0, :63].split([3 * 11, 3 * 6, 3 * 4])
    numbers = [part.view(3, -1).nonzero()[:, 1].tolist() for part in features]
    assert numbers == [[4, 10, 0], [5, 0, 0], [2, 3, 0]]
    with pytest.raises(ValueError, match="3 channels, not 1"):
        heads.intake(DEPTH, WIDTH, "categories")


# ---- On a GPU ----


def assert_close(fused, plain):
    """8 bits, and sums of them, as a fraction of the largest number."""
    atol = 2e-2 * (plain.abs().max().item() or 1.0)
    torch.testing.assert_close(fused.float().cpu(), plain.float().cpu(), rtol=0, atol=atol)


@pytest.mark.parametrize("offset", [0, 1])
@pytest.mark.parametrize("lanes", [None, [3, 0, 3, 22, 7, 4, 1]])
@pytest.mark.parametrize("kinds", [(48, 3, 12), (12, 5), (7,), (3, 64, 1)])
def test_kernel_normalises_like_pytorch(to_gpu, monkeypatch, kinds, lanes, offset):
    """Leaves of 1 to 64 features in float16 and float32, with statistics of one or more, of which
    words of four may be aligned. A thread handles all rows, several, or at most four.
    """
    torch.manual_seed(0)
    space, obs = arrdict(), arrdict()
    for i, n in enumerate(kinds):
        space[f"{i}"] = spaces.MultiVector(1, n) if n % 3 else spaces.MultiImage(1, 3, 1, n // 3)
        obs[f"{i}"] = torch.randn(3, 23, *space[f"{i}"].shape).to(
            torch.float32 if i % 2 else torch.float16
        )
    intake = heads.intake(space, 32)
    for norm in intake.norms:
        norm.mean.normal_()
        norm.scale.uniform_(0.5, 1.5)
    of = None if lanes is None else torch.tensor(lanes)
    with plain_operations():
        expected = intake.encode(obs, of).bfloat16()
    for norm in intake.norms:
        norm.mean, norm.scale = to_gpu(norm.mean), to_gpu(norm.scale)
    longer = obs.map(lambda leaf: to_gpu(torch.cat([leaf.flatten()[:offset], leaf.flatten()])))
    inputs = arrdict({key: longer[key][offset:].view_as(leaf) for key, leaf in obs.items()})
    results = []  # all kept, so that none is in the memory of another
    for n_threads in (0, 150, 10**6):
        monkeypatch.setattr(intakes, "n_resident_threads", lambda *_, n=n_threads: n)
        results.append(intakes._encode_on_gpu(intake, inputs, None if of is None else to_gpu(of)))
    for features in (result.cpu() for result in results):
        # a product with 1 / scale may differ in the last bit of float32, and so of bfloat16
        torch.testing.assert_close(
            features[..., : sum(kinds)], expected[..., : sum(kinds)], rtol=2**-7, atol=1e-6
        )
        assert features.shape[-1] % 8 == 0 and not features[..., sum(kinds) :].any()


ROW, THREE = spaces.MultiImage(1, 3, 1, 16), spaces.MultiVector(1, 3)
MIXED_SPACES = [
    dict(rgb=ROW, d=spaces.MultiImage(1, 1, 1, 16), imu=THREE, health=THREE),
    dict(imu=THREE, rgb=spaces.MultiImage(2, 3, 1, 16), health=THREE, far=ROW),
    dict(rgb=ROW),
    dict(imu=THREE, near=spaces.MultiVector(2, 4)),
]


def mixed_intake(space, lead, device, encoder="conv"):
    """Returns an intake with statistics, and observations."""
    torch.manual_seed(0)
    intake = heads.intake(arrdict(space), 32, encoder)
    for norm in intake.norms:
        norm.mean.normal_()
        norm.scale.uniform_(0.5, 2.0)
    obs = arrdict({key: torch.randn(*lead, *leaf.shape).half() for key, leaf in space.items()})
    return intake.to(device), obs.map(lambda leaf: leaf.to(device))


@pytest.mark.parametrize("encoder", ["linear", "conv", "cnn"])
@pytest.mark.parametrize("space", MIXED_SPACES)
def test_encoders_read_parts_of_wider_rows(space, encoder):
    intake, obs = mixed_intake(space, (3, 5), "cpu", encoder)
    plain = intake.encode(obs)

    leaves, norms = intake.leaves(obs), intake.norms
    parts = [norms[i](leaves[i]).flatten(2) for i in intake.order]
    n_zeros = intake.n_columns - sum(part.shape[-1] for part in parts)
    assert intake.n_columns % 8 == 0 and n_zeros >= intake.n_padding
    columns = torch.cat([*parts, torch.zeros(3, 5, n_zeros)], -1)
    torch.testing.assert_close(intake.encode_columns(columns), plain)


@pytest.mark.cuda
@pytest.mark.parametrize("space", MIXED_SPACES)
@pytest.mark.parametrize("lead", [(5,), (3, 40)])
def test_convolutions_of_an_intake_match_the_plain_form(space, lead):
    intake, obs = mixed_intake(space, lead, "cuda")
    lanes = torch.tensor([3, 0, 3], device="cuda") if len(lead) == 2 else None
    results = []
    for is_fused in (True, False):
        intake.is_fused = is_fused
        with ComputeDtype("cuda", torch.bfloat16):
            features = intake(obs, lanes)
            with torch.no_grad():
                for _ in range(2):  # the second time with what the context remembers
                    assert_close(intake(obs, lanes), features.detach())
        weights = torch.randn(features.shape, generator=torch.Generator().manual_seed(1))
        loss = (features.float() * weights.cuda()).sum()
        results.append([features.detach(), *torch.autograd.grad(loss, [*intake.parameters()])])
    for fused, plain in zip(*results, strict=True):
        assert fused.dtype == plain.dtype
        error = (fused.float() - plain.float()).norm() / plain.float().norm()
        assert error < 0.1, error  # 8 bits, and ReLUs near their kink
