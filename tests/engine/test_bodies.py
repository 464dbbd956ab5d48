"""Objects that are pushed: equal bits on CPU and GPU, the laws of motion, and a twin in float64."""

import numpy as np
import pytest
import torch

from megastep import engine, scene
from megastep.capture import capture, state_tree
from megastep.geometries import toys
from tests.helpers import bodies, bodies_twin
from tests.helpers.cuda_on_cpu import ORDERS


def steps(scenery, agents, random, n, is_busy=True):
    """Takes steps of agents that mostly walk ahead. Yields the outcome of each."""
    odds = torch.tensor([1.0, 1, 1, 8, 1, 2, 2, 3, 3])
    shape = agents.angles.shape
    actions = torch.multinomial(odds.expand(shape[0], -1), shape[1], True, generator=random)
    for _ in range(n):
        new = torch.multinomial(odds.expand(shape[0], -1), shape[1], True, generator=random)
        actions = torch.where(torch.rand(shape, generator=random) < 0.1, new, actions)
        device = agents.angles.device
        yield engine.physics(
            scenery, agents, actions.to(device), bodies.MOVES.to(device), 0.125
        ).progress


def hold_some(scenery, agents, random):
    """Has some agents grab their nearest object, and locks some objects."""
    o = scenery.objects
    to = (agents.positions[:, :, None] - o.positions[:, None, : o.n_bodies]).cpu().norm(dim=-1)
    nearest = to.argmin(1).int()
    mask = (to.amin(1) < 0.6) & (torch.rand(nearest.shape, generator=random) < 0.5)
    o.holders.copy_(torch.where(mask.to(o.holders.device), nearest.to(o.holders.device), -1))
    o.grabbed.copy_(o.holders >= 0)
    o.locked.copy_(torch.rand(nearest.shape, generator=random) < 0.1)


def trajectory(device, source, n_steps=6, n_envs=6):
    scenery, agents, random = bodies.world(n_envs, source, device="cpu", seed=3)
    if device != "cpu":
        other, others, _ = bodies.world(n_envs, source, device=device, seed=3)
        scenery, agents = other, others
    out = {}
    for i, progress in enumerate(steps(scenery, agents, random, n_steps)):
        for name, x in {"progress": progress, **state_tree((scenery.objects, agents))}.items():
            if isinstance(x, torch.Tensor):
                out[f"{name} in step {i}"] = x.clone().cpu()
        if i % 3 == 0:
            hold_some(scenery, agents, random)
    return out


def same_bits(ours, theirs):
    """Of tensors in dicts by name, or in sequences."""
    ours, theirs = (x if isinstance(x, dict) else dict(enumerate(x)) for x in (ours, theirs))
    assert ours.keys() == theirs.keys()
    for name, x in ours.items():
        bits = (one.flatten().contiguous().view(torch.uint8) for one in (x, theirs[name]))
        torch.testing.assert_close(*bits, rtol=0, atol=0, msg=lambda text, at=name: f"{at}: {text}")


@pytest.mark.parametrize("source", ["box", "homes", "ramps"])
def test_cuda_kernels_on_a_cpu_agree_on_every_bit(source, cuda_on_cpu, monkeypatch):
    expected = trajectory("cpu", source)
    cuda_on_cpu.install(monkeypatch)
    for order in ORDERS[1:]:  # tests/envs run the first, which is the CPU's own
        monkeypatch.setattr(cuda_on_cpu, "order", order)
        same_bits(expected, trajectory("cpu", source))
    assert "physics_bodies" in cuda_on_cpu.launched
    assert not {"physics", "physics_objects"} & cuda_on_cpu.launched


@pytest.mark.cuda
@pytest.mark.parametrize("source", ["box", "homes", "ramps"])
def test_cpu_and_gpu_agree_on_every_bit(source):
    same_bits(trajectory("cpu", source, 60), trajectory("cuda", source, 60))


@pytest.mark.parametrize(
    "source, n_envs, n_steps",
    [
        ("box", 16, 60),
        ("ramps", 16, 60),
        pytest.param("homes", 32, 60, marks=pytest.mark.slow),
        pytest.param("box", 1000, 700, marks=pytest.mark.nightly),
        pytest.param("homes", 500, 600, marks=pytest.mark.nightly),
    ],
)
def test_nothing_overlaps_by_more_than_the_slop(source, n_envs, n_steps):
    scenery, agents, random = bodies.world(n_envs, source)
    o, worst, n_moved = scenery.objects, 0.0, 0
    for i, _ in enumerate(steps(scenery, agents, random, n_steps)):
        worst = max(worst, float(bodies.overlaps(scenery, agents).max()))
        n_moved += int((o.velocity != 0).any())
        if i % 50 == 20:
            hold_some(scenery, agents, random)
    assert worst <= 0.005 + 1e-5 and n_moved > n_steps / 4
    extents = scenery.layouts.extents.view(-1, 4)[scenery.layout.long()][:, None]
    for at in (o.positions, agents.positions):
        assert ((at > extents[..., :2]) & (at < extents[..., 2:])).all()


def pair(friction=0.0, n_agents=1, shapes=("crate", "crate"), at=((2.0, 3.0), (2.5, 3.0)), **more):
    """A room of 5 m with an agent at (1.5, 3) and objects."""
    scenery = scene.scenery([toys.box()], n_agents, 1)
    agents = engine.Agents(1, n_agents)
    movable = [True] * len(shapes)
    scenery.objects = o = engine.Objects(1, shapes, [[1.0, 0, 0]], movable=movable, **more)
    o.visible.fill_(True)
    o.solid.fill_(True)
    o.frictions.fill_(friction)
    o.sizes.fill_(0.15)
    o.positions.copy_(torch.as_tensor(at))
    agents.positions.copy_(torch.tensor([1.5, 3.0]))
    return scenery, agents, o


def test_a_pushed_pair_has_the_momentum_of_the_force():
    """Of 20 newtons, on an agent of 1 kg that wants to walk at 100 m/s, and what is before it."""
    scenery, agents, o = pair()
    o.masses.copy_(torch.tensor([2.0, 3.0]))
    agents.velocity[0, 0, 0] = 0
    wish = torch.tensor([[100.0, 0, 0]])
    action = torch.zeros((1, 1), dtype=torch.int64)
    for step in range(1, 6):
        engine.physics(scenery, agents, action, wish, 0.0)
        momentum = agents.velocity[0, 0, 0] + (o.masses * o.velocity[..., 0]).sum()
        assert momentum.item() == pytest.approx(20 * step / 10, abs=1e-4)
    assert (o.velocity[0, :, 0] > 0.3).all() and o.velocity[..., 1].abs().max() < 1e-6


def test_a_collision_keeps_momentum_and_loses_energy():
    random = np.random.default_rng(1)
    for _ in range(20):
        scenery, agents, o = pair(at=((3.0, 3.0), (3.5, 3.2)), widths=[1.0, 0.5])
        o.angles.copy_(torch.as_tensor(random.uniform(-180, 180, (1, 2))))
        o.velocity.copy_(torch.as_tensor(random.normal(0, 0.5, (1, 2, 2))))
        o.velocity[0, 0, 0], o.velocity[0, 1, 0] = 1.0, -1.0
        o.masses.copy_(torch.as_tensor(random.uniform(0.5, 4, (1, 2))))
        inertias = o.masses * o.sizes.square() * (1 + o.widths.square()) / 3
        before = energy = None
        for _ in range(8):
            spin = torch.deg2rad(o.angvelocity)
            momentum = (o.masses[..., None] * o.velocity).sum(1)
            of_turning = (inertias * spin).sum() + (
                o.masses * (o.positions[..., 0] * o.velocity[..., 1])
                - o.masses * (o.positions[..., 1] * o.velocity[..., 0])
            ).sum()
            now = (o.masses * o.velocity.square().sum(-1) + inertias * spin.square()).sum()
            all_momenta = torch.cat([momentum[0], of_turning[None]])
            if before is not None:
                torch.testing.assert_close(all_momenta, before, rtol=0, atol=2e-2)
                torch.testing.assert_close(all_momenta[:2], before[:2], rtol=0, atol=1e-5)
                assert now <= energy + 1e-5
            before, energy = all_momenta, now
            engine.physics(scenery, agents)


def test_what_rests_stays_to_the_bit():
    scenery, agents, random = bodies.world(16, "box")
    for _ in steps(scenery, agents, random, 40):
        pass
    o = scenery.objects
    agents.velocity.zero_()
    for _ in range(40):  # friction stops all
        engine.physics(scenery, agents)
        agents.velocity.zero_()
    assert not o.velocity.any() and not o.angvelocity.any()
    before, places = o.records.view(torch.int32).clone(), o.positions.clone()
    # overlaps of 2 mm, which end when something wakes them; agents keep 5 mm to all else
    overlaps = bodies.overlaps(scenery, agents) > 0.002 - 0.0051
    agents.angvelocity.fill_(10)  # so that environments do not count as at rest
    for _ in range(10):
        engine.physics(scenery, agents)
    is_same = (before == o.records.view(torch.int32)).flatten(1).all(1)
    assert agents.angles.any() and (is_same | overlaps).all() and is_same.double().mean() > 0.5
    assert (o.positions - places).abs().max() < 0.005


@pytest.mark.parametrize("mass, is_moved", [(1.0, True), (3.0, True), (5.0, False), (1e5, False)])
def test_an_agent_moves_what_friction_does_not_hold(mass, is_moved):
    """20 newtons against 0.5 x mass x 9.81 m/s2."""
    scenery, agents, o = pair(0.5, shapes=["crate"], at=[(2.0, 3.0)])
    o.masses.fill_(mass)
    wish, action = torch.tensor([[1.0, 0, 0]]), torch.zeros((1, 1), dtype=torch.int64)
    for _ in range(40):
        engine.physics(scenery, agents, action, wish, 1.0)
    assert (o.positions[0, 0, 0] > 2.5) == is_moved
    if not is_moved:
        assert (o.positions[0, 0, 0] - 2).abs() < 0.03  # of the first impact
        assert agents.positions[0, 0, 0] < 2 - 0.15 - agents.radius + 0.03


def test_friction_stops_a_sliding_object_after_the_right_way():
    """v^2 / (2 mu g), as a step sums it: every substep first loses its share of the speed."""
    for shape in "disc", "crate":
        scenery, agents, o = pair(0.4, shapes=[shape], at=[(2.0, 3.0)])
        o.velocity[0, 0] = torch.tensor([1.5, 0.6])
        o.angvelocity[0, 0] = 90
        for _ in range(10):
            engine.physics(scenery, agents)
        way, speed2 = (o.positions[0, 0] - torch.tensor([2.0, 3.0])).norm(), 1.5**2 + 0.6**2
        assert way.item() == pytest.approx(
            speed2 / (2 * 0.4 * 9.81) - speed2**0.5 * 0.0125, abs=2e-3
        )
        assert not o.velocity.any() and not o.angvelocity.any() and o.angles.abs().sum() > 1


def run_in_island_order(order, n_steps=40):
    """Where objects end up that are given in an order, far from each other but for two pairs."""
    at = torch.tensor([(2.0, 2.0), (2.4, 2.1), (4.5, 4.5), (4.5, 5.0), (2.0, 5.0)])
    speeds = torch.tensor([(1.0, 0.2), (0, 0), (0, 1.0), (0, 0), (0.3, 0.3)])
    scenery, agents, o = pair(0.2, shapes=["crate"] * 5, at=at[list(order)])
    agents.positions.copy_(torch.tensor([5.5, 1.5]))
    o.velocity[0] = speeds[list(order)]
    for _ in range(n_steps):
        engine.physics(scenery, agents)
    back = torch.tensor(order).argsort()
    return o.records[0, back], o.velocity[0, back]


def test_the_order_of_objects_matters_only_among_those_that_touch():
    expected = run_in_island_order((0, 1, 2, 3, 4))
    for order in (4, 0, 1, 2, 3), (2, 3, 4, 0, 1), (0, 2, 1, 3, 4):
        same_bits(expected, run_in_island_order(order))


def mirrored(scenery, agents):
    """Mirrors a world at y = 0."""
    o = scenery.objects
    scenery.layouts.lines.vals[..., 1].neg_()
    for tensor in (agents.positions, agents.velocity, o.positions, o.velocity):
        tensor[..., 1].neg_()
    for tensor in (agents.angles, o.angles, agents.angvelocity, o.angvelocity):
        tensor.neg_()
    engine.bake(scenery)


def test_a_mirrored_world_moves_mirrored_for_100_steps():
    ends = []
    for is_mirrored in (False, True):
        scenery, agents, random = bodies.world(24, "box", seed=5)
        if is_mirrored:
            mirrored(scenery, agents)
        sign = torch.tensor([1.0, -1, -1]) if is_mirrored else torch.ones(3)
        states = []
        for _ in range(100):
            actions = torch.randint(9, agents.angles.shape, generator=random)
            engine.physics(scenery, agents, actions, bodies.MOVES * sign, 0.125)
            both = torch.cat([agents.positions, scenery.objects.positions], 1)
            states.append(both * torch.tensor([1, -1.0 if is_mirrored else 1]))
        ends.append(torch.stack(states))
    off = (ends[0] - ends[1]).abs().amax((0, 2, 3))
    print(off)
    assert off.max() < 1e-4


def slots_of(scenery, agents, e, wish):
    """Environment `e` for the twin: its agents and bodies, and what stands still."""
    o, slots, fixed = scenery.objects, [], []
    for a in range(agents.positions.shape[1]):
        slots.append(
            dict(
                at=agents.positions[e, a].double().numpy(),
                angle=float(agents.angles[e, a]),
                radius=agents.radius * 1.001 + 0.005,
                v=agents.velocity[e, a].double().numpy(),
                w=np.radians(float(wish[1][e, a])),
                wish=wish[0][e, a].double().numpy(),
                **dict(m=1.0, i=0.0, limit=20.0, is_agent=True),
                elevated=0 if o.elevated is None else int(o.elevated[e, a]),
            )
        )
    for k in range(o.n_objects):
        size, width = float(o.sizes[e, k]), float(o.widths[k])
        s = dict(at=o.positions[e, k].double().numpy(), angle=float(o.angles[e, k]))
        gyration2 = size**2 * ((1 + width**2) / 3)
        if int(o.shapes[k]) == 0:
            s["radius"], gyration2 = size, size**2 / 2
        else:
            s["half"] = np.array([size, size * width])
        if int(o.shapes[k]) == 3:
            s["steps"] = o.ramp_steps
        if k >= o.n_bodies:
            fixed.append(s)
            continue
        mass, friction = float(o.masses[e, k]), float(o.frictions[e, k])
        slots.append(
            s
            | dict(
                v=o.velocity[e, k].double().numpy(),
                w=np.radians(float(o.angvelocity[e, k])),
                wish=np.zeros(2),
                m=1 / mass,
                i=1 / (mass * gyration2),
                limit=friction * mass * 9.81,
                is_agent=False,
            )
        )
    walls = []
    for a, b in scenery.layouts.lines[int(scenery.layout[e])].double().numpy():
        half = np.array([np.linalg.norm(b - a) / 2, 0.0])
        walls.append(dict(at=(a + b) / 2, angle=np.degrees(np.arctan2(*(b - a)[::-1])), half=half))
    return slots, [*walls, *fixed]


@pytest.mark.parametrize(
    "source, n_envs, n_steps",
    [
        ("box", 4, 12),
        ("ramps", 4, 24),
        pytest.param("box", 10, 24, marks=pytest.mark.nightly),
        pytest.param("ramps", 8, 30, marks=pytest.mark.nightly),
    ],
)
def test_a_step_is_the_twins(source, n_envs, n_steps):
    """From states that come up in play. Rounding may decide which of two sides touches."""
    off, moved, ups = [], 0, {0: 0, -1: 0, 1: 0}
    scenery, agents, random = bodies.world(n_envs, source, seed=7)
    o = scenery.objects

    def twin(actions):
        turn, move = torch.deg2rad(agents.angles), bodies.MOVES[actions]
        c, s = turn.cos(), turn.sin()
        ahead = torch.stack(
            [c * move[..., 0] - s * move[..., 1], s * move[..., 0] + c * move[..., 1]], -1
        )
        wish = 0.875 * agents.velocity + ahead, 0.875 * agents.angvelocity + move[..., 2]
        ends = []
        for e in range(n_envs):
            slots, fixed = slots_of(scenery, agents, e, wish)
            bodies_twin.step(slots, fixed, 0.1)
            up = [s.get("elevated", 0) for s in slots]
            ends.append([np.array([*s["at"], s["angle"], *s["v"], u]) for s, u in zip(slots, up)])
        return torch.as_tensor(np.array(ends))

    odds = torch.tensor([1.0, 1, 1, 8, 1, 2, 2, 3, 3]).expand(n_envs, -1)
    for step in range(n_steps):
        if step % 8 == 0:
            actions = torch.multinomial(odds, 3, True, generator=random)
        expected = twin(actions)
        engine.physics(scenery, agents, actions, bodies.MOVES, 0.125)
        at = torch.cat([agents.positions, o.positions[:, : o.n_bodies]], 1).double()
        v = torch.cat([agents.velocity, o.velocity], 1).double()
        angles = torch.cat([agents.angles, o.angles[:, : o.n_bodies]], 1).double()
        turned = (angles - expected[..., 2] + 180) % 360 - 180
        gap = torch.cat(
            [at - expected[..., :2], 0.01 * turned[..., None], 0.1 * (v - expected[..., 3:5])], -1
        )
        off.append(gap.abs().amax((1, 2)))
        if o.elevated is not None:
            assert torch.equal(o.elevated, expected[:, :3, 5].int())
            for up in o.elevated.sign().flatten().tolist():
                ups[up] += 1
        moved += int((o.velocity != 0).any((1, 2)).sum())
    off = torch.stack(off)
    assert moved > n_envs * n_steps / 10
    assert (off < 1e-4).double().mean() > 0.99
    assert source != "ramps" or min(ups.values()) > 5


@pytest.mark.cuda
def test_a_captured_step_equals_one_that_is_not():
    def run(is_captured):
        scenery, agents, _ = bodies.world(8, "box", device="cuda")
        actions = torch.full((8, 3), 3, device="cuda")
        moves = bodies.MOVES.cuda()

        def step():
            return engine.physics(scenery, agents, actions, moves, 0.125).progress

        replay = capture(step, (), (scenery, agents)) if is_captured else step
        return [replay().clone() for _ in range(40)] + [scenery.objects.records.view(torch.int32)]

    same_bits(run(False), run(True))
