"""No agent passes a wall, whatever its speed and the corner that it is driven into."""

import numpy as np
import pytest
import torch

from megastep import core, engine, scene, toys
from megastep.dotdict import dotdict
from megastep.geometries import sample

STEPS, N_ENVS = 120, 256
SUNK = 1e-4  # metres that rounding may put a disc into a wall


def star(n_arms=7):
    """Walls that meet in acute corners, in a box."""
    angles = np.linspace(0, 2 * np.pi, n_arms, endpoint=False)
    middle = np.full((n_arms, 2), 4.0)
    arms = np.stack([middle, middle + 2.5 * np.stack([np.cos(angles), np.sin(angles)], 1)], 1)
    box = toys.box(width=6)
    return dotdict(box, walls=np.concatenate([box.walls, arms]).astype(np.float32))


def distances_of(points, walls):
    """Metres (n, W), in float64, from points (n, 2) to walls (W, 2, 2)."""
    start, along = walls[:, 0], walls[:, 1] - walls[:, 0]
    share = ((points[:, None] - start) * along).sum(-1) / (along**2).sum(-1).clip(1e-12)
    nearest = start + share.clip(0, 1)[..., None] * along
    return np.linalg.norm(points[:, None] - nearest, axis=-1)


def sides_of(points, walls):
    """Which side (n, W) of each wall's line a point is on."""
    along, offset = walls[:, 1] - walls[:, 0], points[:, None] - walls[:, 0]
    return np.sign(along[:, 0] * offset[..., 1] - along[:, 1] * offset[..., 0])


@pytest.mark.parametrize("speed", [0.5, 10.0, 1000.0])
@pytest.mark.parametrize("source", ["star", "homes", "maze"])
def test_no_agent_passes_a_wall(source, speed, device):
    """Agents are driven in directions that last for 20 steps, so that many end in corners."""
    g = star() if source == "star" else sample(source, 1, seed=3)[0]
    c = core.Core(scene.scenery([g], 1, N_ENVS, device=device), res=1)
    walls, random = g.walls.astype(float), np.random.default_rng(1)
    low, high = walls.min((0, 1)), walls.max((0, 1))
    spots = random.uniform(low, high, (100 * N_ENVS, 2))
    spots = spots[distances_of(spots, walls).min(1) > engine.AGENT_RADIUS + 0.01][:N_ENVS]
    c.agents.positions[:, 0] = torch.from_numpy(spots).float().to(device)
    n_stopped, before = 0, c.agents.positions[:, 0].cpu().double().numpy()
    for t in range(STEPS):
        if t % 20 == 0:
            angles = random.uniform(-np.pi, np.pi, N_ENVS)
            heading = np.stack([np.cos(angles), np.sin(angles)], 1)
        velocity = speed * heading * random.uniform(0, 1, (N_ENVS, 1))
        c.agents.velocity[:, 0] = torch.from_numpy(velocity).float().to(device)
        n_stopped += int((engine.physics(c.scenery, c.agents).progress < 1).sum())
        after = c.agents.positions[:, 0].cpu().double().numpy()
        assert distances_of(after, walls).min() > engine.AGENT_RADIUS - SUNK
        # a path crosses a wall if each has the ends of the other on two sides
        paths = np.stack([before, after], 1)
        by_wall = sides_of(before, walls) * sides_of(after, walls) < 0
        by_path = sides_of(walls[:, 0], paths) * sides_of(walls[:, 1], paths) < 0
        assert not (by_wall & by_path.T).any()
        before = after
    assert n_stopped > 0.1 * STEPS * N_ENVS or speed < 1, "too few walls were hit"
