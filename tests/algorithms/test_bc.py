"""Behaviour cloning: what it reads, what it learns, and that PPO goes on from it."""

import json

import pytest
import torch

import megastep
from megastep import data
from megastep.agents.algorithms.bc import BC
from megastep.agents.cli import dump, train
from megastep.agents.networks.policy import Policy

WHERE = ["env=pointgoal", "geometry=box", "env.res=16", "env.subsample=1", "device=cpu"]
SMALL = ["env.n_envs=8", "agent.width=16", "learner.n_steps=8", "learner.n_minibatches=2"]
GAMMA = 0.9


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "data"
    words = ["bot=walker", "episodes=13", "env.limit=40", f"folder={folder}", *WHERE]
    assert dump.main(words) == 0
    return folder


@pytest.fixture
def env():
    return megastep.make("pointgoal", n_envs=5, geometry="box", res=16, subsample=1, device="cpu")


def learner(env, folder, **settings):
    policy = Policy(env.obs_space, env.action_space, width=16, critic="plain")
    options = dict(n_steps=7, n_minibatches=2, gamma=GAMMA, lr=1e-12)
    return BC(policy, data=str(folder), **{**options, **settings})


def trained(tmp_path, name, *words):
    words = [*WHERE, *SMALL, "logging.every=1", f"folder={tmp_path / name}", *words]
    assert train.main([word for word in words if word]) == 0
    lines = (tmp_path / name / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def test_lanes_read_whole_episodes(env, folder):
    """All are read once before any is read again; a row between two episodes is no transition."""
    episodes, collect = [*data.load(folder)], learner(env, folder).collector(env)
    rollouts = []
    for _ in range(60):
        rollout = collect()
        names = "starts", "actions", "reward", "terminal", "truncated"
        rows = {name: getattr(rollout, name)[:7].clone() for name in names}
        rows |= {name: leaf[:7].clone() for name, leaf in rollout.obs.items()}
        rollouts.append(rows | {"returns": collect.returns.clone()})
    stream = {name: torch.cat([rows[name] for rows in rollouts]) for name in rollouts[0]}
    began = []
    for lane in range(5):
        (firsts,) = stream["starts"][:, lane].nonzero(as_tuple=True)
        for first, end in zip(firsts.tolist(), firsts.tolist()[1:]):
            rows = {name: leaf[first:end, lane] for name, leaf in stream.items()}
            n = end - first - 1
            (number,) = [i for i, one in enumerate(episodes) if torch.equal(one.obs.d, rows["d"])]
            one = episodes[number]
            began.append((first, lane, number))
            assert torch.equal(one.obs.rgb, rows["rgb"]) and len(one.reward) == n
            for name in "actions", "reward", "terminal", "truncated":
                assert torch.equal(one[name], rows[name][:n]), name
            total = 0.0
            for t in reversed(range(n)):
                total = float(one.reward[t]) + GAMMA * total
                assert rows["returns"][t] == pytest.approx(total, abs=1e-5)
    order = [number for _, _, number in sorted(began)]
    assert sorted(order[:13]) == [*range(13)] and order[13:18] == order[:5]


def test_the_hidden_state_goes_on(env, folder):
    """After two rollouts it is what one pass over both gives, whatever the minibatches."""
    bc = learner(env, folder)
    collect, parts = bc.collector(env), []
    for _ in range(3):
        rollout = collect()
        parts.append((rollout.obs.map(lambda leaf: leaf[:7].clone()), rollout.starts[:7].clone()))
        if len(parts) == 1:
            bc.update(rollout)  # after which observations are normalised
            before = rollout.state.map(torch.clone)
        else:
            state = bc.policy.warm_up(*parts[-1], before)
            stats = bc.policy.state_dict()
            bc.update(rollout)
            before = rollout.state.map(torch.clone)
            assert stats.keys() == bc.policy.state_dict().keys()
            for name, leaf in state.items():
                torch.testing.assert_close(rollout.state[name], leaf)


def test_it_clones_and_ppo_goes_on(folder, tmp_path):
    words = ["learner=bc", f"learner.data={folder}", "learner.lr=1e-2", "learner.gamma=0.98"]
    rows = trained(tmp_path, "bc", *words, "samples=12800")
    # the first policy is uniform over 7 actions
    assert rows[0]["loss/policy"] == pytest.approx(1.946, abs=0.02)
    assert rows[-1]["loss/policy"] < 0.8 and rows[-1]["loss/value"] < 0.5
    lengths = [len(one.reward) for one in data.load(folder)]
    last = rows[-1]["episode/length"]
    assert last == pytest.approx(sum(lengths) / len(lengths), rel=0.1)
    init = [f"init={tmp_path / 'bc'}", "agent.critic=plain", "samples=64"]
    rows = trained(tmp_path, "ppo", *init, "learner.lr=1e-9")
    assert rows[0]["loss/entropy"] < 1.2, "it begins as the clone"


def test_a_resumed_run_is_the_same(folder, tmp_path):
    words = ["learner=bc", f"learner.data={folder}", "learner.anneal=never"]
    whole = trained(tmp_path, "whole", *words, "samples=512")
    trained(tmp_path, "part", *words, "samples=256")
    assert train.main([f"resume={tmp_path / 'part'}", "more_samples=256", "device=cpu"]) == 0
    lines = (tmp_path / "part" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == whole


@pytest.mark.parametrize(
    ("words", "sentence"),
    {
        ("learner.data={absent}",): "does not exist; give a folder that megastep dump has written",
        ("env.control=continuous",): "actions is MultiDiscrete(n_agents=1, n_actions=7) in ",
        ("env.res=32",): "obs.rgb is MultiImage(n_agents=1, C=3, H=1, W=16) in ",
        ("agent.critic=asymmetric",): "use agent.critic=plain",
        ("learner.data=null",): "learner.data: ",
    }.items(),
)
def test_what_cannot_be_cloned_is_one_sentence(words, sentence, folder, tmp_path, capsys):
    words = [word.format(absent=tmp_path / "absent") for word in words]
    own = ["learner=bc", f"learner.data={folder}", f"folder={tmp_path / 'run'}", "samples=64"]
    own = [word for word in own if word.partition("=")[0] not in "".join(words)]
    assert train.main([*WHERE, *SMALL, "learner=bc", *own, *words]) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.cuda
def test_rollouts_are_the_same_on_a_gpu(env, folder):
    gpu = megastep.make("pointgoal", n_envs=5, geometry="box", res=16, subsample=1, device="cuda")
    pair = [learner(one, folder).collector(one) for one in (env, gpu)]
    for _ in range(5):
        own, other = (collect() for collect in pair)
        for name in "starts", "actions", "reward", "terminal", "truncated":
            assert torch.equal(getattr(own, name), getattr(other, name).cpu()), name
        for name, leaf in own.obs.items():
            assert torch.equal(leaf, other.obs[name].cpu()), name


@pytest.mark.cuda
def test_it_clones_by_graphs(folder, tmp_path):
    words = ["learner=bc", f"learner.data={folder}", "learner.lr=1e-2", "samples=12800"]
    rows = trained(tmp_path, "bc", *words, "device=cuda")
    assert rows[-1]["loss/policy"] < 0.8
