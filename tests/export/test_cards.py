"""Cards of agents, and agent files of policies that a loop of one's own has trained."""

import re
import shlex

import pytest
import torch

import megastep
from megastep.agents.cli import evaluate, export, record, train
from megastep.agents.export import agent
from megastep.agents.networks.policy import Policy
from megastep.agents.selfplay.bots.random import RandomActions
from tests.helpers import tiny

MAINS = {"evaluate": evaluate.main, "record": record.main, "train": train.main}
HEIST = "from megastep.envs import Minimal\n\n\nclass Heist(Minimal):\n    pass\n"


def typed(card):
    """Runs every command of a card, as one types it. Returns them."""
    commands = re.findall(r"^`?(megastep (?:evaluate|record|train).*?)(?:`.*)?$", card, re.M)
    for line in commands:
        _, name, *words = shlex.split(line.replace("seconds=60", "samples=32"))
        short = ["steps=2", "file=a.png"] if name == "record" else []
        assert MAINS[name]([*words, *short, "device=cpu"]) == 0, line
    return commands


def test_a_command_on_a_card_has_no_folder_of_the_machine():
    commands = [f"/here/bin/python /home/me/{file} a=1" for file in ("train.py", "tune.py")]
    assert [*map(agent.command_of, commands)] == ["python train.py a=1", "python tune.py a=1"]


def test_export_writes_a_card_whose_commands_work_for_a_colleague(here, monkeypatch, capsys):
    (here / "heist.py").write_text(HEIST)
    monkeypatch.syspath_prepend(here)
    words = [*tiny.TINY[1:], *tiny.SHORT_EPISODES, "env=heist:Heist", "samples=64", "folder=run"]
    assert train.main(words) == 0
    assert evaluate.main(["run=run", "episodes=8", "device=cpu", "baseline=none"]) == 0
    words = ["run=run", "format=safetensors", "file=far/heist_agent.safetensors"]
    assert export.main(words) == 0
    card = (path := here / "far/heist_agent.md").read_text()
    assert card.startswith("# heist_agent\n") and "`env=heist:Heist`" in card
    assert "It needs `heist:Heist`" in card and "icence" not in card
    assert "- samples: 64\n" in card and "| trained " in card
    (here / "far/heist.py").write_text(HEIST)
    monkeypatch.chdir(here / "far")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(here / "colleague"))  # who trusts nothing yet
    assert len(typed(card)) == 4
    monkeypatch.chdir(here)
    path.write_text(card.replace("A baseline, ", "The best thief, "))
    for left_out in (here / "run/provenance.jsonl", *here.glob("run/evaluations/*")):
        left_out.unlink()
    assert export.main(words) == 0
    not_run = " run=run/checkpoints/step_64 was not run\n"
    assert not_run in capsys.readouterr().err, "of any geometry, as not all are for any agent"
    again = path.read_text()
    assert "The best thief, " in again and "Not evaluated." in again and "- command" not in again
    path.write_text("Notes\n")
    assert export.main(words) == 0
    assert path.read_text() == "Notes\n"


MINIMAL: dict = dict(n_envs=3, geometry="box", device="cpu", shortest=5, longest=9)


def test_a_saved_policy_acts_as_before(here):
    env = megastep.make("minimal", res=8, **MINIMAL)
    policy = Policy(env, width=16, core="gru", layers=2, critic=None)
    policy.update_stats(env.reset().obs)
    for weight in policy.parameters():
        weight.data = weight.data.half().float()  # so that the file holds the same numbers
    run = megastep.save(policy, env, "mine.safetensors")
    loaded, world = megastep.load("mine.safetensors").policy, env.reset()
    for _ in range(12):
        decision = policy.act(world, greedy=True)
        assert torch.equal(decision.actions, loaded.act(world, greedy=True).actions)
        world = env.step(decision)
    first, second = (run.make(n_envs=3, seed=1) for _ in range(2))
    assert megastep.evaluate(policy, env=first) == megastep.evaluate(loaded, env=second)
    assert run.config["env"]["res"] == 8 and len(typed((here / "mine.md").read_text())) == 3


def test_what_cannot_be_saved_says_what_can(here):
    env = megastep.make("minimal", res=8, **MINIMAL)
    other = megastep.make("minimal", res=16, **MINIMAL)
    for policy, where, text in [
        (RandomActions(None), env, r"a megastep.*Policy, got RandomActions; .*Policy\(env, core="),
        (Policy(env, width=8), object(), "that megastep.make returned, got object; make one"),
        (Policy(other, width=8), env, "The policy was trained in another .* W=16.* W=8"),
    ]:
        with pytest.raises(megastep.UserError, match=text):
            megastep.save(policy, where, "mine.safetensors")
    with pytest.raises(megastep.UserError, match="must end with .safetensors"):
        megastep.save(Policy(env, width=8), env, "mine.pt")
    assert not [*here.iterdir()]
