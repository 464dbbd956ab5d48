"""Which import paths of a run may be imported."""

import pytest

from megastep.agents.runs import trust


def config(name="rover:Rover", **more):
    return {"train": {"env": {"name": name, **more}}}


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """A user who has not trained yet."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


def test_own_classes_are_trusted():
    assert trust.foreign_names(config("megastep.envs.explorer:Explorer", core="lstm")) == []


@pytest.mark.parametrize(
    "name",
    ["rover:Rover", "os:_exit", "megastep.envs.pong:os._exit", "megastepx:A", " megastep.envs:A"]
    + ["megastep.agents.launch.signals:stop", "my-module:A", ":", "megastep.envs.pong:Pong\n"],
)
def test_names_outside_megastep_are_found_at_any_depth(name):
    for tree in (config(name), config("own", deep={"in": [0, [name]]}), config("own", **{name: 3})):
        assert trust.foreign_names(tree) == [name]


def test_what_a_user_trains_with_is_trusted_afterwards(home, monkeypatch):
    assert trust.untrusted(["a:A", "b:B"]) == ["a:A", "b:B"] and not home.exists()
    trust.remember(["a:A"])
    trust.remember(["a:A", "c:C"])
    assert trust.untrusted(["a:A", "b:B", "c:C"]) == ["b:B"]
    monkeypatch.setenv("XDG_CONFIG_HOME", str(home.with_name("another")))
    assert trust.untrusted(["a:A"]) == ["a:A"]


def test_a_folder_that_cannot_be_written_is_named(home):
    home.write_text("a file")
    with pytest.warns(UserWarning, match=f"{home}.* needs trust=true"):
        trust.remember(["a:A"])
