"""Settings: annotations are enforced, in the command line and in Python."""

import dataclasses
import inspect
import json
import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest
import yaml
from pydantic import Field

from megastep import envs
from megastep.agents.errors import ConfigErrors
from megastep.agents.factory.check import as_tree, check
from megastep.agents.runs import typed_json
from megastep.settings import checked, settings_of

NAN = float("nan")


def messages(kind, **values):
    """Returns {key: sentence} for values that are not allowed."""
    with pytest.raises(ConfigErrors) as error:
        check(kind, values)
    return dict(error.value.errors)


@pytest.mark.parametrize(
    "bounds, inside, outside",
    [
        (dict(ge=1, le=3), (1, 2, 3), {0: "at least 1", 4: "at most 3", NAN: "any finite number"}),
        (dict(gt=0, lt=180), (1e-9, 179.9), {0: "more than 0", 180: "below 180"}),
        (dict(ge=2), (2, 10**18), {1.5: "at least 2", math.inf: "any finite number"}),
        (dict(ge=1, le=2**26), (2**26,), {2**26 + 1: "at most 67,108,864"}),
        (dict(), (-1e300, 0), {NAN: "any finite number", math.inf: "any finite number"}),
    ],
)
@pytest.mark.parametrize("optional", [False, True])
def test_out_of_range(bounds, inside, outside, optional):
    hint = Annotated[float, Field(**bounds)] if bounds else float

    def f(x: hint | None if optional else hint): ...

    kind = settings_of(f)
    assert [check(kind, {"x": value}).x for value in inside] == list(inside)
    for value, allowed in outside.items():
        assert messages(kind, x=value) == {"x": f"{value} is out of range: allowed is {allowed}"}


def rover(
    n_envs: Annotated[int, Field(ge=1)] = 8,
    *,
    seed=1,
    limit: Annotated[float, Field(gt=0, le=500)] = 300,
    far: bool = False,
    colour: Literal["red", "green"] = "red",
    sizes: tuple[int, ...] = (3, 4),
    names=["a"],  # noqa: B006, an argument of a stranger's
    plan: Path | None = None,
    speed=1.5,
    even: Annotated[int, Field(multiple_of=2)] = 2,
    must: str,
    **others,
): ...


def test_settings_of_signature():
    kind = settings_of(rover, ("seed",), name=str)
    settings = check(kind, {"name": "r", "must": "x", "sizes": [5], "limit": 7, "n_envs": 1e3})
    assert dataclasses.astuple(settings) == (
        "r",
        1000,
        7.0,
        False,
        "red",
        (5,),
        ["a"],
        None,
        1.5,
        2,
        "x",
    )
    assert check(kind, as_tree(settings)) == settings and as_tree(settings)["sizes"] == [5]
    assert as_tree(check(kind, {"name": "r", "must": "x", "plan": "a/b"}))["plan"] == "a/b"
    with pytest.raises(dataclasses.FrozenInstanceError):
        settings.limit = 3


@pytest.mark.parametrize(
    "key, value, sentence",
    [
        ("n_envs", 1.5, "expected an integer, got 1.5"),
        ("n_envs", True, "expected an integer, got True"),
        ("n_envs", "3", "expected an integer, got '3'"),
        ("n_envs", None, "expected an integer, got nothing"),
        ("limit", "far", "expected a number, got 'far'"),
        ("limit", True, "expected a number, got True"),
        ("far", 1, "expected true or false, got 1"),
        ("far", "yes", "expected true or false, got 'yes'"),
        ("must", 3, "expected a word, got 3"),
        ("sizes", 3, "expected a list, got 3"),
        ("speed", "x", "expected a number, got 'x'"),
        ("colour", "gren", "'gren' is unknown; did you mean green?"),
        ("colour", 3, "3 is unknown; there are green, red"),
        ("even", 3, "input should be a multiple of 2, got 3"),
        ("seed", 2, "no such key; did you mean speed?"),
    ],
)
def test_wrong_type(key, value, sentence):
    kind = settings_of(rover, ("seed",))
    assert messages(kind, **{"must": "x", key: value}) == {key: sentence}


def test_all_errors_at_once():
    kind = settings_of(rover, ("seed",))
    assert set(messages(kind, n_envs=0, limit=-1, far=3, zzz=1)) == {
        "n_envs",
        "limit",
        "far",
        "zzz",
        "must",
    }


def test_unreadable_annotations():
    def unknown(x: "Nowhere"): ...  # noqa: F821

    def taken(name: str): ...

    with pytest.raises(ValueError, match="arguments cannot be read: name 'Nowhere'"):
        settings_of(unknown)
    with pytest.raises(ValueError, match="called name"):
        settings_of(taken, name=str)


def test_checked():
    @checked
    def f(a: Annotated[int, Field(ge=1, le=3)], b=2, *, c: Annotated[float, Field(le=1)] = 0):
        """Adds up."""
        return a + b + c

    assert f(1) == 3 and f(3, 4, c=1) == 8 and f.__doc__ == "Adds up."
    assert f(np.int64(2), c=np.float32(0.5)) == 4.5
    assert list(inspect.signature(f).parameters) == ["a", "b", "c"]
    with pytest.raises(ValueError, match="^a: 0 is out of range: allowed is at least 1$"):
        f(0)
    with pytest.raises(ValueError, match="^a: 4 is .*; c: 2 is out .* is at most 1$"):
        f(4, c=2)
    with pytest.raises(ValueError, match="^a: expected an integer, got 1.5$"):
        f(1.5)
    with pytest.raises(ValueError, match=r"^sizes: expected a tuple, got the list \[1\]$"):
        checked(lambda sizes=(): sizes)([1])
    with pytest.raises(TypeError):
        f(1, typo=1)


@pytest.mark.parametrize("name", envs.ENVS)
def test_environment_bounds(name):
    outside = {"n_envs": (0, 2**26 + 1), "res": (0, 1025), "fov": (0, 180), "fps": (0.5, 1001)}
    outside |= {"points": (0, 1001), "limit": (0, 10**6 + 1), "tracker_speed": (-0.1, 40)}
    taken = inspect.signature(envs.ENVS[name]).parameters
    for argument, values in ((key, outside[key]) for key in taken if key in outside):
        for value in values:
            with pytest.raises(ValueError, match=f"^{argument}: .* is out of range: "):
                envs.ENVS[name](**{"n_envs": 1, "device": "cpu", argument: value})


# ---- Values as they were typed ----


class Shelf:
    """Takes what a stranger's constructor may take."""

    def __init__(
        self,
        cap=None,
        prices: dict[int, float] | None = None,
        start: list[float] | None = None,
        more: dict[str, Any] | None = None,
        shape=(2, 3),
        limit: float = None,
        pick=max,
        gain: float = math.inf,
        n: int = 1,
    ): ...


TYPED = [
    {"cap": math.inf},
    {"cap": NAN},
    {"cap": 3.0},
    {"cap": 3},
    {"cap": 1e6},
    {"cap": "1e6"},
    {"cap": [0.0, 0, True, None, "0", [-math.inf]]},
    {"cap": {0: 1.0, "0": 2, True: {0.5: [NAN]}}},
    {"cap": {"$float": "inf", "$dict": [[1]]}},
    {"cap": {"$dict": {"$float": "x"}}},
    {"prices": {0: 1.0, 7: -0.0}},
    {"start": [0.0, 2.0]},
    {"more": {"a": {1: [math.inf, {2: 3.0}]}}},
    {"gain": -math.inf},
    {},
]


@pytest.mark.parametrize("tree", TYPED, ids=str)
def test_values_are_kept_as_they_were_typed(tree):
    kind = settings_of(Shelf, is_finite=False)
    chosen = check(kind, tree)
    for name, value in tree.items():
        assert repr(getattr(chosen, name)) == repr(value)
    kept = as_tree(chosen)
    saved = typed_json.loads(typed_json.dumps(kept))
    assert repr(check(kind, saved)) == repr(chosen) and (chosen.shape, chosen.pick) == ((2, 3), max)
    json.loads(typed_json.dumps(kept), parse_constant=pytest.fail)  # standard JSON
    assert repr(yaml.safe_load(yaml.safe_dump(kept, sort_keys=False))) == repr(kept)


def test_annotations_decide_where_they_can():
    kind = settings_of(Shelf, is_finite=False)
    chosen = check(kind, {"n": 1e3, "gain": 2, "prices": {0: 1}, "start": [1], "shape": [1.0, 2]})
    values = chosen.n, chosen.gain, chosen.prices, chosen.start, chosen.shape
    assert repr(values) == "(1000, 2.0, {0: 1.0}, [1.0], (1.0, 2))"
    assert messages(kind, more={0: 1}) == {"more": "expected a word, got 0"}
    assert messages(kind, prices={"a": 1})["prices"].startswith("expected an integer")
    assert messages(kind, cap=[max])["cap"].endswith(
        "cannot be kept in a checkpoint; use numbers, words and lists"
    )


@pytest.mark.parametrize("text", ['{"$float": [1]}', '{"$dict": 3}', '{"$dict": [[[1], 2]]}', "{"])
def test_damaged_json_is_an_error_of_values(text):
    with pytest.raises(ValueError):
        typed_json.loads(text)
