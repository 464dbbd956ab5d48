"""The code of seed 003, "A Minimal Env", run as its users type it, on the CPU, and what it prints
and promises.

Names that moved, all through: `rebar` and `megastep.demo` are `megastep`, `megastep.demo.heads` is
`agents.heads`. Repairs, each as small as could be:

| as typed | why it cannot run | here |
| --- | --- | --- |
| positions printed for two environments, on `cuda:0` | there are 128; no GPU | the first two |
| `n_envs` is not defined; `Minimal()` without it | undefined | `n_envs = 2`; `n_envs=2` by default
|
| `while True:` | never ends | three rounds |
| `return world`, `agent(world)` in the skeleton | undefined | a world of the screen; no movement |
| `self.core.render(...)` | Core has no such method | `cuda.render(...)` |
| `reset = self.core.agent_full(True)` and no more | the call is announced but not typed |
`self.spawner(reset)` |
| "calling the movement module" and no more | the call is not typed | `self.movement(decision)` |
| `self.reset()` prints `obs Tensor((128, 1, 1, 1, 64)...` | three channels; the first line is
missing | both |
| `arrdict(obs=...)` in `step`, which does not move | `arrdict` is the module; announced but not
typed | both |
| `Agent(nn.Module)` | `super().__init__()` is missing | added |
| `Agent(env).cuda()` | no GPU | without `.cuda()` |
| `state`: `arrdict.arrdict(` | the bracket is never closed | the states of core and camera |
| `plot_state` makes a grid and returns nothing | must return a figure | plan and strip in the grid
|
| the loop under `ParallelEncoder` | the state is announced but not fed | `encoder(env.state())` |
"""

import numpy as np
import pytest
import torch
from matplotlib import pyplot as plt
from torch import nn

from agents import heads
from megastep import arrdict, core, cuda, dotdict, modules, plotting, recording, scene, toys


@pytest.fixture(autouse=True)
def _on_the_cpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.manual_seed(1)
    with plt.rc_context({"figure.dpi": 50}):  # draws in half the time
        yield
    torch.set_num_threads(threads)
    plt.close("all")


@pytest.fixture
def boxes():
    """The tutorial's opening: a geometry, 128 sceneries of it, and a core with its agents at (3,
    3).
    """
    geometries = 128 * [toys.box()]
    scenery = scene.scenery(geometries, n_agents=1)
    c = core.Core(scenery)
    c.agents.positions[:] = torch.as_tensor([3.0, 3.0], device=c.device)
    return c


def agent_centre(c, e):
    """(x, y) of the middle of the agent's model in the scenery of environment e."""
    return c.scenery.lines[e][: len(c.scenery.model)].mean((0, 1)).tolist()


def test_scenery_is_displayed():
    geometries = 128 * [toys.box()]
    scenery = scene.scenery(geometries, n_agents=1)

    ax = scene.display(scenery, e=126)
    segments = np.concatenate(
        [
            np.reshape(lines.get_segments(), (-1, 2))
            for lines in ax.collections
            if hasattr(lines, "get_segments")
        ]
    )
    assert segments.max(0).tolist() == [6, 6]  # the walls
    assert np.abs(segments).sum(1).min() < 0.1  # a model of an agent at the origin

    colours = [
        scenery.textures[int(scenery.lines.starts[e]) + len(scenery.model)] for e in (125, 126)
    ]
    assert not torch.equal(*colours)  # each with a randomly-chosen colour scheme


def test_agents_start_at_the_origin():
    c = core.Core(scene.scenery(128 * [toys.box()], n_agents=1))
    assert c.agents.positions.shape == (128, 1, 2)
    assert str(c.agents.positions[:2]) == ("tensor([[[0., 0.]],\n\n        [[0., 0.]]])")


def test_agents_see(boxes):
    c = boxes
    assert np.allclose(agent_centre(c, 0), [0, 0], atol=1e-6)

    r = cuda.render(c.scenery, c.agents)

    im = (
        r.screen[[0]]  # get the screen for agents in env #0
        .cpu()
        .numpy()
    )  # move them to cpu & numpy
    axes = plotting.plot_images({"rgb": im}, transpose=True, aspect=0.1)

    assert im.shape == (1, 1, 64, 3) and im.max() > 0
    shown = axes[0, 0].images[0].get_array()
    assert shown.shape == (1, 64, 3) and np.allclose(
        shown, core.gamma_encode(np.clip(im[0], 0, 1)), atol=1e-6
    )
    beside = (
        np.tan(np.radians(c.fov / 2)) / 64
    )  # the two middle rays pass either side of straight ahead
    assert r.distances[0, 0, 31:33].tolist() == pytest.approx(
        2 * [3 * np.hypot(1, beside)], abs=1e-4
    )
    assert np.allclose(
        agent_centre(c, 0), [3, 3], atol=1e-3
    )  # the model has moved to where the agent is


def test_agents_stop_at_the_wall(boxes):
    c = boxes
    cuda.render(c.scenery, c.agents)
    c.agents.velocity[:] = torch.as_tensor([1000.0, 0.0], device=c.device)
    p = cuda.physics(c.scenery, c.agents)

    assert (c.agents.positions - torch.tensor([5.8649, 3.0])).abs().max() < 1e-3  # a millimetre
    assert str(c.agents.positions[:2]) == (
        "tensor([[[5.8649, 3.0000]],\n\n        [[5.8649, 3.0000]]])"
    )
    assert (p.progress < 1).all() and (c.agents.velocity == 0).all()

    assert np.allclose(agent_centre(c, 0), [3, 3], atol=1e-3)  # still, until the next render
    cuda.render(c.scenery, c.agents)
    assert np.allclose(agent_centre(c, 0), [5.8649, 3], atol=2e-3)


def test_the_basic_loop():
    n_envs = 2

    g = toys.box()
    scenery = scene.scenery(n_envs * [g], n_agents=1)
    c = cuda.Core(scenery)

    # set agent location
    c.agents.positions[:] = torch.as_tensor([3.0, 3.0], device=c.device)
    r = cuda.render(c.scenery, c.agents)
    # generate an observation and send it to the agent
    for _ in range(3):
        # process decisions from the agent
        c.agents.velocity[..., 1] = 1.0
        p = cuda.physics(c.scenery, c.agents)
        # post-collision alterations
        r = cuda.render(c.scenery, c.agents)
        # generate an observation and send it to the agent

    assert (p.progress == 1).all() and r.screen.shape == (2, 1, 64, 3)
    assert torch.allclose(
        c.agents.positions, torch.tensor([3.0, 3.3])
    )  # three steps of 0.1 s at 1 m/s


def test_the_skeleton():
    class Minimal:
        def __init__(self, n_envs=2):
            geometries = n_envs * [toys.box()]
            scenery = scene.scenery(geometries, n_agents=1)
            self.c = cuda.Core(scenery)

        def reset(self):
            # set agent location
            r = cuda.render(self.c.scenery, self.c.agents)
            # generate an observation and send it to the agent
            world = arrdict.arrdict(obs=r.screen)
            return world

        def step(self, decision):
            # process decisions from the agent
            cuda.physics(self.c.scenery, self.c.agents)
            # post-collision alterations
            r = cuda.render(self.c.scenery, self.c.agents)
            # generate an observation and send it to the agent
            world = arrdict.arrdict(obs=r.screen)
            return world

    def agent(world):
        return arrdict.arrdict(actions=torch.zeros(len(world.obs), 1, dtype=torch.long))

    env = Minimal()
    first = world = env.reset()
    for _ in range(3):
        decision = agent(world)
        world = env.step(decision)
    assert torch.equal(world.obs, first.obs) and world.obs.max() > 0  # nothing moves yet


def test_the_finished_class_is_part_of_the_library():
    names = {}
    exec("from megastep.envs.minimal import *", names)
    self = names["Minimal"]()
    world = self.reset()
    assert self.core.n_envs == 128 and world.obs.shape == (128, 1, 3, 1, 64)


def test_spawning():
    geometries = 128 * [toys.box()]
    self = dotdict.dotdict(core=core.Core(scene.scenery(geometries, n_agents=1)))

    self["spawner"] = modules.RandomSpawns(geometries, self.core)
    reset = self.core.agent_full(True)
    self.spawner(reset)

    positions = self.core.agents.positions
    assert ((positions > 1 + 0.1) & (positions < 6 - 0.1)).all()  # in the room, clear of its walls
    assert len(positions.unique(dim=0)) > 64  # each somewhere of its own
    assert (
        self.core.env_full(1.0).shape == (128,)
        and reset.shape == (128, 1)
        and reset.dtype == torch.bool
    )

    cuda.render(self.core.scenery, self.core.agents)
    assert agent_centre(self.core, 5) == pytest.approx(positions[5, 0].tolist(), abs=1e-3)


def test_observations(boxes):
    self = dotdict.dotdict(core=boxes)
    self["rgb"] = modules.RGB(self.core)
    obs = self.rgb()
    assert obs.shape == (128, 1, 3, 1, 64) and self.rgb.space.shape == (1, 3, 1, 64)
    screen = cuda.render(self.core.scenery, self.core.agents).screen
    assert torch.equal(obs[:, :, :, 0].transpose(-1, -2), screen)

    def reset(self):
        return arrdict.arrdict(obs=self.rgb())

    assert repr(reset(self)) == "arrdict:\nobs    Tensor((128, 1, 3, 1, 64), torch.float32)"


def test_movement(boxes):
    self = dotdict.dotdict(core=boxes)
    self["movement"] = modules.SimpleMovement(self.core)
    decision = arrdict.arrdict(actions=self.core.agent_full(3))
    self.movement(decision)
    # Forward is along the agent's +x; 10 m/s for 0.1 s.
    assert torch.allclose(self.core.agents.positions, torch.tensor([4.0, 3.0]), atol=1e-3)


class TutorialMinimal:
    """The environment as the tutorial assembles it."""

    def __init__(self, n_envs=2):
        geometries = n_envs * [toys.box()]
        scenery = scene.scenery(geometries, n_agents=1)
        self.core = core.Core(scenery)
        self.spawner = modules.RandomSpawns(geometries, self.core)
        self.rgb = modules.RGB(self.core)
        self.movement = modules.SimpleMovement(self.core)
        self.obs_space = self.rgb.space
        self.action_space = self.movement.space

    def reset(self):
        self.spawner(self.core.agent_full(True))
        return arrdict.arrdict(obs=self.rgb())

    def step(self, decision):
        self.movement(decision)
        return arrdict.arrdict(obs=self.rgb())

    def state(self, e=0):
        return arrdict.arrdict(core=self.core.state(e), rgb=self.rgb()[e])

    def plot_state(self, state):
        fig = plt.figure()
        gs = plt.GridSpec(3, 1, fig)
        core.Core.plot_state(state.core, fig.add_subplot(gs[:2]))
        plotting.plot_images({"rgb": state.rgb}, aspect=0.1, axes=[fig.add_subplot(gs[2])])
        return fig


class Agent(nn.Module):
    def __init__(self, env, width=32):
        super().__init__()
        self.intake = heads.intake(env.obs_space, width)
        self.output = heads.output(env.action_space, width)
        self.policy = nn.Sequential(self.intake, self.output)

    def forward(self, world):
        logits = self.policy(world.obs)
        actions = self.output.sample(logits)
        return arrdict.arrdict(logits=logits, actions=actions)


def test_heads():
    env, width = TutorialMinimal(), 32
    world = env.reset()
    intake = heads.intake(env.obs_space, width)
    output = heads.output(env.action_space, width)

    policy = nn.Sequential(intake, output)

    logits = policy(world.obs)
    actions = output.sample(logits)
    decision = arrdict.arrdict(logits=logits, actions=actions)

    assert decision.logits.shape == (2, 1, 7) and torch.allclose(
        logits.exp().sum(-1), torch.ones(2, 1)
    )
    assert decision.actions.shape == (2, 1) and ((actions >= 0) & (actions < 7)).all()


def test_trying_it_out():
    env = TutorialMinimal()
    agent = Agent(env)

    world = env.reset()
    decision = agent(world)

    before = env.core.agents.positions.clone()
    world = env.step(decision)

    assert world.obs.shape == (2, 1, 3, 1, 64) and world.obs.isfinite().all()
    assert ((env.core.agents.positions - before).norm(dim=-1) <= 1 + 1e-4).all()


def test_recording(tmp_path):
    env = TutorialMinimal()
    agent = Agent(env)

    with pytest.warns(UserWarning, match="plot_state is a method of a TutorialMinimal object"):
        encoder = recording.ParallelEncoder(env.plot_state)
    with encoder:
        world = env.reset()
        for _ in range(64):
            decision = agent(world)
            world = env.step(decision)
            encoder(env.state())

    import av

    with av.open(str(encoder.save(tmp_path / "minimal.mp4"))) as container:
        assert container.streams.video[0].frames == 64
