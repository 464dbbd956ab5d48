"""Errors that only the device can see: indices out of range and non-finite values. Kernels never
read out of bounds; they set a flag, and ``engine.check`` names the environment.
"""

import math

import pytest
import torch

from megastep import core, engine, envs, scene, toys
from megastep.geometries import sample

LAST = 3  # of four environments, so that the buffers end with it


def boxes(device, n_agents=1):
    """Four environments with two layouts, whose agents stand apart in the middle of their box."""
    geometries = [toys.box(4), toys.box(6)]
    c = core.Core(scene.scenery(geometries, n_agents, n_envs=LAST + 1, device=device), res=32)
    c.agents.positions[:] = 2 + torch.arange(n_agents, device=device)[:, None] / 2
    c.agents.velocity.fill_(1.0)
    return c


def physics(c):
    return engine.physics(c.scenery, c.agents).progress


def render(c):
    return engine.render(c.scenery, c.agents).distances


def observe(c):
    return engine.observe(c.scenery, c.agents, imu=True).depth


def geometry(c):
    engine.update_agent_geometry(c.scenery, c.agents)
    return c.scenery.agent_light


def spawn(c):
    n, a, device = c.scenery.n_envs, c.n_agents, c.scenery.device
    mask = torch.ones((n, a), dtype=torch.bool, device=device)
    points = torch.full((2, 4, 2), 2.5, device=device)
    counts = torch.zeros((n, a), dtype=torch.int32, device=device)
    engine.spawn(c.scenery, c.agents, mask, points, counts, seed=1)
    return c.agents.positions


@pytest.mark.parametrize("layout", [2, -1, 2**31 - 1, -(2**31)])
@pytest.mark.parametrize("n_agents", [1, 3])
@pytest.mark.parametrize("operation", [physics, render, observe, geometry, spawn])
def test_bad_layout_is_named_and_other_environments_continue(operation, n_agents, layout, device):
    expected = operation(boxes(device, n_agents))
    c = boxes(device, n_agents)
    c.scenery.layout[LAST] = layout
    result = expected  # for the CPU, which raises before it returns anything
    with pytest.raises(engine.EngineError, match=f"^Environment {LAST} .* layout"):
        result = operation(c)
        engine.check(c.agents)
    assert torch.equal(result[:LAST], expected[:LAST])
    c.scenery.layout[LAST] = 1
    operation(c)
    engine.check(c.agents)


@pytest.mark.parametrize("operation", [physics, render, observe, geometry, spawn])
def test_on_a_cpu_an_operation_raises_before_it_returns(operation):
    c = boxes("cpu", 2)
    c.scenery.layout[LAST] = 2
    with pytest.raises(engine.EngineError, match=f"^Environment {LAST} .* layout"):
        operation(c)


@pytest.mark.parametrize("operation", [physics, render, observe])
@pytest.mark.parametrize("field", ["positions", "angles"])
def test_nonfinite_pose_is_named_by_every_operation(operation, field, device):
    expected = operation(boxes(device, 2))
    c = boxes(device, 2)
    getattr(c.agents, field)[LAST, 1] = math.nan
    result = expected
    with pytest.raises(engine.EngineError, match=f"environment {LAST} .* non-finite"):
        result = operation(c)
        engine.check(c.agents)
    assert torch.equal(result[:LAST], expected[:LAST])


@pytest.mark.parametrize(
    "make, what",
    [
        *((envs.Explorer, "layout"), (envs.PointGoal, "layout")),
        *((envs.PointGoal, "position"), (envs.Memory, "position"), (envs.Keys, "position")),
    ],
)
def test_rules_of_games_name_the_environment(make, what, device):
    homes = sample("homes", 2)
    env = make(LAST + 1, homes, device=device, res=8, subsample=1, privileged=True)
    env.reset()
    env.check()
    if what == "layout":
        env.layout[LAST] = 2
    else:
        env.core.agents.positions[LAST] = math.nan
    arguments = dict(Explorer=[torch.zeros_like(env.ages)], PointGoal=[None])
    with pytest.raises(engine.EngineError, match=f"(?i)environment {LAST} "):
        env._judge(*arguments.get(make.__name__, []))
        env.check()


@pytest.mark.parametrize("action", [7, -1, 2**40])
def test_bad_action_is_named(action, device):
    c = boxes(device, 2)
    moves = torch.zeros((7, 3), device=device)
    actions = torch.zeros((LAST + 1, 2), dtype=torch.int64, device=device)
    actions[2, 1] = action
    with pytest.raises(engine.EngineError, match="environment 2 .* action"):
        engine.physics(c.scenery, c.agents, actions, moves)
        engine.check(c.agents)


def test_continuous_action_that_is_nan_is_named_and_other_environments_continue(device):
    moves, after = torch.ones((3, 3), device=device), []
    for number in (0.0, math.nan):
        c = boxes(device, 2)
        actions = torch.full((LAST + 1, 2, 3), 0.5, device=device)
        actions[LAST, 1, 2] = number
        if number == 0:
            engine.physics(c.scenery, c.agents, actions, moves)
            engine.check(c.agents)
        else:
            with pytest.raises(engine.EngineError, match=f"environment {LAST} .* NaN"):
                engine.physics(c.scenery, c.agents, actions, moves)
                engine.check(c.agents)
        after.append(c.agents.velocity.clone())
    assert torch.equal(*after), "a NaN adds nothing"


@pytest.mark.parametrize(
    "field, axes",
    [("positions", 0), ("positions", 1), ("angles", ...), ("velocity", ...), ("angvelocity", ...)],
)
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_nonfinite_state_is_named(value, field, axes, device):
    c = boxes(device, 2)
    getattr(c.agents, field)[1, 1, axes] = value
    with pytest.raises(engine.EngineError, match="environment 1 .* non-finite"):
        engine.physics(c.scenery, c.agents)
        engine.check(c.agents)
    engine.check(c.agents)
