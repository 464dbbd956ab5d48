"""Coverage, the fraction of visible texels that was seen: the operation, and Explorer's metric."""

import pytest
import torch
from test_unseen import n_texels, packed, unpacked

from megastep import contract, core, engine, envs, modules, scene, toys
from megastep.arrdict import arrdict
from megastep.geometries import sample
from megastep.modules import visibility
from tests.helpers.outputs import Poison, seen_of


def of_boxes(device, n_envs=3, n_agents=1):
    return core.Core(scene.scenery([toys.box(1.6), toys.column()], n_agents, n_envs, device=device))


def everyone(c):
    return torch.ones((c.n_envs, c.n_agents), dtype=torch.bool, device=c.device)


def visible_of(c, word):
    n_words = seen_of(c).shape[-1]
    return torch.full((2, n_words), word, dtype=torch.int32, device=c.device)


def test_a_third_of_the_visible_texels(device):
    c = of_boxes(device)
    seen = seen_of(c).fill_(0b10011)
    fractions = engine.coverage(c.scenery, c.agents, seen, visible_of(c, 0b1110), everyone(c))
    assert fractions.shape == (3, 1) and torch.equal(fractions.cpu(), torch.full((3, 1), 1 / 3))


def test_coverage_of_all_and_of_nothing(device):
    c = of_boxes(device)
    seen, visible = seen_of(c).fill_(-1), visible_of(c, -1)
    assert (engine.coverage(c.scenery, c.agents, seen, visible, everyone(c)) == 1).all()
    assert not engine.coverage(c.scenery, c.agents, seen * 0, visible, everyone(c)).any()
    assert not engine.coverage(c.scenery, c.agents, seen, visible * 0, everyone(c)).any()


@pytest.mark.parametrize("chance", [0.0, 0.03, 0.5, 1.0])
def test_matches_a_plain_count(chance, device, monkeypatch):
    """With 101 environments of three agents, which do not fill their last warp."""
    c = of_boxes(device, 101, 3)
    random = torch.Generator().manual_seed(1)
    words = seen_of(c).shape[-1]
    seen, visible = (
        torch.rand((*owners, 32 * words), generator=random) < 0.7 for owners in ((101, 3), (2,))
    )
    mask = torch.rand((101, 3), generator=random) < chance
    poison = Poison(torch.empty)
    monkeypatch.setattr(torch, "empty", poison.allocate)
    fractions = engine.coverage(
        c.scenery,
        c.agents,
        packed(seen).to(device),
        packed(visible).to(device),
        mask.to(device),
    )
    poison.check(fractions=fractions)
    visible = visible[c.scenery.layout.cpu().long()][:, None]
    expected = (seen & visible).sum(-1).float() / visible.sum(-1).float()
    assert torch.equal(fractions.cpu(), torch.where(mask, expected, 0.0))


# ---- Explorer's metric ----


@pytest.mark.parametrize("resample", [False, True])
def test_explorer_reports_coverage_at_the_end_of_episodes(resample, device):
    env = envs.Explorer(
        12, sample("bench", 4), device=device, patience=1, res=1, subsample=1, resample=resample
    )
    world, ended = env.reset(), 0
    generator = torch.Generator().manual_seed(1)
    for _ in range(80):
        visible = unpacked(env.visible)[env.layout.cpu().long()]
        seen = unpacked(env.seen[:, 0]) & visible
        fractions = seen.sum(-1).float() / visible.sum(-1).float()
        ends = world.truncated.cpu()
        assert torch.equal(world.metrics.coverage.cpu(), torch.where(ends, fractions, 0.0))
        ended += int(ends.sum())
        world = env.step(random_decision(env, generator))
    assert ended > 12


def random_decision(env, generator):
    return arrdict(actions=contract.random_actions(env, generator))


def test_explorer_can_reach_full_coverage():
    env = envs.Explorer(4, sample("bench", 2), device="cpu", patience=1, res=8, subsample=1)
    env.reset()
    env.seen.fill_(-1)  # also texels that no spawn point shows
    env.lifecycle.limits.fill_(1)
    world = env.step(random_decision(env, torch.Generator()))
    assert world.truncated.all() and (world.metrics.coverage == 1).all()


# ---- The cache ----


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("MEGASTEP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_visible_texels_of_many_homes_are_cached(folder, monkeypatch):
    homes = sample("homes", 32)
    c = core.Core(scene.scenery(homes, 1, 32, device="cpu"))
    points = modules.RandomSpawns(homes, c).points[:, :2].contiguous()
    first = modules.visible_texels(c.scenery, points)
    assert len(list(folder.glob("visible-texels-*"))) == 1
    assert not unpacked(first)[
        torch.arange(32 * first.shape[1]) >= n_texels(c.scenery.layouts)[:, None]
    ].any()
    looked, looks = visibility._visible_from, []
    monkeypatch.setattr(
        visibility, "_visible_from", lambda *parts: looks.append(1) or looked(*parts)
    )
    again = modules.visible_texels(c.scenery, points)
    assert torch.equal(again, first) and again.dtype == torch.int32 and not looks
    again[0, 0] = 0  # the result is writable
    other = modules.visible_texels(c.scenery, points + 0.02)
    c.scenery.layouts.lines.vals[0] += 0.02
    modules.visible_texels(c.scenery, points)
    assert len(looks) == 2, "for other points, and for walls that moved"
    assert not torch.equal(other, first)


def test_visible_texels_of_few_homes_are_not_cached(folder):
    c = of_boxes("cpu")
    modules.visible_texels(c.scenery, torch.full((2, 1, 2), 1.5))
    assert not list(folder.glob("visible-texels-*"))
