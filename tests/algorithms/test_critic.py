"""The asymmetric critic: what it is told reaches the value, the rollout and the memory's lessons,
and never what is done.
"""

import math

import pytest
import torch
from test_train import configured

from megastep import envs, spaces
from megastep.agents.algorithms import ppo
from megastep.agents.cli import evaluate, record, train
from megastep.agents.cli.errors import ConfigErrors, UserError
from megastep.agents.networks.critic import Critic
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.rollout import Collector, Rollout, collect, initial_actor_state
from megastep.agents.training import checkpoint
from megastep.arrdict import arrdict, stack
from megastep.capture import state_tree

T, B, WIDTH = 8, 6, 16
OBS, MOVES = arrdict(eye=spaces.MultiVector(1, 4)), spaces.MultiDiscrete(1, 3)
TOLD = arrdict(episode=spaces.MultiVector(1, 2), unseen=spaces.MultiVector(1, 5))


def policy_of(critic="asymmetric", seed=0):
    """A policy far from uniform, so that whatever reached the logits would show."""
    policy = Policy(OBS, MOVES, TOLD, width=WIDTH, critic=critic, seed=seed)
    with torch.no_grad():
        policy.output.linear.weight.mul_(100)
    return policy


def values_of(tree, *lead, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return tree.map(lambda space: torch.randn(*lead, *space.shape, generator=generator))


def world_of(privileged=None, seed=0):
    """A world of B lanes, some of which begin."""
    world = arrdict(obs=values_of(OBS, B, seed=seed), reset=torch.arange(B) % 2 == 0)
    return world if privileged is None else arrdict(world, privileged=privileged)


# ---- Acting ----


TELLINGS = {
    "zeros": lambda: values_of(TOLD, B) * 0,
    "numbers": lambda: values_of(TOLD, B, seed=3) * 1e3,
    "NaN": lambda: values_of(TOLD, B) * math.nan,
    "infinite": lambda: values_of(TOLD, B) * math.inf,
    "nothing": lambda: None,
}


@pytest.mark.parametrize("told", TELLINGS)
def test_what_is_told_changes_no_bit_of_what_is_done(told):
    """Five steps, in which it could pass through the memory as well."""
    runs = []
    for privileged in (values_of(TOLD, B, seed=9), TELLINGS[told]()):
        policy = policy_of()
        state, decisions = policy.initial(B), []
        for t in range(5):
            decision, state = policy(world_of(privileged, seed=t), state)
            decisions.append(decision)
        runs.append((stack(decisions), state))
    (first, first_state), (second, second_state) = runs
    for name in first:
        assert torch.equal(first[name], second[name]), name
    assert torch.equal(first_state.cell, second_state.cell)
    assert len(first.actions.unique()) == 3


def test_no_gradient_leads_from_what_is_done_to_what_is_told():
    policy, told = policy_of(), values_of(TOLD, B).map(torch.Tensor.requires_grad_)
    decision, _ = policy(world_of(told), policy.initial(B))
    for acted in (decision.logits, decision.logprobs, decision.features):
        grads = torch.autograd.grad(
            acted.sum(), list(told.values()), retain_graph=True, allow_unused=True
        )
        assert grads == (None, None)
    value = policy.value(decision.features, told)
    assert all(grad.any() for grad in torch.autograd.grad(value.sum(), list(told.values())))


def test_the_actors_gradient_reaches_no_weight_of_the_critic():
    policy = policy_of()
    decision, _ = policy(world_of(values_of(TOLD, B)), policy.initial(B))
    decision.logprobs.sum().backward()
    reached = {name.split(".")[0] for name, p in policy.named_parameters() if p.grad is not None}
    assert reached == {"intake", "core", "output"}


def test_who_only_acts_needs_no_critic_and_does_the_same():
    trained, actor = policy_of("asymmetric", seed=1), policy_of(None, seed=2)
    weights = trained.state_dict()
    actor.load_state_dict({name: weights[name] for name in actor.state_dict()})
    assert not any(name.startswith(("critic", "prediction")) for name in actor.state_dict())
    told, untold = world_of(values_of(TOLD, B)), world_of()
    (ours, _), (theirs, _) = (
        policy(world, policy.initial(B), sample=False)
        for policy, world in ((trained, told), (actor, untold))
    )
    assert torch.equal(ours.actions, theirs.actions) and torch.equal(ours.logits, theirs.logits)


@pytest.mark.parametrize("critic", ["asymmetric", "plain", None])
def test_the_actors_first_weights_are_the_same_whatever_the_critic(critic):
    ours, theirs = policy_of(critic).state_dict(), policy_of("asymmetric").state_dict()
    actors = [name for name in ours if not name.startswith(("critic", "prediction"))]
    assert actors and all(torch.equal(ours[name], theirs[name]) for name in actors)


def test_another_critic_is_refused():
    with pytest.raises(ValueError, match="critic: 'foo' is unknown; there are asymmetric, plain"):
        policy_of("foo")


# ---- The value ----


def test_an_asymmetric_critic_values_what_it_is_told_and_a_plain_one_does_not():
    features = torch.randn(T, B, WIDTH)
    one, other = values_of(TOLD, T, B, seed=1), values_of(TOLD, T, B, seed=2)
    policy = policy_of()
    values = [policy.value(features, told) for told in (one, other)]
    assert values[0].shape == (T, B) and not (values[0] == values[1]).any()
    plain = policy_of("plain")
    values = [plain.value(features, told) for told in (one, one * math.nan, None)]
    assert torch.equal(values[0], values[1]) and torch.equal(values[0], values[2])
    assert plain.privileged_space is None and not hasattr(plain, "prediction")


def test_where_nothing_is_told_both_critics_are_the_same():
    asymmetric, plain = (
        Policy(OBS, MOVES, critic=critic, width=WIDTH) for critic in ("asymmetric", "plain")
    )
    ours, theirs = asymmetric.state_dict(), plain.state_dict()
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[k], theirs[k]) for k in ours)


def test_a_critic_takes_a_bare_value_too():
    critic = Critic(WIDTH, spaces.MultiVector(1, 3))
    assert critic(torch.randn(B, WIDTH), torch.randn(B, 1, 3)).shape == (B,)


# ---- The memory's lessons ----


def test_a_prediction_error_teaches_the_features_and_not_the_critic():
    policy, told = policy_of(), values_of(TOLD, T, B)
    features = torch.randn(T, B, WIDTH, requires_grad=True)
    error = policy.prediction_error(features, told)
    assert error.shape == (T, B)
    error.sum().backward()
    assert features.grad.any()
    reached = {name for name, p in policy.named_parameters() if p.grad is not None}
    assert reached == {"prediction.weight", "prediction.bias"}


def test_a_prediction_error_is_measured_in_standard_deviations():
    policy, told = policy_of(), values_of(TOLD, 500, B, seed=4) * 30 + 7
    for row in range(500):
        policy.update_stats(values_of(OBS, B), told[row])
    with torch.no_grad():
        policy.prediction.weight.zero_()
        policy.prediction.bias.zero_()
    # to say nothing is to be one standard deviation off
    error = policy.prediction_error(torch.randn(500, B, WIDTH), told).mean()
    assert error.item() == pytest.approx(1, abs=0.05)


# ---- Rollouts and updates ----


class Telling:
    """Shows nothing, and tells the critic 100 b + t in lane b at time t; an episode lasts three
    steps. It is a float that half precision has no room for.
    """

    obs_space, action_space, privileged_space = OBS, MOVES, TOLD

    def __init__(self, device="cpu"):
        self.device = device
        self.time = torch.zeros((), dtype=torch.int64, device=device)
        self.lanes = 100.0 * torch.arange(B, device=device)

    def reset(self):
        return self._world()

    def step(self, decision):
        self.time += 1
        return self._world()

    def _world(self):
        none = torch.zeros(B, dtype=torch.bool, device=self.device)
        label = (self.lanes + self.time + 1 / 512).view(B, 1, 1)
        return arrdict(
            obs=arrdict(eye=torch.zeros(B, 1, 4, device=self.device)),
            privileged=arrdict(episode=label.expand(B, 1, 2), unseen=label.expand(B, 1, 5)),
            reward=label.flatten() / 100,
            reset=none | (self.time % 4 == 0),
            terminal=none | (self.time % 4 == 3),
            truncated=none,
        )


def rollout_of(policy, device="cpu"):
    return Rollout(T, B, OBS, MOVES, policy.initial(B), device, policy.privileged_space)


def test_a_rollout_holds_what_the_critic_was_told_in_single_precision():
    env, policy = Telling(), policy_of()
    rollout = rollout_of(policy)
    actor_state = initial_actor_state(env, policy, rollout)
    for _ in range(2):
        actor_state = collect(env, policy, rollout, actor_state)
    lanes, times = 100.0 * torch.arange(B), T + torch.arange(T + 1)
    expected = lanes + times[:, None] + 1 / 512
    for values in rollout.privileged.values():
        assert values.dtype == torch.float32
        assert torch.equal(values[:, :, 0, 0], expected)
    rows = torch.tensor([4, 1])
    assert torch.equal(rollout.sequences(rows).privileged.unseen[..., 0, 4], expected[:, rows])
    out = policy.unroll(rollout.obs, rollout.starts, rollout.state)
    # products in another order, of numbers up to 600
    valued = policy.value(out.features, rollout.privileged)
    torch.testing.assert_close(rollout.values, valued, rtol=1e-4, atol=1e-4)


def test_a_plain_policys_rollout_stores_nothing_of_it():
    env, policy = Telling(), policy_of("plain")
    rollout = rollout_of(policy)
    collect(env, policy, rollout, initial_actor_state(env, policy, rollout))
    assert rollout.privileged is None and "privileged" not in rollout.sequences(torch.tensor([0]))
    assert not any("privileged" in name for name in rollout.floats())


def collected(critic="asymmetric"):
    """A policy, and a rollout that it collected."""
    env, policy = Telling(), policy_of(critic)
    rollout = rollout_of(policy)
    collect(env, policy, rollout, initial_actor_state(env, policy, rollout))
    return policy, rollout


def test_an_update_learns_how_what_is_told_is_spread():
    policy, rollout = collected()
    metrics = ppo.PPO(policy).update(rollout)
    assert metrics["loss/auxiliary"] > 0
    for norm, values in zip(policy.critic.intake.norms, rollout.privileged.values(), strict=True):
        torch.testing.assert_close(norm.mean, values[-1].mean(0))


@pytest.mark.parametrize("critic, coef", [("asymmetric", 0.0), ("plain", 0.5)])
def test_without_an_auxiliary_loss_the_prediction_stays_as_it_was(critic, coef):
    policy, rollout = collected(critic)
    before = {name: weight.clone() for name, weight in policy.state_dict().items()}
    metrics = ppo.PPO(policy, auxiliary_coef=coef).update(rollout)
    after = policy.state_dict()
    assert all(torch.equal(after[k], before[k]) for k in after if k.startswith("prediction"))
    assert not torch.equal(after["core.recurrent.weight"], before["core.recurrent.weight"])
    assert ("loss/auxiliary" in metrics) == (critic == "asymmetric")


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e30])
def test_a_bad_number_that_a_critic_is_told_is_named_and_changes_no_bit(value):
    policy, rollout = collected()
    learner = ppo.PPO(policy, n_minibatches=B)
    before = {name: weight.clone() for name, weight in policy.state_dict().items()}
    rollout.privileged.episode[2, 3, 0, 1] = value
    learner.update(rollout)
    after = policy.state_dict()
    assert all(torch.equal(after[name], before[name]) for name in before)
    bad, n_skipped = learner.check.read(rollout.floats())
    assert (bad.name, bad.lane, bad.step) == ("privileged.episode", 3, 3) and n_skipped == 1
    assert str(bad).startswith("privileged.episode of lane 3 was ") and bad.is_from_env


def test_a_collector_keeps_what_is_told_in_its_own_memory():
    env, policy = Telling(), policy_of()
    rollout = rollout_of(policy)
    collector, before = Collector(env, policy, rollout), state_tree(rollout)
    for _ in range(3):
        collector()
    after = state_tree(rollout)
    assert ".privileged['episode']" in after and all(before[path] is after[path] for path in after)


@pytest.mark.cuda
def test_a_captured_collector_tells_what_an_eager_one_does():
    tellings = []
    for is_captured in (False, True):
        env, policy = Telling("cuda"), policy_of().cuda()
        rollout = rollout_of(policy, "cuda")
        collector = Collector(env, policy, rollout)
        collector.on_gpu = is_captured
        for _ in range(4):
            collector()
        assert (collector.graph is not None) == is_captured
        tellings.append((rollout.privileged.episode.clone(), rollout.values.clone()))
    assert torch.equal(tellings[0][0], tellings[1][0])
    # bf16 products, kernels chosen anew
    torch.testing.assert_close(tellings[0][1], tellings[1][1], rtol=2e-2, atol=2e-2)


@pytest.mark.cuda
def test_an_update_with_an_asymmetric_critic_never_synchronises():
    env, policy = Telling("cuda"), policy_of().cuda()
    rollout = rollout_of(policy, "cuda")
    Collector(env, policy, rollout)()
    learner = ppo.PPO(policy, n_minibatches=2)
    learner.update(rollout)
    torch.cuda.set_sync_debug_mode("error")
    try:
        learner.update(rollout)
    finally:
        torch.cuda.set_sync_debug_mode("default")


# ---- The command line ----


EXPLORER = [
    "env=explorer",
    "geometry=box",
    "preset=cpu",
    "env.n_envs=4",
    "env.res=8",
    "env.patience=3",
    "learner.n_steps=8",
    "learner.n_minibatches=2",
    "agent.width=8",
    "device=cpu",
    "log_every=1",
]
UPDATE = 4 * 8  # samples


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def trained(*overrides):
    return train.run(configured(*overrides, tiny=EXPLORER))


def weights(run):
    return checkpoint.load_latest(run / "checkpoints").state["policy"]


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("critic", ["asymmetric", "plain"])
def test_a_run_trains_goes_on_is_evaluated_and_filmed_and_another_begins_with_it(
    critic, monkeypatch
):
    run = trained(f"samples={2 * UPDATE}", f"agent.critic={critic}")
    has_intake = "critic.intake.project.weight" in weights(run)
    assert has_intake == ("prediction.weight" in weights(run)) == (critic == "asymmetric")
    again = configured(f"resume={run}", f"samples={3 * UPDATE}", tiny=[])
    assert again.agent.critic == critic and train.run(again) == run
    assert checkpoint.load_latest(run / "checkpoints").step == 3 * UPDATE
    second = trained("samples=1", "learner.lr=1e-12", f"init={run}", f"agent.critic={critic}")
    first = "intake.project.weight"
    torch.testing.assert_close(weights(second)[first], weights(run)[first], rtol=0, atol=1e-6)

    # whoever only plays does not ask what a critic would be told
    monkeypatch.setattr(envs.Explorer, "_privileged", None)
    assert evaluate.main([f"run={run}", "episodes=3", "baseline=false", "device=cpu"]) == 0
    pytest.importorskip("av")
    assert record.main([f"run={run}", "steps=1", "device=cpu"]) == 0


@pytest.mark.usefixtures("folder")
def test_a_plain_critic_asks_for_nothing(monkeypatch):
    monkeypatch.setattr(envs.Explorer, "_privileged", None)
    trained("samples=1", "agent.critic=plain")
    with pytest.raises(TypeError):
        trained("samples=1", "agent.critic=asymmetric")


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("had, given", [("asymmetric", "plain"), ("plain", "asymmetric")])
def test_a_run_cannot_begin_with_another_kind_of_critic(had, given):
    run = trained("samples=1", f"agent.critic={had}")
    with pytest.raises(
        UserError, match=f"^The critic of .*step_32 is {had} and .* is {given}: .*critic={had}$"
    ):
        trained("samples=1", f"init={run}", f"agent.critic={given}")


@pytest.mark.usefixtures("folder")
def test_where_nothing_is_told_a_run_begins_with_either_kind():
    shape = "env=minimal", "env.n_envs=4", "env.res=8"
    minimal = [word for word in EXPLORER if not word.startswith("env")] + [*shape, "samples=1"]
    run = train.run(configured("agent.critic=asymmetric", tiny=minimal))
    train.run(configured(f"init={run}", "agent.critic=plain", tiny=minimal))


@pytest.mark.parametrize(
    "word, error",
    [
        ("agent.critic=foo", "agent.critic: .*foo.* asymmetric"),
        ("env.privileged=true", "env.privileged: no such key"),
        ("learner.auxiliary_coef=-1", "learner.auxiliary_coef: .*-1.* out of range"),
    ],
)
def test_a_critic_that_is_none_is_refused(word, error):
    with pytest.raises(ConfigErrors, match=error):
        configured(word, tiny=EXPLORER)


def test_memory_is_reckoned_with_layers():
    env = Telling()
    env.n_agents = 1
    policies = [Policy(OBS, MOVES, width=WIDTH, critic="plain", layers=n) for n in (1, 2)]
    one, two = (
        ppo.PPO(policy, n_steps=T, n_minibatches=2).bytes_per_env(env) for policy in policies
    )
    # 8 numbers of 4 bytes per unit, in a minibatch of half of 9 rows
    assert two - one == 8 * 4 * WIDTH * 9 / 2


def test_memory_is_reckoned_with_what_is_told():
    env = Telling()
    env.n_agents = 1
    told, plain = (
        ppo.PPO(policy_of(critic), n_steps=T, n_minibatches=2).bytes_per_env(env)
        for critic in ("asymmetric", "plain")
    )
    # 2 + 5 numbers of 4 bytes, 9 rows of them and half of those again in a minibatch
    assert told - plain == 7 * 4 * 9 * 1.5
