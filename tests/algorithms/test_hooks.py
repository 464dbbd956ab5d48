"""What a user changes in a learner: a loss of one's own, schedules, the optimizer."""

import pathlib
import re
import sys

import pytest
import torch

from megastep import spaces
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.algorithms.vtrace import VTrace
from megastep.agents.cli import evaluate, export, record, train
from megastep.agents.errors import UserError
from megastep.agents.networks.policy import Policy
from megastep.agents.runs import json_lines
from megastep.agents.storage.replay import ReplaySettings
from megastep.arrdict import arrdict
from tests.helpers import headed, pages
from tests.helpers.made_up import PRIVILEGED, Numbers, made_up, weights
from tests.helpers.tiny import ON_GPU, TINY
from tests.helpers.weights import reloaded

PAGE = pages.ROOT / "docs" / "hooks.md"
T = 5
SETTINGS = dict(n_steps=T, n_minibatches=2, lr=1e-2)
REPLAY = ReplaySettings(capacity=2**10, burn_in=1, ratio=2.0)
R2D2 = dict(n_steps=T, gradient_steps=2, lr=1e-2, replay=REPLAY)


def make(kind=PPO, device="cpu", **settings):
    """Returns a policy, its learner and a collector."""
    env = Numbers(device)
    is_r2d2 = issubclass(kind, headed.R2D2)
    output = "duelling" if is_r2d2 else "softmax"
    policy = Policy(env.obs_space, env.action_space, width=8, bf16=False, output=output)
    policy = policy.to(device)
    learner = kind(policy, **{**(R2D2 if is_r2d2 else SETTINGS), **settings})
    return policy, learner, learner.collector(env)


@pytest.mark.parametrize("kind", [headed.Headed, headed.HeadedVTrace, headed.HeadedR2D2])
def test_a_head_of_ones_own_learns_and_is_saved_with_the_learner(kind):
    policy, learner, collect = make(kind)
    before = [parameter.detach().clone() for parameter in learner.extra]
    errors = [learner.update(collect())["loss/reward_error"] for _ in range(6)]
    assert all(error.isfinite() for error in errors[-2:])
    assert all(not torch.equal(a, b) for a, b in zip(before, learner.extra))
    assert not any("head" in name for name in policy.state_dict())
    _, resumed, _ = make(kind)
    resumed.load_state_dict(reloaded(learner.state_dict()))
    assert all(torch.equal(a, b) for a, b in zip(learner.extra, resumed.extra))
    plain = kind.__mro__[2]
    with pytest.raises(ValueError, match="extra_parameters.. have shapes"):
        make(plain)[1].load_state_dict(learner.state_dict() | {"learner": plain.__name__})


@pytest.mark.parametrize("kind", [PPO, VTrace])
def test_the_loss_of_privileged_observations_uses_the_same_door(kind):
    """A learner that only hands on the built-in loss learns what one without a hook does."""

    class HandsOn(kind):
        def extra_loss(self, features, batch):
            return super().extra_loss(features, batch)

    results = []
    for each in (kind, HandsOn):
        policy, rollout = made_up(privileged=PRIVILEGED)
        losses = each(policy, **{**SETTINGS, "n_steps": rollout.n_steps}).update(rollout)
        results.append((weights(policy), losses["loss/auxiliary"], losses["loss/grad_norm"]))
    assert results[0][1] > 0
    for one, other in zip(*results):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)


class Vector(PPO):
    def extra_loss(self, features, batch):
        return features.float().square().mean(-1), {}


class Detached(headed.Headed):
    def extra_loss(self, features, batch):
        return features.detach().float().mean(), {}


class Unused(headed.Headed):
    def extra_loss(self, features, batch):
        return features.float().mean(), {}


class Taken(PPO):
    def extra_loss(self, features, batch):
        loss = features.float().mean()
        return loss, {"kl": loss}


class Wrong(PPO):
    def extra_loss(self, features, batch):
        return batch.no_such_thing


@pytest.mark.parametrize(
    "kind, message",
    [
        (Vector, r"must return tensors of shape \(\), .*, but loss is \(5, "),
        (Detached, r"touches no parameter of extra_parameters\(\)"),
        (Unused, r"touches no parameter of extra_parameters\(\)"),
        (Taken, "the learner has a metric kl itself"),
        (Wrong, "Wrong.extra_loss failed .AttributeError.*no_such_thing"),
    ],
)
def test_a_hook_that_cannot_be_used_is_named(kind, message):
    _, learner, collect = make(kind)
    with pytest.raises(UserError, match=message):
        learner.update(collect())


# ---- Schedules ----


def updated(device, values, graph=False, **settings):
    """Returns the weights after an update for each value of the entropy bonus."""
    torch.manual_seed(0)
    policy, learner, collect = make(device=device, graph=graph, lr=1e-3, **settings)
    rollout, results = collect(), []
    for value in values:
        learner.coefficients.set(entropy_coef=value)
        learner.update(rollout)
        results.append(weights(policy).cpu())
    return results, learner


def test_an_update_follows_a_coefficient_that_is_set_from_outside():
    constant, _ = updated("cpu", [0.0] * 3)
    changed, learner = updated("cpu", [0.0, 0.0, 1.0])
    _, other, _ = make()
    other.load_state_dict(learner.state_dict())
    assert other.coefficients["entropy_coef"] == 1
    assert torch.equal(constant[1], changed[1]) and not torch.equal(constant[2], changed[2])


@pytest.mark.cuda
def test_a_captured_update_follows_a_coefficient():
    """The graph is captured in the third update; the fifth has another coefficient."""
    eager, _ = updated("cuda", [0.0] * 4 + [1.0])
    captured, learner = updated("cuda", [0.0] * 4 + [1.0], graph=True)
    constant, _ = updated("cuda", [0.0] * 5, graph=True)
    assert learner.cuda_graph.graph is not None
    assert torch.equal(captured[3], constant[3]) and not torch.equal(captured[4], constant[4])
    torch.testing.assert_close(captured[4], eager[4], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("words", [TINY, pytest.param(ON_GPU, marks=pytest.mark.cuda)])
def test_a_run_follows_and_logs_schedules(words, here):
    n_samples = 64 * 8 * 8 if words is ON_GPU else 4 * 8 * 8
    schedules = [
        "learner.entropy_coef={from:0.02,to:0.0}",
        "learner.gamma=tests.helpers.headed:falling",
        "learner.lr={from:1e-3,to:0}",
        "learner.warmup=2",
    ]
    assert train.main([*words, *schedules[:2], "samples=9", "learner.lr={from:1,to:-1}"]) == 2
    words = [*words, *schedules, f"samples={n_samples}", "logging.every=1", "folder=run"]
    assert train.main(words) == 0
    rows = json_lines.read("run/metrics.jsonl")
    spent = [i / 8 for i in range(8)]
    assert [row["schedule/entropy_coef"] for row in rows] == pytest.approx(
        [0.02 * (1 - x) for x in spent]
    )
    assert [row["schedule/gamma"] for row in rows] == pytest.approx(
        [0.02 * (1 - x) ** 2 for x in spent]
    )
    rates = [1e-3 * (1 - x) for x in spent]
    rates[0] /= 2
    assert [row["lr"] for row in rows] == pytest.approx(rates)
    assert {row["anneal"] for row in rows} == {"never"}


def test_weights_of_rewards_follow_schedules(here):
    words = [*TINY, "env=pointgoal", "env.cost={from:1,to:0}", "samples=256", "logging.every=1"]
    assert train.main([*words, "folder=run"]) == 0
    rows = json_lines.read("run/metrics.jsonl")
    assert [row["schedule/cost"] for row in rows] == pytest.approx([1 - i / 8 for i in range(8)])


@pytest.mark.parametrize(
    "word, message",
    [
        ("learner.n_steps={from:1,to:2}", "learner.n_steps: is one value, not a schedule"),
        ("learner.max_grad_norm={from:1,to:2}", "max_grad_norm: is one value, not a schedule"),
        ("learner.gamma={from:0.9,to:1.5}", "gamma: 1.5 is out of range: allowed is from 0 to 1"),
        ("learner.gamma={from:0.9}", "expected a number, got {'from': 0.9}; a schedule is"),
        ("learner.gamma=tests.helpers.headed:rises", "1.5 is out of range"),
        ("learner.gamma=tests.helpers.headed:nothing", "has no nothing"),
        ("learner.gamma=fast", "expected a number"),
        ("learner.optimizer=adan", "learner.optimizer: .*adam"),
        ("learner.optimizer=os:getcwd", "cannot be made from groups of parameters"),
    ],
)
def test_what_is_no_schedule_and_no_optimizer_is_refused(word, message, here, capsys):
    assert train.main([*TINY, word, "samples=64", "folder=run"]) == 2
    text = capsys.readouterr().err
    assert message in text or re.search(message, text), text
    assert not (here / "run").exists()


def test_a_schedule_needs_a_budget_and_the_learning_rate_one_master(here, capsys):
    for words, message in (
        (["learner.gamma={from:0.9,to:1}"], "learner.gamma: is a schedule over the budget"),
        (
            ["learner.lr={from:1,to:0.1}", "samples=64", "learner.anneal=samples"],
            "learner.anneal: is samples, but learner.lr is a schedule",
        ),
        (
            ["learner.desired_kl=0.01", "learner.warmup=3", "samples=64"],
            "cannot be combined with warmup",
        ),
    ):
        assert train.main([*TINY, *words, "folder=run"]) == 2
        assert message in capsys.readouterr().err


# ---- Optimizers ----


@pytest.mark.parametrize("name", ["adam", "torch.optim:RMSprop"])
def test_optimizers_learn_and_resume_bit_for_bit(name):
    settings = dict(optimizer=name, weight_decay=0.01, desired_kl=0.01)
    policy, learner, collect = make(**settings)
    start = weights(policy)
    for _ in range(3):
        learner.update(collect())
    assert not torch.equal(weights(policy), start)
    assert learner.optimizer.capturable == (":" not in name)
    other, resumed, _ = make(**settings)
    other.load_state_dict(reloaded(policy.state_dict()))
    resumed.load_state_dict(reloaded(learner.state_dict()))
    rollout = collect()
    learner.update(rollout)
    resumed.update(rollout)
    assert torch.equal(weights(policy), weights(other)) and learner.read_lr() == resumed.read_lr()


def test_the_step_size_follows_the_kl_divergence():
    """rsl_rl's rule: divided by 1.5 above twice the desired divergence, multiplied below half."""
    _, learner, collect = make(desired_kl=0.01, lr=9e-3)
    steps = learner.steps
    steps.begin(collect().floats())
    for kl, lr in (
        (0.021, 6e-3),
        (0.019, 6e-3),
        (0.004, 9e-3),
        (0.004, 1e-2),
        (0.0, 1e-2),
        (float("nan"), 1e-2),
    ):
        steps.follow_kl(torch.tensor(kl), 0.01)
        assert learner.read_lr() == pytest.approx(lr), kl
    for _ in range(30):
        steps.follow_kl(torch.tensor(1.0), 0.01)
    assert learner.read_lr() == pytest.approx(1e-5)


def test_a_head_is_not_needed_to_play(here):
    """Only training needs the learner's class, which may be gone afterwards."""
    module = here / "mine.py"
    module.write_text(pathlib.Path(headed.__file__).read_text())
    words = [*TINY, "learner=mine:Headed", "callbacks=[]", "samples=64", "folder=run"]
    assert train.main(words) == 0
    module.unlink()
    sys.modules.pop("mine")
    assert evaluate.main(["run=run", "episodes=4", "device=cpu", "baseline=none"]) == 0
    assert record.main(["run=run", "steps=2", "file=a.png", "device=cpu"]) == 0
    assert export.main(["run=run", "format=safetensors", "file=a.safetensors"]) == 0
    assert train.main([*TINY, "init=run", "samples=32", "folder=other"]) == 0


def test_commands_and_code_of_the_page_work(here, monkeypatch):
    text = PAGE.read_text()
    learner, schedule = pages.code(text)
    (here / "my_ppo.py").write_text(learner)
    (here / "my_schedules.py").write_text(schedule)
    with pages.inside(here, monkeypatch):
        for _, words in pages.commands(text):
            small = "env.n_envs=4", "env.res=8", "agent.width=8", "samples=128"
            assert train.main([*words, *small, "geometry=box", "device=cpu"]) == 0, words


def test_fields_of_a_rollout_have_the_shapes_that_the_page_says():
    _, rollout = made_up(privileged=PRIVILEGED)
    mask = torch.ones(rollout.n_lanes, 1, 2, dtype=torch.bool)
    rollout.allocate_optional(arrdict(metrics=arrdict(age=rollout.reward[0]), mask=mask))
    rollout.allocate_layouts()
    sizes, named = {"T": rollout.n_steps, "T+1": rollout.n_steps + 1, "B": rollout.n_lanes}, set()
    for names, shape in re.findall(r"^\| (`.+?) \| \((.+?)\) \|", PAGE.read_text(), re.M):
        lead = tuple(sizes[axis] for axis in shape.split(", ") if axis in sizes)
        for name in re.findall(r"\w+", names):
            named.add(name)
            for leaf in spaces.leaves(getattr(rollout, name)).values():
                assert leaf.shape[: len(lead)] == lead, name
    tensors = {name for name, value in vars(rollout).items() if isinstance(value, torch.Tensor)}
    assert named >= tensors | {"obs", "privileged", "metrics", "state", "reset", "mask"}
