"""Bounds of arguments: said in annotations, enforced by constructors."""

import inspect
import math
from typing import Annotated

import pytest

from megastep import envs
from megastep.bounds import Within, bounded, bounds_of

NAN = float("nan")


@pytest.mark.parametrize(
    "bounds, inside, outside, told",
    [
        (Within(1, 3), (1, 2, 3), (0, 4, NAN, math.inf), "from 1 to 3"),
        (Within(0, 180, True, True), (1e-9, 179.9), (0, 180, -1), "above 0 and below 180"),
        (Within(0, min_open=True), (1e-9, 1e300), (0, math.inf, -math.inf), "more than 0"),
        (Within(2), (2, 10**18), (1.5, math.inf), "at least 2"),
        (Within(1, 2**26), (2**26,), (2**26 + 1,), "from 1 to 67,108,864"),
    ],
)
def test_a_value_outside_is_told_what_is_allowed(bounds, inside, outside, told):
    assert [bounds.error(value) for value in inside] == [None] * len(inside)
    for value in outside:
        assert bounds.error(value) == f"{value} is out of range: allowed is {told}"


def test_a_bounded_function_refuses_by_name_and_keeps_its_signature():
    @bounded
    def f(a: Annotated[int, Within(1, 3)], b: int = 2, *, c: Annotated[float, Within(0, 1)] = 0.5):
        """Adds up."""
        return a + b + c

    assert f(1) == 3.5 and f(3, 4, c=1) == 8 and f.__doc__ == "Adds up."
    assert list(inspect.signature(f).parameters) == ["a", "b", "c"]
    with pytest.raises(ValueError, match="^a: 0 is out of range: allowed is from 1 to 3$"):
        f(0)
    with pytest.raises(ValueError, match="^c: 2 "):
        f(1, c=2)
    with pytest.raises(TypeError):
        f(1, typo=1)


@pytest.mark.parametrize("name", envs.ENVS)
def test_an_environment_refuses_what_is_out_of_the_bounds_of_its_arguments(name):
    bounds = bounds_of(envs.ENVS[name].__init__)
    assert {"n_envs", "res", "fov", "fps"} < set(bounds)
    for argument, limits in bounds.items():
        for value in (limits.min - 1, limits.max + 1):
            with pytest.raises(ValueError, match=f"^{argument}: .* is out of range: "):
                envs.ENVS[name](**{"n_envs": 1, "device": "cpu", argument: value})
