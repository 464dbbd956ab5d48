"""The engine against golden outputs of the original, against a brute-force twin in random
environments, and `observe` against the operations that it fuses. Outputs are poisoned first.
"""

import math

import numpy as np
import pytest
import torch

from megastep import cuda, engine
from megastep.modules import IMU, RGB, Depth
from tests.helpers import compare, random_scenery
from tests.helpers.outputs import Poison
from tests.helpers.texels import seen_of


def core_of(envs, device, **settings):
    """A Core with these environments."""
    core = cuda.Core(envs.scenery(device), **settings)
    for name in ("positions", "angles", "velocity", "angvelocity"):
        getattr(core.agents, name).copy_(getattr(envs, name))
    return core


@pytest.fixture
def poison(monkeypatch):
    poison = Poison(torch.empty)
    monkeypatch.setattr(torch, "empty", poison.allocate)
    return poison


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
    """The fields of a render after a bake, with all outputs of both poisoned first."""
    baked = core.scenery.layouts.baked.vals
    baked.fill_(math.nan)
    cuda.bake(core.scenery)
    assert not baked.isnan().any(), "bake did not write all light"
    poison.scenery(core.scenery)
    r = cuda.render(core.scenery, core.agents)._asdict()
    poison.check(**r, lines=core.scenery.agent_lines, light=core.scenery.agent_light)
    return r


# ---- Golden outputs of the original, with the tolerances of their README ----


@pytest.mark.parametrize("case", random_scenery.CASES)
def test_matches_the_original(case, device, poison):
    envs, settings, _ = random_scenery.golden(case)
    core = core_of(envs, device, **settings)
    r = baked_and_rendered(core, poison)
    compare.check_golden(
        case, dict(r, lines=core.scenery.lines.vals, baked=core.scenery.baked.vals)
    )
    physics = cuda.physics(core.scenery, core.agents)
    poison.check(**physics._asdict())
    compare.check_golden(case, state_of(core, physics))


# ---- The twin: random environments with degenerate cases ----

VIEWS = [
    dict(res=1, fov=130.0),
    dict(res=64, fov=20.0),
    dict(res=63, fov=130.0),
    dict(res=256, fov=170.0),
    dict(res=1024, fov=90.0),
    dict(res=64, fov=70.0, cameras=(0.0, 120.0, 240.0)),
]


#: Numbers of environments and agents, and a seed. The last are thorough.
ROUNDS = [
    *((2, 1, 0), (2, 4, 1)),
    *(pytest.param(4, n, s, marks=pytest.mark.nightly) for n in (1, 4) for s in (0, 1)),
]


@pytest.mark.parametrize("n_envs, n_agents, seed", ROUNDS)
@pytest.mark.parametrize("view", VIEWS, ids=str)
@pytest.mark.parametrize("degenerate", [(), random_scenery.EVERYTHING], ids=["plain", "degenerate"])
def test_render_matches_twin(view, n_envs, n_agents, seed, degenerate, device, poison):
    envs = random_scenery.random_environments(
        seed,
        n_envs,
        n_agents,
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
def test_physics_matches_twin(name, n_agents, device, poison):
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


def test_unwritten_outputs_are_named(poison, monkeypatch):
    """The checks above fail for kernels that write nothing."""
    core = core_of(random_scenery.random_environments(0), "cpu")
    monkeypatch.setattr("megastep.engine.launch_params.launch", lambda *args, **kwargs: None)
    outputs = [
        cuda.render(core.scenery, core.agents),
        cuda.physics(core.scenery, core.agents),
        engine.observe(
            core.scenery,
            core.agents,
            imu=True,
            centre_line=True,
            agent_ray=True,
            seen=seen_of(core),
        ),
    ]
    for output in outputs:
        for name, tensor in output._asdict().items():
            with pytest.raises(AssertionError, match=rf"wrote: {name}: {tensor.numel()}\b"):
                poison.check(**{name: tensor})


# ---- observe against the operations that it fuses ----


@pytest.mark.parametrize("n_agents", [1, 3])
@pytest.mark.parametrize("subsample", [1, 4])
def test_observe_matches_render_and_sensors(n_agents, subsample, device, poison):
    envs = random_scenery.random_environments(
        5, n_envs=8, n_agents=n_agents, degenerate=random_scenery.EVERYTHING, res=64
    )
    core = core_of(envs, device, res=64)
    cuda.bake(core.scenery)
    seen = seen_of(core)
    o = engine.observe(core.scenery, core.agents, subsample, imu=True, centre_line=True, seen=seen)
    poison.check(**o._asdict())
    r = cuda.render(core.scenery, core.agents)
    # half a unit in fp16's last place, and the rounding of the mean
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
    assert not again.newly_seen.any(), "a texel is newly seen once"
    cleared = engine.observe(
        core.scenery, core.agents, subsample, seen=seen, clear_mask=core.agent_full(True)
    )
    assert torch.equal(cleared.newly_seen, o.newly_seen), "clear_mask clears"


def bits_seen(core, r):
    """The expected `seen` after one view, from a full render, agent by agent."""
    scenery, layouts = core.scenery, core.scenery.layouts
    out = torch.zeros((core.n_envs, core.n_agents, -(-layouts.max_texels // 32)), dtype=torch.int64)
    n_agent_lines, starts = scenery.agent_lines.shape[1], layouts.texel_starts.tolist()
    for e in range(core.n_envs):
        first = int(layouts.wall_starts[int(scenery.layout[e])])
        for a in range(core.n_agents):
            for line, location in zip(r.indices[e, a].tolist(), r.locations[e, a].tolist()):
                if line >= n_agent_lines:
                    wall = first + line - n_agent_lines
                    width = starts[wall + 1] - starts[wall]
                    texel = (
                        starts[wall]
                        - starts[first]
                        + min(int(np.float32(location) * np.float32(width)), width - 1)
                    )
                    out[e, a, texel // 32] |= 1 << (texel % 32)
    return torch.where(out >= 1 << 31, out - (1 << 32), out).int().to(core.device)
