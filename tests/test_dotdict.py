"""Trees with attribute access: what a plain dict does not do."""

import copy
import pickle
import subprocess
import sys

import pytest

from megastep.dotdict import dotdict, leaves, mapping


@pytest.fixture
def objs():
    return dotdict(a=dotdict(b=1, c=2), d=3)


def lines(*rows):
    return "\n".join(rows)


def test_keys_are_attributes(objs):
    assert objs.d == 3
    assert objs.a.c == 2


def test_unknown_attributes_are_looked_up_on_every_leaf():
    tree = dotdict(a=1 + 2j, b=dotdict(c=3 - 4j))
    assert tree.imag == dotdict(a=2.0, b=dotdict(c=-4.0))
    assert type(tree.imag.b) is dotdict


def test_calls_are_forwarded_with_their_arguments():
    tree = dotdict(a="x-y", b=dotdict(c="z"))
    assert tree.split("-") == {"a": ["x", "y"], "b": {"c": ["z"]}}
    assert tree.replace("z", "w").b.c == "w"


def test_a_key_shared_by_nested_trees_is_reached_through_their_parent():
    assert dotdict(a=dotdict(x=1, y=2), b=dotdict(x=3)).x == {"a": 1, "b": 3}


def test_methods_come_before_keys_and_keys_before_the_values_attributes():
    tree = dotdict(items=1, imag=2)
    assert list(tree.items()) == [("items", 1), ("imag", 2)]
    assert tree.imag == 2


def test_empty_branches_survive_forwarding():
    assert dotdict(a="x", b=dotdict()).upper() == {"a": "X", "b": {}}


def test_a_misspelt_attribute_names_itself_the_keys_and_the_nearest_one():
    with pytest.raises(
        AttributeError, match=r"'rewrd' is not .*type float.* its keys are obs, reward .*'reward'"
    ):
        _ = dotdict(obs=1.0, reward=2.0).rewrd
    with pytest.raises(AttributeError, match=r"'x' is not a key .*its keys are none"):
        _ = dotdict().x


def test_a_misspelt_item_names_the_keys():
    with pytest.raises(KeyError, match=r"'q' is not a key; its keys are a, d"):
        dotdict(a=1, d=2)["q"]


def test_assigning_or_deleting_by_attribute_is_refused(objs):
    with pytest.raises(AttributeError, match=r"write d\['e'\] = "):
        objs.e = 1
    with pytest.raises(AttributeError, match=r"write del d\['d'\]"):
        del objs.d
    assert list(objs) == ["a", "d"]


def test_private_and_special_names_are_not_forwarded(objs):
    class Boastful:
        _private = __special__ = 1

    tree = dotdict(a=Boastful())
    assert not hasattr(tree, "_private")
    assert not hasattr(tree, "__special__")
    assert not hasattr(objs, "__array_interface__")
    assert hasattr(objs, "d") and hasattr(objs, "real") and not hasattr(objs, "colour")


@pytest.mark.parametrize(
    "trip", [copy.copy, copy.deepcopy, dotdict.copy, lambda tree: pickle.loads(pickle.dumps(tree))]
)
def test_copies_keep_type_and_values(objs, trip):
    made = trip(objs)
    assert type(made) is dotdict and type(made.a) is dotdict
    assert made == objs and made is not objs


def test_deep_copies_are_deep(objs):
    copy.deepcopy(objs).a["b"] = 9
    assert objs.a.b == 1


def test_pipe_map_and_starmap_chain(objs):
    assert objs.pipe(list) == ["a", "d"]
    assert objs.map(float) == {"a": {"b": 1.0, "c": 2.0}, "d": 3.0}
    assert objs.starmap(int.__add__, objs) == {"a": {"b": 2, "c": 4}, "d": 6}
    assert objs.map(float).starmap(float.__add__, objs).pipe(list) == ["a", "d"]
    assert objs.map(round, -1) == {"a": {"b": 0, "c": 0}, "d": 0}
    assert objs.starmap(lambda x, y, z: x + y * z, objs, objs).d == 12


def test_starmap_refuses_trees_of_other_keys(objs):
    with pytest.raises(ValueError, match="one has b, c and the other b"):
        objs.starmap(max, dotdict(a=dotdict(b=1), d=3))
    with pytest.raises(ValueError, match="keys a, d was matched with one value of type int"):
        objs.starmap(max, 3)


def test_leaves_come_in_order(objs):
    assert leaves(objs) == [1, 2, 3]
    assert leaves(5) == [5]


def test_mapping_makes_a_function_of_trees():
    @mapping
    def scale(x, by, plus=0):
        return by * x + plus

    assert scale(dotdict(a=1, b={"c": 2}), 10, plus=1) == {"a": 11, "b": {"c": 21}}
    assert scale(3, 10) == 30
    assert scale.__name__ == "scale"


def test_merging_keeps_the_type():
    merged = dotdict(a=1, b=2) | {"b": 3}
    assert type(merged) is dotdict and merged == {"a": 1, "b": 3}
    assert type({"a": 1} | dotdict(b=2)) is dotdict


def test_printing_nests(objs):
    assert (
        repr(objs)
        == str(objs)
        == lines("dotdict:", "a    dotdict:", "     b    1", "     c    2", "d    3")
    )


def test_printing_aligns_values_and_keeps_leaves_to_a_line():
    tree = dotdict(long_key=[1, 2, 3], s="two\nlines", t="x" * 500, e=dotdict())
    first, second, third, fourth, fifth = repr(tree).split("\n")
    assert (first, second, third, fifth) == (
        "dotdict:",
        "long_key    list((3,))",
        "s           two lines",
        "e           dotdict:",
    )
    assert fourth.endswith("...") and len(fourth) <= 120


def test_tuples_of_integers_are_printed_in_full_and_other_collections_by_their_length():
    tree = dotdict(shape=(2, 3), flags=(True,), names=("a", "b"), long=tuple(range(9)))
    assert repr(tree) == lines(
        "dotdict:",
        "shape    (2, 3)",
        "flags    tuple((1,))",
        "names    tuple((2,))",
        "long     tuple((9,))",
    )


def test_completion_offers_the_keys(objs):
    assert {"a", "d", "map"} <= set(dir(objs))


def test_importing_it_needs_no_torch():
    code = (
        "import sys; sys.modules['torch'] = sys.modules['numpy'] = None; "
        "from megastep.dotdict import dotdict; print(dotdict(a=1).a)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "1\n", done.stderr
