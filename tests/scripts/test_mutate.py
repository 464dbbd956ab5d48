"""Mutants: which faults are made, and that they keep their names when other lines change."""

import mutate

CODE = '''"""A module: 1 + 1."""

import os

LIMIT: int = 3


def first(xs: list[int], floor=0.5) -> int:
    """Returns a - b."""
    xs.sort(key=abs, reverse=True)
    if not xs or len(xs) < 2 and floor is None:
        raise ValueError("no 1 < 2")
    xs[0] += 1
    return xs[0] * 2
'''
HEADER = """// a < b
#include "x.h"
HD float f(float a, int b) {
    return a < 0.5f && b > 3 ? a : -a;  // 1 + 1
}
"""


def faults(path, text):
    """Returns {"before -> after": name} of all mutants."""
    return {f"{one.before} -> {one.after}": one.name for one in mutate.mutants_of(path, text)}


def test_faults_of_python():
    found = faults("a.py", CODE)
    changes = ["< -> <=", "is -> is not", "or -> and", "and -> or", "* -> /", "3 -> 4"]
    changes += ["0.5 -> 1.0", "reverse=True -> ", "xs[0] += 1 -> pass", "xs[0] * 2 -> None"]
    changes += ['raise ValueError("no 1 < 2") -> pass', "xs.sort(key=abs, reverse=True) -> pass"]
    changes += [f"not xs or len(xs) < 2 and floor is None -> {value}" for value in (True, False)]
    assert set(changes) <= set(found)
    assert not any("a - b" in change for change in found), "not in texts"


def test_faults_of_headers():
    changes = {"< -> <=", "&& -> ||", "> -> >=", "3 -> 3+1", "0.5f -> 1.0f"}
    assert set(faults("a.h", HEADER)) == changes


def test_edits_elsewhere_change_no_name_and_a_sample_grows_with_n():
    longer = CODE.replace("import os", "import os\n\nOTHER = 7")
    assert faults("a.py", CODE).items() <= faults("a.py", longer).items()
    sample = [*mutate.in_order({"a.py": CODE}, seed=1)]
    assert len({CODE.count("\n", 0, one.start) for one in sample}) == len(sample) >= 6
    assert sample == [*mutate.in_order({"a.py": CODE}, seed=1)]
    assert sample != [*mutate.in_order({"a.py": CODE}, seed=2)]
