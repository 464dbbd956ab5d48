"""A recorded environment is its kernels: replayed, they give the same bits. What PyTorch computes
in between is refused by name.
"""

import re

import pytest
import torch

from megastep import envs, spaces, toys
from megastep.arrdict import arrdict
from megastep.spaces import random_actions
from megastep.types import n_lanes
from megastep.web.program import Replay
from megastep.web.recording import record
from tests.helpers.web import ENVS, made


@pytest.mark.parametrize("name", ENVS)
def test_replay_is_the_environment(name):
    program, env = record(made(name)), made(name)
    replay, generator, n_ended = Replay(program), torch.Generator().manual_seed(2), 0
    replay.run("reset")
    world = env.reset()
    for t in range(800 if isinstance(env, (envs.Explorer, envs.MiniGrid)) else 150):
        leaves = spaces.leaves(world)
        for path, leaf in replay.world().items():
            assert torch.equal(leaf, leaves[path]), f"{path} in step {t}"
        n_ended += int((world.terminal | world.truncated).sum())
        actions = random_actions(env.action_space, n_lanes(env), generator=generator)
        replay.tensor(program.actions).copy_(actions)
        replay.run("step")
        world = env.step(arrdict(actions=actions))
    assert n_ended > 0


class Doubled(envs.Explorer):
    """Computes outside of kernels."""

    def step(self, decision):
        world = super().step(decision)
        return arrdict(world, reward=world.reward.mul(2))


class Clocked(envs.Explorer):
    """Gives a kernel a number of Python that changes."""

    def step(self, decision):
        self.patience += 1
        return super().step(decision)


class Branching(envs.Explorer):
    """Acts by a clock of Python, in ways that two steps do not show."""

    n_steps = 0

    def step(self, decision):
        self.n_steps += 1
        if self.n_steps > 6:
            self.seen.fill_(0)
        return super().step(decision)


@pytest.mark.parametrize(
    "kind, sentence",
    [
        (Doubled, "PyTorch's operation mul computes between its kernels"),
        (Clocked, "patience of explorer_step changes from step to step"),
        (Branching, "a replay of its kernels differs in .* in step 7"),
        (envs.Minimal, "PyTorch's operation .* computes between its kernels"),
    ],
)
def test_refusals_say_what_computes(kind, sentence):
    with pytest.raises(ValueError, match=re.escape(kind.__name__) + ".*" + sentence):
        record(kind(2, [toys.box()], device="cpu"))


def test_several_actions_and_no_kernels_are_refused():
    env = envs.Minimal(2, [toys.box()], device="cpu")
    env.action_space = {"move": env.action_space}
    with pytest.raises(ValueError, match="several actions at once"):
        record(env)


class Masked(envs.Pong):
    """Allows some actions."""

    def reset(self):
        return arrdict(super().reset(), mask=torch.ones(2, 1, 3, dtype=torch.bool))


def test_masks_and_environments_in_python_are_refused():
    with pytest.raises(ValueError, match="Masked cannot be exported: a page has no action masks"):
        record(Masked(2, device="cpu"))
    pytest.importorskip("gymnasium")
    env = envs.Gymnasium(2, id="CartPole-v1", device="cpu")
    with pytest.raises(ValueError, match="Gymnasium cannot be exported: it steps in Python"):
        record(env)
