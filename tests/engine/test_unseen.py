"""Texels that are left to see: visible texels, counts of unseen ones, and Explorer's privileged
observation.
"""

import pytest
import torch
from test_engine import core_of

from megastep import arrdict, contract, core, engine, envs, modules, scene, toys
from megastep.geometries import sample
from tests.helpers import random_scenery, twin
from tests.helpers.outputs import Poison, seen_of

SLACK = 2e-5  # of 1 + d metres: float32's resolution at 200 m, and rounded sines and tangents
AHEAD, LEFT, BEHIND, RIGHT = 0, 4, 8, 12  # sectors


def packed(bits):
    """Packs bits (..., 32 n_words) into words (..., n_words) int32, the first in the lowest bit."""
    values = torch.tensor([2**i for i in range(31)] + [-(2**31)])
    return (bits.unflatten(-1, (-1, 32)) * values).sum(-1).int()


def unpacked(words):
    """Unpacks words (..., n_words) int32 into bits (..., 32 n_words) bool."""
    return (words.cpu()[..., None] >> torch.arange(32, dtype=torch.int32) & 1).bool().flatten(-2)


def n_texels(layouts):
    """(D,): the number of texels of each layout."""
    return layouts.texel_starts[layouts.wall_starts.long()].diff()


# ---- engine.unseen: facts to check by hand ----


def square(device, n_envs=1):
    """A room of 1.6 m around (1.8, 1.8), whose four walls have one word of 32 texels each."""
    c = core.Core(scene.scenery([toys.box(1.6)], 1, n_envs, device=device))
    c.agents.positions[:] = 1.8
    return c


def counts_of(c, seen=None, visible=None):
    seen = seen_of(c) if seen is None else seen
    if visible is None:
        visible = torch.full_like(seen[: len(c.scenery.layouts), 0], -1)
    return engine.unseen(c.scenery, c.agents, seen, visible)


def test_one_wall_on_each_side(device):
    counts = counts_of(square(device))
    assert counts.shape == (1, 1, 3, 16) and counts.dtype == torch.int32
    near = counts[0, 0, 0].tolist()
    assert [near[sector] for sector in (AHEAD, LEFT, BEHIND, RIGHT)] == 4 * [32]
    assert counts.sum() == 128


@pytest.mark.parametrize(
    "angle, sector", [(0, AHEAD), (90, RIGHT), (180, BEHIND), (-90, LEFT), (-60, 3), (45, 14)]
)
def test_sectors_follow_the_heading(angle, sector, device):
    """Only the eastern wall is unseen. Sectors are 22.5 degrees wide: 60 degrees to the left is
    closest to sector 3 at 67.5, and 45 to the right to sector 14 at 315.
    """
    c = square(device)
    c.agents.angles[:] = angle
    east = (c.scenery.layouts.lines.vals[..., 0] > 2).all(-1).nonzero().item()
    seen = seen_of(c).fill_(-1)
    seen[..., east] = 0
    counts = counts_of(c, seen)
    assert counts[0, 0, 0, sector] == counts.sum() == 32


@pytest.mark.parametrize("metres, band", [(0.7, 0), (1.49, 0), (1.51, 1), (3.99, 1), (4.01, 2)])
def test_bands_end_at_1_5_and_4_metres(metres, band, device):
    c = square(device)
    c.agents.positions[..., 0] = 2.6 - metres
    east = (c.scenery.layouts.lines.vals[..., 0] > 2).all(-1).nonzero().item()
    visible = torch.zeros((1, 4), dtype=torch.int32, device=device)
    visible[:, east] = -1
    counts = counts_of(c, visible=visible)
    assert counts[0, 0, band, AHEAD] == counts.sum() == 32


def test_only_visible_unseen_texels_count(device):
    c = square(device)
    seen, visible = seen_of(c), torch.zeros((1, 4), dtype=torch.int32, device=device)
    assert not counts_of(c, visible=visible).any()
    assert not counts_of(c, seen.fill_(-1)).any()
    seen.fill_(0b0011)
    visible.fill_(0b0110)
    assert counts_of(c, seen, visible).sum() == 4


# ---- engine.unseen against the twin ----


def check_unseen(c, seen, visible):
    """Checks that every count is within the twin's bounds and that no texel is missing.

    Returns the fraction of texels whose sector and band are certain.
    """
    counts = engine.unseen(c.scenery, c.agents, seen, visible).cpu().long()
    layouts, certain, total = c.scenery.layouts, 0, 0
    left = unpacked(visible)[c.scenery.layout.cpu().long()][:, None] & ~unpacked(seen)
    for e, d in enumerate(c.scenery.layout.tolist()):
        first, end = layouts.wall_starts[d : d + 2].tolist()
        walls = layouts.lines.vals[first:end].cpu().double()
        widths = layouts.texel_starts[first : end + 1].diff().cpu()
        for a in range(c.n_agents):
            position, angle = c.agents.positions[e, a].cpu().double(), c.agents.angles[e, a].item()
            least, most = twin.unseen(walls, widths, left[e, a], position, angle, SLACK)
            ours = counts[e, a]
            where = f"agent {a} of environment {e}"
            assert bool(((ours >= least) & (ours <= most)).all()), f"{where}: {ours}"
            total += (n := int(left[e, a, : int(widths.sum())].sum()))
            assert int(ours.sum()) == n, where
            certain += int(least.sum())
    return certain / max(total, 1)


@pytest.mark.parametrize("n_agents", [1, 3])
@pytest.mark.parametrize("degenerate", [(), random_scenery.EVERYTHING], ids=["plain", "degenerate"])
@pytest.mark.parametrize("density", [0.02, 0.5, pytest.param(1.0, marks=pytest.mark.slow)])
def test_counts_match_twin(n_agents, degenerate, density, device, monkeypatch):
    """Walls begin anywhere in a word, and some take hundreds of words. Two of four environments
    share a layout. `visible` has bits beyond a layout's texels.
    """
    poison = Poison(torch.empty)
    for seed in range(2):
        scenery = random_scenery.random_environments(
            seed, n_agents=n_agents, degenerate=degenerate, origin=190.0 if seed else 1.0
        )
        c = core_of(scenery, device)
        c.scenery.layout.copy_(torch.tensor([1, 3, 0, 1]))
        n_words = -(-c.scenery.layouts.max_texels // 32) + seed
        random = torch.Generator().manual_seed(seed)
        is_visible, is_seen = (
            torch.rand(*lead, 32 * n_words, generator=random) < chance
            for lead, chance in (((4,), density), ((4, n_agents), 0.5 * (density < 1)))
        )
        with monkeypatch.context() as patch:
            patch.setattr(torch, "empty", poison.allocate)
            words = packed(is_seen).to(device), packed(is_visible).to(device)
            poison.check(counts=engine.unseen(c.scenery, c.agents, *words))
        assert check_unseen(c, *words) > 0.95, (
            "few are so close to a border that both sides are allowed"
        )


def test_counts_match_twin_in_homes(device):
    homes = sample("homes", 3)
    c = core.Core(scene.scenery(homes, 2, 5, device=device), res=256)
    spawner, seen = modules.RandomSpawns(homes, c), seen_of(c)
    visible = modules.visible_texels(c.scenery, spawner.points[:, :8])
    for _ in range(3):
        spawner(c.agent_full(True))
        engine.observe(c.scenery, c.agents, seen=seen)
        assert check_unseen(c, seen, visible) > 0.95


def test_too_few_words():
    c = square("cpu")
    short = torch.zeros((1, 1, 3), dtype=torch.int32)
    with pytest.raises(ValueError, match="seen must have a bit .* at least 4 words, but it has 3"):
        engine.unseen(c.scenery, c.agents, short, short[0])
    with pytest.raises(ValueError, match="visible must be .*1, 4.*1, 3"):
        engine.unseen(c.scenery, c.agents, seen_of(c), short[0])


# ---- visible_texels ----


def test_all_texels_of_a_box_are_visible(device):
    scenery = scene.scenery([toys.box(5), toys.box(2)], 1, device=device)
    points = torch.tensor([[[3.5, 3.5]], [[2.0, 2.0]]])
    bits = unpacked(modules.visible_texels(scenery, points))
    assert bits.shape == (2, 13 * 32)
    for row, n in zip(bits, (400, 160), strict=True):  # 5 cm a texel
        assert bool(row[:n].all()) and not row[n:].any()


def test_texels_behind_a_pillar_are_not_visible(device):
    """From a point 1 m in front of a pillar's western side, only that side is visible, and of the
    wall behind the pillar only the ends.
    """
    scenery = scene.scenery([toys.column(5, 1)], 1, device=device)
    bits = unpacked(modules.visible_texels(scenery, torch.tensor([[[2.0, 3.5]]])))[0]
    layouts, fractions = scenery.layouts, {}
    for wall, line in enumerate(layouts.lines.vals.cpu()):
        first, end = layouts.texel_starts[wall : wall + 2].tolist()
        fractions[tuple(line.mean(0).tolist())] = float(bits[first:end].float().mean())
    assert [fractions[3.0, 3.5], fractions[4.0, 3.5], fractions[3.5, 3.0], fractions[3.5, 4.0]] == [
        1,
        0,
        0,
        0,
    ]
    # the shadow of 1 m at 1 m is 4 m wide at 4 m, of the wall's 5 m
    assert fractions[6.0, 3.5] == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize("n_agents", [1, 3])
def test_visible_texels_match_observe_at_every_point(n_agents, device):
    homes = [*sample("homes", 2), *sample("bench", 1), toys.column()]
    scenery = scene.scenery(homes, n_agents, 6, device=device)
    points = modules.RandomSpawns(homes, core.Core(scenery)).points[:, : 4 * n_agents]
    visible = unpacked(modules.visible_texels(scenery, points))
    for d, home in enumerate(homes):
        alone = core.Core(
            scene.scenery([home], 1, device=device), res=512, fov=122.0, cameras=[0, 120, 240]
        )
        expected = torch.zeros(visible.shape[1], dtype=torch.bool)
        for point in points[d]:
            alone.agents.positions[:] = point
            seen = seen_of(alone)
            engine.observe(alone.scenery, alone.agents, seen=seen)
            marked = unpacked(seen)[0, 0]
            expected[: len(marked)] |= marked
        assert torch.equal(visible[d], expected), f"layout {d}"
        n = int(n_texels(scenery.layouts)[d])
        assert 0.1 * n < int(visible[d].sum()) <= n and not visible[d, n:].any()


def test_visible_texels_changes_no_state():
    scenery = scene.scenery([toys.box(), toys.column()], 1, 4, device="cpu")
    before = scenery.layout.clone(), scenery.agent_lines.clone()
    modules.visible_texels(scenery, torch.full((2, 1, 2), 2.0))
    assert torch.equal(scenery.layout, before[0]) and torch.equal(scenery.agent_lines, before[1])


def test_visible_texels_needs_an_agent():
    scenery = scene.scenery([toys.box()], 0, 1, device="cpu")
    with pytest.raises(ValueError, match="scenery.n_agents must be .*1"):
        modules.visible_texels(scenery, torch.full((1, 1, 2), 2.0))


# ---- Explorer's privileged observation ----


def explorer(device="cpu", n_envs=6, **settings):
    defaults = dict(patience=1, res=1, subsample=1, resample=True, privileged=True)
    return envs.Explorer(n_envs, sample("bench", 4), device=device, **{**defaults, **settings})


@pytest.mark.parametrize("resample", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_explorers_privileged_observation_by_hand(resample, device):
    """Computed from the flags, the texels seen and the visible texels."""
    env = explorer(device, resample=resample)
    worlds, age = contract.rollout(env, 0), torch.zeros(6)
    generator = torch.Generator().manual_seed(1)
    n_ends = 0
    for step in range(60):
        if step:
            actions = contract.random_actions(env, generator)
            worlds.append(env.step(arrdict.arrdict(actions=actions)).clone())
        world = arrdict.arrdict(worlds[-1]).map(torch.Tensor.cpu)
        age = torch.where(world.reset, 0, age + 1)
        seen, visible = unpacked(env.seen)[:, 0], unpacked(env.visible)[env.layout.cpu().long()]
        n_seen, n_left = seen.sum(-1), (visible & ~seen).sum(-1)
        episode = world.privileged.episode[:, 0] * torch.tensor([200.0, 1000.0, 1000.0, 1000.0])
        expected = torch.stack([1 + n_seen - age, age, n_seen, n_left], -1)
        torch.testing.assert_close(episode, expected.float(), rtol=1e-6, atol=0)
        left = world.privileged.unseen.square() * 64
        counts = engine.unseen(env.core.scenery, env.core.agents, env.seen, env.visible)
        torch.testing.assert_close(left, counts.view(6, 1, 48).cpu().float(), rtol=1e-5, atol=0)
        torch.testing.assert_close(left.sum((1, 2)), n_left.float(), rtol=1e-5, atol=0)
        if step % 10 == 0:
            assert check_unseen(env.core, env.seen, env.visible) > 0.95
        ended = world.truncated
        assert torch.equal(world.privileged.episode[:, 0, 0] == 0, ended), "no step is left"
        n_ends += int(ended.sum())
    assert n_ends >= 6 and len(env.layout.unique()) > 1


def test_privileged_changes_nothing_else(device):
    plain, extended = (
        contract.rollout(explorer(device, privileged=privileged), 40)
        for privileged in (False, True)
    )
    assert all("privileged" not in world for world in plain)
    assert explorer(privileged=False).privileged_space is None
    for a, b in zip(plain, extended, strict=True):
        assert contract.same(a, arrdict.arrdict({k: v for k, v in b.items() if k != "privileged"}))


def test_explorers_visible_texels():
    env = explorer()
    expected = modules.visible_texels(env.core.scenery, env.spawner.points)
    assert torch.equal(env.visible, expected)
