"""Callbacks: when they are called, and what they can do."""

import pytest

import megastep
from megastep.agents.cli import train
from megastep.agents.errors import UserError
from megastep.agents.training.callbacks import HOOKS, Callbacks
from tests.helpers.pages import ROOT, code
from tests.helpers.tiny import TINY

CALLS = []


class Noted:
    def __getattr__(self, name):
        if name in HOOKS:
            return lambda trainer, *others: CALLS.append((name, trainer.updates, others))
        raise AttributeError(name)


class Stop:
    def on_update(self, trainer, losses):
        if trainer.updates == 3:
            trainer.end()


class Fails:
    def on_rollout(self, trainer, rollout):
        raise KeyError("no such thing")


class Nothing:
    """No callback."""


def run(*callbacks):
    names = ",".join(f"{__name__}:{one.__name__}" for one in callbacks)
    return train.main(
        [*TINY, "samples=192", "checkpoints.seconds=1000", "folder=run", f"callbacks=[{names}]"]
    )


def test_hooks_are_called_in_order(here):
    CALLS.clear()
    assert run(Noted) == 0
    names = [name for name, *_ in CALLS]
    update = ["on_collect", "on_rollout", "on_update"]
    report = ["on_measure", "on_report"]
    end = ["on_checkpoint", "on_end"]
    assert names == ["on_start", *4 * update, *report, *2 * update, *report, *end]
    assert [n for name, n, _ in CALLS if name == "on_update"] == [1, 2, 3, 4, 5, 6]
    reports = [others[0] for name, _, others in CALLS if name == "on_report"]
    assert [report["samples"] for report in reports] == [128, 192] and "loss/value" in reports[0]


def test_a_callback_stops_training_with_a_checkpoint(here):
    assert run(Stop) == 0
    assert [*here.glob("run/checkpoints/step_96")]


def test_a_callback_that_raises_is_named_and_what_was_learnt_is_saved(here, capsys):
    assert run(Fails) == 2
    assert "Fails.on_rollout failed (KeyError: 'no such thing')" in capsys.readouterr().err


def test_what_is_no_callback_is_refused(here, capsys):
    assert run(Nothing) == 2
    assert "Nothing is not a callback: it has none of on_start" in capsys.readouterr().err
    assert not [*here.glob("run/checkpoints/*")]
    assert train.main([*TINY, "callbacks=[nowhere:Stop]"]) == 2
    assert "callbacks: nowhere:Stop cannot be imported" in capsys.readouterr().err
    with pytest.raises(UserError, match="callbacks: .* must take no arguments"):
        megastep.train(callbacks=[Callbacks, ConfigTaker])


class ConfigTaker:
    def __init__(self, config):
        pass


def test_examples_of_the_page(here):
    names = {}
    exec(code((ROOT / "docs/callbacks.md").read_text())[0], names)
    patience, calls = names["Patience"](), []
    trainer = type("T", (), {"end": lambda self: calls.append(1)})()
    for score in [1.0, 2.0, *20 * [1.5]]:
        patience.on_report(trainer, {"episode/return": score})
    assert calls == [1]
