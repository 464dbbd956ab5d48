"""Signatures of runs, and the key that they are made with."""

import json
import stat
import warnings

import pytest

from megastep.agents.runs import trust
from tests.helpers.processes import in_threads


def config(name="rover:Rover", **more):
    return json.dumps({"train": {"env": {"name": name, **more}}}).encode()


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """A user without a key."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


def test_own_classes_need_no_signature(home):
    own = config("megastep.envs.explorer:Explorer", core="lstm")
    assert trust.sign(own) is None and trust.untrusted_names(own, None) == []
    assert not home.exists(), "and no key"


@pytest.mark.parametrize(
    "name",
    ["rover:Rover", "os:_exit", "megastep.envs.pong:os._exit", "megastepx:A", " megastep.envs:A"]
    + ["megastep.agents.launch.signals:stop", "my-module:A", ":", "megastep.envs.pong:Pong\n"],
)
def test_names_outside_megastep_are_found_at_any_depth(name):
    for text in (config(name), config("own", deep={"in": [0, [name]]}), config("own", **{name: 3})):
        assert trust.untrusted_names(text, None) == [name]


def test_logger_outside_megastep_is_found():
    tree = {"train": {"logger": {"csv": {"name": "megastep.agents.training.loggers.csv:CSV"}}}}
    assert trust.untrusted_names(json.dumps(tree).encode(), None) == []
    tree["train"]["logger"]["mine"] = {"name": "mine:Mine"}
    assert trust.untrusted_names(json.dumps(tree).encode(), None) == ["mine:Mine"]


def test_signature_is_of_one_user_and_one_configuration(home, monkeypatch):
    signature = trust.sign(config())
    assert trust.untrusted_names(config(), signature) == []
    assert trust.untrusted_names(config("other:A"), signature) == ["other:A"]
    for forged in (None, "", 3, [], "\ud800", signature[:-1], signature.upper()):
        assert trust.untrusted_names(config(), forged) == ["rover:Rover"]
    monkeypatch.setenv("XDG_CONFIG_HOME", str(home.with_name("another")))
    assert trust.untrusted_names(config(), signature) == ["rover:Rover"]
    assert not home.with_name("another").exists(), "reading makes no key"


def test_key_is_private_and_made_once(home):
    signatures = set()
    in_threads(lambda: signatures.add(trust.sign(config())))
    (folder,) = home.iterdir()
    (key,) = folder.iterdir()
    assert len(signatures) == 1 and len(key.read_bytes()) == 32
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def spoil(home, how):
    key = home / "megastep/key"
    if how == "no folder":
        home.write_text("a file")
        return
    trust.sign(config())
    if how == "short":
        key.write_bytes(b"")
    else:
        key.chmod(0o640)


@pytest.mark.parametrize("how", ["no folder", "short", "shared"])
def test_unusable_key_signs_nothing_and_is_named(home, how):
    spoil(home, how)
    with pytest.warns(UserWarning, match=f"cannot be signed .*{home}.* needs trust=true"):
        assert trust.sign(config()) is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert trust.untrusted_names(config(), None) == ["rover:Rover"]


def test_deeply_nested_configuration():
    text = b'{"train": {"env": ' + 900 * b"[" + b'"a:b"' + 900 * b"]" + b"}}"
    assert trust.untrusted_names(text, None) == ["a:b"]
    for text in (b"[]", b"3", b'{"train": 3}', b'{"train": {"env": null}}'):
        assert trust.untrusted_names(text, None) == []
