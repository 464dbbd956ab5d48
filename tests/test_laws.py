"""Laws that hold for every input, tried on inputs that hypothesis makes up.

Every run tries the same inputs. `EXAMPLES=10000 python -m pytest tests/test_laws.py` tries that
many others; an input that fails is kept in data/.
"""

import functools
import io
import os
import pathlib

import numpy as np
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from megastep import arrdict, geometries
from megastep.agents.algorithms import returns
from megastep.agents.cli import train
from megastep.agents.cli.compose import Composer, own
from megastep.agents.errors import UserError
from megastep.agents.factory.check import leaves
from megastep.geometries import files, toys
from megastep.ragged import Ragged

DATA = pathlib.Path(__file__).parent / "data"
EXAMPLES = int(os.environ.get("EXAMPLES", 0))


def law(n_examples, **inputs):
    """Tries a test on `n_examples` inputs, or on $EXAMPLES."""
    how = settings(
        max_examples=EXAMPLES or n_examples,
        derandomize=not EXAMPLES,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    return lambda test: how(given(**inputs)(test))


# ---- Trees of arrays ----

N = 4  # the length of every leaf
NUMBERS = st.integers(-9, 9)
LEAVES = st.integers(1, 3).flatmap(
    lambda width: arrays.arrays(np.int64, (N, width), elements=NUMBERS)
)
TREES = st.recursive(
    st.dictionaries(st.sampled_from("abc"), LEAVES, min_size=1).map(arrdict.arrdict),
    lambda trees: st.dictionaries(st.sampled_from("abc"), trees, min_size=1).map(arrdict.arrdict),
    max_leaves=3,
)


def same(a, b):
    """True if two trees have equal keys in the same order, types and leaves."""
    if not isinstance(a, dict):
        return type(a) is type(b) and a.dtype == b.dtype and bool((a == b).all())
    return (type(a), [*a]) == (type(b), [*b]) and all(same(a[key], b[key]) for key in a)


@law(30, tree=TREES, at=st.integers(0, N), index=st.integers(-N, N - 1), is_torch=st.booleans())
def test_parts_of_a_tree_join_to_the_tree(tree, at, index, is_torch):
    tree = arrdict.torchify(tree) if is_torch else tree
    assert same(arrdict.cat([tree[:at], tree[at:]]), tree)
    assert same(arrdict.stack([tree[i] for i in range(N)]), tree)
    assert same(arrdict.stack([tree, tree], 1)[:, 1], tree)
    changed = arrdict.clone(tree)
    changed[index] = tree[index] + 1
    assert same(changed[index], tree[index] + 1) and same(changed - tree, (changed - tree).copy())
    assert sum(int((leaf != 0).sum()) for leaf in arrdict.leaves(changed - tree)) == sum(
        leaf.shape[1] for leaf in arrdict.leaves(tree)
    )


@law(30, tree=TREES, index=st.integers(-N, N - 1), number=NUMBERS)
def test_operators_commute_with_indexing_and_mapping(tree, index, number):
    other = tree.map(lambda leaf: leaf[::-1])
    for result, leaf_result in (
        (tree + other, lambda a, b: a + b),
        (number - tree, lambda a, b: number - a),
        (tree * number <= other, lambda a, b: a * number <= b),
        (-tree, lambda a, b: -a),
    ):
        assert same(result, tree.starmap(leaf_result, other))
        assert same(result[index], tree[index].starmap(leaf_result, other[index]))
    assert same(tree.map(np.square).map(np.negative), tree.map(lambda leaf: -np.square(leaf)))
    assert same(arrdict.numpyify(arrdict.torchify(tree)), tree)


# ---- Ragged ----


@law(
    40,
    widths=st.lists(st.integers(0, 4), max_size=6),
    axes=st.sampled_from([(), (2,)]),
    is_torch=st.booleans(),
    index=st.slices(6),
)
def test_ragged_is_a_list_of_arrays(widths, axes, is_torch, index):
    values = np.arange(sum(widths) * (axes[0] if axes else 1)).reshape(-1, *axes)
    ends = np.cumsum([0, *widths])
    parts = [values[start:end] for start, end in zip(ends, ends[1:])]
    ragged = Ragged(torch.as_tensor(values) if is_torch else values, np.array(widths, int))
    assert len(ragged) == len(parts)
    for r, expected in ((ragged, parts), (ragged[index], parts[index])):
        assert len(r) == len(expected) and type(r) is type(ragged)
        assert r.vals.dtype == ragged.vals.dtype
        assert all(np.array_equal(a, b) for a, b in zip(r, expected, strict=True))
        assert all(np.array_equal(r[-i - 1], expected[-i - 1]) for i in range(len(r)))
        assert r.inverse.tolist() == [i for i, part in enumerate(expected) for _ in part]
        assert (r.ends - r.starts).tolist() == [len(part) for part in expected]
        back = r.torchify().numpyify()
        assert np.array_equal(back.vals, np.asarray(r.vals))
        assert back.widths.tolist() == r.widths.tolist()


# ---- Returns ----

FRACTIONS = st.floats(0, 1)


@st.composite
def rollouts(draw):
    """Returns transitions of up to 9 steps of 3 lanes, with log ratios, in float64."""
    n_steps, n_lanes = draw(st.integers(1, 9)), 3
    generator = np.random.default_rng(draw(st.integers(0, 2**32)))
    ends = draw(arrays.arrays(np.int8, (n_steps, n_lanes), elements=st.integers(0, 3)))
    reset = np.zeros((n_steps, n_lanes), bool)
    reset[0] = draw(st.booleans())
    for t in range(1, n_steps):  # the step after an end is a reset, in which nothing ends
        reset[t] = (ends[t - 1] < 2) & ~reset[t - 1]
    case = dict(reset=reset, terminal=(ends == 0) & ~reset, truncated=(ends == 1) & ~reset)
    for name, shape in dict(reward=reset.shape, value=reset.shape, last_value=(3,)).items():
        case[name] = generator.normal(size=shape)
    log_ratio = generator.normal(size=reset.shape)
    return {name: torch.as_tensor(x) for name, x in case.items()}, torch.as_tensor(log_ratio)


def recursion(case, lane, advantage):
    """Returns one lane's sums from the last step back: advantage(t, V_t+1, the sum of t+1)."""
    value = [*case["value"][:, lane].tolist(), case["last_value"][lane].item()]
    sums = [0.0]
    for t in reversed(range(len(value) - 1)):
        is_reset, is_terminal, is_truncated = (
            case[name][t, lane].item() for name in ("reset", "terminal", "truncated")
        )
        following = 0.0 if is_terminal else value[t + 1]
        later = 0.0 if is_terminal or is_truncated else sums[0]
        sums.insert(0, 0.0 if is_reset else advantage(t, following, later))
    return torch.tensor(sums[:-1], dtype=torch.float64)


@law(20, rollout=rollouts(), gamma=FRACTIONS, lambda_=FRACTIONS, clip=st.floats(0.1, 3))
def test_returns_equal_their_recursions(rollout, gamma, lambda_, clip):
    case, log_ratio = rollout
    settings = dict(gamma=gamma, lambda_=lambda_)
    gae = returns.gae(**case, **settings)
    vtrace = returns.vtrace(log_ratio, **case, **settings, rho_clip=clip, c_clip=clip)
    for lane in range(3):
        value, reward, ratio = (
            x[:, lane].tolist() for x in (case["value"], case["reward"], log_ratio.exp())
        )

        def gae_step(t, following, later, value=value, reward=reward):
            return reward[t] + gamma * following - value[t] + gamma * lambda_ * later

        def vtrace_step(t, following, later, value=value, reward=reward, ratio=ratio):
            rho = min(clip, ratio[t])
            return rho * (reward[t] + gamma * following - value[t] + gamma * lambda_ * later)

        torch.testing.assert_close(gae.advantages[:, lane], recursion(case, lane, gae_step))
        expected = case["value"][:, lane] + recursion(case, lane, vtrace_step)
        torch.testing.assert_close(vtrace.targets[:, lane], expected)


@law(20, rollout=rollouts(), gamma=FRACTIONS, lambda_=FRACTIONS, factor=st.floats(-3, 3))
def test_returns_are_linear_and_nested(rollout, gamma, lambda_, factor):
    """Returns of scaled rewards and values are scaled. V-trace on policy gives the lambda return;
    n steps, n at least as many as there are, give the lambda return of lambda 1.
    """
    case, log_ratio = rollout
    scaled = case | {name: factor * case[name] for name in ("reward", "value", "last_value")}
    gae, vtrace = (
        lambda case, lambda_=lambda_: returns.gae(**case, gamma=gamma, lambda_=lambda_).targets,
        lambda case: returns.vtrace(log_ratio, **case, gamma=gamma, lambda_=lambda_).targets,
    )
    n_steps = len(log_ratio)
    for function in (gae, vtrace, lambda case: returns.n_step_returns(**case, gamma=gamma, n=2)):
        torch.testing.assert_close(function(scaled), factor * function(case))
    torch.testing.assert_close(
        returns.vtrace(0 * log_ratio, **case, gamma=gamma, lambda_=lambda_).targets, gae(case)
    )
    torch.testing.assert_close(
        returns.n_step_returns(**case, gamma=gamma, n=n_steps), gae(case, lambda_=1.0)
    )


@law(60, x=st.floats(-1e5, 1e5))
def test_rescale_is_odd_and_inverted(x):
    x = torch.tensor(x, dtype=torch.float64)
    assert returns.rescale(-x) == -returns.rescale(x)
    torch.testing.assert_close(returns.inverse_rescale(returns.rescale(x)), x, rtol=1e-6, atol=1e-6)


# ---- Geometry files ----

DTYPES = st.sampled_from(["f2", "f4", "f8", "i1", "u1", "i4", "i8", "u8", "?", ">f4", "c8", "S3"])
ANY_ARRAY = DTYPES.flatmap(
    lambda dtype: arrays.arrays(
        dtype, arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
    )
)


def loaded(path, content):
    """Returns the geometries in a file's content, or the ValueError, which must name the file."""
    path.write_bytes(content)
    try:
        return files.load(path)
    except ValueError as error:
        text = str(error)
        assert text.startswith(f"Geometry file {str(path)!r}") and "\n" not in text, text
        return error


@law(
    8,
    seeds=st.lists(st.integers(1, 99), min_size=1, max_size=3, unique=True),
    goal=arrays.arrays(np.float64, (2,), elements=st.floats(-9, 9)),
)
def test_saved_geometries_load_unchanged(tmp_path_factory, seeds, goal):
    path = tmp_path_factory.mktemp("saved") / "some.npz"
    saved = [geometries.sample("maze", 1, seed=seed, size=2)[0] for seed in seeds]
    saved = [type(g)(g, goal=goal) for g in [*saved, toys.column()]]
    files.save(path, saved)
    for before, after in zip(saved, files.load(path), strict=True):
        assert before.keys() == after.keys()
        assert all(np.array_equal(before[key], after[key]) for key in before)


@law(40, changes=st.dictionaries(st.sampled_from(files.KEYS), ANY_ARRAY, min_size=1))
def test_file_of_any_arrays_loads_or_is_refused(tmp_path_factory, changes):
    buffer = io.BytesIO()
    np.savez(buffer, **{f"0/{key}": value for key, value in {**toys.box(), **changes}.items()})
    loaded(tmp_path_factory.mktemp("made") / "some.npz", buffer.getvalue())


CUTS = st.tuples(st.integers(0, 10**4), st.integers(0, 40), st.binary(max_size=40))


@law(60, cuts=st.lists(CUTS, min_size=1, max_size=3), is_packed=st.booleans())
def test_damaged_file_loads_or_is_refused(tmp_path_factory, cuts, is_packed):
    """Replaces some bytes by others, also by more or fewer."""
    buffer = io.BytesIO()
    save = np.savez_compressed if is_packed else np.savez
    save(buffer, **{f"0/{key}": value for key, value in toys.box().items()})
    content = buffer.getvalue()
    for start, n_bytes, insert in cuts:
        start %= len(content) + 1
        content = content[:start] + insert + content[start + n_bytes :]
    loaded(tmp_path_factory.mktemp("damaged") / "some.npz", content)


# ---- Words of the command line ----

ATOMS = ["0", "-1", "1e400", "nan", "true", "null", "a", "a:b", "builtins:dict", "math:pi", "''"]
ATOMS += ["${seed}", "${oc.decode:1}", "${", "x.y", "1_0", "0x1", "auto", "minimal"]


@functools.cache
def composer():
    return Composer(train.COMMAND)


@functools.cache
def keys():
    """Returns all keys of the default configuration, its groups, and some others."""
    own_keys = [key for key, _ in leaves(own(composer().composed()))]
    others = ["hydra.run.dir", "hydra.job.name", "env@x", "opponents", "geometry.path", "agent"]
    return [*own_keys, *composer().groups(), *others]


VALUES = st.recursive(
    st.sampled_from(ATOMS) | st.text(st.characters(codec="utf-8"), max_size=4),
    lambda values: (
        st.lists(values, max_size=2).map(lambda v: f"[{','.join(v)}]")
        | st.tuples(st.sampled_from(["a", "name", "lr"]), values).map(
            lambda p: f"{{{p[0]}:{p[1]}}}"
        )
        | st.tuples(st.sampled_from(["choice", "range", "glob", "sort"]), values).map(
            lambda p: f"{p[0]}({p[1]})"
        )
    ),
    max_leaves=3,
)
WORDS = st.builds(
    "".join,
    st.tuples(
        st.sampled_from(["", "", "+", "++", "~"]),
        st.deferred(lambda: st.sampled_from(keys())),
        st.sampled_from(["", "", ".a", "@a", "/a", "."]),
        st.sampled_from(["=", "=", "=", "", "=="]),
        VALUES,
    ),
)
ANY_TEXT = st.text(st.sampled_from("a1.=+~@:/,[]{}()$'\"\\ \n\0\x85"), max_size=12)


def compose(words):
    """Composes settings, or raises a UserError with a sentence per error."""
    try:
        composer().settings(words)
    except UserError as error:
        assert str(error)


@law(15, words=st.lists(WORDS | ANY_TEXT, min_size=1, max_size=2))
def test_any_word_is_composed_or_refused(words):
    compose(words)


@law(80, word=WORDS | ANY_TEXT)
def test_any_word_is_read_or_refused(word):
    try:
        composer().parse([word])
    except UserError as error:
        assert str(error)


def test_words_that_were_neither_are_refused():
    for word in (DATA / "overrides.txt").read_text().splitlines():
        compose([word])
