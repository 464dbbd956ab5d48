"""Composing and checking configurations. No test starts a run."""

import dataclasses
import logging
import operator
import re

import pytest
import yaml

from megastep import envs, geometries
from megastep.agents.cli import sweeps, train
from megastep.agents.cli.command import load
from megastep.agents.cli.compose import Composer
from megastep.agents.cli.words import Typed
from megastep.agents.errors import ConfigErrors
from megastep.agents.factory import components
from megastep.agents.factory.check import MOVED, as_tree, check
from megastep.agents.factory.settings import Train
from megastep.geometries import sources
from tests.helpers.tiny import changed
from tests.helpers.tiny import settings as compose


def errors(*overrides, script="train"):
    with pytest.raises(ConfigErrors) as error:
        compose(*overrides, script=script)
    return dict(error.value.errors)


#: What a member of a group needs beside itself.
MORE = {
    "geometry=files": [f"geometry.path={sources.BENCH}"],
    "learner=bc": ["learner.data=walks"],
    "robot=turtlebot3": ["env=pointgoal"],
    "robot=turtlebot4": ["env=pointgoal"],
}


PARTS = "env", "robot", "geometry", "agent", "learner", "curriculum", "logger", "experiment"


@pytest.mark.slow
@pytest.mark.parametrize("group", PARTS)
def test_every_group_member_composes(group):
    composer = Composer(load("train"))
    groups = composer.groups()
    assert set(groups) == {*PARTS}
    assert set(groups["env"]) == set(envs.ENVS)
    assert set(groups["geometry"]) == set(geometries.SOURCES)
    for choice in [f"{group}={member}" for member in groups[group]]:
        assert isinstance(composer.settings([choice, *MORE.get(choice, ())]), Train)


@pytest.mark.slow
def test_other_commands_compose_environments():
    composer = Composer(load("evaluate"))
    for env in composer.groups()["env"]:
        assert composer.settings([f"env={env}", "run=x"]).env
    for name, words in ("record", []), ("dump", ["run=x", "folder=y"]):
        assert Composer(load(name)).settings(["env=pong", *words]).env


def test_settings_round_trip():
    cfg = compose("env=minimal", "samples=1e6")
    assert check(Train, as_tree(cfg)) == cfg
    with pytest.raises(dataclasses.FrozenInstanceError):
        cfg.seed = 2


@pytest.mark.parametrize(
    "words, labels",
    [
        ([], {"tensorboard"}),
        (["logger=none"], set()),
        (["logger=[tensorboard,wandb,csv]"], {"tensorboard", "wandb", "csv"}),
        (["logger=[csv,tests.cli.test_config:Memo]"], {"csv", "memo"}),
    ],
)
def test_loggers_of_a_run(words, labels):
    assert compose(*words).logger.keys() == labels


class Memo:
    """A logger outside megastep."""

    def __init__(self, folder, config, path: str = "memo", size: int = 3):
        pass

    def write(self, step, values):
        pass

    def close(self):
        pass


class CSV(Memo):
    """Called as one of megastep's."""


def test_each_logger_has_settings_of_its_own():
    path = "tests.cli.test_config:Memo"
    own = ["logger.wandb.mode=offline", "logger.wandb.project=p", "logger.memo.size=4"]
    chosen = compose(f"logger=[wandb,{path}]", *own).logger
    assert dataclasses.asdict(chosen["memo"]) == {"name": path, "path": "memo", "size": 4}
    wandb = dict(
        name=components.members("logger")["wandb"], project="p", mode="offline", group=None
    )
    assert dataclasses.asdict(chosen["wandb"]) == wandb
    assert compose(f"logger={path}", "logger.memo.path=here").logger["memo"].path == "here"


@pytest.mark.parametrize(
    "words, key, text",
    [
        (["logger.mode=offline"], "logger.mode", "is a group of keys, got 'offline'"),
        (["logger.wandb.mode=offline"], "logger.wandb", "is not chosen: give logger= as well"),
        (["logger=wandb", "logger.wandb.mod=x"], "logger.wandb.mod", "logger.wandb.mode?"),
        (["logger.mlfow.uri=x"], "logger.mlfow", "is not chosen: give logger= as well"),
        (["logger=[csv,wandbb]"], "logger", "'wandbb' is unknown; did you mean wandb?"),
        (["logger=[csv,nowhere:Memo]"], "logger.memo", "nowhere:Memo cannot be imported"),
        (["logger=pathlib:Path"], "logger.path", "cannot be used: it has no method write"),
        (["logger=[csv,tests.cli.test_config:CSV]"], "logger", "the same class name"),
    ],
)
def test_loggers_that_are_refused(words, key, text):
    messages = errors(*words)
    assert list(messages) == [key] and text in messages[key]


def test_values_follow_the_device(monkeypatch):
    cpu, gpu = compose("device=cpu"), compose("device=cuda")
    assert compose() == dataclasses.replace(cpu, device="auto")
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert compose() == dataclasses.replace(gpu, device="auto") != compose("device=cpu") == cpu
    assert compose("experiment=quickstart").env == gpu.env
    assert compose("env.n_envs=7", "learner.n_minibatches=1").env.n_envs == 7


@pytest.mark.parametrize(
    "word, value",
    [
        ("samples=100k", 100_000),
        ("samples=1.5b", 1_500_000_000),
        ("seconds=1h30min", 5400),
        ("seconds=2.5m", 150),
        ("population.every=20k", 20_000),
    ],
)
def test_quantities_as_people_write_them(word, value):
    key = word.partition("=")[0]
    assert operator.attrgetter(key)(compose(word)) == value


@pytest.mark.parametrize("word", ["samples=1h", "seconds=10M5", "samples=k", "seconds=1.5x"])
def test_quantities_that_are_none(word):
    with pytest.raises(ConfigErrors, match=r"expected a|got '"):
        compose(word)


def test_key_of_another_member():
    messages = errors("env=minimal", "env.patience=3", "geometry=box", "geometry.outer=false")
    assert messages["env.patience"] == "no such key here; env=explorer has it"
    assert messages["geometry.outer"] == "no such key here; geometry=homes has it"


def test_all_errors_are_listed_at_once():
    messages = errors(
        "env=explorr", "learner.lrr=1", "learner.lr=-1", "learner.gamma=nan", "seed=x", "device=gpu"
    )
    assert set(messages) == {"env", "learner.lrr", "learner.lr", "learner.gamma", "seed", "device"}
    assert messages["device"] == "'gpu' is unknown; there are auto, cpu, cuda, cuda:1, ..."


@pytest.fixture(scope="module")
def tree():
    return as_tree(compose())


NAN, INFINITY = float("nan"), float("inf")


OUT_OF_RANGE = {
    "env.n_envs": [0, 10**12, 2.5, "many", None, True, {}],
    "env.res": [0, 1025],
    "env.fov": [0, 180, NAN],
    "env.fps": [0],
    "learner.lr": [-1, 0, INFINITY, 1e300],
    "learner.gamma": [1.01],
    "learner.n_steps": [0],
    "learner.n_minibatches": [0],
    "agent.width": [0],
    "agent.layers": [0, 9],
    "agent.encoder": ["cnv"],
    "geometry.n": [0],
    "seed": [-1],
    "samples": [0, INFINITY],
    "seconds": [0, INFINITY, -INFINITY, NAN],
    "checkpoints.seconds": [INFINITY, -3],
    "checkpoints.keep": [1],
    "logging.every": [0],
    "finish.episodes": [0],
    "finish.record": [1],
    "logger.mode": ["often"],
    "env": ["explorer"],
    "learner.typo": [1],
}


@pytest.mark.parametrize("key", OUT_OF_RANGE)
def test_out_of_range_values(tree, key):
    for value in OUT_OF_RANGE[key]:
        with pytest.raises(ConfigErrors) as error:
            check(Train, changed(tree, key, value))
        assert [path for path, _ in error.value.errors] == [key], value


def test_contradicting_settings():
    assert compose("env.n_envs=8", "learner.n_minibatches=8").learner.n_minibatches == 8
    assert errors("geometry=files") == {"geometry.path": "is missing"}
    assert "resume" in errors("resume=a", "init=b")["init"]


@pytest.mark.parametrize(
    "override, key, sentence",
    [
        ("learner.lrr=1", "learner.lrr", "learner.lr?"),
        ("n_envs=8", "n_envs", "env.n_envs?"),
        ("geometri=box", "geometri", "geometry?"),
        ("env=explorr", "env", "explorer?"),
        ("seed=1,2", "seed", "add -m"),
        ("env.res=1025", "env.res", "1025 is out of range: allowed is at most 1,024"),
        ("env.fov=180", "env.fov", "180 is out of range: allowed is below 180"),
        ("seconds=inf", "seconds", "inf is out of range: allowed is any finite number"),
        ("env.cameras=[]", "env.cameras", "has 0 values: allowed is at least 1"),
        ("env.n_envs=2", "learner.n_minibatches", "2"),
        ("learner.anneal=samples", "learner.anneal", "samples="),
        ("seed=" + 3000 * "[", "seed=" + 112 * "[" + "...", "write key=value"),
        ("learner.lr={a:{b:1}}", "learner.lr", "expected a number, got {'a': {'b': 1}}"),
        (
            "precision=high",
            "precision",
            "no such key; there are agent, callbacks, checkpoints",
        ),
        ("learner.learning_rate=1", "learner.learning_rate", "no such key; learner has anneal, "),
        ("env.control=continuos", "env.control", "is unknown; did you mean continuous?"),
        ("env=null", "env", "None is unknown"),
        ("~env", "env", "None is unknown"),
        ("env@x=minimal", "configuration", "+env@x=minimal"),
        ("hydra.searchpath=ppo", "configuration", "hydra.searchpath must be a list"),
        ("seed=${nothere}", "seed", "Interpolation key 'nothere' not found"),
        ("hydra.swep.dir=x", "hydra.swep.dir", "no such key; did you mean hydra.sweep.dir?"),
        ("hydra/launcher=basik", "hydra/launcher", "'basik' is unknown; did you mean basic?"),
        ("explorer", "explorer", "is not key=value; did you mean env=explorer?"),
        ("learner.lr", "learner.lr", "has no value; write learner.lr=..."),
        ("my-run", "my-run", "is not key=value; --cfg job prints all keys"),
        ("runs/my-run", "runs/my-run", "is not key=value; did you mean resume=runs/my-run?"),
    ],
)
def test_bad_overrides(override, key, sentence):
    ((error_key, text),) = errors(override).items()
    assert error_key == key and sentence in text and "\n" not in text


@pytest.mark.parametrize(
    "words, key, sentence",
    [
        ([], "run", "is missing; run=latest takes the newest run, run=FOLDER another one"),
        (["runs/my-run"], "runs/my-run", "is not key=value; did you mean run=runs/my-run?"),
        (["~run"], "run", "is missing"),
        (["run=x", "split=tset"], "split", "'tset' is unknown; did you mean test?"),
    ],
)
def test_evaluations_without_a_run(words, key, sentence):
    with pytest.raises(ConfigErrors) as error:
        compose(*words, script="evaluate")
    assert error.value.errors == [(key, sentence)]


def test_launcher_not_installed(monkeypatch):
    composer = Composer(load("train"))
    composer.members = lambda group: ["basic"]
    _, errors = composer.config([Typed("hydra/launcher", "joblib", "hydra/launcher=joblib")])
    assert "pip install 'megastep-flatland[sweep]'" in dict(errors)["hydra/launcher"]


def test_plus_signs():
    expected = compose("seed=3", "env=minimal", "env.n_envs=9", "experiment=quickstart")
    assert compose("+seed=3", "env=minimal", "++env.n_envs=9", "experiment=quickstart") == expected
    assert compose("experiment=null", "~env.resample") == compose("env.resample=false")


def test_value_with_equals_sign():
    assert compose("folder=sweeps/1/0_seed=1").folder == "sweeps/1/0_seed=1"
    cfg = compose("run=x", "against=[a/0_seed=1,bot]", script="evaluate")
    assert cfg.against == ("a/0_seed=1", "bot")
    words, *_ = sweeps.jobs_of(Composer(load("evaluate")), ["run=a/0_seed=1,a/1_seed=2"])
    runs = [compose(*job, script="evaluate").run for job in words]
    assert runs == ["a/0_seed=1", "a/1_seed=2"]


@pytest.mark.parametrize(
    "call", ["${ oc.env:SECRET}", "${oc.select:nothing,${oc.env :SECRET}}", "${hydra:job.name}"]
)
def test_environment_variables_are_refused(monkeypatch, call):
    monkeypatch.setenv("SECRET", "hush")
    messages = errors(
        "logger=wandb", f"logger.wandb.project='x{call}'", "folder='${oc.env:SECRET}'"
    )
    assert set(messages) == {"logger.wandb.project", "folder"} and "hush" not in str(messages)


@pytest.mark.parametrize("old", MOVED)
def test_an_old_key_is_refused_with_the_new_one(old):
    word = f"{old}.return=1" if old == "stop" else f"{old}=1"
    assert errors(word) == {old: f"is now called {MOVED[old]}"}


def test_value_for_a_group_of_keys():
    assert "finish" in errors("finish=1")
    assert compose("finish={steps:3}").finish == dataclasses.replace(compose().finish, steps=3)


def jobs(*words):
    """Returns the words of each job of a sweep."""
    return sweeps.jobs_of(Composer(load("train")), [*words])[0]


def test_grid_jobs():
    words = ["env=minimal,explorer", "seed=choice(1,2)", "checkpoints.keep=3"]
    assert jobs(*words) == [
        [f"env={env}", f"seed={seed}", "checkpoints.keep=3"]
        for env in ("minimal", "explorer")
        for seed in (1, 2)
    ]


def test_grid_is_checked_before_the_first_job():
    with pytest.raises(ConfigErrors, match="learner.lr"):
        jobs("learner.lr=1e-3,-1")


def test_search_is_checked_at_bounds():
    optuna = "hydra/sweeper=optuna"
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    base = compose().learner.lr
    words = ["learner.lr=interval(1e-4,1e-2)", "checkpoints.keep=2,3", "seed=range(1,4)"]
    configs = [compose(*job) for job in jobs(optuna, *words)]
    tried = [(cfg.learner.lr, cfg.checkpoints.keep, cfg.seed) for cfg in configs]
    assert tried[0] == (base, 2, 1) and (1e-4, 2, 1) in tried and (1e-2, 2, 1) in tried
    assert (base, 3, 1) in tried and (base, 2, 3) in tried and len(tried) == 7
    for word, problem in (
        ("learner.lr=interval(1e-4,1e9)", "1000000000.0 is out of range"),
        ("logging.every=interval(1.0,4.0)", "expected an integer"),
        ("checkpoints.keep=range(1,3)", "1 is out of range"),
        ("agent.core=lstm,lstmm", "lstmm"),
    ):
        with pytest.raises(ConfigErrors, match=re.escape(problem)):
            jobs(optuna, word)
    with pytest.raises(ConfigErrors, match="hydra/sweeper=optuna"):
        jobs("learner.lr=interval(1e-4,1e-2)")


@pytest.mark.parametrize("key, value", [("geometry", "maze"), ("geometry.n", "3")])
def test_a_geometry_that_the_environment_does_not_take_is_refused(key, value):
    message = "env=pong takes no floor plans; leave geometry out"
    assert errors("env=pong", f"{key}={value}") == {key: message}


@pytest.mark.parametrize("word", ["env=glob(zz*)", "seed=range(3,3)"])
def test_empty_sweep(word):
    with pytest.raises(ConfigErrors, match="has no value"):
        jobs(word)


def test_help_lists_groups_and_members(capsys):
    assert train.main(["--help"]) == 0
    text = capsys.readouterr().out
    assert "gymnasium, hideandseek, keys, memory, minatar, minigrid, minimal, pettingzoo" in text
    assert "quickstart" in text and "--multirun" in text


@pytest.fixture
def logging_as_it_was():
    """Restores what Hydra's own main changes."""
    root = logging.getLogger()
    handlers, level = [*root.handlers], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


def test_cfg_prints_composed_config(capsys, logging_as_it_was):
    def printed(*words):
        assert train.main([*words]) == 0
        return capsys.readouterr().out

    tree = yaml.safe_load(printed("--cfg", "job", "logging.every=${checkpoints.keep}"))
    assert tree == as_tree(compose("logging.every=2"))
    assert "hydra" in yaml.safe_load(printed("--cfg", "all"))
    assert "seed: 1" in printed("-m", "seed=1,2", "--cfg", "job").split("---")[0]
    assert [*yaml.safe_load(printed("--cfg", "hydra"))] == ["hydra"]
