"""The searcher that explores by frontiers."""

import numpy as np
import pytest
import torch

pytest.importorskip("scipy")
import searcher

from megastep import engine, geometries
from megastep.envs.deathmatch import Deathmatch


def rounds(plans):
    env = Deathmatch(len(plans), plans, n_agents=2, limit=10**4, damage=0.0, device="cpu")
    return env, [searcher.Home(np.asarray(plan["walls"], float)) for plan in plans]


def test_an_agent_reaches_four_metres_per_second():
    env, _ = rounds(geometries.sample("box", 1, width=40.0))
    env.reset()
    env.core.agents.positions[0] = torch.tensor([[5.0, 20.0], [35.0, 35.0]])
    env.core.agents.angles[:] = 0.0
    for _ in range(60):
        env.step(dict(actions=torch.tensor([[3], [5]])))
    # 0.5 m/s per action and an eighth lost: 4 m/s, and 18 deg/s: 144 deg/s
    assert float(env.core.agents.velocity[0, 0].norm()) == pytest.approx(4.0, abs=0.01)
    assert float(env.core.agents.angvelocity[0, 1]) == pytest.approx(144.0, abs=0.2)
    # 0.1 s of 4 m/s each, less 2.8 m to reach that speed
    expected = 5 + 0.4 * 60 - 0.4 * 7
    assert float(env.core.agents.positions[0, 0, 0]) == pytest.approx(expected, abs=0.01)


def test_each_action_is_predicted_as_the_environment_takes_it():
    env, _ = rounds(geometries.sample("box", 7, width=40.0))
    env.reset()
    agents = env.core.agents
    agents.positions[:] = torch.tensor([[20.0, 20.0], [30.0, 30.0]])
    agents.velocity[:] = torch.tensor([1.0, -0.5])
    agents.angvelocity[:] = 30.0
    angle, velocity, spin = (
        getattr(agents, name)[:, 0].numpy().astype(float)
        for name in ("angles", "velocity", "angvelocity")
    )
    velocities, _ = searcher.options(angle, velocity, spin)
    actions = torch.stack([torch.arange(7), torch.zeros(7, dtype=torch.int64)], 1)
    env.step(dict(actions=actions.reshape(-1, 1)))
    np.testing.assert_allclose(
        velocities[np.arange(7), np.arange(7)], agents.velocity[:, 0].numpy(), atol=1e-4
    )


def test_floor_is_seen_exactly_where_no_wall_is_in_the_way():
    """Against a test of segments that shares nothing with the renderer."""
    env, homes = rounds(geometries.sample("homes", 3, "test"))
    env.reset()
    search, agents = searcher.Search(env, homes), env.core.agents
    depth = engine.observe(env.core.scenery, agents, 4, rgb=False).depth.float().numpy()[:, 0]
    for e, plan in enumerate(env.layout.tolist()):
        one, here = search.searchers[e], agents.positions[e, 0].numpy().astype(float)
        angle = float(agents.angles[e, 0])
        one.look(here, angle, depth[e].ravel(), search.slope, 10.0)
        off = homes[plan].centres[one.visible] - here
        bearing = (np.rad2deg(np.arctan2(off[:, 1], off[:, 0])) - angle + 180) % 360 - 180
        away = np.hypot(*off.T)
        walls = np.asarray(geometries.sample("homes", 3, "test")[plan]["walls"], float)
        hidden = crosses(here, off, walls) | (away > 10) | (np.abs(bearing) > 35)
        clear = (away > 0.3) & (np.abs(np.abs(bearing) - 35) > 1)
        seen = one.remembered[one.visible]
        assert seen[clear].any() and (seen == ~hidden)[clear].mean() > 0.98


def crosses(here, off, walls):
    """Returns which of the lines from a point by offsets (K, 2) cross any wall."""
    along, start = walls[:, 1] - walls[:, 0], walls[:, 0] - here
    cross = off[:, :1] * along[:, 1] - off[:, 1:] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / cross
        u = (start[:, 0] * off[:, 1:] - start[:, 1] * off[:, :1]) / cross
    return ((t > 0) & (t < 1) & (u >= 0) & (u <= 1)).any(1)


def test_a_searcher_sees_all_of_a_room_with_a_pillar():
    env, homes = rounds(geometries.sample("column", 2))
    found = searcher.play(env, homes, 250, opponent="still", lasting=250)
    assert (found["met"] < 250).all()
    assert (found["seen"][:, searcher.STEPS.index(250)] > 0.95).all()


def test_a_walker_who_knows_where_the_other_is_meets_it():
    env, homes = rounds(geometries.sample("homes", 4, "test"))
    found = searcher.play(env, homes, 400, opponent="still", knows_all=True)
    assert (found["saw"] < 400).all() and (found["metres"] < 40).all()
    assert (found["met"] <= found["saw"]).all() and (found["saw"] <= found["near"]).all()


def test_without_inertia_it_walks_at_the_speed_given():
    env, homes = rounds(geometries.sample("homes", 1, "test"))
    env.reset()
    search = searcher.Search(env, homes, knows_all=True)
    start = env.core.agents.positions[0, 0].numpy().astype(float)
    ahead = start + np.array([[0, 0], [0.08, 0], [0.16, 0], [0.4, 0], [0.48, 0]])
    search.searchers[0].path = np.concatenate([ahead, ahead[-1:]])
    search.glide(np.ones(1, bool), 3.0)
    moved = env.core.agents.positions[0, 0].numpy() - start
    assert moved == pytest.approx([0.3, 0.0], abs=1e-3)


@pytest.mark.parametrize("case", searcher.CASES)
def test_every_case_has_a_row(case, monkeypatch):
    monkeypatch.setattr(searcher, "STEPS", [2, 4, 6, 8])
    monkeypatch.setattr(searcher, "LIMIT", 4)
    settings = searcher.CASES[case]
    small = {k: 8 if k == "n_steps" else 4 if k == "lasting" else v for k, v in settings.items()}
    monkeypatch.setitem(searcher.CASES, case, small)
    found = searcher.results(("generated", case, 1, 1))
    cells = searcher.row("generated", case, found).strip("|").split("|")
    assert len(cells) == 11 and [cell.strip() for cell in cells[:2]] == ["generated", case]
    assert found["metres"].shape == (1,) and found["metres"][0] <= 8 * searcher.TOP
