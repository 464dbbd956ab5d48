"""What all built-in learners have in common, as `megastep.agents.algorithms.learner` says. That they learn is in
test_learning.py.
"""

import copy
import io

import pytest
import torch

from megastep.agents.algorithms.learner import check_learner
from megastep.agents.cli import train
from megastep.agents.training import checkpoint
from megastep.dotdict import leaves
from tests.helpers.learners import LEARNERS
from tests.helpers.made_up import B, Numbers, weights
from tests.helpers.tiny import TINY, UPDATE

T = 5
SMALL = dict(width=8, n_steps=T, n_minibatches=2, lr=1e-2)
NAMES = pytest.mark.parametrize("name", LEARNERS)


def made(name, env=None, device="cpu", **how):
    """An environment, a policy, its learner and what collects for it."""
    env = env or Numbers(device)
    policy, learner = LEARNERS[name].make(env, **{**SMALL, **how})
    return policy, learner, learner.collector(env)


def flat(policy):
    return torch.cat([value.flatten().double() for value in policy.state_dict().values()])


@NAMES
def test_it_is_a_learner_whose_metrics_are_numbers(name):
    _, learner, collect = made(name)
    check_learner(learner)
    assert collect.rollout.n_lanes == B and collect.rollout.n_steps == T
    for _ in range(6):
        losses = learner.update(collect())
    assert all(key.startswith("loss/") for key in losses) and "loss/skipped_steps" in losses
    assert all(value.shape == () and value.isfinite() for value in losses.values())
    assert learner.check.read(collect.rollout.floats()) == (None, 0)


@NAMES
def test_a_saved_learner_goes_on_bit_by_bit(name):
    """What is replayed is not saved: here both have the same."""
    policy, learner, collect = made(name)
    for _ in range(4):
        learner.update(collect())
    learner.set_lr(2e-3)
    file = io.BytesIO()
    torch.save(dict(policy=policy.state_dict(), learner=learner.state_dict()), file)
    file.seek(0)
    saved = torch.load(file, weights_only=True)
    other, resumed, _ = made(name, seed=9, lr=0.5)
    if getattr(learner, "replay", None) is not None:
        resumed.replay = copy.deepcopy(learner.replay)
    other.load_state_dict(saved["policy"])
    resumed.load_state_dict(saved["learner"])
    assert torch.equal(
        other.generator.on(other.device).get_state(), policy.generator.on(policy.device).get_state()
    )
    rollout = collect()
    before = flat(policy)
    for each in (learner, resumed):
        each.update(rollout)
    assert torch.equal(flat(other), flat(policy)) and not torch.equal(flat(policy), before)
    resumed.set_lr(0.0)  # still reaches the optimizer
    before = weights(other)
    resumed.update(rollout)
    assert torch.equal(weights(other), before)


@NAMES
@pytest.mark.parametrize("other", ["PPO", "Nobody"])
def test_the_state_of_another_learner_is_refused(name, other):
    _, learner, _ = made(name)
    state = learner.state_dict()
    if state["learner"] == other:
        return
    state["learner"] = other
    with pytest.raises(ValueError, match=f"the state of a {other} learner"):
        learner.load_state_dict(state)


@NAMES
def test_a_bad_number_changes_no_bit_and_is_named(name):
    """In the first step of the third rollout; what follows is learnt from."""
    policy, learner, collect = made(name, Numbers(bad_steps=(2 * T + 1,)))
    for _ in range(2):
        learner.update(collect())
    before = [value.clone() for value in policy.state_dict().values()]
    optimizer = [value.clone() for value in learner.optimizer.means]
    losses = learner.update(collect())
    assert all(map(torch.equal, policy.state_dict().values(), before))
    assert all(map(torch.equal, learner.optimizer.means, optimizer))
    assert losses["loss/skipped_steps"] > 0
    bad, n_skipped = learner.check.read(collect.rollout.floats())
    assert (bad.name, bad.lane, bad.step, n_skipped) == ("reward", 3, 2 * T + 1, 1)
    for _ in range(4):
        losses = learner.update(collect())
    assert losses["loss/skipped_steps"] == 0 and flat(policy).isfinite().all()
    assert not torch.equal(flat(policy), torch.cat([v.flatten().double() for v in before]))


@NAMES
@pytest.mark.parametrize("bad_steps", [range(1, 999), range(4 * T + 1, 999), (1,)], ids=str)
def test_skipped_updates_are_counted_and_end_with_the_bad_numbers(name, bad_steps):
    """Whether or not there is anything to replay."""
    _, learner, collect = made(name, Numbers(bad_steps=bad_steps))
    counts = []
    for _ in range(9):
        learner.update(collect())
        counts.append(learner.check.read(collect.rollout.floats())[1])
    first = (min(bad_steps) - 1) // T
    n_bad = 9 - first if len(bad_steps) > 1 else 1
    assert counts == [0] * first + [*range(1, n_bad + 1)] + [0] * (9 - first - n_bad)


@NAMES
def test_memory_is_estimated_from_above_and_grows_with_what_is_stored(name):
    env = Numbers()
    (_, few, collect), (_, many, _) = made(name), made(name, n_steps=4 * T)
    rollout = collect.rollout
    tensors = [value for value in vars(rollout).values() if isinstance(value, torch.Tensor)]
    stored = sum(leaf.nbytes for leaf in [*tensors, *leaves(rollout.state)])
    assert stored < few.bytes_per_env(env) * B < 100 * stored
    assert 3 < many.bytes_per_env(env) / few.bytes_per_env(env) < 5


@NAMES
def test_the_memory_of_what_is_replayed_is_told_before_there_is_any(name):
    env = Numbers()
    _, learner, _ = made(name)
    n, each = learner.replay_size(env) if hasattr(learner, "replay_size") else (0, 0.0)
    replay = getattr(learner, "replay", None)
    if replay is None:
        assert n == 0
    else:
        assert n - T * B < replay.capacity <= n
        assert each * n == pytest.approx(replay.bytes, rel=0.05)


def test_a_run_starts_from_the_weights_of_another_learner_unless_they_do_not_fit(
    tmp_path, monkeypatch, capsys
):
    """With steps of no size they are the same afterwards."""
    monkeypatch.chdir(tmp_path)
    assert train.main([*TINY, f"samples={UPDATE}", "folder=first"]) == 0
    given = [word for word in TINY if not word.startswith("agent.width")]
    given += ["learner=vtrace", "init=first", "learner.lr=1e-30", f"samples={UPDATE}"]
    assert train.main([*given, "learner.lag=1", "folder=second"]) == 0
    first, second = (
        checkpoint.load_latest(tmp_path / run / "checkpoints") for run in ("first", "second")
    )
    name = "output.linear.weight"
    assert torch.equal(first.state["policy"][name], second.state["policy"][name])
    kinds = [each.state["learner"]["learner"] for each in (first, second)]
    assert kinds == ["PPO", "VTrace"]
    capsys.readouterr()
    assert train.main([*given, "agent.width=16", "folder=third"]) == 2
    assert "do not fit this agent" in capsys.readouterr().err


def test_a_checkpoint_of_another_learner_is_refused_in_a_sentence(tmp_path, monkeypatch, capsys):
    """Its configuration was changed since."""
    monkeypatch.chdir(tmp_path)
    assert train.main([*TINY, f"samples={UPDATE}", "folder=run"]) == 0
    loaded = checkpoint.load_latest(tmp_path / "run" / "checkpoints")
    loaded.config["train"]["learner"] |= {"name": "megastep.agents.algorithms.vtrace:VTrace"}
    del loaded.config["train"]["learner"]["clip"], loaded.config["train"]["learner"]["target_kl"]
    checkpoint.save(tmp_path / "run" / "checkpoints", 2 * UPDATE, loaded.state, loaded.config)
    capsys.readouterr()
    assert train.main(["resume=run", f"samples={4 * UPDATE}"]) == 2
    error = capsys.readouterr().err
    assert "the state of a PPO learner cannot be that of VTrace" in error
    assert "Traceback" not in error


REPLAY = ["learner=vtrace", "learner.buffer=replay"]


@pytest.mark.parametrize(
    "words, told",
    [
        (
            ["learner=vtrace", "learner.lag=1", "opponents.past=0.5"],
            "learner.lag=0 or no opponents",
        ),
        ([*REPLAY, "learner.replay.capacity=40_000_000_000"], "on cpu: at most"),
        ([*REPLAY, "learner.replay.capacity=40"], "it needs at least 64"),
        ([*REPLAY, "learner.replay.burn_in=9", "learner.replay.length=9"], "leaves nothing"),
        ([*REPLAY, "learner.replay.capcity=9"], "did you mean learner.replay.capacity?"),
        (["learner=vtrace", "learner.replay.ratio=2"], "those of buffer=replay"),
    ],
)
def test_what_does_not_fit_is_told_in_a_sentence(words, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert train.main([*TINY, *words, f"samples={UPDATE}"]) == 2
    error = capsys.readouterr().err
    assert told in error and "Traceback" not in error
    assert not list(tmp_path.glob("runs/*"))


@pytest.mark.cuda
@NAMES
def test_collecting_and_learning_never_synchronise(name):
    _, learner, collect = made(name, device="cuda", graph=True)
    for _ in range(6):
        learner.update(collect())
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(3):
            learner.update(collect())
    finally:
        torch.cuda.set_sync_debug_mode("default")
    if hasattr(collect, "wait"):
        collect.wait()
    assert learner.cuda_graph.graph is not None and collect.graph is not None


@pytest.mark.cuda
@NAMES
def test_a_captured_update_is_the_eager_one(name):
    ends = []
    for graph in (False, True):
        policy, learner, collect = made(name, device="cuda", graph=graph)
        for i in range(6):
            learner.set_lr(1e-3 / (i + 1))
            losses = learner.update(collect())
        ends.append(flat(policy))
        assert all(value.isfinite() for value in losses.values())
    # kernels are chosen anew where a graph is captured
    torch.testing.assert_close(ends[1], ends[0], rtol=1e-2, atol=1e-2)
