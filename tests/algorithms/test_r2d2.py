"""R2D2's update. test_learners.py tests what all learners have in common."""

import pytest
import torch
from torch import testing

from megastep import spaces
from megastep.agents.algorithms import r2d2, returns
from megastep.agents.cli import evaluate, train
from megastep.agents.networks.policy import Policy
from megastep.agents.runs import checkpoint
from megastep.agents.storage.replay import ReplaySettings
from megastep.arrdict import arrdict
from tests.helpers.made_up import weights
from tests.helpers.tiny import TINY, UPDATE

B, T, WIDTH = 6, 8, 16


class Noise:
    """Random observations; action 2 has reward 1. An episode ends after each step with probability
    1/8: terminal in lane 0, truncated in the others.
    """

    n_envs, n_agents = B, 1
    obs_space, action_space = spaces.MultiVector(1, 4), spaces.MultiDiscrete(1, 3)

    def __init__(self, device="cpu"):
        self.device = torch.device(device)
        self.generator = torch.Generator(device).manual_seed(0)
        self.ended = torch.zeros(B, dtype=torch.bool, device=device)

    def reset(self):
        return self._world(torch.zeros(B, device=self.device), torch.ones_like(self.ended))

    def step(self, decision):
        reward = (decision["actions"][:, 0] == 2).float()
        return self._world(reward.masked_fill(self.ended, 0.0), self.ended)

    def _world(self, reward, reset):
        options = dict(generator=self.generator, device=self.device)
        self.ended = (torch.rand(B, **options) < 1 / 8) & ~reset
        is_first = torch.arange(B, device=self.device) == 0
        return arrdict(
            obs=torch.randn(B, 1, 4, **options),
            reward=reward,
            reset=reset,
            terminal=self.ended & is_first,
            truncated=self.ended & ~is_first,
        )


SETTINGS = dict(
    n_steps=T,
    lr=3e-4,
    gamma=0.99,
    return_steps=5,
    target_period=100,
    epsilon_spread=7.0,
    gradient_steps=4,
)


def make(device="cpu", width=WIDTH, seed=1, burn_in=3, **settings):
    """Returns a learner and its collector. Sequences have 11 steps."""
    env = Noise(device)
    policy = Policy(env.obs_space, env.action_space, width=width, output="duelling", seed=seed)
    replay = ReplaySettings(capacity=6 * T * B, burn_in=burn_in, alpha=0.9)
    settings = {**SETTINGS, "replay": replay, **settings}
    learner = r2d2.R2D2(policy.to(device), seed=seed, **settings)
    return learner, learner.collector(env)


def update(learner, collect, n):
    """Performs n updates and returns the metrics of the last."""
    for _ in range(n):
        losses = learner.update(collect())
    return losses


def test_no_learning_before_first_whole_sequence():
    learner, collect = make()  # 11 steps and the next observation need two rollouts
    before = weights(learner.policy)
    losses = update(learner, collect, 1)
    assert torch.equal(weights(learner.policy), before) and learner.n_taken == 0
    priorities, skipped = ("loss/priority_max", "loss/priority_mean"), "loss/skipped_steps"
    for name, value in losses.items():
        # a mean over no step has no value; nothing is stored yet and nothing was skipped
        assert value == 0 if name in (*priorities, skipped) else value.isnan(), name
    assert not learner.check.read({})[1]
    update(learner, collect, 1)
    assert not torch.equal(weights(learner.policy), before) and learner.n_taken == 4


def by_hand(learner, batch, m, gamma, n, eta):
    """Computes step by step, for sequence m: the errors after the burn-in, whether they are valid,
    and the priority.
    """
    policy, target = learner.policy, learner.target
    burn_in = learner.replay_settings.burn_in
    q, values = [], []
    for network, outputs in (policy, q), (target, values):
        state = arrdict(batch.state)[m : m + 1]
        for t in range(learner.length + 1):
            row = batch.obs[t : t + 1, m : m + 1], batch.starts[t : t + 1, m : m + 1]
            out = network.unroll(*row, state)
            state = out.state
            outputs.append(out.logits[0, 0, 0])
    best = [returns.inverse_rescale(v[row.argmax()]) for row, v in zip(q, values, strict=True)]
    errors, valid = [], []
    for t in range(burn_in, learner.length):
        total, discount = 0.0, 1.0
        for s in range(t, min(t + n, learner.length)):
            total, discount = total + discount * batch.reward[s, m], discount * gamma
            if batch.terminal[s, m] or batch.truncated[s, m]:
                break
        if not batch.terminal[s, m]:
            total = total + discount * best[s + 1]
        errors.append(returns.rescale(total) - q[t][batch.actions[t, m, 0]])
        valid.append(bool(~batch.starts[t + 1, m] & batch.learns[t, m]))
    sizes = torch.stack(errors).abs()[torch.tensor(valid)]
    return errors, valid, eta * sizes.max() + (1 - eta) * sizes.mean()


@pytest.mark.parametrize("burn_in", [0, 3])
def test_errors_and_priorities_match_hand_calculation(burn_in):
    learner, collect = make(burn_in=burn_in, gamma=0.9, return_steps=3, eta=0.7, lr=1e-2)
    update(learner, collect, 6)  # after which the target differs from the policy
    learner.replay_buffer.flags[5::7, ::2] &= ~2  # some steps do not learn
    batch = learner.replay_buffer.sample(5, torch.Generator().manual_seed(0))
    assert not batch.learns[burn_in:-1].all()
    with torch.no_grad():
        loss, metrics, priorities, n_valid = learner._losses(batch)
        expected = [by_hand(learner, batch, m, 0.9, 3, 0.7) for m in range(5)]
    squares, sizes = [], []
    assert n_valid == sum(sum(is_valid) for _, is_valid, _ in expected)
    for m, (errors, is_valid, priority) in enumerate(expected):
        testing.assert_close(priorities[m], priority, rtol=1e-4, atol=1e-5)
        for error, counts in zip(errors, is_valid, strict=True):
            if counts:
                squares.append(batch.weight[m] * error**2)
                sizes.append(error.abs())
    testing.assert_close(loss, torch.stack(squares).mean(), rtol=1e-4, atol=1e-6)
    testing.assert_close(metrics["td_error"], torch.stack(sizes).mean(), rtol=1e-4, atol=1e-6)


def test_target_is_copied_every_target_period():
    learner, collect = make(target_period=6, lr=1e-2)
    update(learner, collect, 1)
    policy, target = learner.policy.state_dict(), learner.target.state_dict()
    before = {name: value.clone() for name, value in policy.items()}
    update(learner, collect, 1)  # steps 1 to 4
    first = {name: policy[name].clone() for name in target}
    assert all(torch.equal(target[name], before[name]) for name in target)
    update(learner, collect, 1)  # steps 5 to 8; the target is copied before step 7
    assert not torch.equal(target["core.input.weight"], before["core.input.weight"])
    assert not torch.equal(target["core.input.weight"], first["core.input.weight"])
    assert not torch.equal(target["core.input.weight"], policy["core.input.weight"])
    assert all(not leaf.requires_grad for leaf in learner.target.parameters())


def test_target_starts_with_loaded_weights():
    learner, collect = make(target_period=1000, lr=1e-30)
    with torch.no_grad():
        learner.policy.output.advantage.weight.add_(3.0)
    update(learner, collect, 3)
    outputs = learner.target.output, learner.policy.output
    assert torch.equal(*(output.advantage.weight for output in outputs))


def test_epsilons_fall_from_lane_to_lane():
    epsilon = r2d2.epsilons(9, 0.4, 7.0)
    assert epsilon[0].item() == pytest.approx(0.4) and epsilon[8].item() == pytest.approx(0.4**8)
    testing.assert_close(epsilon.log().diff(), (epsilon[1] / epsilon[0]).log().expand(8))
    assert r2d2.epsilons(1, 0.4, 7.0).tolist() == pytest.approx([0.4])


def test_collector_uses_epsilon_per_lane():
    learner, collect = make(epsilon=0.5, epsilon_spread=100.0)
    with torch.no_grad():
        learner.policy.output.advantage.bias[1] = 99.0
    actions = torch.cat([collect().actions[..., 0].clone() for _ in range(12)])
    random = (actions != 1).float().mean(0)
    assert 0.15 < random[0] < 0.5 and not random[1:].any()


@pytest.mark.cuda
@pytest.mark.parametrize("core", ["lstm", "gru"])
def test_fused_update_matches_the_cpus(core):
    """The same minibatch has the same loss, priorities and gradients, but for bfloat16."""
    torch.manual_seed(0)
    results = []
    for device in ("cpu", "cuda"):
        env = Noise(device)
        policy = Policy(env.obs_space, env.action_space, width=64, core=core, output="duelling")
        learner = r2d2.R2D2(policy.to(device), **SETTINGS, replay=ReplaySettings(burn_in=3))
        batch = drawn_batch(learner.length, 40, policy)
        batch = batch.map(lambda leaf, device=device: leaf.to(device))
        result = learner._losses(batch)
        gradients = torch.autograd.grad(result.loss, list(policy.parameters()))
        results.append([result.loss, result.priorities, *gradients])
        assert result.n_valid == (~batch.starts[4:] & batch.learns[3:-1]).sum()
    for i, (plain, fused) in enumerate(zip(*results, strict=True)):
        # 8 bits, over the steps of a sequence; a ReLU's input near 0 may change its sign
        error = (fused.cpu() - plain).norm() / plain.norm()
        assert error < 0.2, (i, error)


def drawn_batch(length, n_sequences, policy):
    """Returns random sequences like those of a replay buffer."""
    generator = torch.Generator().manual_seed(0)
    rows, with_last = (length, n_sequences), (length + 1, n_sequences)

    def flags(shape):
        return torch.rand(shape, generator=generator) < 0.1

    return arrdict(
        obs=torch.randn(*with_last, 1, 4, generator=generator).half(),
        starts=flags(with_last),
        learns=~flags(with_last),
        actions=torch.randint(3, (*rows, 1), generator=generator),
        reward=torch.randn(rows, generator=generator),
        terminal=flags(rows),
        truncated=torch.zeros(rows, dtype=torch.bool),
        state=policy.initial(n_sequences, "cpu"),
        weight=torch.rand(n_sequences, generator=generator),
        age=torch.arange(n_sequences),
    )


TINY_R2D2 = [word.replace("n_minibatches", "gradient_steps") for word in TINY]
RUN = [*TINY_R2D2, "learner=r2d2", "learner.replay.burn_in=2", "learner.replay.capacity=320"]


def test_train_resume_evaluate_and_init(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert train.main([*RUN, f"samples={4 * UPDATE}", "folder=run", "logging.every=1"]) == 0
    state = checkpoint.load_latest(tmp_path / "run" / "checkpoints").state
    assert state["learner"]["n_taken"] == 2 * 3 and "output.advantage.weight" in state["policy"]
    assert train.main(["resume=run", f"samples={6 * UPDATE}"]) == 0
    state = checkpoint.load_latest(tmp_path / "run" / "checkpoints").state
    assert state["learner"]["n_taken"] == 2 * 5, "the replay buffer continues, too"
    assert evaluate.main(["run=run", "episodes=4", "device=cpu"]) == 0
    assert train.main([*RUN, "init=run", f"samples={UPDATE}", "folder=second"]) == 0


@pytest.mark.parametrize(
    "words, cure",
    [
        (["learner=ppo", "agent.output=duelling"], "agent.output=softmax"),
        (["agent.output=softmax"], "agent.output=duelling"),
        (["learner.replay.capacity=30"], "replay.capacity=30"),
        (["learner.gradient_steps=1000"], "fewer gradient_steps"),
    ],
)
def test_command_line_refuses_bad_settings(words, cure, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    base = RUN if words[0] != "learner=ppo" else TINY
    assert train.main([*base, "samples=64", *words]) == 2
    error = capsys.readouterr().err
    assert cure in error and "Traceback" not in error
