"""The contract of `megastep.agents.algorithms.learner` for all built-in learners. test_learning.py
tests that they learn.
"""

import copy

import pytest
import reference
import torch

from megastep import spaces
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.algorithms.vtrace import VTrace
from megastep.agents.cli import train
from megastep.agents.runs import checkpoint
from megastep.dotdict import leaves
from tests.helpers.learners import LEARNERS
from tests.helpers.made_up import PRIVILEGED, B, Numbers, made_up, weights
from tests.helpers.synchronisation import no_synchronisation
from tests.helpers.tiny import TINY, UPDATE
from tests.helpers.weights import reloaded

T = 5
SMALL = dict(width=8, n_steps=T, n_minibatches=2, lr=1e-2)
NAMES = pytest.mark.parametrize("name", LEARNERS)
ACTOR_CRITICS = pytest.mark.parametrize("learner", [PPO, VTrace])


def make(name, env=None, device="cpu", **settings):
    """Returns a policy, its learner and a collector."""
    env = env or Numbers(device)
    policy, learner = LEARNERS[name].make(env, **{**SMALL, **settings})
    return policy, learner, learner.collector(env)


def flat(policy):
    return torch.cat([value.flatten().double() for value in policy.state_dict().values()])


@NAMES
def test_keeps_contract_and_metrics_are_finite(name):
    _, learner, collect = make(name)
    assert collect.rollout.n_lanes == B and collect.rollout.n_steps == T
    for _ in range(6):
        losses = learner.update(collect())
    assert all(key.startswith("loss/") for key in losses) and "loss/skipped_steps" in losses
    assert [key for key in losses if not reference.has_metric(key)] == []
    assert all(value.shape == () and value.isfinite() for value in losses.values())
    assert learner.check.read(collect.rollout.floats()) == (None, 0)


@NAMES
def test_state_dict_resumes_bit_for_bit(name):
    """Replay buffers are not saved, so both learners get the same."""
    policy, learner, collect = make(name)
    for _ in range(4):
        learner.update(collect())
    learner.set_lr(2e-3)
    saved = reloaded(dict(policy=policy.state_dict(), learner=learner.state_dict()))
    other, resumed, _ = make(name, seed=9, lr=0.5)
    if getattr(learner, "replay_buffer", None) is not None:
        resumed.replay_buffer = copy.deepcopy(learner.replay_buffer)
    other.load_state_dict(saved["policy"])
    resumed.load_state_dict(saved["learner"])
    assert torch.equal(
        other.generator.on(other.device).get_state(), policy.generator.on(policy.device).get_state()
    )
    rollout = collect()
    before = flat(policy)
    learner.update(rollout)
    resumed.update(rollout)
    assert torch.equal(flat(other), flat(policy)) and not torch.equal(flat(policy), before)
    resumed.set_lr(0.0)  # must still reach the optimizer
    before = weights(other)
    resumed.update(rollout)
    assert torch.equal(weights(other), before)


@NAMES
def test_nonfinite_rollout_changes_no_bit(name):
    """The first step of the third rollout is NaN; later rollouts are learned from again."""
    policy, learner, collect = make(name, Numbers(bad_steps=(2 * T + 1,)))
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


@pytest.mark.parametrize("name", ["ppo", "vtrace", "r2d2"])
@pytest.mark.parametrize("graph", [False, pytest.param(True, marks=pytest.mark.cuda)])
def test_frozen_and_unused_parameters_stay_as_they_are(name, graph):
    env = Numbers("cuda" if graph else "cpu")
    policy = LEARNERS[name].make_policy(env, width=8)
    policy.intake.requires_grad_(False)
    policy.unused = torch.nn.Parameter(torch.ones(3, device=env.device))
    untrained = [policy.unused, *policy.intake.parameters()]
    before, all_before = [p.clone() for p in untrained], flat(policy)
    _, learner, collect = make(name, env, policy=policy, graph=graph)
    for _ in range(5):
        losses = learner.update(collect())
    assert all(map(torch.equal, untrained, before)) and not torch.equal(flat(policy), all_before)
    assert losses["loss/grad_norm"] > 0


@ACTOR_CRITICS
@pytest.mark.parametrize("factor", [1.0, 0.5])
def test_critic_lr_is_of_the_critic_alone_and_falls_with_lr(learner, factor):
    """Adam's first step is the step size."""
    policy, rollout = made_up(privileged=PRIVILEGED, values=learner is PPO)
    before = {name: p.detach().clone() for name, p in policy.named_parameters()}
    trained = learner(policy, n_minibatches=1, lr=1e-3, critic_lr=1e-2)
    trained.set_lr(factor * 1e-3)
    trained.update(rollout)
    steps = {n: (p - before[n]).abs().max().item() for n, p in policy.named_parameters()}
    for name in ("critic.hidden.weight", "critic.intake.project.weight"):
        assert steps[name] == pytest.approx(factor * 1e-2, rel=0.02)
    for name in ("prediction.weight", "intake.project.weight", "output.linear.weight"):
        assert steps[name] == pytest.approx(factor * 1e-3, rel=0.02)


@ACTOR_CRITICS
def test_invalid_rows_are_ignored(learner):
    results = []
    for corrupt in (False, True):
        policy, rollout = made_up(values=learner is PPO)
        if corrupt:
            ignored = rollout.reset.nonzero(as_tuple=True)
            assert len(ignored[0]) == 2
            rollout.reward[ignored] = 1e3
            rollout.logprobs[ignored] = -5.0 if learner is PPO else -500.0
            rollout.actions[ignored] = (rollout.actions[ignored] + 1) % 3
        metrics = learner(policy, n_epochs=2, n_minibatches=2).update(rollout)
        results.append((metrics, weights(policy)))
    (clean_metrics, clean), (dirty_metrics, dirty) = results
    assert torch.equal(clean, dirty) and clean_metrics == dirty_metrics


@ACTOR_CRITICS
@pytest.mark.parametrize("n_minibatches", [2, B])
def test_lanes_that_do_not_learn_change_no_bit(learner, n_minibatches):
    """Replaces two lanes by numbers whose ratios overflow. A third lane learns at some times only:
    its other rows count in no mean, but its hidden state and its traces pass through them.
    """
    results = []
    for changed in (False, True):
        policy, rollout = made_up(privileged=PRIVILEGED, values=learner is PPO)
        rollout.learns[:, [0, 4]] = False
        rollout.learns[2:4, 3] = False
        if changed:
            numbers = [rollout.obs, rollout.privileged, rollout.reward]
            for lanes in [*numbers, rollout.values] if learner is PPO else numbers:
                lanes[:, [0, 4]] = torch.randn(lanes[:, [0, 4]].shape) * 50 + 9
            rollout.logprobs[:, 0], rollout.logprobs[:, 4] = -200.0, 3.0
            rollout.actions[:, [0, 4]] = (rollout.actions[:, [0, 4]] + 1) % 3
            rollout.terminal[5, 0] = rollout.truncated[6, 4] = rollout.starts[4, 0] = True
            rollout.state.cell[[0, 4]] = 7.0
            rollout.logprobs[2:4, 3] += torch.tensor([9.0, -200.0])
            if learner is PPO:
                rollout.actions[2:4, 3] = (rollout.actions[2:4, 3] + 1) % 3
        trained = learner(policy, n_epochs=2, n_minibatches=n_minibatches, lr=1e-2)
        metrics = trained.update(rollout)
        results.append((metrics, policy.state_dict(), trained.optimizer.means))
    (clean_metrics, clean, means), (metrics, dirty, dirty_means) = results
    assert clean.keys() == dirty.keys() and all(torch.equal(clean[k], dirty[k]) for k in clean)
    assert all(map(torch.equal, means, dirty_means))
    assert metrics == clean_metrics and metrics["loss/skipped_steps"] == 0
    assert metrics["loss/auxiliary"] > 0


class Pushes(Numbers):
    """The first of two continuous actions is rewarded with the observation's first number."""

    action_space = spaces.MultiContinuous(1, 2)

    def step(self, decision):
        return self._world(self.age == 7, decision["actions"][:, 0, 0])


@pytest.mark.parametrize("name, settings", [("ppo", {"n_epochs": 1}), ("vtrace", {}), ("r2d2", {})])
def test_weights_decay_and_biases_and_standard_deviations_do_not(name, settings):
    """After one gradient step."""
    ends = []
    for weight_decay in (0.0, 2.0):
        env = Numbers() if name == "r2d2" else Pushes()
        policy, learner, collect = make(
            name, env, n_minibatches=1, weight_decay=weight_decay, **settings
        )
        for parameter in policy.parameters():
            parameter.data += 0.01
        first = {n: p.detach().clone() for n, p in policy.named_parameters()}
        while not learner.optimizer.n_steps:
            learner.update(collect())
        ends.append({n: p.detach().clone() for n, p in policy.named_parameters()})
    plain, decayed = ends
    assert learner.optimizer.n_steps == 1
    moments = learner.state_dict()["optimizer"]["means"]  # in an order that no setting changes
    assert [mean.shape for mean in moments] == [p.shape for p in policy.parameters()]
    for key in first.keys() - {"critic.output.linear.weight"}:  # which PopArt changes, too
        subtracted = SMALL["lr"] * 2.0 * first[key] if "weight" in key else 0 * first[key]
        torch.testing.assert_close(plain[key] - decayed[key], subtracted, rtol=1e-3, atol=1e-6)


@NAMES
def test_bytes_per_env_bounds_stored_bytes(name):
    env = Numbers()
    (_, few, collect), (_, many, _) = make(name), make(name, n_steps=4 * T)
    rollout = collect.rollout
    tensors = [value for value in vars(rollout).values() if isinstance(value, torch.Tensor)]
    stored = sum(leaf.nbytes for leaf in [*tensors, *leaves(rollout.state)])
    assert stored < few.bytes_per_env(env) * B < 100 * stored
    assert 3 < many.bytes_per_env(env) / few.bytes_per_env(env) < 5


@NAMES
def test_replay_size_matches_replay_buffer(name):
    env = Numbers()
    _, learner, _ = make(name)
    n, n_bytes = learner.replay_size(env) if hasattr(learner, "replay_size") else (0, 0.0)
    replay_buffer = getattr(learner, "replay_buffer", None)
    if replay_buffer is None:
        assert n == 0
    else:
        assert n - T * B < replay_buffer.capacity <= n
        assert n_bytes * n == pytest.approx(replay_buffer.bytes, rel=0.05)


def test_init_from_other_learner(tmp_path, monkeypatch, capsys):
    """With a tiny learning rate the weights stay the same. Weights of another shape are refused."""
    monkeypatch.chdir(tmp_path)
    assert train.main([*TINY, f"samples={UPDATE}", "folder=first"]) == 0
    words = [word for word in TINY if not word.startswith("agent.width")]
    words += ["learner=vtrace", "init=first", "learner.lr=1e-30", f"samples={UPDATE}"]
    assert train.main([*words, "folder=second"]) == 0
    first, second = (
        checkpoint.load_latest(tmp_path / run / "checkpoints") for run in ("first", "second")
    )
    name = "output.linear.weight"
    assert torch.equal(first.state["policy"][name], second.state["policy"][name])
    learners = [run.state["learner"]["learner"] for run in (first, second)]
    assert learners == ["PPO", "VTrace"]
    capsys.readouterr()
    assert train.main([*words, "agent.width=16", "folder=third"]) == 2
    assert "agent.width=8" in capsys.readouterr().err


def test_resume_from_other_learner_fails(tmp_path, monkeypatch, capsys):
    """The learner in the checkpoint's configuration is changed by hand."""
    monkeypatch.chdir(tmp_path)
    assert train.main([*TINY, f"samples={UPDATE}", "folder=run"]) == 0
    loaded = checkpoint.load_latest(tmp_path / "run" / "checkpoints")
    loaded.config["train"]["learner"] |= {"name": "megastep.agents.algorithms.vtrace:VTrace"}
    for key in ("clip", "target_kl", "value_clip", "normalise_advantage"):
        del loaded.config["train"]["learner"][key]
    checkpoint.save(tmp_path / "run" / "checkpoints", 2 * UPDATE, loaded.state, loaded.config)
    capsys.readouterr()
    assert train.main(["resume=run", f"samples={4 * UPDATE}"]) == 2
    error = capsys.readouterr().err
    assert all(part in error for part in ("PPO", "VTrace", "init=")) and "Traceback" not in error


REPLAY = ["learner=vtrace", "learner.buffer=replay"]


@pytest.mark.parametrize(
    "words, cure",
    [
        ([*REPLAY, "learner.replay.capacity=40_000_000_000"], "on cpu may be used: at most"),
        ([*REPLAY, "learner.replay.capacity=40"], "at least 64"),
        ([*REPLAY, "learner.replay.capcity=9"], "did you mean learner.replay.capacity?"),
        (["learner=vtrace", "learner.replay.ratio=2"], "buffer=replay"),
    ],
)
def test_bad_settings_fail_before_training(words, cure, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert train.main([*TINY, *words, f"samples={UPDATE}"]) == 2
    error = capsys.readouterr().err
    assert cure in error and "Traceback" not in error
    assert not list(tmp_path.glob("runs/*"))


@pytest.mark.cuda
@NAMES
def test_collect_and_update_never_synchronise(name):
    _, learner, collect = make(name, device="cuda", graph=True)
    for _ in range(6):
        learner.update(collect())
    with no_synchronisation():
        for _ in range(3):
            learner.update(collect())
    if hasattr(collect, "wait"):
        collect.wait()
    assert learner.cuda_graph.graph is not None and collect.graph is not None


@pytest.mark.cuda
@NAMES
def test_captured_update_matches_eager(name):
    ends = []
    for graph in (False, True):
        policy, learner, collect = make(name, device="cuda", graph=graph)
        for i in range(6):
            learner.set_lr(1e-3 / (i + 1))
            losses = learner.update(collect())
        ends.append(flat(policy))
        assert all(value.isfinite() for value in losses.values())
    # the captured graph may use other kernels
    torch.testing.assert_close(ends[1], ends[0], rtol=1e-2, atol=1e-2)
