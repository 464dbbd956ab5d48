"""Modules that a user has not trained with are imported only with trust=true."""

import importlib
import pathlib
import sys
from contextlib import suppress

import pytest

from megastep.agents.cli import evaluate, export, record, train, web
from megastep.agents.errors import ConfigErrors
from megastep.agents.factory import check
from megastep.agents.factory.components import kind_of
from megastep.agents.factory.settings import Train
from megastep.agents.runs import checkpoint, trust
from tests.helpers.tiny import TINY, changed, settings

KEYS = ("env.name", "geometry.name", "learner.name", "curriculum.name", "opponents.bot_class")
KEYS += ("agent.core", "agent.encoder", "logger.tensorboard.name", "callbacks")
KEYS += ("learner.optimizer",)
SCHEDULED = (
    "auxiliary_coef",
    "c_clip",
    "entropy_coef",
    "gamma",
    "lambda_",
    "lr",
    "rho_clip",
    "value_coef",
)
IMPORTED = pathlib.Path("imported")  # written by the planted module


@pytest.fixture(autouse=True)
def planted(tmp_path, monkeypatch):
    """Changes to a folder with a module that leaves a file when it is imported."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    pathlib.Path("planted.py").write_text(f"open({str(tmp_path / IMPORTED)!r}, 'w').close()\n")
    importlib.invalidate_caches()
    kind_of.cache_clear()
    yield
    sys.modules.pop("planted", None)
    kind_of.cache_clear()


def save(monkeypatch, *keys, value="planted:Thing", user="another"):
    """Saves the run `run` of a user, with another value of some keys."""
    tree = check.as_tree(settings(*TINY))
    for key in keys:
        tree = changed(tree, key, value)
    state = dict(samples=64, updates=2, seconds=2.5)
    with monkeypatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(pathlib.Path(user).absolute()))
        checkpoint.save("run/checkpoints", 64, state, {"train": tree, "spaces": {}})


COMMANDS = [
    (train.main, ["resume=run"]),
    (train.main, ["rerun=run"]),
    (train.main, ["init=run", *TINY]),
    (train.main, ["-m", "init=run", "seed=1,2"]),
    (evaluate.main, ["run=run"]),
    (evaluate.main, ["run=run", "against=bot"]),
    (record.main, ["run=run"]),
    (export.main, ["run=run", "format=safetensors"]),
    (export.main, ["run=run", "format=torch"]),
    (web.main, ["run=run"]),
]


@pytest.mark.parametrize("main, words", COMMANDS)
def test_downloaded_run_is_refused_before_anything_is_imported(main, words, monkeypatch, capsys):
    save(monkeypatch, *KEYS)
    assert main(words) == 2
    err = capsys.readouterr().err
    assert err.count("planted:Thing") == 1 and "trust=true" in err and err.count("\n") == 1
    assert not IMPORTED.exists() and "planted" not in sys.modules


def test_downloaded_opponent_is_refused(monkeypatch, capsys):
    save(monkeypatch, "agent.core")
    mine = ["folder=mine", "env=pong", "device=cpu", "env.n_envs=8"]
    assert train.main([*mine, "agent.width=8", "learner.n_minibatches=2", "samples=64"]) == 0
    assert evaluate.main(["run=mine", "against=run", "episodes=8"]) == 2
    assert "planted:Thing" in capsys.readouterr().err and not IMPORTED.exists()


@pytest.mark.parametrize("word, user", [("trust=true", "another"), ("seed=1", None)])
def test_trusted_or_own_run_is_imported(word, user, monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "mine"))
    save(monkeypatch, "agent.core", user=user or "mine")
    assert evaluate.main(["run=run", word]) == 2
    assert "planted has no Thing" in capsys.readouterr().err and IMPORTED.exists()


def test_run_of_own_classes_needs_no_trust(monkeypatch):
    save(monkeypatch)
    pathlib.Path("torchvision.py").write_text("raise SystemExit('shadowed')")
    assert settings("resume=run", "samples=99").trust is False
    assert str(pathlib.Path.cwd()) not in sys.path, "a downloaded folder shadows no package"


def test_checkpoint_cannot_ask_for_trust(monkeypatch):
    save(monkeypatch, "trust", value=True)
    assert settings("resume=run", "samples=99").trust is False


def test_what_is_typed_is_trusted(monkeypatch, capsys):
    save(monkeypatch)
    assert train.main(["init=run", *TINY, "agent.core=planted:Thing"]) == 2
    assert "planted has no Thing" in capsys.readouterr().err and IMPORTED.exists()


def test_every_setting_that_imports_is_known_to_do_so():
    tree = check.as_tree(settings(*TINY, "learner=vtrace", "learner.buffer=replay"))
    others = ["planted:Thing"], {"planted": "Thing"}, {"planted:Thing": 1}
    importing = set()
    for key, _ in check.fields_of(Train, tree):
        for value in ("planted:Thing", *(others if key in KEYS else ())):
            wrong = changed(tree, key, value)
            names = trust.foreign_names({"train": wrong})
            with suppress(ConfigErrors):
                check.check(Train, wrong)
            if sys.modules.pop("planted", None):
                assert names, (key, value)
                importing.add(key)
                kind_of.cache_clear()
    # the learner's numbers may be schedules, functions by import path; bots are imported later
    numbers = {key for key in importing if key not in KEYS}
    assert numbers == {f"learner.{name}" for name in SCHEDULED}
    assert importing - numbers == {*KEYS} - {"opponents.bot_class"}
