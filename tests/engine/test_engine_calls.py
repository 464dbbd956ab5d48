"""The engine's operations: facts to check by hand, bad arguments, no synchronisation."""

import math

import numpy as np
import pytest
import torch

from megastep import capture, cuda, devices, engine, scene, toys
from megastep.dotdict import dotdict
from megastep.geometries import sample
from megastep.modules import RandomSpawns, to_global
from tests.helpers.synchronisation import no_synchronisation
from tests.helpers.texels import seen_of

# ---- Facts to check by hand ----


def box(device, **settings):
    core = cuda.Core(scene.scenery(2 * [toys.box()], n_agents=1, device=device), **settings)
    core.agents.positions[:] = 3.0
    return core


def test_depth_two_metres_from_a_wall(device):
    core = box(device, res=63)
    core.agents.positions[:, :, 0] = 4.0
    r = cuda.render(core.scenery, core.agents)
    assert torch.allclose(r.distances[:, 0, 31].cpu(), torch.tensor(2.0), atol=1e-6)
    o = engine.observe(core.scenery, core.agents)
    assert abs(float(o.depth[0, 0, 31]) - (1 - (2 - engine.AGENT_RADIUS) / 10)) < 5e-4


def test_wall_of_the_tutorial(device):
    core = box(device)
    core.agents.velocity[:] = torch.tensor([1000.0, 0.0])
    p = cuda.physics(core.scenery, core.agents)
    assert torch.allclose(core.agents.positions.cpu(), torch.tensor([5.8649, 3.0]), atol=1e-3)
    assert not core.agents.velocity.any() and bool((p.progress < 1).all())


def test_uniform_matches_published_philox_vectors(device):
    """Key 0 and counter 0, from Random123's kat_vectors."""
    counts = torch.zeros(1, dtype=torch.int32, device=device)
    out = engine.uniform(
        counts,
        torch.ones(1, dtype=torch.bool, device=device),
        0,
        torch.zeros((1, 4), device=device),
    )
    words = (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)
    assert out[0].tolist() == [(word >> 8) / 2**24 for word in words] and counts.tolist() == [1]


def test_uniform_draws_for_masked_lanes_only(device):
    counts = torch.tensor([5, 5, 5], dtype=torch.int32, device=device)
    mask = torch.tensor([True, False, True], device=device)
    out = engine.uniform(counts, mask, 3, torch.full((3, 4), -1.0, device=device))
    assert counts.tolist() == [6, 5, 6] and (out[1] == -1).all() and (out[::2] >= 0).all()


def test_actions_damp_and_add_their_move(device):
    core = box(device)
    core.agents.angles[:] = 90.0  # ahead is +y, left is -x
    core.agents.velocity[:] = torch.tensor([2.0, 0.0])
    core.agents.angvelocity[:] = 8.0
    moves = torch.tensor([(0, 0, 0), (1, 0.5, 40)], dtype=torch.float32, device=device)
    actions = torch.tensor([[0], [1]], device=device)
    engine.physics(core.scenery, core.agents, actions, moves, damping=0.25)
    expected = torch.tensor([[1.5, 0.0], [1.0, 1.0]])
    assert torch.allclose(core.agents.velocity[:, 0].cpu(), expected, atol=1e-6)
    assert core.agents.angvelocity.flatten().tolist() == [6.0, 46.0]
    assert torch.allclose(core.agents.positions[:, 0].cpu(), 3 + expected / 10, atol=1e-6)


def test_continuous_actions_add_weighted_moves(device):
    """Weights beyond [-1, 1] are clipped. Rotated here by PyTorch's sine and cosine."""
    n_envs, random = 64, torch.Generator().manual_seed(1)
    core = cuda.Core(scene.scenery([toys.box(100)], 2, n_envs=n_envs, device=device))
    agents = core.agents
    agents.positions[:] = torch.tensor([[30.0, 30.0], [70.0, 70.0]])
    agents.angles.copy_(360 * torch.rand((n_envs, 2), generator=random) - 180)
    agents.velocity.copy_(torch.randn((n_envs, 2, 2), generator=random))
    agents.angvelocity.copy_(90 * torch.randn((n_envs, 2), generator=random))
    moves = torch.tensor([(2, 0.5, 10), (-1, 3, -40), (0, 0, 20), (1, 1, 0)], dtype=torch.float32)
    weights = 3 * torch.rand((n_envs, 2, 4), generator=random) - 1.5
    weights[0, 0] = torch.tensor([math.inf, -math.inf, 7.0, 0.0])
    move = weights.clamp(-1, 1) @ moves
    ahead_left = to_global(agents.angles.cpu(), move[..., :2])
    velocity = 0.75 * agents.velocity.cpu() + ahead_left
    angvelocity = 0.75 * agents.angvelocity.cpu() + move[..., 2]
    engine.physics(core.scenery, agents, weights.to(device), moves.to(device), damping=0.25)
    torch.testing.assert_close(agents.velocity.cpu(), velocity, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(agents.angvelocity.cpu(), angvelocity, rtol=1e-5, atol=1e-5)


def test_spawn_changes_masked_agents_only(device):
    scenery = scene.scenery([toys.box(), toys.column()], 1, 8, device=device)
    core = cuda.Core(scenery)
    points = torch.full((2, 4, 2), 2.5, device=device)
    mask = core.agent_full(True)
    mask[::2] = False
    counts = torch.zeros((8, 1), dtype=torch.int32, device=device)
    engine.spawn(scenery, core.agents, mask, points, counts, seed=1)
    assert core.agents.positions[:, 0, 0].tolist() == [0, 2.5] * 4
    assert counts.flatten().tolist() == [0, 1] * 4 and scenery.layout.tolist() == [0, 1] * 4
    for _ in range(8):
        engine.spawn(scenery, core.agents, mask, points, counts, seed=1, resample=True)
    assert scenery.layout[::2].tolist() == [0] * 4, "environments without respawns stay"
    assert scenery.layout[1::2].unique().tolist() == [0, 1], "the others move"


def test_spawn_draws_layouts_by_cumulative_weights(device):
    """The third of the four numbers that the generator draws says where in the weights."""
    weights, n = torch.tensor([0, 5, 1, 0, 7, 3, 0]), 4096
    cumulative = weights.cumsum(0)  # up to 16
    scenery = scene.scenery(len(weights) * [toys.box()], 1, n, device=device)
    core = cuda.Core(scenery)
    points = torch.full((len(weights), 4, 2), 2.5, device=device)
    mask, counts = core.agent_full(True), torch.full((n, 1), 3, dtype=torch.int32, device=device)
    numbers = torch.full((n, 4), torch.nan, device=device)
    engine.uniform(counts.flatten().clone(), mask.flatten(), 5, out=numbers)
    expected = np.searchsorted(cumulative.numpy(), 16 * numbers[:, 2].cpu().numpy(), side="right")
    table = cumulative.to(device, torch.int32)
    engine.spawn(
        scenery, core.agents, mask, points, counts, seed=5, resample=True, cumulative=table
    )
    assert np.array_equal(scenery.layout.cpu().numpy(), expected)
    assert set(expected) == {1, 2, 4, 5}


@pytest.mark.parametrize(
    "low, high, is_hidden", [(3.2, 3.8, True), (1.0, 3.52, False), (3.48, 6.0, False)]
)
def test_hidden_spawn_is_behind_a_wall_that_hides_all_of_it(low, high, is_hidden, device):
    """Agent 0 looks from 0.3 m at a wall, behind which agent 1 spawns unless a side is in sight."""
    wall = [[(3.5, low), (3.5, high)]]
    home = dotdict(toys.box(), walls=np.concatenate([toys.box().walls, wall]))
    core = cuda.Core(scene.scenery([home], 2, 1, device=device))
    core.agents.positions[0, 0] = torch.tensor([3.2, 3.5])
    behind, in_sight = (3.75, 3.5), (3.25, 5.5)
    points = torch.tensor([[(2, 2), (2, 2), behind, in_sight]], device=device)
    counts = torch.zeros((1, 2), dtype=torch.int32, device=device)
    mask = torch.tensor([[False, True]], device=device)
    engine.spawn(core.scenery, core.agents, mask, points, counts, seed=1, hidden=True)
    assert core.agents.positions[0, 1].tolist() == list(behind if is_hidden else in_sight)


# ---- Bad arguments ----


def test_actions_and_moves_come_together():
    core, actions = box("cpu"), torch.zeros((2, 1), dtype=torch.int64)
    with pytest.raises(TypeError, match="moves"):
        engine.physics(core.scenery, core.agents, actions)
    with pytest.raises(TypeError, match="actions"):
        engine.physics(core.scenery, core.agents, moves=torch.zeros((1, 3)))


def test_agents_are_checked_for_each_scenery():
    core, more = box("cpu"), scene.scenery(3 * [toys.box()], n_agents=1, device="cpu")
    cuda.render(core.scenery, core.agents)
    with pytest.raises(ValueError, match=r"agents.positions must be .* \(3, 1, 2\)"):
        cuda.render(more, core.agents)


def test_unknown_devices():
    if not torch.cuda.is_available():
        with pytest.raises(engine.EngineError, match="no GPU"):
            engine.device("cuda")


def test_too_many_environments_say_how_many_fit(monkeypatch):
    monkeypatch.setattr(devices, "free_memory", lambda device: 10**6)
    with pytest.raises(engine.EngineError, match="at most [0-9,]+ fit"):
        scene.scenery([toys.box()], n_agents=1, n_envs=10**6, device="cpu")


# ---- On a GPU ----


@pytest.mark.cuda
def test_no_operation_synchronises():
    homes = sample("homes", 3)
    core = cuda.Core(scene.scenery(homes, 2, n_envs=6, device="cuda"), res=64)
    spawn = RandomSpawns(homes, core, resample=True)
    seen = seen_of(core)
    mask = core.agent_full(True)
    moves = torch.zeros((7, 3), device="cuda")
    actions = torch.zeros((6, 2), dtype=torch.long, device="cuda")

    def everything():
        engine.bake(core.scenery)
        spawn(mask)
        engine.physics(core.scenery, core.agents, actions, moves, 0.5)
        engine.render(core.scenery, core.agents)
        engine.observe(core.scenery, core.agents, 4, imu=True, seen=seen, clear_mask=mask)
        core.agents.positions = core.agents.positions + 0.01
        engine.physics(core.scenery, core.agents)

    everything()  # compiles, and fills caches
    torch.cuda.synchronize()
    with no_synchronisation():
        everything()
    engine.check(core.agents)


@pytest.mark.cuda
def test_captured_bake_follows_moved_walls_and_lights():
    captured, eager = (
        scene.scenery([toys.box(), toys.column()], 1, 4, device="cuda") for _ in range(2)
    )
    graph = capture.Graph(lambda: engine.bake(captured), (), (captured,))
    for scenery in (captured, eager):
        scenery.layouts.lines.vals.add_(0.25)
        scenery.layouts.lights.vals[:, 2].mul_(0.5)
    graph()
    engine.bake(eager)
    assert torch.equal(captured.layouts.boxes, eager.layouts.boxes)
    assert torch.equal(captured.layouts.baked.vals, eager.layouts.baked.vals)
    images = [cuda.render(s, cuda.Core(s).agents).screen for s in (captured, eager)]
    assert torch.equal(*images)
