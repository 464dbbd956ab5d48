"""The door: what composes, what is refused, and in which words. Nothing here starts a run."""

import copy
import dataclasses

import pytest

from agents.cli import compose as compose_module
from agents.cli import settings
from agents.cli.command import run_command
from agents.cli.compose import ConfigLoader
from agents.cli.settings import ConfigErrors, Evaluate, Record, Train, build
from megastep import envs, geometries

SCRIPTS = {"train": Train, "evaluate": Evaluate, "record": Record}


def compose(*overrides, script="train"):
    with ConfigLoader(script, SCRIPTS[script]) as door:
        return build(SCRIPTS[script], door.tree(list(overrides)))


def errors(*overrides, script="train"):
    with pytest.raises(ConfigErrors) as error:
        compose(*overrides, script=script)
    return dict(error.value.errors)


@pytest.mark.parametrize(
    "choice",
    [
        "env=minimal",
        "env=explorer",
        "geometry=homes",
        "geometry=bench",
        "geometry=box",
        "geometry=column",
        "agent=small",
        "agent=large",
        "logger=wandb",
        "experiment=newcomer",
    ],
)
def test_every_group_member_composes(choice):
    assert isinstance(compose(choice), Train)


def test_every_member_of_every_group_is_tested_above_or_needs_more():
    with ConfigLoader("train", Train) as door:
        groups = door.groups()
    assert set(groups) == {"env", "geometry", "agent", "learner", "logger", "experiment"}
    assert set(groups["env"]) == set(envs.ENVS) == set(settings.ENVS)
    assert set(groups["geometry"]) == set(geometries.SOURCES)
    assert set(groups["agent"]) == {"auto", "small", "large"}


def test_settings_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        compose().seed = 2


def test_what_is_written_can_be_read_again():
    cfg = compose("env=minimal", "samples=1e6")
    assert build(Train, settings.as_tree(cfg)) == cfg


def test_the_keys_of_an_environment_are_its_arguments():
    import inspect

    for name, kind in settings.ENVS.items():
        arguments = set(inspect.signature(envs.ENVS[name].__init__).parameters)
        assert {field.name for field in dataclasses.fields(kind)} - {"name"} <= arguments


def test_sizes_follow_the_device(monkeypatch):
    small = compose("agent=small")
    monkeypatch.setattr(compose_module, "_has_gpu", lambda device: device != "cpu")
    assert compose() == compose("agent=large") != small
    assert compose("experiment=newcomer").env.n_envs == compose("agent=large").env.n_envs
    assert compose("device=cpu") == dataclasses.replace(small, device="cpu")
    assert compose("env.n_envs=7", "learner.n_minibatches=1").env.n_envs == 7


def test_a_typo_names_the_nearest_key():
    assert "learner.lr?" in errors("learner.lrr=1")["learner.lrr"]
    assert "learner.lr?" in errors("lr=1")["lr"]
    assert "env.n_envs?" in errors("n_envs=8")["n_envs"]
    assert "device?" in errors("devise=cpu")["devise"]
    assert "geometry?" in errors("geometri=box")["geometri"]


def test_an_unknown_member_names_the_nearest_one():
    assert "explorer?" in errors("env=explorr")["env"]
    assert "homes?" in errors("geometry=home")["geometry"]
    assert "newcomer?" in errors("experiment=newcomr")["experiment"]
    assert "test?" in errors("run=x", "split=tset", script="evaluate")["split"]
    assert "minimal" in errors("env.name=zzz")["env.name"]


def test_all_faults_are_listed_at_once():
    found = errors(
        "env=explorr", "learner.lrr=1", "learner.lr=-1", "learner.gamma=nan", "seed=x", "device=gpu"
    )
    assert set(found) == {"env", "learner.lrr", "learner.lr", "learner.gamma", "seed", "device"}


@pytest.fixture(scope="module")
def tree():
    with ConfigLoader("train", Train) as door:
        return door.tree([])


NAN, INFINITY = float("nan"), float("inf")


@pytest.mark.parametrize(
    "key, value",
    [
        ("env.n_envs", 0),
        ("env.n_envs", 10**12),
        ("env.n_envs", 2.5),
        ("env.n_envs", "many"),
        ("env.n_envs", None),
        ("env.n_envs", True),
        ("env.n_envs", {}),
        ("env.res", 0),
        ("env.res", 1025),
        ("env.fov", 0),
        ("env.fov", 180),
        ("env.fov", NAN),
        ("env.fps", 0),
        ("learner.lr", -1),
        ("learner.lr", 0),
        ("learner.lr", INFINITY),
        ("learner.lr", 1e300),
        ("learner.gamma", 1.01),
        ("learner.n_steps", 0),
        ("learner.n_minibatches", 0),
        ("agent.width", 0),
        ("agent.encoder", "cnv"),
        ("geometry.n", 0),
        ("seed", -1),
        ("samples", 0),
        ("seconds", 0),
        ("seconds", NAN),
        ("checkpoint", -3),
        ("keep", 1),
        ("report", 0),
        ("finish.lanes", 0),
        ("finish.record", 1),
        ("logger.mode", "often"),
        ("env", "explorer"),
        ("learner.typo", 1),
    ],
)
def test_values_out_of_range_are_named_with_their_key(tree, key, value):
    *groups, last = key.split(".")
    changed = copy.deepcopy(tree)
    target = changed
    for group in groups:
        target = target[group]
    target[last] = value
    with pytest.raises(ConfigErrors) as error:
        build(Train, changed)
    assert [path for path, _ in error.value.errors] == [key]


def test_a_missing_key_is_named(tree):
    with pytest.raises(ConfigErrors, match="seed: is missing"):
        build(Train, {key: value for key, value in tree.items() if key != "seed"})


def test_a_range_is_told():
    assert errors("env.res=1025")["env.res"] == "1025 is out of range: allowed is from 1 to 1,024"
    assert (
        errors("env.fov=180")["env.fov"]
        == "180.0 is out of range: allowed is above 0 and below 180"
    )


def test_settings_that_contradict_each_other_are_named():
    assert "256" in errors("env.subsample=3")["env.subsample"]
    assert "2" in errors("env.n_envs=2")["learner.n_minibatches"]
    assert "path" in errors("geometry=files")["geometry.path"]
    assert "resume" in errors("resume=a", "init=b")["init"]


@pytest.mark.parametrize("override", ["+x=1", "~env", "a=[", "env@x=minimal"])
def test_what_is_no_override_is_refused(override):
    assert set(errors(override)) == {override}


def test_several_values_need_multirun():
    assert "add -m" in errors("seed=1,2")["seed"]


def test_a_sweep_is_every_combination():
    with ConfigLoader("train", Train) as door:
        jobs = [
            overrides
            for overrides, _ in door.jobs(
                ["env=minimal,explorer", "seed=choice(1,2)", "keep=3"], True
            )
        ]
    assert jobs == [
        [f"env={env}", f"seed={seed}", "keep=3"]
        for env in ("minimal", "explorer")
        for seed in (1, 2)
    ]


def test_a_sweep_is_checked_before_its_first_job():
    with ConfigLoader("train", Train) as door, pytest.raises(ConfigErrors, match="learner.lr"):
        door.jobs(["learner.lr=1e-3,-1"], True)


def test_help_lists_groups_and_members(capsys):
    assert run_command("train", Train, None, "Trains.", ["--help"]) == 0
    text = capsys.readouterr().out
    assert "explorer, minimal" in text and "newcomer" in text and "--multirun" in text


def test_the_composed_configuration_is_printed(capsys):
    assert run_command("train", Train, None, "", ["--cfg", "job", "learner.lr=0.5"]) == 0
    assert "lr: 0.5" in capsys.readouterr().out


def test_a_sweep_goes_past_a_failing_job(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run(cfg):
        if cfg.seed == 1:
            raise ZeroDivisionError("by chance")

    assert run_command("train", Train, run, "", ["-m", "seed=1,2"]) == 2
    out = capsys.readouterr().out
    assert "FAILED: ZeroDivisionError: by chance" in out and "done" in out
