"""R2D2: what one update does, beside what every learner is held to."""

import io

import pytest
import torch
from torch import testing

from megastep import spaces
from megastep.agents.algorithms import r2d2, returns
from megastep.agents.cli import evaluate, train
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.replay import ReplaySettings
from megastep.agents.training import checkpoint
from megastep.arrdict import arrdict
from tests.helpers.tiny import TINY, UPDATE

B, T, WIDTH = 6, 8, 16


class Noise:
    """Shows noise, and pays 1 for action 2. An episode ends after each step with probability 1/8,
    in lane 0 by its own rule and elsewhere by a time limit.
    """

    n_envs, n_agents = B, 1
    obs_space, action_space = spaces.MultiVector(1, 4), spaces.MultiDiscrete(1, 3)

    def __init__(self, device="cpu"):
        self.device = torch.device(device)
        self.generator = torch.Generator(device).manual_seed(0)
        self.over = torch.zeros(B, dtype=torch.bool, device=device)

    def reset(self):
        return self._world(torch.zeros(B, device=self.device), torch.ones_like(self.over))

    def step(self, decision):
        paid = (decision["actions"][:, 0] == 2).float()
        return self._world(paid.masked_fill(self.over, 0.0), self.over)

    def _world(self, reward, reset):
        how = dict(generator=self.generator, device=self.device)
        ends = (torch.rand(B, **how) < 1 / 8) & ~reset
        self.over = ends
        first = torch.arange(B, device=self.device) == 0
        obs = torch.randn(B, 1, 4, **how)
        return arrdict(
            obs=obs, reward=reward, reset=reset, terminal=ends & first, truncated=ends & ~first
        )


def made(device="cpu", width=WIDTH, seed=1, burn_in=3, **how):
    """(learner, what collects for it)."""
    env = Noise(device)
    policy = Policy(env.obs_space, env.action_space, width=width, output="duelling", seed=seed)
    settings = ReplaySettings(burn_in=burn_in, **dict(capacity=6 * T * B, alpha=0.9))
    settings = how.pop("replay", settings)
    learner = r2d2.R2D2(policy.to(device), n_steps=T, replay=settings, seed=seed, **how)
    return learner, learner.collector(env)


def weights(policy):
    return torch.cat([p.detach().flatten() for p in policy.parameters()])


def updated(learner, collect, n):
    for _ in range(n):
        losses = learner.update(collect())
    return losses


def test_nothing_is_learnt_before_there_is_a_whole_sequence():
    learner, collect = made()  # of 11 steps and the observation after them: two rollouts
    before = weights(learner.policy)
    losses = updated(learner, collect, 1)
    assert torch.equal(weights(learner.policy), before) and learner.n_taken == 0
    assert all(value.item() == 0 for value in losses.values()) and not learner.check.read({})[1]
    updated(learner, collect, 1)
    assert not torch.equal(weights(learner.policy), before) and learner.n_taken == 4


def test_learning_starts_when_enough_was_collected():
    learner, collect = made(replay=ReplaySettings(capacity=6 * T * B, burn_in=3, start=4 * T * B))
    taken = []
    for _ in range(5):
        updated(learner, collect, 1)
        taken.append(learner.n_taken.item())
    assert taken == [0, 0, 0, 4, 8]


def test_what_is_told_of_an_update():
    learner, collect = made()
    losses = updated(learner, collect, 4)
    assert set(losses) == {
        f"loss/{name}"
        for name in (
            *(
                "td",
                "td_error",
                "q",
                "staleness",
                "effective_samples",
                "grad_norm",
                "skipped_steps",
            ),
            *("priority_max", "priority_mean"),
        )
    }
    assert all(value.isfinite() for value in losses.values())
    assert 1 <= losses["loss/staleness"] <= 3 and 0 < losses["loss/effective_samples"] <= 1
    assert losses["loss/priority_mean"] <= losses["loss/priority_max"]


def by_hand(learner, batch, m, gamma, n, eta):
    """Of sequence m: the errors of its steps behind the burn-in, valid or not, and its priority,
    step by step.
    """
    policy, target = learner.policy, learner.target
    burn_in = learner.replay_settings.burn_in
    q, values = [], []
    for network, found in (policy, q), (target, values):
        state = arrdict(batch.state)[m : m + 1]
        for t in range(learner.length + 1):
            row = batch.obs[t : t + 1, m : m + 1], batch.starts[t : t + 1, m : m + 1]
            out = network.unroll(*row, state)
            state = out.state
            found.append(out.logits[0, 0, 0])
    best = [returns.unscaled(v[one.argmax()]) for one, v in zip(q, values, strict=True)]
    errors, valid = [], []
    for t in range(burn_in, learner.length):
        total, discount = 0.0, 1.0
        for s in range(t, min(t + n, learner.length)):
            total, discount = total + discount * batch.reward[s, m], discount * gamma
            if batch.terminal[s, m] or batch.truncated[s, m]:
                break
        if not batch.terminal[s, m]:
            total = total + discount * best[s + 1]
        errors.append(returns.rescaled(total) - q[t][batch.actions[t, m, 0]])
        valid.append(bool(~batch.starts[t + 1, m] & batch.learns[t, m]))
    sizes = torch.stack(errors).abs()[torch.tensor(valid)]
    return errors, valid, eta * sizes.max() + (1 - eta) * sizes.mean()


@pytest.mark.parametrize("burn_in", [0, 3])
def test_errors_and_priorities_by_hand(burn_in):
    learner, collect = made(burn_in=burn_in, gamma=0.9, return_steps=3, eta=0.7, lr=1e-2)
    updated(learner, collect, 6)  # the networks differ
    learner.replay.flags.rows[5::7, ::2] &= ~2  # and some steps of some lanes do not learn
    batch = learner.replay.sample(5, torch.Generator().manual_seed(0))
    assert not batch.learns[burn_in:-1].all()
    with torch.no_grad():
        loss, metrics, priorities, valid = learner._losses(batch)
        found = [by_hand(learner, batch, m, 0.9, 3, 0.7) for m in range(5)]
    squares, sizes = [], []
    for m, (errors, is_valid, priority) in enumerate(found):
        assert valid[:, m].tolist() == is_valid
        testing.assert_close(priorities[m], priority, rtol=1e-4, atol=1e-5)
        for error, counts in zip(errors, is_valid, strict=True):
            if counts:
                squares.append(batch.weight[m] * error**2)
                sizes.append(error.abs())
    testing.assert_close(loss, torch.stack(squares).mean(), rtol=1e-4, atol=1e-6)
    testing.assert_close(metrics["td_error"], torch.stack(sizes).mean(), rtol=1e-4, atol=1e-6)


def test_the_target_is_the_policy_of_some_steps_ago():
    learner, collect = made(target_period=6, lr=1e-2)
    updated(learner, collect, 1)
    own, target = learner.policy.state_dict(), learner.target.state_dict()
    before = {name: value.clone() for name, value in own.items()}
    updated(learner, collect, 1)  # steps 1 to 4
    first = {name: own[name].clone() for name in target}
    assert all(torch.equal(target[name], before[name]) for name in target)
    updated(learner, collect, 1)  # steps 5 to 8: it is copied before the seventh
    assert not torch.equal(target["core.input.weight"], before["core.input.weight"])
    assert not torch.equal(target["core.input.weight"], first["core.input.weight"])
    assert not torch.equal(target["core.input.weight"], own["core.input.weight"])
    assert all(not leaf.requires_grad for leaf in learner.target.parameters())


def test_a_target_begins_with_the_weights_that_a_run_begins_with():
    learner, collect = made(target_period=1000, lr=1e-30)
    with torch.no_grad():
        learner.policy.output.advantage.weight.add_(3.0)
    updated(learner, collect, 3)
    found = learner.target.output.advantage.weight, learner.policy.output.advantage.weight
    assert torch.equal(*found)


def test_lanes_explore_from_most_to_almost_not():
    found = r2d2.epsilons(9, 0.4, 7.0)
    assert found[0].item() == pytest.approx(0.4) and found[8].item() == pytest.approx(0.4**8)
    testing.assert_close(found.log().diff(), (found[1] / found[0]).log().expand(8))
    assert r2d2.epsilons(1, 0.4, 7.0).tolist() == pytest.approx([0.4])


def test_its_collector_explores_lane_by_lane():
    learner, collect = made(epsilon=0.5, epsilon_spread=100.0)
    with torch.no_grad():
        learner.policy.output.advantage.bias[1] = 99.0
    actions = torch.cat([collect().actions[..., 0].clone() for _ in range(12)])
    others = (actions != 1).float().mean(0)
    assert 0.15 < others[0] < 0.5 and not others[1:].any()


@pytest.mark.parametrize("name", ["obs", "reward"])
def test_a_bad_number_changes_nothing_and_is_never_drawn(name):
    learner, collect = made(lr=1e-2)
    updated(learner, collect, 3)
    learner.update(collect())
    before = {key: value.clone() for key, value in learner.policy.state_dict().items()}
    target = {key: value.clone() for key, value in learner.target.state_dict().items()}
    rollout = collect()
    kept = rollout.floats()[name][2, 3].clone()
    rollout.floats()[name][2, 3] = torch.nan
    losses = learner.update(rollout)
    assert losses["loss/skipped_steps"].item() == 4
    assert all(
        torch.equal(value, before[key]) for key, value in learner.policy.state_dict().items()
    )
    assert all(
        torch.equal(value, target[key]) for key, value in learner.target.state_dict().items()
    )
    bad, n_skipped = learner.check.read(rollout.floats())
    assert (bad.name, bad.lane, n_skipped) == (name, 3, 1)
    rollout.floats()[name][2, 3] = kept
    skipped = [updated(learner, collect, 1)["loss/skipped_steps"].item() for _ in range(12)]
    assert not any(skipped) and weights(learner.policy).isfinite().all()
    assert not torch.equal(
        weights(learner.policy), torch.cat([v.flatten() for v in before.values()])
    )


def test_what_is_saved_is_all_but_what_is_replayed():
    learner, collect = made(lr=1e-2)
    updated(learner, collect, 5)
    file = io.BytesIO()
    torch.save(dict(policy=learner.policy.state_dict(), learner=learner.state_dict()), file)
    file.seek(0)
    saved = torch.load(file, weights_only=True)
    other, again = made(seed=7)
    other.policy.load_state_dict(saved["policy"])
    other.load_state_dict(saved["learner"])
    for part in ("policy", "target"):
        own, theirs = (getattr(x, part).state_dict() for x in (learner, other))
        assert all(torch.equal(own[key], theirs[key]) for key in own)
    assert other.n_taken == learner.n_taken == 16
    updated(other, again, 1)
    assert other.n_taken == 16, "its memory is empty"
    updated(other, again, 1)
    assert other.n_taken == 20


@pytest.mark.parametrize(
    "how, sentence",
    [
        (dict(output="softmax"), "R2D2 needs a policy of action values: agent.output=duelling"),
        (dict(replay=ReplaySettings(burn_in=9, length=9)), "burn_in=9 leaves nothing"),
        (dict(replay=ReplaySettings(capacity=50)), "replay.capacity=50 is too small"),
        (dict(epsilon=0.0), "epsilon"),
    ],
)
def test_what_cannot_be_learnt_with_is_refused_in_a_sentence(how, sentence):
    env, how = Noise(), dict(how)
    output = how.pop("output", "duelling")
    policy = Policy(env.obs_space, env.action_space, width=WIDTH, output=output)
    with pytest.raises(ValueError, match=sentence):
        r2d2.R2D2(policy, n_steps=T, **how).collector(env)


@pytest.mark.cuda
def test_a_captured_update_is_the_eager_one():
    ends = []
    for graph in (False, True):
        learner, collect = made("cuda", graph=graph, target_period=3, width=32)
        losses = updated(learner, collect, 7)
        ends.append((weights(learner.policy), losses["loss/q"], losses["loss/priority_mean"]))
    assert learner.cuda_graph.graph is not None
    testing.assert_close(ends[1], ends[0], rtol=1e-2, atol=1e-3)  # bf16 products, chosen anew


OWN = [word.replace("n_minibatches", "gradient_steps") for word in TINY]
RUN = [*OWN, "learner=r2d2", "learner.replay.burn_in=2", "learner.replay.capacity=320"]


def test_a_run_is_trained_resumed_evaluated_and_used(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert train.main([*RUN, f"samples={4 * UPDATE}", "folder=run", "log_every=1"]) == 0
    state = checkpoint.load_latest(tmp_path / "run" / "checkpoints").state
    assert state["learner"]["n_taken"] == 2 * 3 and "output.advantage.weight" in state["policy"]
    assert train.main(["resume=run", f"samples={6 * UPDATE}"]) == 0
    state = checkpoint.load_latest(tmp_path / "run" / "checkpoints").state
    assert state["learner"]["n_taken"] == 2 * 4, "the first rollout after a resume is only stored"
    assert evaluate.main(["run=run", "episodes=4", "device=cpu"]) == 0
    again = [*RUN, "init=run", f"samples={UPDATE}", "folder=second"]
    assert train.main(again) == 0


@pytest.mark.parametrize(
    "words, sentence",
    [
        (["learner=ppo", "agent.output=duelling"], "PPO needs a policy with a critic"),
        (["agent.output=softmax"], "R2D2 needs a policy of action values"),
        (["learner.replay.burn_in=9", "learner.replay.length=9"], "burn_in=9 leaves nothing"),
        (["learner.replay.capacity=30"], "replay.capacity=30 is too small"),
        (["learner.replay.capacity=1e12"], "observations of learner.replay.capacity need"),
        (["learner.gradient_steps=1000"], "less than a sequence for each of 1,000 gradient steps"),
        (["learner.replay.images=fp8"], "learner.replay.images: 'fp8' is unknown"),
        (["learner.replay.capaciti=9"], "did you mean learner.replay.capacity?"),
    ],
)
def test_bad_settings_end_with_one_sentence(words, sentence, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    given = RUN if words[0] != "learner=ppo" else TINY
    assert train.main([*given, "samples=64", *words]) == 2
    error = capsys.readouterr().err
    assert sentence in error and "Traceback" not in error
