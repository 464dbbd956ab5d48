"""Trees of arrays: indexing, operators, joining, conversion, and torch's pytrees."""

import copy
import operator
import pickle

import numpy as np
import pytest
import torch
from torch.utils import _pytree

from megastep.arrdict import arrdict, cat, clone, numpyify, stack, torchify
from megastep.dotdict import dotdict
from megastep.ragged import Ragged

OPERATORS = "add sub mul truediv floordiv mod pow lshift rshift and_ or_ xor lt le eq ne ge gt"


@pytest.fixture
def tensors():
    return arrdict(a=torch.tensor([1]), b=arrdict(c=torch.tensor([2])))


def numbers(tree):
    """A dict of the tree's arrays as nested lists, so that == gives one bool."""
    return {
        key: numbers(value) if isinstance(value, dict) else np.asarray(value).tolist()
        for key, value in tree.items()
    }


def test_assignment_to_an_index_writes_in_place():
    a, c = torch.zeros(3), torch.zeros(3, 2)
    tree = arrdict(a=a, b=arrdict(c=c))
    tree[torch.tensor([True, False, True])] = arrdict(
        a=torch.tensor([1.0, 2.0]), b=arrdict(c=torch.ones(2, 2))
    )
    assert a.tolist() == [1, 0, 2] and c.tolist() == [[1, 1], [0, 0], [1, 1]]
    tree[1] = 7
    assert a.tolist() == [1, 7, 2] and c[1].tolist() == [7, 7]


def test_assignment_of_a_tree_with_other_keys_is_refused_before_any_write():
    tree = arrdict(a=torch.zeros(2), b=torch.zeros(2))
    with pytest.raises(ValueError, match="one has a, b and the other a"):
        tree[0] = arrdict(a=1.0)
    assert tree.a.tolist() == [0, 0]


@pytest.mark.parametrize("name", OPERATORS.split())
@pytest.mark.parametrize("kind", [torch.tensor, np.array])
def test_operators_with_trees_and_values_on_either_side(name, kind):
    op = getattr(operator, name)
    x, y = kind([5, 6]), kind([2, 1])
    left, right = arrdict(a=x, b=arrdict(c=y)), arrdict(a=y, b=arrdict(c=y))
    assert numbers(op(left, right)) == {"a": op(x, y).tolist(), "b": {"c": op(y, y).tolist()}}
    for other in (3, kind([3, 4]), kind(3), np.int64(3)):
        assert numbers(op(left, other)) == {
            "a": op(x, other).tolist(),
            "b": {"c": op(y, other).tolist()},
        }, other
        assert numbers(op(other, left)) == {
            "a": op(other, x).tolist(),
            "b": {"c": op(other, y).tolist()},
        }, other
        assert type(op(other, left)) is arrdict


def test_matmul_and_divmod():
    tree = arrdict(a=np.array([[1.0, 2.0], [3.0, 4.0]]))
    swap = np.array([[0.0, 1.0], [1.0, 0.0]])
    assert (tree @ swap).a.tolist() == [[2, 1], [4, 3]]
    assert (swap @ tree).a.tolist() == [[3, 4], [1, 2]]
    assert divmod(arrdict(a=7), 2) == {"a": (3, 1)}
    assert divmod(7, arrdict(a=2)) == {"a": (3, 1)}


def test_unary_operators():
    tree = arrdict(a=torch.tensor([1, -2]))
    assert (-tree).a.tolist() == [-1, 2]
    assert (+tree).a.tolist() == [1, -2]
    assert abs(tree).a.tolist() == [1, 2]
    assert (~arrdict(a=torch.tensor([True, False]))).a.tolist() == [False, True]


def test_augmented_assignment_makes_a_new_tree():
    tree = arrdict(a=torch.tensor([True, False]))
    before, tree = tree, operator.ior(tree, arrdict(a=torch.tensor([False, True])))
    assert tree.a.tolist() == [True, True] and before.a.tolist() == [True, False]
    tree += 1
    assert tree.a.tolist() == [2, 2]


def test_stack_makes_a_new_axis_and_cat_extends_one():
    trees = [arrdict(a=torch.full((2, 3), i), b=arrdict(c=np.full(4, i)), n=i) for i in range(5)]
    stacked = stack(trees)
    assert stacked.a.shape == (5, 2, 3) and stacked.b.c.shape == (5, 4)
    assert stacked.n.tolist() == [0, 1, 2, 3, 4]
    assert stacked.b.c[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert type(stacked) is arrdict and type(stacked.b) is arrdict
    assert stack([torch.zeros(2), torch.ones(2)], dim=1).tolist() == [[0, 1], [0, 1]]
    pair = [arrdict(a=torch.full((2, 3), i), b=arrdict(c=np.full((1, 1), i))) for i in range(2)]
    assert cat(pair).a.shape == (4, 3) and cat(pair, dim=1).a.tolist() == [[0, 0, 0, 1, 1, 1]] * 2
    assert cat(pair).b.c.tolist() == [[0], [1]]


def test_torchify_converts_float64_to_float32_only():
    tree = torchify(
        arrdict(
            d=np.zeros(2),
            f=np.zeros(2, np.float32),
            h=np.zeros(2, np.float16),
            i=np.arange(2),
            b=np.array([True]),
            n=3,
            r=Ragged(np.arange(3.0), [1, 2]),
        )
    )
    assert {key: leaf.dtype for key, leaf in tree.items() if key != "r"} == dict(
        d=torch.float32,
        f=torch.float32,
        h=torch.float16,
        i=torch.int64,
        b=torch.bool,
        n=torch.int64,
    )
    assert tree.r.vals.dtype == torch.float32
    with pytest.raises(ValueError, match="torchify .*str"):
        torchify(arrdict(s="word"))


def test_numpyify_converts_lists_and_keeps_other_values():
    tree = numpyify(
        dotdict(
            t=torch.ones(2, requires_grad=True),
            h=torch.ones(2, dtype=torch.bfloat16),
            s="word",
            n=None,
            many=(torch.zeros(1), [torch.ones(1)]),
            r=Ragged(torch.arange(3.0), [1, 2]),
        )
    )
    assert isinstance(tree.t, np.ndarray) and tree.h.dtype == np.float32
    assert tree.s == "word" and tree.n is None and tree.r[1].tolist() == [1, 2]
    assert isinstance(tree.many[0], np.ndarray) and isinstance(tree.many[1][0], np.ndarray)


def test_clones_share_no_memory():
    tree = arrdict(
        t=torch.zeros(2), n=np.zeros(2), b=arrdict(r=Ragged(torch.zeros(2), [2])), list=[1]
    )
    copied = clone(tree)
    copied.t[0] = copied.n[0] = copied.b.r.vals[0] = copied["list"][0] = 9
    assert tree.t[0] == tree.n[0] == tree.b.r.vals[0] == 0 and tree["list"] == [1]


@pytest.mark.parametrize(
    "make_copy", [copy.copy, copy.deepcopy, lambda tree: pickle.loads(pickle.dumps(tree))]
)
def test_copies_keep_type_and_values(tensors, make_copy):
    copied = make_copy(tensors)
    assert type(copied) is type(copied.b) is arrdict and numbers(copied) == numbers(tensors)


@pytest.mark.parametrize("kind", [arrdict, dotdict])
def test_pytrees_keep_the_type(kind):
    tree = kind(a=torch.tensor([1]), b=kind(c=torch.tensor([2])))
    mapped = _pytree.tree_map(lambda x: x + 1, tree)
    assert type(mapped) is type(mapped.b) is kind and mapped.b.c.tolist() == [3]
    paths = [_pytree.keystr(path) for path, _ in _pytree.tree_flatten_with_path(tree)[0]]
    assert paths == ["['a']", "['b']['c']"]
