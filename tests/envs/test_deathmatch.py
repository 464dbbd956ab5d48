"""Deathmatch: against its twin on every bit, and its rules by hand."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from megastep import arrdict, contract, core, engine, envs, modules, scene, toys
from megastep.agents.cli import evaluate, record, train
from megastep.engine.rendering import Observation
from megastep.geometries import sample
from tests.helpers.deathmatch_twins import hits_of, privileged, respawned, sound

RADIUS = engine.AGENT_RADIUS
METRICS = "kills", "deaths", "damage", "accuracy"
RULES = {
    "hits less wounds": dict(damage=0.1),
    "everything": dict(
        damage=0.31,
        recovery=0.01,
        drain=0.003,
        health_per_hit=0.05,
        limit=7,
        hit_reward=0.3,
        wound_cost=0.7,
        kill_reward=5.0,
        death_cost=2.5,
        aim_reward=0.1,
    ),
    "deadly": dict(damage=1.0, kill_reward=1.0, hit_reward=0.0, wound_cost=0.0),
}
ALL = dict(
    damage=0.1,
    recovery=0.0,
    drain=0.0,
    health_per_hit=0.0,
    limit=1000,
    hit_reward=1.0,
    wound_cost=1.0,
    kill_reward=0.0,
    death_cost=0.0,
    aim_reward=0.0,
)


# ---- A step's rules against their twin ----


NOTHING = Observation(*len(Observation._fields) * [None])
STATE = "health", "tally", "ages", "ended"


def fight(device, n_envs, n_agents, steps=30, rounds=False, search_reward=0.0, **rules):
    """Yields steps with random views, half of which show an agent: (inputs, outputs, positions,
    angles), with `rounds` as long as an episode.
    """
    random, lanes = np.random.default_rng(n_agents), (n_envs, n_agents)
    env = envs.Deathmatch(
        n_envs, [toys.box()], n_agents=n_agents, device=device, resample=rounds, privileged=True
    )
    rules = ALL | rules
    env.weights.set(**{name: rules[name] for name in env.weights.values})
    env.rules |= {name: rules[name] for name in env.rules.keys() & rules.keys()}
    env.rules["search_reward"] = search_reward
    env.ended.fill_(True)
    state = {name: getattr(env, name) for name in STATE}
    if rounds:
        state["round_ages"] = env.round_ages.fill_(-1)
    for _ in range(steps):
        line = random.integers(-1, 16 * n_agents, lanes).astype(np.int32)
        ray = random.integers(-1, 512, lanes).astype(np.int32)
        positions, angles = random.uniform(-9, 9, (*lanes, 2)), random.uniform(-180, 180, lanes)
        newly_seen = random.integers(0, 99, lanes).astype(np.int32)
        agents = env.core.agents
        agents.positions.copy_(torch.from_numpy(positions))
        agents.angles.copy_(torch.from_numpy(angles))
        view = NOTHING._replace(
            centre_line=torch.from_numpy(line).to(device),
            agent_ray=torch.from_numpy(ray).to(device) if rules["aim_reward"] else None,
            newly_seen=torch.from_numpy(newly_seen).to(device) if search_reward else None,
        )
        inputs = dict(line=line, ray=ray, newly_seen=newly_seen)
        inputs |= dict(**{k: v.cpu().numpy().copy() for k, v in state.items()})
        out = env._judge(view, {})
        outputs = {k: v.cpu().numpy().copy() for k, v in (out | state).items() if v is not None}
        outputs |= dict(zip(METRICS, outputs["metrics"], strict=True))
        yield inputs, outputs, agents.positions.cpu().numpy(), agents.angles.cpu().numpy()


@pytest.mark.parametrize("n_agents", [2, 3, 16])
@pytest.mark.parametrize("rules", RULES.values(), ids=RULES)
def test_step_matches_twin_on_every_bit(rules, n_agents, device):
    dead = 0
    for inputs, outputs, positions, angles in fight(device, 5, n_agents, **rules):
        for e in range(5):
            lanes = slice(e * n_agents, (e + 1) * n_agents)
            state = {
                k: v[..., lanes]
                for k, v in inputs.items()
                if k not in ("line", "ray", "newly_seen")
            }
            expected = hits_of(
                inputs["line"][e], inputs["ray"][e], **state, n_model=8, res=512, rules=ALL | rules
            )
            for name, values in expected.items():
                ours = outputs[name][..., lanes] if name == "tally" else outputs[name][lanes]
                ours = ours.T if name == "tally" else ours.reshape(values.shape)
                assert (ours == values).all(), f"{name}: {ours} is not {values}"
            close = privileged(expected["health"], positions[e], angles[e])
            np.testing.assert_allclose(outputs["privileged"][lanes, 0], close, rtol=0, atol=2e-6)
            dead += int(expected["terminal"].sum())
    assert dead > 5


def test_rounds_and_search_match_pytorch_on_every_bit(device):
    """Against the step without them, and the operations that a round's end and the reward take."""
    steps = fight(device, 5, 3, limit=7, damage=0.31)
    with_rounds = fight(device, 5, 3, limit=7, damage=0.31, search_reward=0.37, rounds=True)
    rounds, n_over = torch.full((5,), -1, dtype=torch.int32), 0
    for (before, plain, *_), (inputs, outputs, *_) in zip(steps, with_rounds, strict=True):
        if not all((inputs[name] == before[name]).all() for name in before):
            break  # the round's end has changed who begins an episode
        step = {name: torch.from_numpy(values) for name, values in plain.items()}
        rounds += 1
        over = (rounds >= 7) & ~step["reset"].view(5, 3).any(1)
        rounds = rounds.masked_fill(over, -1)
        over = over[:, None].expand(5, 3).flatten()
        kills, damage, hits, _ = step["tally"]
        so_far = torch.stack([kills, torch.zeros(15), damage, hits / step["ages"]])
        search = torch.from_numpy(inputs["newly_seen"]).flatten() * 0.37
        expected = dict(
            reward=step["reward"] + search.masked_fill(step["reset"], 0.0),
            metrics=torch.where(over & ~step["ended"], so_far, step["metrics"]),
            truncated=step["truncated"] | (over & ~step["terminal"]),
            ended=step["ended"] | over,
            round_ages=rounds,
        )
        n_over += int(over.sum())
        for name, values in expected.items():
            assert (torch.from_numpy(outputs[name]) == values).all(), name
    assert n_over >= 3


def test_actions_of_ended_lanes_are_nothing(device):
    env = envs.Deathmatch(2, [toys.box()], n_agents=2, device=device)
    env.reset()
    env.ended.copy_(torch.tensor([False, True, True, False]))
    taken = []
    env.movement = lambda decision: taken.extend(decision["actions"].tolist())
    env.step(dict(actions=torch.tensor([[3], [4], [0], [6]], device=device)))
    assert taken == [[3], [0], [0], [6]]
    with pytest.raises(ValueError, match="actions"):
        env.step(dict(actions=torch.zeros((3, 1), dtype=torch.int64, device=device)))


# ---- engine.observe's agent_ray ----


@pytest.mark.parametrize("n_agents, res", [(1, 64), (4, 512), (4, 63), (3, 1)])
def test_agent_ray_is_the_closest_to_the_centre(n_agents, res, device):
    homes = [toys.box(2), toys.column(3)]
    c = core.Core(scene.scenery(homes, n_agents, 40, device=device), res=res, fov=70)
    modules.RandomSpawns(homes, c)(c.agent_full(True))
    rays = engine.observe(c.scenery, c.agents, agent_ray=True).agent_ray
    shown = engine.render(c.scenery, c.agents).indices
    is_agent = ((shown >= 0) & (shown < 8 * n_agents)).view(-1, res).tolist()
    for row, ray in zip(is_agent, rays.flatten().tolist(), strict=True):
        hits = [r for r in range(res) if row[r]]
        assert ray == min(hits, key=lambda r: (abs(r - res // 2), r), default=-1)
    assert n_agents == 1 or (rays >= 0).any()


# ---- Hidden spawns ----


@pytest.mark.parametrize("n_agents", [2, 4, 16])
@pytest.mark.parametrize("source", ["bench", "homes", "box", "column"])
def test_hidden_spawns_match_twin(source, n_agents, device):
    homes = sample(source, 4)
    c = core.Core(scene.scenery(homes, n_agents, 6, device=device))
    spawner, random = modules.RandomSpawns(homes, c, hidden=True, seed=3), np.random.default_rng(1)
    points = spawner.points.cpu().numpy().reshape(len(homes), n_agents, -1, 2)
    for step in range(4 if source in ("bench", "homes") else 2):
        mask = random.random((6, n_agents)) < (0.4 if step else 1)
        before, draws = (v.cpu().numpy().copy() for v in (c.agents.positions, spawner.counts))
        spawner(torch.from_numpy(mask).to(device))
        for e, d in enumerate(c.scenery.layout.tolist()):
            walls = c.scenery.layouts.lines[d].cpu().numpy()
            drawn = dict(draws=draws[e], first_lane=e * n_agents, seed=3, radius=RADIUS)
            expected = respawned(walls, points[d], before[e], mask[e], **drawn)
            ours = c.agents.positions[e].cpu().numpy()
            assert (ours == expected.astype(np.float32)).all(), f"environment {e}, step {step}"


def views_of(c, who):
    """(N, A, len(who)) bool: agents that, looking all round, see the lines of the agents `who`."""
    around = core.Core(c.scenery, res=1024, fov=122, cameras=[0, 120, 240])
    around.agents.positions.copy_(c.agents.positions)
    shown = engine.render(around.scenery, around.agents).indices.flatten(2)
    return torch.stack([((shown // 8) == a).logical_and(shown >= 0).any(-1) for a in who], -1)


# ---- The rules, by hand ----


class Ring:
    """One home whose agents are placed by hand: (x, y, degrees) each, in a box from 1 to 6."""

    def __init__(self, device, *poses, geometry=None, **settings):
        home = toys.box() if geometry is None else geometry
        self.env = envs.Deathmatch(1, [home], n_agents=len(poses), device=device, **settings)
        self.first = self.env.reset()
        self.place(*poses)

    def place(self, *poses):
        poses = torch.tensor(poses, dtype=torch.float32, device=self.env.device)
        agents = self.env.core.agents
        agents.positions[0], agents.angles[0] = poses[:, :2], poses[:, 2]
        agents.velocity.zero_()
        agents.angvelocity.zero_()

    def step(self, n=1, *actions):
        actions = torch.tensor(actions or (0,) * self.env.n_agents, device=self.env.device)
        for _ in range(n):
            world = self.env.step(arrdict.arrdict(actions=actions[:, None]))
        return world

    @property
    def health(self):
        return self.env.health.tolist()


# The first agent looks at the second, which is two metres ahead and looks away.
AMBUSH = (2.0, 3.5, 0.0), (4.0, 3.5, 0.0)


def test_agent_at_the_centre_of_a_view_is_hit_each_step(device):
    ring = Ring(device, *AMBUSH)
    for step in range(1, 4):
        world = ring.step()
        assert world.reward.tolist() == [1, -1]
        assert ring.health == pytest.approx([1, 1 - 0.1 * step])
        health_obs = world.obs.health[:, 0].tolist()
        assert health_obs[0] == [1, 1, 0]
        assert health_obs[1] == pytest.approx([1 - 0.1 * step, 0, 1], abs=1e-3)


def test_ten_hits_kill_and_the_next_step_respawns(device):
    ring = Ring(device, *AMBUSH)
    world = ring.step(9)
    assert not world.terminal.any() and ring.health[1] == pytest.approx(0.1)
    world = ring.step()
    assert world.terminal.tolist() == [False, True] and not world.truncated.any()
    assert ring.health == [1, 0] and world.reward.tolist() == [1, -1], "as for any hit"
    assert [float(world.metrics[name][1]) for name in METRICS] == [0, 1, 0, 0]
    assert ring.env.tally[:3, 0].tolist() == pytest.approx([1, 1, 10])
    world = ring.step()
    assert world.reset.tolist() == [False, True] and not world.reward.any()
    assert ring.health == [1, 1] and ring.env.ages.tolist() == [11, 0]
    assert ring.env.core.agents.positions[0, 0].tolist() == [2, 3.5], "the other stays"


def test_drain_and_recovery_are_per_second(device):
    away = (2.0, 2.0, 180.0), (5.0, 5.0, 0.0)
    ring = Ring(device, *away, drain=0.5)
    ring.step()
    assert ring.health == pytest.approx([0.95, 0.95]), "at ten steps per second"
    world = ring.step(19)
    assert world.terminal.all() and not world.reward.any(), "of the drain both die"
    assert world.metrics.kills.tolist() == [0, 0] and world.metrics.deaths.tolist() == [1, 1]
    ring = Ring(device, *AMBUSH, recovery=0.2)
    ring.step(3)
    assert ring.health == pytest.approx([1, 0.7]), "not while wounded"
    ring.place(*away)
    ring.step()
    assert ring.health == pytest.approx([1, 0.72])
    ring.step(20)
    assert ring.health == [1, 1], "and never more than all"


def test_search_reward_counts_newly_seen_texels(device):
    """In each lane, the reward is the number of bits that a step adds to `seen`."""
    rewards = dict(hit_reward=0, wound_cost=0, search_reward=64 / 4)
    env = envs.Deathmatch(3, sample("homes", 3), n_agents=2, device=device, limit=9, **rewards)

    def count():
        return np.unpackbits(env.seen.cpu().numpy().view(np.uint8).reshape(6, -1), axis=1).sum(1)

    env.reset()
    generator, bits, n_rewarded, n_reset = torch.Generator().manual_seed(1), count(), 0, 0
    for _ in range(30):
        decision = arrdict.arrdict(actions=contract.random_actions(env, generator))
        world, now = env.step(decision), count()
        reset = world.reset.cpu().numpy()
        assert world.reward.tolist() == np.where(reset, 0, (now - bits) / 4).tolist()
        bits, n_rewarded, n_reset = (
            now,
            n_rewarded + (world.reward > 0).sum(),
            n_reset + reset.sum(),
        )
    assert n_rewarded > 60 and n_reset > 12


def test_deaths_respawn_out_of_sight(device):
    """In homes, over many episodes: no agent sees a newly respawned one, whichever way it looks."""
    homes = sample("bench", 8)
    env = envs.Deathmatch(32, homes, n_agents=3, device=device, limit=5)
    env.reset()
    random, n_respawns = torch.Generator().manual_seed(1), 0
    for _ in range(40):
        world = env.step(arrdict.arrdict(actions=contract.random_actions(env, random)))
        new = modules.to_agents(world.reset, 3)
        env.ages.copy_(torch.where(world.reset, torch.arange(96, device=env.device) % 5, env.ages))
        seen = views_of(env.core, range(3))  # (N, observer, observed)
        seen &= ~new[:, :, None]
        if new.all(1).any():
            seen[new.all(1)] = False
        assert not (seen & new[:, None]).any()
        n_respawns += int(new.sum())
    assert n_respawns > 100


@pytest.mark.parametrize("n_agents", [2, 3, 16])
def test_sound_matches_twin(n_agents, device):
    n_silent = 0
    for _, outputs, positions, angles in fight(device, 5, n_agents, hearing=6.0):
        for e in range(5):
            ours = outputs["sound"][e * n_agents : (e + 1) * n_agents, 0]
            expected = sound(positions[e], angles[e], 6.0)
            np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-3)
            n_silent += (expected[:, 0] == 0).sum()
    assert n_silent or n_agents == 16


# ---- Images ----


# ---- Bad settings ----


# ---- Learning ----


def rows_of(run):
    """The rows of a run's only evaluation."""
    (table,) = Path(run).glob("evaluations/*.json")
    return json.loads(table.read_text())["rows"]


def test_train_evaluate_and_record_in_self_play(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ["env.n_envs=4", "env.n_agents=3", "env.limit=20", "learner.n_minibatches=2"]
    small += ["agent.width=8", "env.res=64", "geometry=column", "samples=1000", "folder=run"]
    assert train.main(["env=deathmatch", *small, "device=cpu"]) == 0
    assert evaluate.main(["run=run", "episodes=12", "device=cpu"]) == 0
    for row in rows_of("run"):
        assert set(row["metrics"]) == set(METRICS) and row["lanes"] == 12
    assert record.main(["run=run", "steps=2", "device=cpu"]) == 0
    assert Path("run/video.mp4").exists()


@pytest.mark.nightly
def test_recipe_learns_to_hit(tmp_path, monkeypatch):
    """With a quarter of its samples, five times as many as it needs to show."""
    monkeypatch.chdir(tmp_path)
    words = ["experiment=deathmatch", "geometry=box", "samples=250_000"]
    assert train.main([*words, "finish.record=false", "device=cpu", "folder=run"]) == 0
    assert evaluate.main(["run=run", "episodes=256", "split=all", "device=cpu"]) == 0
    trained, random = (row["metrics"]["accuracy"] for row in rows_of("run"))
    assert trained["lower"] > 1.3 * random["upper"]
