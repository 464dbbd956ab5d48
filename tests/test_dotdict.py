"""Trees with attribute access, beyond what a dict does."""

import copy
import pickle
import subprocess
import sys

import pytest

from megastep.dotdict import dotdict, mapping


@pytest.fixture
def objs():
    return dotdict(a=dotdict(b=1, c=2), d=3)


def test_unknown_attributes_are_looked_up_on_leaves():
    tree = dotdict(a=1 + 2j, b=dotdict(c=3 - 4j))
    assert tree.imag == dotdict(a=2.0, b=dotdict(c=-4.0))
    assert type(tree.imag.b) is dotdict


def test_an_unknown_attribute_is_named_with_the_nearest_key():
    with pytest.raises(AttributeError, match=r"'rewrd' .*float.* obs, reward .*mean 'reward'"):
        _ = dotdict(obs=1.0, reward=2.0).rewrd
    with pytest.raises(AttributeError, match="'x' is not a key of this dotdict"):
        _ = dotdict().x


def test_an_unknown_key_is_named_with_the_keys():
    with pytest.raises(KeyError, match=r"'q' .*a, d"):
        dotdict(a=1, d=2)["q"]


def test_assignment_and_deletion_by_attribute_are_refused(objs):
    with pytest.raises(AttributeError, match=r"write d\['e'\] = "):
        objs.e = 1
    with pytest.raises(AttributeError, match=r"write del d\['d'\]"):
        del objs.d
    assert list(objs) == ["a", "d"]


def test_private_and_special_names_are_not_looked_up_on_leaves(objs):
    class Leaf:
        _private = __special__ = 1

    tree = dotdict(a=Leaf())
    assert not hasattr(tree, "_private")
    assert not hasattr(tree, "__special__")
    assert not hasattr(objs, "__array_interface__")
    assert hasattr(objs, "d") and hasattr(objs, "real") and not hasattr(objs, "colour")


@pytest.mark.parametrize(
    "make_copy",
    [copy.copy, copy.deepcopy, dotdict.copy, lambda tree: pickle.loads(pickle.dumps(tree))],
)
def test_copies_keep_type_and_values(objs, make_copy):
    copied = make_copy(objs)
    assert type(copied) is type(copied.a) is dotdict
    assert copied == objs and copied is not objs


def test_starmap_refuses_trees_with_other_keys(objs):
    with pytest.raises(ValueError, match="one has b, c and the other b"):
        objs.starmap(max, dotdict(a=dotdict(b=1), d=3))
    with pytest.raises(ValueError, match="keys a, d .*int"):
        objs.starmap(max, 3)


def test_mapping():
    @mapping
    def scale(x, by, plus=0):
        return by * x + plus

    assert scale(dotdict(a=1, b={"c": 2}), 10, plus=1) == {"a": 11, "b": {"c": 21}}
    assert scale(3, 10) == 30
    assert scale.__name__ == "scale"


def test_repr_aligns_values_and_shortens_long_leaves():
    tree = dotdict(long_key=[1, 2, 3], s="two\nlines", t="x" * 500, e=dotdict())
    first, second, third, fourth, fifth = repr(tree).split("\n")
    assert (first, second, third, fifth) == (
        "dotdict:",
        "long_key    list((3,))",
        "s           two lines",
        "e           dotdict:",
    )
    assert fourth.endswith("...") and len(fourth) <= 120


def test_import_needs_no_torch():
    code = (
        "import sys; sys.modules['torch'] = sys.modules['numpy'] = None; "
        "from megastep.dotdict import dotdict; print(dotdict(a=1).a)"
    )
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert process.stdout == "1\n", process.stderr
