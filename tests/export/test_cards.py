"""Cards of agents."""

import re
import shlex

from megastep.agents.cli import evaluate, export, record, train
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


def test_export_writes_a_card_whose_commands_work_for_a_colleague(here, monkeypatch):
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
    again = path.read_text()
    assert "The best thief, " in again and "Not evaluated." in again and "- command" not in again
    path.write_text("Notes\n")
    assert export.main(words) == 0
    assert path.read_text() == "Notes\n"
