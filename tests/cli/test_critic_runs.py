"""Runs with either critic: train, resume, evaluate and init."""

import pytest
import torch

from megastep.agents.cli import evaluate, train
from megastep.agents.errors import UserError
from megastep.agents.runs import checkpoint
from megastep.envs import Explorer
from tests.cli.test_train import configured
from tests.helpers import tiny
from tests.helpers.weights import of_run as weights

pytestmark = pytest.mark.usefixtures("here")
EXPLORER = ["env=explorer", *tiny.TINY[1:], "env.patience=3", "logging.every=1"]
UPDATE = tiny.UPDATE


def trained(*overrides):
    return train.run(configured(*overrides, tiny=EXPLORER))


def refuse_privileged(monkeypatch):
    """Has Explorer raise a TypeError if it computes a privileged observation."""

    def plain_judge(env, newly_seen):
        if env.privileged_space is not None:
            raise TypeError("a privileged observation is computed")
        return judge(env, newly_seen)

    judge = Explorer._judge
    monkeypatch.setattr(Explorer, "_judge", plain_judge)


@pytest.mark.parametrize("critic", ["asymmetric", "plain"])
def test_train_resume_evaluate_and_init(critic, monkeypatch):
    run = trained(f"samples={2 * UPDATE}", f"agent.critic={critic}")
    has_intake = "critic.intake.project.weight" in weights(run)
    assert has_intake == ("prediction.weight" in weights(run)) == (critic == "asymmetric")
    again = configured(f"resume={run}", f"samples={3 * UPDATE}", tiny=[])
    assert again.agent.critic == critic and train.run(again) == run
    assert checkpoint.load_latest(run / "checkpoints").step == 3 * UPDATE
    second = trained("samples=1", "learner.lr=1e-12", f"init={run}", f"agent.critic={critic}")
    first = "intake.project.weight"
    torch.testing.assert_close(weights(second)[first], weights(run)[first], rtol=0, atol=1e-6)

    # evaluating computes no privileged observations
    refuse_privileged(monkeypatch)
    assert evaluate.main([f"run={run}", "episodes=3", "baseline=false", "device=cpu"]) == 0


def test_plain_critic_does_not_compute_privileged(monkeypatch):
    refuse_privileged(monkeypatch)
    trained("samples=1", "agent.critic=plain")
    with pytest.raises(TypeError):
        trained("samples=1", "agent.critic=asymmetric")


@pytest.mark.parametrize("saved, chosen", [("asymmetric", "plain"), ("plain", "asymmetric")])
def test_init_refuses_other_kind_of_critic(saved, chosen):
    run = trained("samples=1", f"agent.critic={saved}")
    with pytest.raises(UserError, match=f"agent.critic={saved}.*critic"):
        trained("samples=1", f"init={run}", f"agent.critic={chosen}")


def test_init_allows_any_critic_without_privileged_space():
    run = train.run(configured("agent.critic=asymmetric", "samples=1", tiny=tiny.TINY))
    train.run(configured(f"init={run}", "agent.critic=plain", "samples=1", tiny=tiny.TINY))
