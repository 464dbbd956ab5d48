"""The state of an environment: what it reaches, what it names, and that it is restored in place."""

import collections
import enum
import random

import numpy as np
import pytest
import torch

from megastep.capture import HostState
from megastep.env_state import EnvState
from tests.helpers.weights import reloaded


class Colour(enum.Enum):
    RED, BLUE = "red", "blue"


class Inner:
    n = np.int32(0)

    def __init__(self):
        self.n = self.n


class Env:
    device = torch.device("cpu")

    def __init__(self):
        self.place, self.wind = torch.zeros(3), np.zeros(2)
        self.numpy, self.old_numpy = np.random.default_rng(1), np.random.RandomState(1)
        self.python, self.generator = random.Random(1), torch.Generator().manual_seed(1)
        self.n, self.name, self.seen, self.pages = 0, "calm", {1}, {"a": 1}
        self.queue, self.frames = collections.deque(maxlen=2), [torch.zeros(1)]
        self.pair = self.also = torch.zeros(2)
        self.later = self.later_array = self.later_list = None
        self.place_of_two, self.nested, self.total = (3, 4), [[1]], 0.0
        self.colour, self.key, self.by_name = Colour.RED, b"a", {"a": torch.zeros(1), 2: Inner()}
        self.one, self.other = torch.zeros(2), torch.zeros(2)
        self.letters, self.lines = np.array([b"a", b"b"]), np.array([["a", "bc"]])
        self.times = np.array(["2020-01-01"], "M8[D]")

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
        self.letters[0], self.lines[0, 0], self.times = b"c", "d", self.times + self.n
        self.n, self.name = self.n + 1, "wild"
        self.seen.add(self.n + 5)
        self.pages = {"b": None}
        self.queue += [self.n, self.n + 1, self.n + 2]
        self.frames = [*self.frames, torch.full((1,), float(self.n))]
        self.pair = torch.full((2,), float(self.n))  # no longer `also`
        self.later, self.later_array = torch.ones(self.n), np.arange(self.n)[::-1]
        self.later_list = [torch.full((1,), float(self.n)), np.ones(self.n)]
        self.place_of_two, self.nested = (self.n, 1.5), [*self.nested, [self.n, {self.n: "x"}]]
        self.total += np.float64(self.n)
        self.colour, self.key = Colour.BLUE, bytes([self.n])
        self.by_name.pop("a", None)
        self.by_name[2].n = np.int32(self.n)
        self.other = self.one
        self.one += 1  # both
        return self.draw()


def facts(env):
    arrays = env.place, env.wind, env.pair, env.also, *env.frames
    arrays += () if env.later is None else (env.later,)
    plain = env.n, env.name, sorted(env.seen), env.pages, list(env.queue), env.queue.maxlen
    kinds = type(env.later_array), [*map(type, env.later_list or ())], type(env.total)
    more = (
        env.place_of_two,
        env.nested,
        env.total,
        env.colour,
        env.key,
        sorted(map(str, env.by_name)),
    )
    more = *more, env.letters.tolist(), env.lines.tolist(), env.times.tolist()
    rest = env.later_array, env.later_list, env.by_name[2].n, env.one, env.other
    return [*(torch.as_tensor(one).tolist() for one in arrays), *plain, *more, *rest, kinds]


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
    saved = reloaded(state.state_dict())
    expected, draws = str(facts(env)), [env.step(), env.draw()]
    target = restored(saved, n_steps_of_target)
    assert str(facts(target)) == expected
    assert [target.step(), target.draw()] == draws


def test_what_cannot_be_saved_is_named():
    env = Env()
    assert EnvState(env).unreachable() == []
    env.counter, env.nodes, env.objects = iter([1]), {object()}, np.array([env])
    env.words = np.zeros(1, "i4,f4")
    env.fixed = (1, 2.0, b"bytes", range(3), slice(1), torch.float16, np.float32(1), len)
    state = EnvState(env)
    names = ["counter (list_iterator)", "nodes (set)", "objects (ndarray)", "words (ndarray)"]
    assert state.unreachable() == names


def test_plain_values_that_never_change_are_not_saved():
    """They may be addresses, or differ between machines."""
    env = Env()
    state = EnvState(env)
    kinds = [record[0] for record in state.state_dict()["records"].values()]
    assert "tensor" in kinds and "value" not in kinds
    env.n = 3
    assert state.state_dict()["records"][".env.n"] == ("value", 3)


def test_another_environment_is_refused_and_unchanged():
    env = Env()
    env.inner = Env()
    env.inner.extra = torch.ones(1)
    saved = EnvState(env).state_dict()
    target = Env()
    with pytest.raises(ValueError, match="of Env does not fit: it has no inner"):
        EnvState(target).load_state_dict(saved)
    assert str(facts(target)[:4]) == str(facts(Env())[:4])


def test_state_that_fails_in_the_middle_is_put_back():
    """A tuple cannot take another tensor."""
    env, target = Env(), Env()
    for one, n in ((env, 2), (target, 3)):
        one.pair_of_tensors = torch.zeros(n), torch.zeros(n)
    env.step()
    saved = EnvState(env).state_dict()
    before = str(facts(target))
    with pytest.raises(ValueError, match="a tensor inside a tuple was replaced"):
        EnvState(target).load_state_dict(saved)
    assert str(facts(target)) == before


def test_state_of_a_gpu_is_restored_without_one():
    env = Env()
    saved = EnvState(env).state_dict()
    saved["records"][".generators['cuda']"] = "generator", torch.zeros(16, dtype=torch.uint8)
    EnvState(Env()).load_state_dict(saved)


def test_large_tensors_are_saved_only_if_they_have_changed():
    def with_plans():
        env = Env()
        env.plans, env.places = torch.arange(2**19).float(), torch.zeros(2**18 + 3)
        return env

    env, target, other = with_plans(), with_plans(), with_plans()
    state, restored = EnvState(env), EnvState(target)
    env.places[7] = 1
    saved = state.state_dict()
    assert saved["records"][".env.plans"][0] == "unchanged"
    assert saved["records"][".env.places"][0] == "tensor"
    restored.load_state_dict(saved)
    assert torch.equal(target.places, env.places)
    kind = restored.state_dict()["records"][".env.places"][0]
    assert kind == "tensor", "not what a new environment has"
    other.plans[[3, 2**18]] = other.plans[[2**18, 3]]
    with pytest.raises(ValueError, match="plans is not that of the run"):
        EnvState(other).load_state_dict(saved)
    assert not other.places.any()


@pytest.mark.parametrize("what", ["tensor", "generator", "default", "none"])
def test_what_is_on_a_cpu_beside_a_gpu_is_frozen_in_a_graph(what, monkeypatch):
    """A device that was forgotten: such a tensor is a constant of the recording."""
    monkeypatch.setattr(torch.cuda, "default_generators", [torch.Generator()])
    env = Env()
    env.device, env.long = torch.device("cuda:0"), np.zeros(1, np.longdouble)
    env.sparse = torch.eye(3).to_sparse()
    state = HostState(env)
    if what == "tensor":
        env.place += 1
    elif what == "generator":
        torch.rand(1, generator=env.generator)
    elif what == "default":
        torch.rand(1)
    name = state.changed()
    of = {"tensor": "place", "generator": "generator", "default": "the global generator of torch"}
    assert name == of.get(what)
