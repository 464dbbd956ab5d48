"""Bots: they walk, explore and win without learning."""

import json
import re
from types import SimpleNamespace

import pytest
import torch

from megastep import envs, toys
from megastep.agents.cli import evaluate, train
from megastep.agents.errors import UserError
from megastep.agents.evaluation import playing, statistics
from megastep.agents.evaluation.playing import first_episodes
from megastep.agents.factory import make as factory
from megastep.agents.selfplay.bots import BOTS
from megastep.agents.selfplay.bots.plans import Plans
from megastep.agents.selfplay.bots.random import RandomActions
from megastep.agents.selfplay.bots.seekers import Mapper, Oracle, Wanderer
from megastep.agents.selfplay.bots.walker import Explorer, Hunter, Runner, Walker
from megastep.arrdict import arrdict
from megastep.geometries import sample
from megastep.modules.spawning import distances
from tests.helpers.games import Matrix

HOMES = sample("homes", 8, split="test", seed=1)
DENSE = sample("homes", 8, split="test", seed=1, density=3.0)


def play(env, bot, n_steps):
    """Plays a bot in all lanes. Returns the last decision, state and world."""
    world, generator = env.reset(), torch.Generator(env.device).manual_seed(1)
    state = bot.initial(len(world.reset), env.device)
    for _ in range(n_steps):
        decision, state = bot(world, state, generator=generator)
        world = env.step(decision)
    return decision, state, world


def test_agents_fit_on_nodes_and_ways_in_a_box_are_straight(device):
    env = envs.Deathmatch(1, [toys.box()], n_agents=2, device=device)
    plans = Plans(env.core.scenery, env.spawner.points, env.core.agents.radius)
    nodes, targets = plans.nodes.cpu(), plans.targets[0].cpu()
    assert (distances(nodes.numpy(), toys.box().walls) > env.core.agents.radius).all()
    straight = torch.cdist(nodes, targets)
    # in float16, 6 m are exact to 2 mm
    torch.testing.assert_close(plans.lengths.cpu().float(), straight, atol=4e-3, rtol=0)


@pytest.mark.parametrize("settings", [{}, dict(control="continuous")])
def test_walker_reaches_goals(settings, device):
    env = envs.PointGoal(64, HOMES, device=device, **settings)
    metrics = first_episodes(env, Walker(env)).metrics
    assert metrics.success.mean() >= 0.98
    assert metrics.spl.mean() >= 0.9


def test_explorer_sees_more_than_random_actions(device):
    env = envs.Explorer(16, HOMES, patience=10_000, device=device)
    seen = {}
    for name, bot in dict(explorer=Explorer(env), random=RandomActions(env.action_space)).items():
        play(env, bot, 200)
        seen[name] = float(env.n_seen.float().mean())
    assert seen["explorer"] > 1.5 * seen["random"], seen


def test_hunter_turns_to_an_agent_and_kills_it(device):
    env = envs.Deathmatch(1, [toys.box()], n_agents=2, device=device)
    hunter, world = Hunter(env), env.reset()
    state = hunter.initial(2, device)
    agents = env.core.agents
    agents.positions[0] = torch.tensor([[2.0, 3.5], [5.0, 4.0]])
    agents.angles[0] = torch.tensor([-20.0, 180.0])
    still = torch.zeros(2, 1, dtype=torch.int64, device=device)
    world = env.step(arrdict(actions=still))
    for _ in range(60):
        decision, state = hunter(world, state)
        decision.actions[1] = 0
        world = env.step(decision)
        if world.terminal[1]:
            break
    assert world.terminal.tolist() == [False, True]


def test_an_oracle_finds_an_object_every_few_seconds(device):
    """In mazes of 9 x 9 cells: one in 3 s, about."""
    env = envs.Memory(8, sample("memory_maze", 8, split="test"), device=device, res=8, subsample=1)
    play(env, Oracle(env), 150)
    assert env.found.float().mean() > 3 and env.found.min() > 0


@pytest.mark.nightly
def test_what_a_seeker_remembers_is_worth_finds():
    """Over whole episodes. The oracle's are within 20 % of Memory Maze's, 34.8."""
    mazes = sample("memory_maze", 48, split="test")
    found = {}
    for kind in (Oracle, Mapper, Wanderer):
        env = envs.Memory(48, mazes, device="cpu", res=8, subsample=1)
        found[kind] = float(first_episodes(env, kind(env)).metrics.found.mean())
    assert abs(found[Oracle] / 34.8 - 1) < 0.2
    assert found[Oracle] > 1.02 * found[Mapper] and found[Mapper] > 0.85 * found[Oracle], found
    assert found[Mapper] > 3 * found[Wanderer], found


@pytest.mark.nightly
def test_hunter_wins_duels():
    env = envs.Deathmatch(128, HOMES, n_agents=2, device="cpu")
    (row,) = statistics.summaries(playing.first_duels(env, Hunter(env), env.bot(env.core.fov)))
    assert row["won"] > 0.6 and row["wins"] > 2 * row["losses"], row


def test_bots_play_alike_in_some_lanes(device):
    deathmatch = envs.Deathmatch(6, DENSE, n_agents=3, device=device)
    hide_and_seek = envs.HideAndSeek(5, device=device, prep=10)
    lanes = torch.tensor([17, 0, 4, 9], device=device)
    for kind, env in ((Explorer, deathmatch), (Hunter, deathmatch), (Runner, hide_and_seek)):
        bot = kind(env)
        decision, state, world = play(env, bot, 20)
        all_decided, _ = bot(world, state)
        some = [part.map(lambda leaf: leaf[lanes]) for part in (world, state)]
        some_decided, _ = bot.in_lanes(lanes)(*some)
        assert (some_decided.actions == all_decided.actions[lanes]).all()


@pytest.mark.cuda
@pytest.mark.parametrize("kind", [Explorer, Hunter, Walker, Runner])
def test_bots_never_synchronise(kind):
    env = envs.Deathmatch(64, DENSE, n_agents=2, device="cuda")
    env = envs.HideAndSeek(32, device="cuda") if kind is Runner else env
    bot, world = kind(env), env.reset()
    state = bot.initial(128, env.device)
    decision, state = bot(world, state)
    torch.cuda.set_sync_debug_mode("error")
    try:
        bot(env.step(decision), state)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def pong():
    return envs.Pong(2, self_play=True, device="cpu")


def pointgoal():
    return envs.PointGoal(1, HOMES[:1], device="cpu")


def deathmatch():
    return envs.Deathmatch(1, HOMES[:1], device="cpu")


@pytest.mark.parametrize(
    "name, make, sentence",
    [
        *((n, pong, f"{n} cannot play in Pong.*Pong has no core") for n in BOTS if n != "random"),
        ("hunter", pointgoal, "hunts others by the observation d"),
        ("explorer", lambda: Matrix(2), "explorer cannot play in Matrix"),
        ("runner", deathmatch, "is_hider says who runs"),
        ("oracle", pointgoal, "PointGoal has no cue"),
        ("hunted", pong, "hunted"),
    ],
)
def test_refusals(name, make, sentence):
    with pytest.raises(UserError, match=sentence) as error:
        factory.make_bot(name, SimpleNamespace(), make())
    assert "\n" not in str(error.value)


def test_evaluations_give_the_fraction_of_what_an_oracle_finds(tmp_path, monkeypatch):
    """In the same episodes: the same mazes, spawns, objects and cues."""
    monkeypatch.chdir(tmp_path)
    words = ["env=memory", "env.n_envs=4", "env.limit=90", "env.res=8", "geometry=memory_maze"]
    words += ["geometry.n=2", "agent.width=8", "learner.n_steps=8", "samples=1", "device=cpu"]
    assert train.main([*words, "folder=run"]) == 0
    words = ["run=run", "baseline=oracle,wanderer", "episodes=4", "device=cpu"]
    assert evaluate.main(words) == 0
    (path,) = (tmp_path / "run" / "evaluations").glob("*.json")
    episodes = json.loads(path.read_text())["episodes"]
    found = torch.tensor(episodes["found"]).view(3, 4)  # trained, oracle, wanderer
    fractions = torch.tensor(episodes["oracle_fraction"]).view(3, 4)
    assert (found[1] > 0).all()
    torch.testing.assert_close(fractions, found / found[1])
    starts = torch.tensor([episodes["start_x"], episodes["start_y"]]).view(2, 3, 4)
    assert (starts == starts[:, :1]).all()


def test_commands_take_bots_by_name(tmp_path, monkeypatch):
    """Training against a bot that walks in other homes than those of the duels that follow."""
    monkeypatch.chdir(tmp_path)
    words = ["env=deathmatch", "env.n_agents=2", "env.n_envs=4", "env.limit=20"]
    words += ["geometry=homes", "geometry.n=4"]
    words += ["agent.width=8", "learner.n_steps=8", "samples=1", "device=cpu"]
    words += ["opponents.bot=0.5", "opponents.bot_class=hunter", "folder=run"]
    assert train.main(words) == 0
    words = ["run=run", "against=explorer,walker,bot,random", "episodes=4", "device=cpu"]
    assert evaluate.main(words) == 0, "the environment's bot, not the hunter"
    (path,) = (tmp_path / "run" / "evaluations").glob("*.json")
    rows = json.loads(path.read_text())["rows"]
    assert [row["against"] for row in rows] == ["explorer", "walker", "bot", "random"]
    assert not re.search("nan", path.read_text(), re.IGNORECASE)
