"""Objects in the engine: drawn and collided with as in a twin in float64; equal bits on a GPU."""

import numpy as np
import pytest
import torch

from megastep import engine, scene
from megastep.capture import state_tree
from megastep.geometries import toys
from megastep.geometries.sources import homes
from megastep.modules.spawning import cached_points
from tests.helpers import twin
from tests.helpers.cuda_on_cpu import ORDERS

N, A, RES = 6, 3, 64
SHAPES = ("disc", "disc", "crate", "door", "crate", "disc")
PALETTE = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0.2, 0.3, 0.9]])


def world(device="cpu", n_agents=A, lit=False, seed=1, n_envs=N):
    """Scenery with objects and agents at random poses in homes."""
    random = np.random.default_rng(seed)
    plans = homes(3, seed=seed)
    scenery = scene.scenery(plans, n_agents, n_envs, device=device)
    agents = engine.Agents(n_envs, n_agents, res=RES, device=device)
    objects = engine.Objects(n_envs, SHAPES, PALETTE, lit, device=device)
    scenery.objects = objects
    for e in range(n_envs):
        home = plans[e % 3]
        cells = np.argwhere(home.masks > 0)
        cells = cells[random.permutation(len(cells))[: n_agents + len(SHAPES)]]
        spots = np.stack([cells[:, 1] + 0.5, len(home.masks) - cells[:, 0] - 0.5], 1) * home.res
        agents.positions[e] = torch.as_tensor(spots[:n_agents])
        objects.positions[e] = torch.as_tensor(spots[n_agents:])
    shape = n_envs, len(SHAPES)
    for tensor, values in (
        (objects.angles, random.uniform(-180, 180, shape)),
        (objects.sizes, random.uniform(0.1, 0.4, shape)),
        (objects.colours, random.integers(3, size=shape)),
        (objects.visible, random.random(shape) < 0.9),
        (objects.solid, random.random(shape) < 0.7),
        (objects.open, random.random(shape) < 0.2),
        (objects.carriers, np.where(random.random(shape) < 0.2, random.integers(n_agents), -1)),
        (agents.angles, random.uniform(-180, 180, (n_envs, n_agents))),
        (agents.velocity, random.normal(0, 15, (n_envs, n_agents, 2))),
        (agents.angvelocity, random.normal(0, 90, (n_envs, n_agents))),
    ):
        tensor.copy_(torch.as_tensor(values))
    return scenery, agents


def drawn(shape, size, position, angle):
    """The lines of an object, written down by hand."""
    if shape == "disc":
        turns = torch.arange(6, dtype=torch.float64) * 60
        corners = twin.turn(torch.tensor([[1.0, 0]]).double().expand(6, 2), turns)
    elif shape == "crate":
        corners = torch.tensor([[-1, -1], [1, -1], [1, 1], [-1, 1]]).double()
    else:
        corners = torch.tensor([[-1, 0], [1, 0]]).double()
    corners = twin.turn(size * corners, angle.expand(len(corners))) + position
    lines = torch.stack([corners, corners.roll(-1, 0)], 1)
    return lines[:1] if shape == "door" else lines


def by_hand(scenery, agents, e):
    """Lines of an environment for the twin, the object of each or -1, and who carries it."""
    o = scenery.objects
    lines, owners = [], []
    for k, shape in enumerate(SHAPES):
        carrier = int(o.carriers[e, k])
        held = carrier >= 0
        position = (agents.positions[e, carrier] if held else o.positions[e, k]).double()
        angle = (agents.angles[e, carrier] if held else o.angles[e, k]).double()
        new = drawn(shape, o.sizes[e, k].double(), position, angle)
        there = o.visible[e, k] and not o.open[e, k]
        lines.append(new if there else torch.zeros_like(new))
        owners += [k] * len(new)
    return torch.cat(lines), torch.tensor(owners)


@pytest.mark.parametrize("lit", [False, True])
def test_cameras_see_objects_as_the_twin_does(lit):
    scenery, agents = world(lit=lit)
    view = engine.render(scenery, agents)
    n_same = n_rays = n_of_objects = 0
    for e in range(N):
        own, owner = by_hand(scenery, agents, e)
        positions, angles = agents.positions[e].double(), agents.angles[e].double()
        d = int(scenery.layout[e])
        walls = scenery.layouts.lines[d].double()
        bodies = twin.agent_lines(scenery.model.double(), positions, angles)
        first, o = len(bodies), scenery.objects
        for a in range(A):
            carried = o.carriers[e, owner] == a  # its own: not seen
            lines = torch.cat([bodies, torch.where(carried[:, None, None], 0, own), walls])
            rays = twin.rays(angles[a : a + 1], [0.0], RES, agents.fov)
            hits = {k: v[0, 0] for k, v in twin.raycast(lines, positions[a : a + 1], rays).items()}
            same = hits["indices"] == view.indices[e, a]
            n_same, n_rays = n_same + int(same.sum()), n_rays + RES
            torch.testing.assert_close(
                view.distances[e, a][same].double(), hits["distances"][same], rtol=1e-4, atol=1e-4
            )
            index = hits["indices"][same]
            is_object = (index >= first) & (index < first + len(own))
            n_of_objects += int(is_object.sum())
            k = owner[(index - first).clamp(0, len(own) - 1)]
            light = torch.ones(len(SHAPES), dtype=torch.float64)
            if lit:
                lights = scenery.layouts.lights[d].double()
                light = twin.light_at(o.positions[e].double(), walls, lights)
            facing = (1 - hits["dots"][same].square())[:, None]
            colours = PALETTE.double()[o.colours[e, k].long()] * light[k][:, None] * facing
            seen = view.screen[e, a][same].double()
            torch.testing.assert_close(seen[is_object], colours[is_object], rtol=0, atol=2e-3)
    assert n_same > 0.99 * n_rays and n_of_objects > 0.03 * n_rays
    lines = scenery.lines[0]
    assert torch.equal(lines, scenery.env(0)[0]) and len(lines) == len(scenery.env(0)[1])
    first = scenery.agent_lines.shape[1]
    for line, lit_texture in enumerate(scenery.env(0)[1]):
        at = int(scenery.lines.starts[0]) + line
        texture = scenery.textures[at] * scenery.baked[at][:, None]
        if not (first <= line < first + len(own)) or lines[line].any():
            torch.testing.assert_close(lit_texture, texture)


def test_agents_stop_at_solid_objects_as_in_the_twin():
    n_stopped = 0
    for seed in range(12):
        scenery, agents = world(seed=seed)
        o, before = scenery.objects, {k: getattr(agents, k).double() for k in MOVING}
        expected = []
        for e in range(N):
            walls, discs = [scenery.layouts.lines[int(scenery.layout[e])].double()], []
            for k, shape in enumerate(SHAPES):
                blocks = o.visible[e, k] and o.solid[e, k] and not o.open[e, k]
                if not blocks or o.carriers[e, k] >= 0:
                    continue
                pose = o.sizes[e, k].double(), o.positions[e, k].double(), o.angles[e, k].double()
                if shape == "disc":
                    discs.append(pose[:2])
                else:
                    walls.append(drawn(shape, *pose))
            state = {k: v[e] for k, v in before.items()}
            without = twin.physics(torch.cat(walls), **state)["progress"]
            step = state["velocity"] / 10
            for size, position in discs:
                offset, reach = state["positions"] - position, twin.INFLATION * twin.RADIUS + size
                first = twin.contact(offset, step, reach)
                found = torch.where(first <= 1, (twin.SHORTFALL * first).clamp(0, 1), 1.0)
                without = torch.minimum(without, found)
            expected.append(without)
            bare = twin.physics(walls[0], **state)["progress"]
            n_stopped += int((without < bare).sum())
        progress = engine.physics(scenery, agents).progress
        torch.testing.assert_close(progress.double(), torch.stack(expected), rtol=0, atol=2e-3)
    assert n_stopped > 5


MOVING = "positions", "angles", "velocity", "angvelocity"


def trajectory(device, n_agents=A, lit=False, hidden=False, steps=3):
    """All that the operations write in a few steps, as CPU tensors."""
    scenery, agents = world(device, n_agents, lit)
    o, out = scenery.objects, []
    points = torch.rand((3, 40, 2), generator=torch.Generator().manual_seed(3)) * 4 + 1
    points = points.to(device)
    counts = torch.zeros((N, n_agents), dtype=torch.int32, device=device)
    placed = torch.zeros_like(o.carriers)
    seen = torch.zeros((N, n_agents, -(-scenery.layouts.max_texels // 32)), dtype=torch.int32)
    seen = seen.to(device)
    for i in range(steps):
        random = torch.Generator().manual_seed(i)
        mask = (torch.rand((N, n_agents), generator=random) < 0.5).to(device)
        out.append(engine.physics(scenery, agents).progress)
        engine.spawn(scenery, agents, mask, points, counts, 5, resample=i == 1, hidden=hidden)
        which = (torch.rand((N, len(SHAPES)), generator=random) < 0.4).to(device)
        engine.place_objects(scenery, agents, which, points, placed, 7)
        out += engine.observe(scenery, agents, 4, True, True, True, True, True, seen)
        out += engine.render(scenery, agents)
        agents.velocity.copy_(torch.randn((N, n_agents, 2), generator=random) * 10)
        out += [value for _, value in sorted(state_tree((scenery.objects, agents)).items())]
    return [x.cpu().clone() for x in out if isinstance(x, torch.Tensor)]


CASES = [dict(), dict(n_agents=1), dict(lit=True, hidden=True)]


def same_bits(ours, theirs):
    for one, other in zip(ours, theirs, strict=True):
        bits = (x.flatten().contiguous().view(torch.uint8) for x in (one, other))
        torch.testing.assert_close(*bits, rtol=0, atol=0)


@pytest.mark.parametrize("amount", ["few", "some", "many"])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_cuda_kernels_on_a_cpu_agree_on_every_bit(case, amount, cuda_on_cpu, monkeypatch):
    expected = trajectory("cpu", **case)
    cuda_on_cpu.install(monkeypatch)
    room = {"few": 10**6, "some": 200, "many": 1}[amount]
    monkeypatch.setattr(engine.rendering, "n_resident_threads", lambda device: room)
    if amount == "many":
        monkeypatch.setattr(engine.operations, "MAX_SPAWN_WARPS", 3)
    for order in ORDERS[1:]:  # tests/envs run the first, which is the CPU's own
        monkeypatch.setattr(cuda_on_cpu, "order", order)
        same_bits(expected, trajectory("cpu", **case))
    kernel = dict(few="_split", some="_unspilled", many="")[amount]
    used = {f"render_objects{kernel}", "place_objects", "update_objects"}
    assert used <= cuda_on_cpu.launched and "physics_objects" in str(cuda_on_cpu.launched)
    assert not {"render", "physics", "spawn", "spawn_hidden"} & cuda_on_cpu.launched


@pytest.mark.cuda
@pytest.mark.parametrize("n_warps", (3, N))
@pytest.mark.parametrize("case", CASES, ids=str)
def test_cpu_and_gpu_agree_on_every_bit(case, n_warps, monkeypatch):
    monkeypatch.setattr(engine.operations, "MAX_SPAWN_WARPS", n_warps)
    same_bits(trajectory("cpu", **case), trajectory("cuda", **case))


def test_placed_objects_keep_clear_of_agents_and_of_each_other(device):
    scenery, agents = world(device)
    o = scenery.objects
    o.carriers.fill_(-1)
    o.sizes.fill_(0.15)
    plans = homes(3, seed=1)
    points = torch.as_tensor(cached_points(plans, 128, 1, 0.15, 3), device=device)
    counts = torch.zeros_like(o.carriers)
    mask = torch.zeros_like(o.visible)
    mask[::2] = True
    before = o.positions.clone()
    engine.place_objects(scenery, agents, mask, points, counts, 9)
    assert torch.equal(before[1::2], o.positions[1::2]) and counts[::2].eq(1).all()
    assert o.visible[::2].all() and not counts[1::2].any()
    apart = torch.cdist(o.positions[::2], o.positions[::2]) + 9 * torch.eye(6, device=device)
    assert apart.min() >= 0.35 - 1e-5
    assert torch.cdist(o.positions[::2], agents.positions[::2]).min() >= 0.2 + agents.radius - 1e-5
    among = o.positions[::2, :, None] == points[scenery.layout.long()[::2], None]
    assert among.all(-1).any(-1).all(), "at points of the layout"
    moved = o.positions.clone()
    engine.place_objects(scenery, agents, mask, points, counts, 9)
    assert not torch.equal(moved[::2], o.positions[::2]), "another draw"


def test_respawning_agents_drop_what_they_carry_and_avoid_obstacles(device):
    scenery = scene.scenery([toys.box()], 1, 2, device=device)
    agents = engine.Agents(2, 1, device=device)
    scenery.objects = o = engine.Objects(2, ["crate", "disc"], PALETTE, device=device)
    o.visible.fill_(True)
    o.solid[:, 0] = True
    points = torch.tensor([[[2.0, 2.0], [4.0, 4.0]]], device=device)
    o.positions[:, 0] = points[0, 0]
    o.positions[:, 1] = 3.0
    o.carriers[0, 1] = 0
    counts = torch.zeros((2, 1), dtype=torch.int32, device=device)
    mask = torch.tensor([[True], [False]], device=device)
    for _ in range(8):
        agents.positions.fill_(3)
        engine.spawn(scenery, agents, mask, points, counts, 1)
        assert agents.positions[0, 0].tolist() == [4, 4], "the other point is on a crate"
    assert o.carriers.tolist() == [[-1, -1], [-1, -1]]
    assert o.positions[0, 1].tolist() == [3, 3]


@pytest.mark.parametrize(
    "write, message",
    [
        (lambda o: o.positions[1, 2].fill_(torch.nan), "environment 1, object 2 has a non-finite"),
        (lambda o: o.sizes[3, 0].fill_(0), "environment 3, object 0 has a non-finite"),
        (lambda o: o.colours[2, 4].fill_(3), "environment 2, object 4 has a colour"),
        (lambda o: o.carriers[5, 5].fill_(A), "environment 5, object 5 is carried by"),
        (lambda o: o.positions[0, 1].fill_(99), "environment 0, object 1 is outside"),
    ],
    ids=["pose", "size", "colour", "carrier", "outside"],
)
def test_bad_objects_are_named(write, message, device):
    scenery, agents = world(device)
    scenery.objects.visible.fill_(True)
    scenery.objects.open.fill_(False)
    scenery.objects.carriers.fill_(-1)
    write(scenery.objects)
    with pytest.raises(engine.EngineError, match=message):
        engine.observe(scenery, agents)
        engine.check(agents)
    engine.check(agents)  # is cleared


def test_more_objects_than_fit_are_named(device):
    scenery, agents = world(device)
    mask = torch.ones_like(scenery.objects.visible)
    points = torch.full((3, 4, 2), 3.0, device=device)
    counts = torch.zeros_like(scenery.objects.carriers)
    with pytest.raises(engine.EngineError, match=r"environment \d, object \d does not fit"):
        engine.place_objects(scenery, agents, mask, points, counts, 1)
        engine.check(agents)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (dict(shapes=["ball"]), "shapes must be disc or crate or door"),
        (dict(shapes=[]), "shapes must hold at least one"),
        (dict(palette=[[1.0, 0]]), "palette must be an array"),
        (dict(shapes=["disc"] * 257), "must be an integer from 1 to 256"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        engine.Objects(**dict(n_envs=1, shapes=["disc"], palette=PALETTE) | arguments)


def test_replaced_tensors_are_refused():
    scenery, _ = world()
    with pytest.raises(AttributeError):
        scenery.objects.positions = torch.zeros(3)
    with pytest.raises(AttributeError, match="records of a Objects"):
        scenery.objects.records = torch.zeros(3)
    with pytest.raises(AttributeError):
        scenery.objects = engine.Objects(N, ["disc"], PALETTE)
