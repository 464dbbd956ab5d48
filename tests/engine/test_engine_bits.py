"""CPU and GPU, and any number of CPU threads, agree on every bit."""

import math
from types import SimpleNamespace

import pytest
import torch

from megastep import cuda, engine, scene, toys
from megastep.engine import operations, rendering
from megastep.geometries import sample
from megastep.modules import RandomSpawns, visible_texels
from tests.helpers.cuda_on_cpu import ORDERS
from tests.helpers.texels import seen_of


def trajectory(device, n_agents, subsample=1, n_steps=12, **settings):
    """All outputs of a few steps in generated homes."""
    homes = sample("homes", 8)
    core = cuda.Core(scene.scenery(homes, n_agents, n_envs=24, device=device), **settings)
    spawn, seen = RandomSpawns(homes, core), seen_of(core)
    hide = RandomSpawns(homes, core, hidden=True, resample=True)
    visible = visible_texels(core.scenery, spawn.points[:, :4])
    random = torch.Generator().manual_seed(1)
    moves = torch.tensor(
        [(0, 0, 0), (3, 0, 0), (0, 3, 40), (9, 1, -40)], dtype=torch.float32, device=device
    )
    out = [core.scenery.layouts.baked.vals, visible]
    for step in range(n_steps):
        some = torch.rand((24, n_agents), generator=random).to(device)
        spawn(some < (1 if step == 0 else 0.1))
        hide(some > 0.8)
        actions = torch.randint(4, (24, n_agents), generator=random)
        if step % 2:  # continuous ones, partly beyond their bounds
            actions = 3 * torch.rand((24, n_agents, len(moves)), generator=random) - 1.5
        out += engine.physics(core.scenery, core.agents, actions.to(device), moves, 0.9)
        out += engine.observe(
            core.scenery,
            core.agents,
            subsample,
            imu=True,
            centre_line=True,
            agent_ray=True,
            seen=seen,
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
    dict(n_agents=1, res=256, subsample=4),  # the most common one
    # batches that do not fill a warp, or span blocks
    dict(n_agents=1, res=60, subsample=3),
    dict(n_agents=2, res=160, subsample=5),
    dict(n_agents=1, res=96, subsample=32),
    dict(n_agents=1, res=63),
    dict(n_agents=2, res=96, subsample=4, cameras=[0, 120]),  # a half has more tiles than the other
]


#: Threads per environment that a GPU runs at once, by what that makes 24 environments: each number
#: has another kernel, or other threads per environment.
ROOMS = dict(many=0, some=32, few=96)
amounts = pytest.mark.parametrize("amount", ROOMS)


def pretend(patch, amount, n_agents):
    """Makes 24 environments many, some or few."""
    n_threads = 24 * ROOMS[amount]
    patch.setattr(rendering, "n_resident_threads", lambda device: n_agents * n_threads)
    patch.setattr(operations, "n_resident_threads", lambda device, n=32: n_threads * n // 32)


@pytest.mark.cuda
@amounts
@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_cpu_and_gpu_agree_on_every_bit(settings, amount, monkeypatch):
    expected = trajectory("cpu", **settings)
    pretend(monkeypatch, amount, settings["n_agents"])
    assert not any(differing(expected, trajectory("cuda", **settings)))


@pytest.mark.parametrize(
    "settings, amount",
    [
        (settings, amount)
        for number, settings in enumerate(SETTINGS)
        for k, amount in enumerate(ROOMS)
        if number in (1, 3, 8) or k == number % 3  # the others have one amount each
    ],
    ids=str,
)
def test_cuda_kernels_on_a_cpu_agree_on_every_bit(settings, amount, cuda_on_cpu, monkeypatch):
    """The threads of a block run in three orders, blocks in two."""
    expected = trajectory("cpu", n_steps=2, **settings)
    cuda_on_cpu.install(monkeypatch)
    pretend(monkeypatch, amount, settings["n_agents"])
    for order in ORDERS[1:]:  # tests/envs run the first, which is the CPU's own
        monkeypatch.setattr(cuda_on_cpu, "order", order)
        assert not any(differing(expected, trajectory("cpu", n_steps=2, **settings)))
    can_split = settings["res"] > 32 and 32 % settings.get("subsample", 1) == 0
    kernel = dict(many="render", some="render_unspilled", few="render_split")[amount]
    if amount == "few" and not can_split:
        kernel = "render_unspilled"
    assert {kernel, "render"} <= cuda_on_cpu.launched  # `render` for all fields
    if amount == "many":
        assert not {"render_unspilled", "render_split"} & cuda_on_cpu.launched
    physics = "physics" if amount == "many" else "physics_unspilled"
    assert {"physics", "physics_unspilled"} & cuda_on_cpu.launched == {physics}


@pytest.mark.parametrize(
    "n_envs, n_agents, res, subsample, kernel",
    [
        (2816, 1, 256, 4, "render_split"),
        (2817, 1, 256, 4, "render_unspilled"),
        (33_792, 1, 256, 4, "render_unspilled"),
        (33_793, 1, 256, 4, "render"),
        (1408, 2, 256, 4, "render_split"),
        (1409, 2, 256, 4, "render_unspilled"),
        (64, 1, 32, 1, "render_unspilled"),  # a single tile
        (64, 1, 96, 3, "render_unspilled"),  # tiles would cut pixels
        (64, 2, 96, 3, "render_unspilled"),
    ],
)
def test_choice_of_kernel_on_an_h200(monkeypatch, n_envs, n_agents, res, subsample, kernel):
    monkeypatch.setattr(rendering, "n_resident_threads", lambda device: 132 * 2048)
    scenery = SimpleNamespace(n_envs=n_envs, n_agents=n_agents, device=None)
    assert rendering._kernel(scenery, res, subsample) == kernel


def test_few_of_a_mask_are_rendered_as_few(monkeypatch):
    monkeypatch.setattr(rendering, "n_resident_threads", lambda device: 132 * 2048)
    scenery = SimpleNamespace(n_envs=8448, n_agents=1, device=None)
    assert rendering._kernel(scenery, 256, 4, only=1) == "render_split"
    scenery.n_envs += 1
    assert rendering._kernel(scenery, 256, 4, only=1) == "render_unspilled"


@pytest.mark.cuda
def test_cpu_and_gpu_agree_on_angles_that_no_int_holds():
    angles = torch.tensor([2.0**31, 2.0**38, -(2.0**38), 1e30, -1e30, math.inf, math.nan])
    lines = []
    for device in ("cpu", "cuda"):
        c = cuda.Core(scene.scenery([toys.box(4)], 1, n_envs=len(angles), device=device))
        c.agents.angles[:] = angles[:, None].to(device)
        engine.update_agent_geometry(c.scenery, c.agents)
        lines.append(c.scenery.agent_lines.cpu())
    assert not any(differing(*([each] for each in lines)))


@pytest.mark.cuda
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_gpus_agree_on_every_bit():
    here, there = trajectory("cuda:0", n_agents=2, res=64), trajectory("cuda:1", n_agents=2, res=64)
    assert torch.cuda.current_device() == 0 and not any(differing(here, there))


@pytest.mark.parametrize("settings", [SETTINGS[n] for n in (1, 2, 3, 8)], ids=str)
def test_number_of_threads_changes_no_bit(settings):
    runs = []
    try:
        for n in (1, 2, 4):
            engine.set_threads(n)
            runs.append(trajectory("cpu", **settings))
    finally:
        engine.set_threads(None)
    assert not any(differing(runs[0], runs[1])) and not any(differing(runs[0], runs[2]))
