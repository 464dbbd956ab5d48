"""megastep from Python, as docs/python.md has it."""

import importlib
import re
import shlex
import sys
import warnings

import numpy as np
import pytest
import torch

import megastep
from megastep import devices
from megastep.agents import api
from megastep.agents.cli import compose
from megastep.agents.errors import ConfigErrors, UserError
from megastep.agents.launch import signals
from megastep.agents.networks.plain_cores import GRU
from megastep.agents.networks.policy import Policy
from megastep.agents.runs import checkpoint
from megastep.agents.selfplay.bots.random import RandomActions
from tests.helpers import tiny
from tests.helpers.pages import ROOT, code

PAGE = (ROOT / "docs" / "python.md").read_text()
ROWS = re.findall(r"^\| `(python .*)` \| `(megastep.*)` \|$", PAGE, re.M)
#: `tiny.TINY` as keyword arguments.
TINY = dict(
    env={"name": "minimal", "n_envs": 4, "res": 8, "shortest": 5, "longest": 9},
    geometry="box",
    learner={"n_steps": 8, "n_minibatches": 2},
    agent={"width": 8},
    logging={"every": 4},
    device="cpu",
)


class Memory(GRU):
    """A core of the user's."""


class Rover(megastep.envs.Minimal):
    """An environment of the user's."""


def words_of(line):
    script, *words = shlex.split(line.removeprefix("python "), comments=True)
    return script.removesuffix(".py"), words


@pytest.mark.parametrize("typed, line", ROWS)
def test_a_line_of_python_has_the_settings_of_its_command(typed, line, monkeypatch):
    made = []

    def take(name, arguments):
        made.append((name, arguments))
        raise KeyboardInterrupt  # instead of a training

    monkeypatch.setattr(api, "_settings", take)
    with pytest.raises(KeyboardInterrupt):
        eval(line)
    ((name, arguments),) = made
    script, typed = words_of(typed)
    assert name == script
    if "resume=latest" in typed:  # there is no run here
        assert {f"{key}={value}" for key, value in arguments.items()} == {*typed}
    else:
        expected = tiny.settings(*typed, script=name)
        assert compose.settings_from(tiny.load(name), arguments) == expected


def test_a_run_without_floor_plans_gives_its_policy_and_environment(here):
    small = {key: value for key, value in TINY.items() if key not in ("env", "geometry")}
    run = megastep.train(**small | {"env": {"name": "pong", "n_envs": 4}}, samples=64, folder="run")
    (row,) = megastep.evaluate(run.policy, env=run.make(n_envs=3, limit=9))
    assert row["lanes"] == 3


def test_a_run_from_training_to_film(here, capsys):
    run = megastep.train(**TINY, samples=256, folder="run")
    assert str(run.folder) == "run"
    assert run.metrics["samples"] == [128, 256] and len(run.metrics["perf/seconds"]) == 2
    assert run.config["env"]["res"] == 8 and run.config["seed"] == 1
    rows = run.evaluate(episodes=8, baseline="none")
    assert [row["lanes"] for row in rows] == [8]
    film = run.record(steps=2, file="film.png")
    assert film.exists()
    assert [one.folder for one in megastep.runs()] == [run.folder]
    assert megastep.load("latest").folder == run.folder == megastep.load(run).folder
    more = megastep.train(resume=run, more_samples=128)
    assert more.metrics["samples"] == [128, 256, 384]
    env = run.make(n_envs=3, seed=2)
    (row,) = megastep.evaluate(run.policy, env=env)
    assert row["lanes"] == 3
    assert megastep.record(run.policy, env=env, file="policy.png", steps=2).exists()
    assert megastep.train(**TINY, samples=256, dry_run=True) is None
    assert "Training on cpu in run" in capsys.readouterr().out


def test_errors_are_those_of_the_command_line_and_nothing_is_written(here):
    with pytest.raises(megastep.UserError) as info:
        megastep.train(env="explorr", learner={"lrr": 1}, **{"env.n_envs": 0})
    assert isinstance(info.value, ConfigErrors) and info.value.code == 2
    assert sorted(info.value.errors) == [
        ("env", "'explorr' is unknown; did you mean explorer?"),
        ("env.n_envs", "0 is out of range: allowed is at least 1"),
        ("learner.lrr", "no such key; did you mean learner.lr?"),
    ]
    with pytest.raises(UserError, match="env.n_env: no such key; did you mean env.n_envs?"):
        megastep.make("explorer", n_env=3)
    with pytest.raises(ConfigErrors) as unknown:
        megastep.make("explorr", n_envs=4)  # and nothing of its settings
    assert unknown.value.errors == [("env", "'explorr' is unknown; did you mean explorer?")]
    with pytest.raises(UserError, match="run folder nor a pretrained agent"):
        megastep.load("explorer_anywere")
    with pytest.raises(UserError, match="learner.lr: object is not a setting"):
        megastep.train(learner={"lr": object()})
    with pytest.raises(UserError, match="has no import path"):
        megastep.train(env=type("Local", (), {"__qualname__": "f.<locals>.Local"}))
    with pytest.raises(UserError, match=r"give env=megastep.make\(...\)"):
        megastep.evaluate(RandomActions(None))
    assert not any(here.iterdir())


@pytest.mark.parametrize("value", ["true", 'a "b" \\', None, "1"])
def test_a_value_means_itself_and_is_no_grammar(value):
    chosen = api._settings("train", {"folder": value, "device": "cpu"})
    assert chosen.folder == value


def test_classes_and_groups_as_arguments():
    chosen = {"env": {"res": 8, "name": Rover}, "logger": ["csv", "tensorboard"]}
    cfg = api._settings("train", {**chosen, "learner.lr": np.float32(0.5), "device": "cpu"})
    assert (cfg.env.name, cfg.env.res) == (f"{__name__}:Rover", 8)
    assert {*cfg.logger} == {"csv", "tensorboard"} and cfg.learner.lr == 0.5
    env = megastep.make(Rover, n_envs=2, geometry="box", device="cpu")
    assert type(env).__name__ == "Rover" and env.n_envs == 2


def test_policies_take_classes_and_have_their_critic(here):
    env = megastep.make("minimal", n_envs=3, geometry="box", device="cpu")
    assert type(Policy(env, core=Memory).core) is Memory
    assert Policy(env, core=Memory).settings["core"] == f"{__name__}:Memory"
    own = {"name": "homes", "n": 6}
    run = megastep.train(**TINY | {"env": "pointgoal", "geometry": own}, samples=1)
    env = run.make(n_envs=3, privileged=True)
    assert env.core.scenery.layouts.n_layouts == 3
    saved = checkpoint.load_latest(run.path / "checkpoints").state["policy"]
    policy, world = run.policy, env.reset()
    assert all(torch.equal(weight, saved[name]) for name, weight in policy.state_dict().items())
    decision, _ = policy(world, policy.initial(3))
    values = policy.value(decision.features, world.privileged)
    assert values.shape == (3,) and values.isfinite().all()
    with pytest.raises(ValueError, match="the policy has no critic"):
        policy.actor().value(decision.features)


def test_act_carries_and_clears_its_own_hidden_state():
    env = megastep.make("minimal", n_envs=3, geometry="box", device="cpu", shortest=3, longest=4)
    policy, other = (Policy(env.obs_space, env.action_space, width=8, seed=1) for _ in range(2))
    world, state, n_resets = env.reset(), other.initial(3), 0
    for _ in range(12):
        n_resets += int(world.reset.any())
        expected, state = other(world, state)
        decision = policy.act(world)
        assert torch.equal(decision.logits, expected.logits)
        world = env.step(decision)
    assert n_resets > 2
    assert policy.state_dict().keys() == other.state_dict().keys()


def test_the_parts_alone_run(here):
    parts = next(block for block in code(PAGE) if "Trainer" in block)
    assert len([line for line in parts.splitlines() if line]) <= 20
    exec(parts.replace('geometry="box"', 'geometry="box", device="cpu"'), {})
    assert not any(here.iterdir())


@pytest.mark.parametrize(
    "number, kind", [(signals.signal.SIGINT, KeyboardInterrupt), (15, SystemExit)]
)
def test_signals_raise_what_python_raises(number, kind):
    with pytest.raises(kind), api._interrupts():
        raise signals.Interrupted(number, "Stopped after 3 samples. To continue: ...")


def test_names_of_the_original(recwarn):
    for name in [name for name in sys.modules if name.startswith("megastep.demo")]:
        del sys.modules[name]  # of other tests
    from megastep.demo.envs.minimal import Minimal

    from megastep.demo import learning

    assert Minimal is megastep.envs.Minimal and megastep.demo.Agent is Policy
    assert learning.__name__ == "megastep.agents.algorithms.returns"
    assert [str(one.message) for one in recwarn if one.category is DeprecationWarning] == [
        "megastep.demo is megastep.envs and megastep.agents; docs/from-the-original.md has the new "
        "place of each name"
    ]
    importlib.import_module("megastep.compat")
    from rebar import arrdict, dotdict  # pyright: ignore[reportMissingImports]

    assert arrdict is megastep.arrdict and dotdict is megastep.dotdict
    assert not any(name.startswith("megastep.demo.envs") for name in vars(megastep.envs))


def test_threads_that_spin_are_warned_of_once(monkeypatch):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    monkeypatch.setattr(devices, "_n_threads", 2)
    devices._warn_of_spinning.cache_clear()
    with pytest.warns(RuntimeWarning, match="import megastep first, or set OMP_WAIT_POLICY"):
        assert devices.threads() == 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        devices.threads()
        monkeypatch.setenv("OMP_WAIT_POLICY", "passive")
        devices._warn_of_spinning.cache_clear()
        devices.threads()
