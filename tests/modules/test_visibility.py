"""The texels that are visible from spawn points, and their cache."""

import pytest
import torch

from megastep import cache, core, engine, envs, modules, scene, toys
from megastep.engine import operations
from megastep.geometries import sample
from megastep.modules import spawning, visibility
from tests.helpers.texels import n_texels, seen_of, unpacked


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


def test_a_second_start_of_many_members_computes_nothing_again(folder, monkeypatch):
    """Each member of a population has light, spawn points and visible texels of its own seed."""
    for module in (operations, spawning, visibility):
        monkeypatch.setattr(module, "MIN_CACHED", 1)

    def start(seeds):
        for seed in seeds:
            envs.Explorer(1, [toys.box()], seed=seed, device="cpu")

    start(range(64))
    start([64])  # another run
    assert len(list(folder.glob("spawn-points-*"))) == 65
    monkeypatch.setattr(cache, "write_atomically", None)  # whatever is computed would be written
    start(range(65))
