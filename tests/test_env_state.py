"""The state of an environment: what it reaches, what it names, and that it is restored in place."""

import collections
import random

import numpy as np
import pytest
import torch

from megastep.env_state import EnvState


class Env:
    device = torch.device("cpu")

    def __init__(self):
        self.place, self.wind = torch.zeros(3), np.zeros(2)
        self.numpy, self.old_numpy = np.random.default_rng(1), np.random.RandomState(1)
        self.python, self.generator = random.Random(1), torch.Generator().manual_seed(1)
        self.n, self.name, self.seen, self.pages = 0, "calm", {1}, {"a": 1}
        self.queue, self.frames = collections.deque(maxlen=2), [torch.zeros(1)]
        self.pair = self.also = torch.zeros(2)
        self.later = None

    def draw(self):
        return (
            self.numpy.normal(),
            self.old_numpy.normal(),
            self.python.random(),
            torch.rand(1, generator=self.generator).item(),
            torch.rand(1).item(),
            np.random.random(),
            random.random(),
        )

    def step(self):
        self.place += torch.tensor([1, torch.nan, torch.inf])
        self.wind[0] += 1
        self.n, self.name = self.n + 1, "wild"
        self.seen.add(self.n + 5)
        self.pages = {"b": None}
        self.queue += [self.n, self.n + 1, self.n + 2]
        self.frames = [*self.frames, torch.full((1,), float(self.n))]
        self.pair = torch.full((2,), float(self.n))  # no longer `also`
        self.later = torch.ones(self.n)
        return self.draw()


def facts(env):
    arrays = env.place, env.wind, env.pair, env.also, *env.frames
    arrays += () if env.later is None else (env.later,)
    plain = env.n, env.name, env.seen, env.pages, list(env.queue), env.queue.maxlen
    return [*(torch.as_tensor(one).tolist() for one in arrays), *plain]


def restored(source, n_steps_of_target=0):
    """Returns a new environment with the state of another."""
    target = Env()
    state = EnvState(target)
    for _ in range(n_steps_of_target):
        target.step()
    place = target.place
    state.load_state_dict(source)
    assert target.place is place, "in place"
    return target


@pytest.mark.parametrize("n_steps_of_target", [0, 1, 4])
def test_everything_is_restored_and_goes_on(n_steps_of_target):
    env = Env()
    state = EnvState(env)
    env.step(), env.step()
    saved = {key: dict(part) for key, part in state.state_dict().items()}
    saved["arrays"] = {path: array.clone() for path, array in saved["arrays"].items()}
    expected, draws = str(facts(env)), [env.step(), env.draw()]
    target = restored(saved, n_steps_of_target)
    assert str(facts(target)) == expected
    assert [target.step(), target.draw()] == draws


def test_what_cannot_be_saved_is_named():
    env = Env()
    assert EnvState(env).unreachable() == []
    env.counter, env.nodes, env.objects = iter([1]), {object()}, np.array([env])
    env.fixed = (1, 2.0, b"bytes", range(3), slice(1), torch.float16, np.float32(1), len)
    assert EnvState(env).unreachable() == [
        "counter (list_iterator)",
        "nodes (set)",
        "objects (ndarray)",
    ]


def test_plain_values_that_never_change_are_not_saved():
    """They may be addresses, or differ between machines."""
    env = Env()
    state = EnvState(env)
    assert state.state_dict()["values"] == {}
    env.n = 3
    assert state.state_dict()["values"] == {".env.n": 3}


def test_another_environment_is_refused_and_unchanged():
    env = Env()
    env.inner = Env()
    env.inner.extra = torch.ones(1)
    saved = EnvState(env).state_dict()
    target = Env()
    with pytest.raises(ValueError, match=r"holds env.inner.\S+, which this Env does not have"):
        EnvState(target).load_state_dict(saved)
    assert str(facts(target)[:4]) == str(facts(Env())[:4])
