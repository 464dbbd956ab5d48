"""The learner of docs/learners.md: it has only what is required, and it learns."""

import pytest
import torch

from megastep.agents.cli import train
from megastep.agents.networks.policy import Policy
from megastep.agents.types import LearnerOptions, with_defaults
from tests.algorithms.test_learning import Bandit, Corridor, Reach
from tests.helpers import pages, tiny

PAGE = pages.ROOT / "docs" / "learners.md"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, which holds my_a2c.py."""
    text = PAGE.read_text()
    assert "This is `my_a2c.py`" in text
    (tmp_path / "my_a2c.py").write_text(pages.code(text)[0])
    with pages.inside(tmp_path, monkeypatch):
        yield tmp_path


def test_commands_of_page_train_evaluate_and_resume(folder, monkeypatch):
    scripts = pages.type_all(PAGE.read_text(), folder, monkeypatch)
    assert scripts == ["train.py", "evaluate.py", "train.py"]


def test_python_code_of_page_trains(folder):
    names = {}
    exec(compile(pages.code(PAGE.read_text())[1], str(PAGE), "exec"), names)
    assert all(bool(value.isfinite()) for value in names["losses"].values())
    options = with_defaults(names["learner"], LearnerOptions)
    assert options.set_lr is options.check is options.replay_buffer is None
    assert options.replay_size(names["env"]) == (0, 0) and options.bytes_per_env(names["env"]) == 0


def test_learning_rate_that_cannot_fall_is_refused(folder, capsys):
    """By default it is constant."""
    words = [word for word in tiny.TINY if not word.startswith("learner.")]
    words += ["learner=my_a2c:A2C", "samples=1", "learner.anneal=samples"]
    assert train.main(words) == 2 and not list(folder.glob("runs/*/*"))
    assert "A2C has no set_lr(lr), so its learning rate cannot fall" in capsys.readouterr().err


@pytest.mark.parametrize(
    "make, n_updates, least", [(Bandit, 40, 0.45), (Corridor, 40, 1 / 8), (Reach, 40, 0.2)]
)
def test_a2c_learns(folder, make, n_updates, least):
    """Reward per step: 1/2, 1/7 and 4/5 at best, 0.18, 0.01 and less than 0 at random."""
    import my_a2c

    env = make()
    learner = my_a2c.A2C(Policy(env.obs_space, env.action_space, width=32), lr=1e-2)
    collect, rewards = learner.collector(env), []
    for _ in range(n_updates):
        rollout = collect()
        learner.update(rollout)
        rewards.append(rollout.reward.mean())
    assert torch.stack(rewards[-5:]).mean() > least
