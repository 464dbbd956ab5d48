"""Recipes: the settings of each on a CPU and on a GPU, and how the blocks of files are merged."""

import textwrap

import pytest

from megastep.agents.cli import compose, evaluate, train
from megastep.agents.cli.command import load
from megastep.agents.cli.compose import Composer
from megastep.agents.errors import ConfigErrors
from tests.helpers import tiny


@pytest.fixture(autouse=True)
def without_a_gpu(monkeypatch):
    """Has `device=auto` be the CPU."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)


# ---- Blocks ----


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A function that writes a file, in a current folder of its own."""
    monkeypatch.chdir(tmp_path)

    def write(name, text):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text))
        return path

    return write


def composed(*words):
    """Returns the settings of words, with files of conf/ beside ours."""
    return Composer(load("train"), folder="conf").settings(words)


RECIPE = """\
    # @package _global_
    env: {n_envs: 7}
    learner: {gamma: 0.5, n_minibatches: 1}
    cpu:
      env: {n_envs: 5}
      ppo: {seed: 8}
    gpu: {seed: 9}
    vtrace:
      env: {n_envs: 6}
      cpu:
    """


def test_blocks_win_over_their_file_and_words_over_blocks(here):
    here("conf/experiment/mine.yaml", RECIPE)
    assert composed("experiment=mine").env.n_envs == 5
    assert composed("experiment=mine", "learner=vtrace").env.n_envs == 6
    assert composed("experiment=mine", "env.n_envs=3").env.n_envs == 3
    assert composed("experiment=mine", "device=cuda").env.n_envs == 7
    words = [], ["device=cuda"], ["learner=vtrace"]
    assert [composed("experiment=mine", *more).seed for more in words] == [8, 9, 1]


def test_a_later_file_wins_over_the_blocks_of_an_earlier_one(here):
    here("conf/experiment/mine.yaml", RECIPE)
    gammas = composed().learner.gamma, composed("experiment=mine").learner.gamma
    assert gammas == (0.98, 0.5)


def test_blocks_of_a_component_and_of_a_device_that_a_file_chooses(here):
    here("conf/learner/mine.yaml", "defaults: [vtrace]\nlr: 0.1\ncpu: {lr: 0.2, gamma: 0.3}\n")
    here("conf/experiment/gpu.yaml", "# @package _global_\ndevice: cuda\n")
    cfg = composed("learner=mine")
    assert (cfg.learner.lr, cfg.learner.gamma, cfg.learner.advantage_floor) == (0.2, 0.3, 0.3)
    cfg = composed("learner=mine", "experiment=gpu")
    assert (cfg.learner.lr, cfg.learner.gamma, cfg.env.n_envs) == (0.1, 0.995, 4096)


def test_wrong_keys_of_blocks_are_named(here):
    here("conf/experiment/mine.yaml", "# @package _global_\ncpu: {learner: {lrr: 1}, sed: 2}\n")
    here("conf/experiment/value.yaml", "# @package _global_\ncpu: 3\n")
    with pytest.raises(ConfigErrors) as error:
        composed("experiment=mine")
    assert dict(error.value.errors) == {
        "learner.lrr": "no such key; did you mean learner.lr?",
        "sed": "no such key; did you mean seed?",
    }
    for words in (["experiment=value"], ["cpu.seed=2"]):
        with pytest.raises(ConfigErrors, match="cpu.*: no such key"):
            composed(*words)


def test_files_of_environments_say_nothing_of_training_in_evaluations(capsys):
    cfg = tiny.settings("run=x", "env=gymnasium", "env.id=a", script="evaluate")
    assert cfg.env.name.endswith("Gymnasium") and cfg.episodes == 1024
    assert evaluate.main(["run=x", "env=gymnasium", "env.id=a", "learner.lr=1"]) == 2
    assert "learner: no such key" in capsys.readouterr().err


# ---- Learners of one's own ----

OWN = """
    from megastep.agents.algorithms.ppo import PPO
    from megastep.agents.algorithms.r2d2 import R2D2
    from megastep.envs import Explorer


    class MyPPO(PPO):
        def __init__(self, policy, *, mine: float = 1.0, **kwargs):
            super().__init__(policy, **kwargs)
            self.mine = mine


    class Clipped(PPO):
        def __init__(self, policy, **kwargs):
            super().__init__(policy, clip=0.1, **kwargs)


    class Slow(PPO):
        def __init__(self, policy, **kwargs):
            super().__init__(policy, lr=1e-5, **kwargs)


    class MyR2D2(R2D2):
        pass


    class A2C:
        def __init__(self, policy, *, lr: float = 7e-4, gamma: float = 0.99, n_steps: int = 5):
            raise ValueError(f"made with lr={lr}")


    class Rover(Explorer):
        def __init__(self, *args, mine: int = 3, **kwargs):
            super().__init__(*args, **kwargs)
    """


@pytest.fixture
def own(here, monkeypatch):
    """The name of a module of the current folder."""
    name = f"own_{here('x', '').parent.name}"
    here(f"{name}.py", OWN)
    return name


def test_a_class_has_the_blocks_of_the_learner_it_derives_from(own):
    cfg = tiny.settings(f"learner={own}:MyPPO", "learner.gamma=0.5", "learner.mine=2").learner
    assert (cfg.lr, cfg.gamma, cfg.entropy_coef, cfg.mine) == (3e-3, 0.5, 0.02, 2)
    cfg = tiny.settings(f"learner={own}:MyR2D2")
    assert (cfg.learner.lr, cfg.learner.replay.capacity) == (5e-4, 100_000)
    assert (cfg.agent.output, cfg.agent.critic) == ("duelling", None)
    cfg = tiny.settings(f"learner={own}:MyPPO", "experiment=pong", "device=cuda").learner
    assert (cfg.lr, cfg.gamma, cfg.n_epochs) == (1e-3, 0.99, 2)
    assert tiny.settings(f"learner.name={own}:MyPPO").learner.lr == 3e-3
    assert [compose.built_in(f"{own}:{name}") for name in ("MyR2D2", "A2C", "No")] == [
        *("r2d2", None, None)
    ]


def test_another_class_has_values_of_the_arguments_that_it_takes(own):
    words = [f"learner={own}:A2C", "experiment=popgym"]
    cfg = tiny.settings(*words, "learner.lr=0.5").learner
    assert {k: v for k, v in vars(cfg).items() if k != "name"} == {
        "lr": 0.5,
        "gamma": 0.99,
        "n_steps": 104,
        "anneal": "auto",
    }
    with pytest.raises(ConfigErrors, match="learner.clip: no such key here; learner=ppo has it"):
        tiny.settings(*words, "learner.clip=0.1")


def test_a_class_may_fix_an_argument(own, capsys):
    assert train.main([f"learner={own}:Clipped", *tiny.TINY, "samples=32"]) == 0
    assert train.main([f"learner={own}:Slow", *tiny.TINY, "samples=32"]) == 2
    text = capsys.readouterr().err
    assert "multiple values for keyword argument 'lr'; an argument that it sets itself" in text


def test_an_environment_passes_arguments_on(own):
    cfg = tiny.settings(f"env={own}:Rover", "env.patience=9", "env.mine=4").env
    assert (cfg.patience, cfg.mine, cfg.n_envs) == (9, 4, 256)
    assert train.main([f"env={own}:Rover", "env.fov=90", *tiny.TINY[1:], "samples=32"]) == 0
