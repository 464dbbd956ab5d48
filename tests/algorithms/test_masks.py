"""Action masks: forbidden actions are never taken, and losses are those of what acted."""

import pytest
import torch

from megastep import contract, spaces
from megastep.agents.cli import evaluate, train
from megastep.agents.selfplay.bots.random import RandomActions
from megastep.arrdict import arrdict
from tests.helpers.learners import LEARNERS
from tests.helpers.tiny import TINY

B, N = 6, 5
MOVES = spaces.MultiDiscrete(2, N)
TREE = dict(move=MOVES, turn=spaces.MultiContinuous(1, 2))


class Forbidding:
    """Random masks, which change in every step. The reward counts forbidden actions, and is NaN in
    no case. Episodes last 7 steps.
    """

    obs_space = spaces.MultiVector(1, 3)
    privileged_space = None

    def __init__(self, n_envs=B, device="cpu", action_space=MOVES, seed=1):
        self.n_envs, self.device, self.action_space = n_envs, torch.device(device), action_space
        self.generator = torch.Generator(device).manual_seed(seed)
        self.age = torch.zeros(n_envs, dtype=torch.int64, device=device)
        self.allowed = torch.ones(n_envs, 2, N, dtype=torch.bool, device=device)
        self.n_forbidden = torch.zeros((), dtype=torch.int64, device=device)

    def reset(self):
        self.age.fill_(7)
        return self._world()

    def step(self, decision):
        actions = decision["actions"]
        moves = actions["move"] if isinstance(self.action_space, dict) else actions
        is_forbidden = ~self.allowed.gather(-1, moves[..., None])[..., 0]
        self.n_forbidden += is_forbidden.sum()
        return self._world()

    def _world(self):
        reset = self.age == 7
        self.age.add_(1).masked_fill_(reset, 0)
        options = dict(generator=self.generator, device=self.device)
        obs = torch.randn(self.n_envs, 1, 3, **options)
        scores = torch.rand(self.n_envs, 2, N, **options)
        self.allowed.copy_((scores < 0.4) | (scores == scores.amin(-1, keepdim=True)))
        is_tree, mask = isinstance(self.action_space, dict), self.allowed.clone()
        return arrdict(
            obs=obs,
            reward=obs[:, 0, 0].masked_fill(reset, 0.0),
            reset=reset,
            terminal=torch.zeros_like(reset),
            truncated=self.age == 7,
            mask=arrdict(move=mask) if is_tree else mask,
        )


def run(kind, device="cpu", space=MOVES, n_updates=6, **settings):
    env = Forbidding(device=device, action_space=space)
    policy, learner = LEARNERS[kind].make(env, width=8, **{"n_steps": 8, **settings})
    with torch.no_grad():  # far from uniform, so that masks matter
        for name, p in policy.output.named_parameters():
            if "weight" in name:
                p.mul_(30)
    collect = learner.collector(env)
    losses = [learner.update(collect()) for _ in range(n_updates)]
    return env, policy, losses


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("kind", LEARNERS)
def test_no_learner_takes_a_forbidden_action(kind, device):
    env, policy, losses = run(kind, device, n_minibatches=2)
    assert int(env.n_forbidden) == 0
    assert all(value.isfinite() for value in losses[-1].values())
    world, state = env.reset(), policy.initial(B, device)
    for sample in (True, False) * 5:
        decision, state = policy(world, state, sample)
        world = env.step(decision)
    assert int(env.n_forbidden) == 0


@pytest.mark.parametrize("space", [MOVES, TREE], ids=["moves", "dict"])
@pytest.mark.parametrize("kind", ["ppo", "vtrace"])
def test_the_loss_is_of_the_policy_that_acted(kind, space):
    """In a single gradient step the policy is still the one that acted, so no ratio differs from 1;
    the entropy is below that of all actions.
    """
    settings = dict(n_minibatches=1, n_epochs=1) if kind == "ppo" else dict(n_minibatches=1)
    env, _, losses = run(kind, space=space, n_updates=2, **settings)
    assert int(env.n_forbidden) == 0
    # V-trace's first rollout only tells the size of rewards
    ratio = losses[0]["loss/kl"] if kind == "ppo" else losses[1]["loss/rho"] - 1
    assert abs(float(ratio)) < 1e-6
    if space is MOVES:
        assert 0 < losses[kind == "vtrace"]["loss/entropy"] < 2 * torch.tensor(3.0).log()


def test_random_actions_are_allowed_ones_and_uniform():
    env = Forbidding(n_envs=2000)
    world, policy = env.reset(), RandomActions(MOVES)
    decision, _ = policy(world, policy.initial(2000), generator=torch.Generator().manual_seed(0))
    assert bool(world.mask.gather(-1, decision.actions[..., None]).all())
    pairs = world.mask.sum(-1) == 2
    first = world.mask.int().argmax(-1) == decision.actions
    assert abs(float(first[pairs].float().mean()) - 0.5) < 0.05


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda mask: mask[..., 0], r"mask must be torch.bool \(6, 2, 5\)"),
        (lambda mask: mask.float(), "mask must be torch.bool"),
        (lambda mask: torch.zeros_like(mask), "mask must allow at least one action"),
        (lambda mask: arrdict(jump=mask), "mask.jump is of no discrete action space"),
    ],
)
def test_a_wrong_mask_breaks_the_contract(change, message):
    class Wrong(Forbidding):
        def _world(self):
            world = super()._world()
            return arrdict(world, mask=change(world.mask))

    contract.rollout(Forbidding(), 9)
    with pytest.raises(contract.ContractError, match=message):
        contract.rollout(Wrong(), 2)


@pytest.mark.parametrize(
    "vectorization", ["sync", pytest.param("async", marks=pytest.mark.nightly)]
)
def test_masks_of_gymnasium_reach_training_and_evaluation(vectorization, here):
    """The environment raises an error if a forbidden action is taken."""
    name = "env.id=tests.helpers.masked_gym:Strict-v0"
    words = [*TINY[2:3], *TINY[4:], "env=gymnasium", name]
    more = "samples=640", f"env.vectorization={vectorization}", "folder=run"
    assert train.main([*words, *more]) == 0
    assert evaluate.main(["run=run", "episodes=4", "device=cpu", "baseline=random"]) == 0
