"""The engine against the laws: the original's golden outputs, the brute-force twin on random
environments, and the CPU against the GPU bit by bit. Outputs are poisoned first.
"""

import math

import compare
import numpy as np
import pytest
import random_scenery
import torch

from megastep import capture, cuda, devices, engine, scene, toys
from megastep.geometries import sample
from megastep.modules import IMU, RGB, Depth, RandomSpawns

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
HAS_GPU = torch.cuda.is_available()


@pytest.fixture(params=DEVICES)
def device(request):
    if request.param == "cuda" and not HAS_GPU:
        pytest.skip("needs a GPU")
    return request.param


def core_of(envs, device, **settings):
    """A Core of a test's environments."""
    core = cuda.Core(cuda.Scenery(**envs.scenery_arguments(), device=device), **settings)
    for name in ("positions", "angles", "velocity", "angvelocity"):
        getattr(core.agents, name).copy_(getattr(envs, name))
    return core


# Bits that no kernel writes: NaNs that are not its own, and an integer that is no index or count.
POISON = {torch.float32: 0x7FC0DEAD, torch.float16: 0x7EAD, torch.int32: -0x21524111}


def bits(tensor):
    return tensor.view(torch.int16 if tensor.dtype == torch.float16 else torch.int32)


class Poison:
    """Fills memory that the engine is to write with bits of its own, and finds what is left of
    them.
    """

    def __init__(self, empty):
        self.empty = empty

    def allocate(self, *args, **kwargs):
        """Stands in for torch.empty."""
        made = self.empty(*args, **kwargs)
        if made.dtype in POISON:
            bits(made).fill_(POISON[made.dtype])
        return made

    def scenery(self, scenery):
        """Poisons what render writes into a scenery."""
        for tensor in (scenery.agent_lines, scenery.agent_light):
            bits(tensor).fill_(POISON[tensor.dtype])

    def check(self, **outputs):
        """Asserts that all of these tensors were written."""
        left = {
            name: int((bits(tensor) == POISON[tensor.dtype]).sum())
            for name, tensor in outputs.items()
            if tensor is not None
        }
        unwritten = [f"{name}: {n}" for name, n in left.items() if n]
        assert not unwritten, f"elements that no kernel wrote: {', '.join(unwritten)}"


@pytest.fixture
def poison(monkeypatch):
    found = Poison(torch.empty)
    monkeypatch.setattr(torch, "empty", found.allocate)
    return found


def state_of(core, physics):
    agents = core.agents
    return dict(
        progress=physics.progress,
        positions=agents.positions,
        angles=agents.angles,
        velocity=agents.velocity,
        angvelocity=agents.angvelocity,
    )


def baked_and_rendered(core, poison):
    """A render's fields, after a bake; all that either must write was poisoned."""
    baked = core.scenery.layouts.baked.vals
    baked.fill_(math.nan)
    cuda.bake(core.scenery)
    assert not baked.isnan().any(), "light that bake did not write"
    poison.scenery(core.scenery)
    r = cuda.render(core.scenery, core.agents)._asdict()
    poison.check(**r, lines=core.scenery.agent_lines, light=core.scenery.agent_light)
    return r


# ---- Golden: what the original computed, within the tolerances its README gives ----


@pytest.mark.parametrize("case", random_scenery.CASES)
def test_golden(case, device, poison):
    envs, settings, _ = random_scenery.golden(case)
    core = core_of(envs, device, **settings)
    r = baked_and_rendered(core, poison)
    compare.check_golden(
        case, dict(r, lines=core.scenery.lines.vals, baked=core.scenery.baked.vals)
    )
    physics = cuda.physics(core.scenery, core.agents)
    poison.check(**physics._asdict())
    compare.check_golden(case, state_of(core, physics))


# ---- The twin: random environments, all degenerate cases ----

VIEWS = [
    dict(res=1, fov=130.0),
    dict(res=64, fov=20.0),
    dict(res=63, fov=130.0),
    dict(res=256, fov=170.0),
    dict(res=1024, fov=90.0),
    dict(res=64, fov=70.0, cameras=(0.0, 120.0, 240.0)),
]


@pytest.mark.parametrize("n_agents", [1, 4])
@pytest.mark.parametrize("view", VIEWS, ids=str)
@pytest.mark.parametrize("degenerate", [(), random_scenery.EVERYTHING], ids=["plain", "degenerate"])
def test_twin_render(view, n_agents, degenerate, device, poison):
    for seed in range(2):
        envs = random_scenery.random_environments(
            seed,
            n_agents=n_agents,
            degenerate=degenerate,
            res=view["res"],
            fov=view["fov"],
            origin=190.0 if seed else 1.0,
        )
        core = core_of(envs, device, **view)
        r = baked_and_rendered(core, poison)
        compare.check_render(r, envs, **view)
        compare.check_baked(core.scenery.baked.vals, envs, static_only=False)


@pytest.mark.parametrize("n_agents", [1, 4])
@pytest.mark.parametrize("name", [None, *random_scenery.DEGENERATE, "overlap"])
def test_twin_physics(name, n_agents, device, poison):
    for seed in range(6):
        envs = random_scenery.random_environments(
            seed,
            n_envs=16,
            n_agents=n_agents,
            degenerate=(name,) if name else (),
            origin=190.0 if seed % 2 else 1.0,
        )
        core = core_of(envs, device)
        physics = cuda.physics(core.scenery, core.agents)
        poison.check(**physics._asdict())
        compare.check_physics(state_of(core, physics), envs)


def test_an_output_that_is_not_written_is_named(poison, monkeypatch):
    """What the checks above would say of kernels that write nothing."""
    core = core_of(random_scenery.random_environments(0), "cpu")
    monkeypatch.setattr(engine, "launch", lambda *args, **kwargs: None)
    outputs = [
        cuda.render(core.scenery, core.agents),
        cuda.physics(core.scenery, core.agents),
        engine.observe(core.scenery, core.agents, imu=True, centre_line=True, seen=seen_of(core)),
    ]
    for output in outputs:
        for name, tensor in output._asdict().items():
            with pytest.raises(AssertionError, match=rf"wrote: {name}: {tensor.numel()}\b"):
                poison.check(**{name: tensor})


# ---- The fused pass is the composition of the public pieces ----


@pytest.mark.parametrize("n_agents", [1, 3])
@pytest.mark.parametrize("subsample", [1, 4])
def test_observe_composes(n_agents, subsample, device, poison):
    envs = random_scenery.random_environments(
        5, n_envs=8, n_agents=n_agents, degenerate=random_scenery.EVERYTHING, res=64
    )
    core = core_of(envs, device, res=64)
    cuda.bake(core.scenery)
    seen = seen_of(core)
    o = engine.observe(core.scenery, core.agents, subsample, imu=True, centre_line=True, seen=seen)
    poison.check(**o._asdict())
    r = cuda.render(core.scenery, core.agents)
    # half a unit of fp16's last place, and the mean's rounding
    assert torch.allclose(o.rgb.float(), RGB(core, subsample)(r)[:, :, :, 0], atol=6e-4), "rgb"
    assert torch.allclose(o.depth.float(), Depth(core, subsample)(r)[:, :, 0, 0], atol=6e-4), (
        "depth"
    )
    assert torch.equal(o.centre_line, r.indices[..., 32]), "centre_line"
    assert torch.allclose(o.imu.float(), IMU(core)(), rtol=1e-3, atol=1e-6), "imu"
    assert torch.equal(bits_seen(core, r), seen), "seen"
    assert torch.equal(
        torch.tensor(
            [[bin(int(w) & 0xFFFFFFFF).count("1") for w in a] for e in seen.tolist() for a in e]
        )
        .sum(1)
        .view(8, n_agents),
        o.newly_seen.cpu().long(),
    ), "newly_seen"
    again = engine.observe(core.scenery, core.agents, subsample, seen=seen)
    assert not again.newly_seen.any(), "a texel is new only once"
    cleared = engine.observe(
        core.scenery, core.agents, subsample, seen=seen, clear_mask=core.agent_full(True)
    )
    assert torch.equal(cleared.newly_seen, o.newly_seen), "a cleared mask starts anew"


def seen_of(core):
    """Room for the texels that each agent has seen."""
    n_words = -(-core.scenery.layouts.max_texels // 32)
    return torch.zeros((core.n_envs, core.n_agents, n_words), dtype=torch.int32, device=core.device)


def bits_seen(core, r):
    """What `seen` must hold after one view, from a full render, agent by agent."""
    scenery, layouts = core.scenery, core.scenery.layouts
    out = torch.zeros((core.n_envs, core.n_agents, -(-layouts.max_texels // 32)), dtype=torch.int64)
    own, starts = scenery.agent_lines.shape[1], layouts.texel_starts.tolist()
    for e in range(core.n_envs):
        first = int(layouts.wall_starts[int(scenery.layout[e])])
        for a in range(core.n_agents):
            for line, location in zip(r.indices[e, a].tolist(), r.locations[e, a].tolist()):
                if line >= own:
                    wall = first + line - own
                    width = starts[wall + 1] - starts[wall]
                    texel = (
                        starts[wall]
                        - starts[first]
                        + min(int(np.float32(location) * np.float32(width)), width - 1)
                    )
                    out[e, a, texel // 32] |= 1 << (texel % 32)
    return torch.where(out >= 1 << 31, out - (1 << 32), out).int().to(core.device)


# ---- CPU = GPU, and 1 thread = 2 threads, on every bit ----


def trajectory(device, n_agents, subsample=1, **settings):
    """All tensors of a few steps in generated homes."""
    homes = sample("homes", 8)
    core = cuda.Core(scene.scenery(homes, n_agents, n_envs=24, device=device), **settings)
    spawn, seen = RandomSpawns(homes, core), seen_of(core)
    random = torch.Generator().manual_seed(1)
    moves = torch.tensor(
        [(0, 0, 0), (3, 0, 0), (0, 3, 40), (9, 1, -40)], dtype=torch.float32, device=device
    )
    out = [core.scenery.layouts.baked.vals]
    for step in range(12):
        spawn(torch.rand((24, n_agents), generator=random).to(device) < (1 if step == 0 else 0.1))
        actions = torch.randint(4, (24, n_agents), generator=random).to(device)
        out += engine.physics(core.scenery, core.agents, actions, moves, 0.9)
        out += engine.observe(
            core.scenery, core.agents, subsample, imu=True, centre_line=True, seen=seen
        )
    out += [
        *engine.render(core.scenery, core.agents),
        *engine.observe(core.scenery, core.agents, subsample, rgb=False)[1:2],
        *engine.observe(core.scenery, core.agents, subsample, depth=False)[:1],
        *(
            core.agents.positions,
            core.agents.angles,
            core.scenery.agent_lines,
            core.scenery.agent_light,
            seen,
        ),
    ]
    return [tensor.cpu() for tensor in out]


def differing(a, b):
    return [int(((x != y) & ~((x != x) & (y != y))).sum()) for x, y in zip(a, b, strict=True)]


SETTINGS = [
    dict(n_agents=1, res=64),
    dict(n_agents=4, res=128, fov=70.0),
    dict(n_agents=2, res=32, fov=90.0, cameras=[0, 120, 240]),
    dict(
        n_agents=1, res=256, subsample=4
    ),  # the usual one; then batches that do not fill a warp, or lie across blocks
    dict(n_agents=1, res=60, subsample=3),
    dict(n_agents=2, res=160, subsample=5),
    dict(n_agents=1, res=96, subsample=32),
    dict(n_agents=1, res=63),
]


@pytest.mark.cuda
@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_cpu_and_gpu_agree_on_every_bit(settings):
    if not HAS_GPU:
        pytest.skip("needs a GPU")
    assert not any(differing(trajectory("cpu", **settings), trajectory("cuda", **settings)))


@pytest.mark.cuda
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_gpus_agree_on_every_bit_whichever_is_current():
    here, there = trajectory("cuda:0", n_agents=2, res=64), trajectory("cuda:1", n_agents=2, res=64)
    assert torch.cuda.current_device() == 0 and not any(differing(here, there))


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_threads_do_not_matter(settings):
    before = torch.get_num_threads()
    runs = []
    try:
        for n in (1, 2, 4):
            torch.set_num_threads(n)
            runs.append(trajectory("cpu", **settings))
    finally:
        torch.set_num_threads(before)
    assert not any(differing(runs[0], runs[1])) and not any(differing(runs[0], runs[2]))


# ---- Facts to check on paper ----


def box(device, **settings):
    core = cuda.Core(scene.scenery(2 * [toys.box()], n_agents=1, device=device), **settings)
    core.agents.positions[:] = 3.0
    return core


def test_two_metres_from_a_wall_depth_reads_two_metres(device):
    core = box(device, res=63)
    core.agents.positions[:, :, 0] = 4.0
    r = cuda.render(core.scenery, core.agents)
    assert torch.allclose(r.distances[:, 0, 31].cpu(), torch.tensor(2.0), atol=1e-6)
    o = engine.observe(core.scenery, core.agents)
    assert abs(float(o.depth[0, 0, 31]) - (1 - (2 - engine.AGENT_RADIUS) / 10)) < 5e-4


def test_the_tutorials_wall(device):
    core = box(device)
    core.agents.velocity[:] = torch.tensor([1000.0, 0.0])
    p = cuda.physics(core.scenery, core.agents)
    assert torch.allclose(core.agents.positions.cpu(), torch.tensor([5.8649, 3.0]), atol=1e-3)
    assert not core.agents.velocity.any() and bool((p.progress < 1).all())


@pytest.mark.parametrize("speed", [1.0, 10.0, 1000.0])
def test_no_agent_leaves_a_closed_box(speed, device):
    core = cuda.Core(scene.scenery([toys.box()], n_agents=1, n_envs=512, device=device))
    core.agents.positions[:] = 3.5
    random = torch.Generator().manual_seed(2)
    for _ in range(200):
        core.agents.velocity.copy_(speed * torch.randn((512, 1, 2), generator=random))
        cuda.physics(core.scenery, core.agents)
    clearance = torch.minimum(core.agents.positions - 1, 6 - core.agents.positions).amin()
    assert float(clearance) >= engine.AGENT_RADIUS, "cameras stay on their side of the wall"


def test_two_cores_live_side_by_side(device):
    narrow, wide = box(device, res=16, fov=30.0), box(device, res=64, fov=150.0, cameras=[0, 180])
    before = cuda.render(narrow.scenery, narrow.agents)
    assert cuda.render(wide.scenery, wide.agents).screen.shape == (2, 1, 2, 64, 3)
    after = cuda.render(narrow.scenery, narrow.agents)
    assert before.screen.shape == (2, 1, 16, 3) and torch.equal(before.screen, after.screen)


def test_layouts_are_shared(device):
    scenery = scene.scenery([toys.box(), toys.column()], n_agents=1, n_envs=6, device=device)
    assert scenery.layout.tolist() == [0, 1, 0, 1, 0, 1] and len(scenery.layouts) == 2
    lines, textures, baked = scenery.lines, scenery.textures, scenery.baked
    assert (
        len(lines) == 6
        and torch.equal(lines[1], lines[3])
        and torch.equal(lines.vals[lines.starts[2] : lines.ends[2]], lines[2])
    )
    assert len(textures) == len(lines.vals) == len(baked) and torch.equal(lines[-1], lines[5])
    wall = int(lines.starts[3]) + 8  # after the agent's eight
    assert torch.equal(textures[wall], textures[int(lines.starts[1]) + 8]) and len(
        baked[wall]
    ) == len(textures[wall])
    assert (
        torch.equal(textures.vals[textures.inverse == wall], textures[wall])
        and len(lines[1:3]) == 2
    )


def test_random_streams_are_philox(device):
    """Against the published vector for key 0, counter 0 (Random123's kat_vectors)."""
    counts = torch.zeros(1, dtype=torch.int32, device=device)
    out = engine.uniform(
        counts,
        torch.ones(1, dtype=torch.bool, device=device),
        0,
        torch.zeros((1, 4), device=device),
    )
    words = (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)
    assert out[0].tolist() == [(word >> 8) / 2**24 for word in words] and counts.tolist() == [1]


# ---- Bad input ----


@pytest.mark.parametrize(
    "settings",
    [dict(res=0), dict(res=1025), dict(fov=180.0), dict(fov=0.0), dict(fps=0.0), dict(cameras=[])],
    ids=str,
)
def test_bad_settings_are_refused(settings):
    with pytest.raises(ValueError, match="but"):
        box("cpu", **settings)


@pytest.mark.parametrize("radius", [0.0, -1.0, math.nan, math.inf])
def test_a_disc_needs_a_radius(radius):
    with pytest.raises(ValueError, match="radius must be a number of metres above 0"):
        engine.Agents(1, 1, radius=radius)


@pytest.mark.parametrize("max_depth", [0.0, -1.0, math.nan])
def test_depth_needs_a_range(max_depth):
    core = box("cpu")
    with pytest.raises(ValueError, match="max_depth must be a number of metres above 0"):
        engine.observe(core.scenery, core.agents, max_depth=max_depth)


def test_a_position_that_is_not_finite_is_named(device):
    core = box(device)
    core.agents.positions[1, 0, 0] = math.nan
    with pytest.raises(engine.EngineError, match="environment 1 .* not a finite number"):
        cuda.render(core.scenery, core.agents)
        engine.check(core.agents)
    core.agents.positions[:] = 3.0
    cuda.render(core.scenery, core.agents)
    engine.check(core.agents)


@pytest.mark.parametrize(
    "broken, found",
    [
        (lambda good: good.double(), r"a torch.float64 tensor of shape \(2, 1, 2\)"),
        (lambda good: good[:1].clone(), r"a torch.float32 tensor of shape \(1, 1, 2\)"),
        (lambda good: torch.stack([good, good], -1)[..., 0], "a non-contiguous torch.float32"),
        (lambda good: None, "None was given"),
    ],
    ids=["dtype", "shape", "not contiguous", "None"],
)
def test_wrong_tensors_are_named(broken, found):
    core = box("cpu")
    good = core.agents.positions
    core.agents.positions = broken(good)
    with pytest.raises((TypeError, ValueError), match=f"agents.positions must be .*but {found}"):
        cuda.render(core.scenery, core.agents)
    core.agents.positions = good.clone()
    cuda.render(core.scenery, core.agents)


def test_unknown_devices_are_refused():
    with pytest.raises(engine.EngineError, match="device=tpu is unknown"):
        engine.device("tpu")
    if not HAS_GPU:
        with pytest.raises(engine.EngineError, match="no GPU"):
            engine.device("cuda")


def test_too_many_environments_are_counted(monkeypatch):
    monkeypatch.setattr(devices, "free_memory", lambda device: 10**6)
    with pytest.raises(engine.EngineError, match="at most [0-9,]+ fit"):
        scene.scenery([toys.box()], n_agents=1, n_envs=10**6, device="cpu")


# ---- What needs a GPU ----


def no_synchronisation(act):
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        act()
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.cuda
def test_no_operation_synchronises():
    homes = sample("homes", 3)
    core = cuda.Core(scene.scenery(homes, 2, n_envs=6, device="cuda"), res=64)
    spawn, seen, mask = (
        RandomSpawns(homes, core, resample=True),
        seen_of(core),
        core.agent_full(True),
    )
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
    no_synchronisation(everything)
    engine.check(core.agents)


@pytest.mark.cuda
def test_a_recorded_bake_follows_walls_and_lights_that_move():
    recorded, eager = (
        scene.scenery([toys.box(), toys.column()], 1, 4, device="cuda") for _ in range(2)
    )
    graph = capture.Graph(lambda: engine.bake(recorded), (), (recorded,))
    for scenery in (recorded, eager):
        scenery.layouts.lines.vals.add_(0.25)
        scenery.layouts.lights.vals[:, 2].mul_(0.5)
    graph()
    engine.bake(eager)
    assert torch.equal(recorded.layouts.boxes, eager.layouts.boxes)
    assert torch.equal(recorded.layouts.baked.vals, eager.layouts.baked.vals)
    images = [cuda.render(s, cuda.Core(s).agents).screen for s in (recorded, eager)]
    assert torch.equal(*images)
