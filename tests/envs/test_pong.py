"""Pong: against its twins on every bit, and its rules by hand."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from megastep import arrdict, envs
from megastep.agents.cli import evaluate, record, train
from megastep.engine import EngineError
from tests.helpers.pong_twins import PythonPong

N, STEPS = 40, 500
HALF = 2**-10  # of numbers up to 2 that are rounded to fp16
SETTINGS = {
    "points": dict(),
    "games, slow tracker": dict(points=3, tracker_speed=0.125, limit=60),
    "self-play": dict(self_play=True),
    "self-play, games": dict(self_play=True, points=2, limit=40),
}


def actions_of(n_lanes, steps=STEPS):
    """(T, B, 1): actions that are often repeated, so that paddles reach the walls and hit balls."""
    random = torch.Generator().manual_seed(1)
    actions = torch.randint(3, (steps, n_lanes, 1), generator=random)
    repeats = torch.rand((steps, n_lanes, 1), generator=random) < 0.8
    for t in range(1, steps):
        actions[t] = torch.where(repeats[t], actions[t - 1], actions[t])
    return actions


def worlds_of(device, seed=5, **settings):
    """The worlds of a reset and of STEPS steps, stacked: leaves (T + 1, B, ...)."""
    env = envs.Pong(N, seed=seed, device=device, **settings)
    worlds = [env.reset().clone()]
    for actions in actions_of(N * env.n_agents):
        worlds.append(env.step(arrdict.arrdict(actions=actions.to(device))).clone())
    return arrdict.stack(worlds)


def twins_settings(settings):
    tracker = round(256 * settings.get("tracker_speed", 0.5))
    points, limit = settings.get("points", 1), settings.get("limit", 1000)
    both = dict(seed=5, points=points, limit=points * limit, tracker=tracker)
    return both | dict(self_play=settings.get("self_play", False))


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_matches_python_twin_on_every_bit(settings):
    worlds = worlds_of("cpu", pixels=True, **settings)
    sides = 2 if settings.get("self_play") else 1
    actions = actions_of(N * sides).view(STEPS, N, sides).tolist()
    worlds = {key: worlds[key].unflatten(1, (N, sides)) for key in worlds if key != "metrics"}
    our_features = worlds_of("cpu", **settings).obs.view(STEPS + 1, N, sides, 8).float().numpy()
    for game in (0, N - 1):
        twin = PythonPong(game, **twins_settings(settings))
        for t in range(STEPS + 1):
            expected = twin.reset() if t == 0 else twin.step(actions[t - 1][game])
            for name in ("reset", "terminal", "truncated"):
                assert worlds[name][t, game].tolist() == sides * [expected[name]], (name, t)
            assert worlds["reward"][t, game].tolist() == expected["reward"], t
            features = [twin.features(side) for side in range(sides)]
            assert np.abs(our_features[t, game] - features).max() < HALF
            for side in range(sides):
                assert (
                    bytes(worlds["obs"][t, game, side].flatten().numpy()) == expected["obs"][side]
                )


# ---- The rules, by hand ----


class Court:
    """One environment whose ball and paddles are placed by hand, in cells."""

    FIELDS = dict(x=0, y=1, vx=2, vy=3, last_x=4, last_y=5, left=6, right=7)
    SCORES = slice(8, 10)

    def __init__(self, device="cpu", **settings):
        self.env = envs.Pong(1, device=device, **settings)
        self.env.reset()

    def place(self, **cells):
        for name, value in cells.items():
            self.env.games[self.FIELDS[name]] = round(256 * value)
        return self

    def step(self, *actions):
        actions = torch.tensor(actions or (0,) * self.env.n_agents, device=self.env.device)
        return self.env.step(arrdict.arrdict(actions=actions[:, None]))

    def __getattr__(self, name):
        return int(self.env.games[self.FIELDS[name]]) / 256


def test_game_ends_at_its_points(device):
    court, shares = Court(device, points=2, self_play=True), []
    for x, vx, rewards, ends in [
        (1.5, -1, [-1, 1], False),
        (38.5, 1, [1, -1], False),
        (1.5, -1, [-1, 1], True),
    ]:
        world = court.place(x=x, y=20, vx=vx, vy=0, left=1, right=1).step()
        assert world.reward.tolist() == rewards and world.terminal.tolist() == [ends] * 2
        shares.append(world.metrics.points_won.tolist())
        if not ends:
            assert court.x in (20, 20 - 1 / 256), "the next ball is served"
            assert (court.left, court.right) == (1, 1), "and the paddles stay where they are"
    assert shares[:2] == [[0, 0], [0, 0]] and shares[2] == pytest.approx([1 / 3, 2 / 3])
    world = court.step(1, 2)
    assert world.reset.all() and not world.reward.any()
    assert court.left == court.right == 13 and not court.env.games[Court.SCORES].any()


def test_serves_are_random(device):
    env = envs.Pong(4096, device=device)
    env.reset()
    x, y, vx, vy = env.games[:4].cpu()
    to_right = vx > 0
    assert set(vx.tolist()) == {-256, 256} and 0.45 < to_right.float().mean() < 0.55
    assert set(x[to_right].tolist()) == {5119} and set(x[~to_right].tolist()) == {5120}
    assert y.min() < 64 and y.max() >= 7680 - 64 and vy.min() == -128 and vy.max() == 128
    assert not torch.equal(y[:2048], y[2048:])


@pytest.mark.parametrize("pixels", [False, True], ids=["features", "pixels"])
def test_both_sides_observe_the_court_mirrored(pixels, device):
    """Mirroring the court and swapping the paddles swaps the observations of the two lanes."""
    place = dict(x=3.5, y=12.25, vx=-1, vy=0.5, last_x=4.5, last_y=11.75, left=9, right=20.5)
    mirrored = dict(
        place, x=40 - 1 / 256 - 3.5, last_x=40 - 1 / 256 - 4.5, vx=1, left=20.5, right=9
    )
    seen = [
        Court(device, self_play=True, pixels=pixels).place(**court).step().obs.cpu()
        for court in (place, mirrored)
    ]
    assert torch.equal(seen[0][0], seen[1][1]) and torch.equal(seen[0][1], seen[1][0])
    assert not torch.equal(seen[0][0], seen[0][1])


# ---- Display ----


# ---- Errors ----


@pytest.mark.parametrize("action", [-1, 3, 2**40])
def test_bad_action_is_named(action, device):
    env = envs.Pong(4, device=device)
    env.reset()
    actions = torch.zeros((4, 1), dtype=torch.int64, device=device)
    actions[2] = action
    with pytest.raises(EngineError, match="environment 2 was given an action"):
        env.step(arrdict.arrdict(actions=actions))
        env.check()
    env.check()


# ---- Learning ----


def rows_of(run):
    """The rows of a run's newest evaluation."""
    newest = max(Path(run).glob("evaluations/*.json"), key=lambda path: path.stat().st_mtime_ns)
    return json.loads(newest.read_text())["rows"]


def test_evaluate_self_play_against_itself_and_the_tracker(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ["env.n_envs=8", "learner.n_minibatches=2", "agent.width=8", "device=cpu"]
    words = ["env=pong", "env.self_play=true", "env.limit=30", "samples=1000", "folder=run", *small]
    assert train.main(words) == 0
    table = ["run=run", "episodes=16", "device=cpu", "baseline=false"]
    assert evaluate.main(table) == 0
    assert [row.get("role") for row in rows_of("run")] == [None, "left", "right"]
    assert evaluate.main([*table, "env=pong", "env.limit=30"]) == 0
    (row,) = rows_of("run")
    assert row["lanes"] == 16 and row["homes"] is None and 0 <= row["metrics"]["points_won"]["mean"]
    assert len(list(Path("run").glob("evaluations/*.json"))) == 2
    assert record.main(["run=run", "steps=3", "device=cpu"]) == 0 and Path("run/video.mp4").exists()


@pytest.mark.nightly
def test_recipe_beats_the_tracker(tmp_path, monkeypatch):
    """Random actions win 0.15 of the points, following the ball 0.7, the whole recipe 0.98."""
    monkeypatch.chdir(tmp_path)
    words = ["experiment=pong", "samples=3e6", "seconds=null", "device=cpu", "folder=run"]
    words += ["finish.record=false"]
    assert train.main(words) == 0
    trained, random = rows_of("run")
    assert trained["metrics"]["points_won"]["lower"] > 0.8
    assert random["metrics"]["points_won"]["upper"] < 0.2
