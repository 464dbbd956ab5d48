"""Free points: they lie in the home that is shown, clear of walls, and repeat by seed."""

import numpy as np
import pytest
import torch

from megastep import core, engine, modules, scene, toys
from megastep.geometries import sample
from megastep.geometry import indices
from tests.helpers.synchronisation import no_synchronisation

CLEAR = engine.AGENT_RADIUS + 0.05


def core_of(geometries, n_envs, n_agents=1, device="cpu"):
    return core.Core(scene.scenery(geometries, n_agents, n_envs, device=device), res=8)


def nearest_wall(point, walls):
    """Metres to the nearest wall, by sampling every wall each half centimetre."""
    along = np.linspace(0, 1, 2000)[:, None, None]
    ends = walls.astype(float).transpose(1, 0, 2)
    return np.linalg.norm(ends[0] + along * (ends[1] - ends[0]) - point, axis=-1).min()


def test_points_are_in_rooms_of_the_home_shown_and_clear_of_walls():
    homes = [toys.column(), *sample("homes", 2)]
    c = core_of(homes, n_envs=7, n_agents=2)
    free_points, draws = modules.FreePoints(homes, c, n_points=20), []
    for _ in range(3):
        draws.append(free_points(c.agent_full(True)))
    assert draws[0].shape == (7, 2, 2)
    for draw in draws:
        for layout, points in zip(c.scenery.layout.tolist(), draw.double().numpy()):
            for point in points:
                home = homes[layout]
                assert nearest_wall(point, home.walls) > CLEAR - 1e-3
                assert home.masks[tuple(indices(point, home.masks.shape, home.res))] > 0


def test_draws_where_masked_and_repeats_by_seed():
    homes = [toys.box(), toys.column()]
    c = core_of(homes, n_envs=6)
    first, again = (modules.FreePoints(homes, c, per_env=3) for _ in range(2))
    other = modules.FreePoints(homes, c, per_env=3, seed=2)
    before = first(torch.ones(6, 3, dtype=torch.bool)).clone()
    assert torch.equal(again(torch.ones(18, dtype=torch.bool)), before)
    assert not (other(torch.ones(6, 3, dtype=torch.bool)) == before).any(-1).all()
    mask = torch.arange(18).view(6, 3) % 2 == 0
    after = first(mask)
    assert torch.equal(after[~mask], before[~mask])
    assert (after[mask] != before[mask]).any(-1).sum() > 5


def test_all_points_are_drawn_and_none_is_a_spawn_point():
    c = core_of([toys.box()], n_envs=2000)
    free_points = modules.FreePoints([toys.box()], c)
    spawner = modules.RandomSpawns([toys.box()], c)
    drawn = free_points(c.env_full(True))[:, 0].unique(dim=0)
    assert len(drawn) == len(free_points.points[0].unique(dim=0)) == 128
    assert torch.cdist(drawn, spawner.points[0]).min() > 1e-6


def test_points_follow_environments_to_other_homes():
    """Rooms 3 and 30 m wide: points in the large one seldom lie in the small one's place."""
    homes = [toys.box(3), toys.box(30)]
    c = core_of(homes, n_envs=64)
    spawner = modules.RandomSpawns(homes, c, resample=True)
    free_points = modules.FreePoints(homes, c)
    for _ in range(3):
        spawner(c.agent_full(True))
        points, layout = free_points(c.agent_full(True))[:, 0], c.scenery.layout.long()
        assert 0 < layout.float().mean() < 1
        assert (points[:, None] == free_points.points[layout]).all(-1).any(-1).all()


@pytest.mark.cuda
def test_points_are_the_same_on_a_gpu_without_synchronising():
    homes, mask = sample("homes", 5), torch.arange(24) % 3 > 0
    draws = []
    for device in ("cpu", "cuda"):
        free_points = modules.FreePoints(homes, core_of(homes, 24, device=device))
        on_device = mask.to(device)
        free_points(on_device)
        with no_synchronisation():
            draws.append(free_points(on_device))
    assert torch.equal(draws[0], draws[1].cpu())
