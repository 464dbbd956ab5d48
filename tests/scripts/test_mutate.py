"""Mutants: which faults are made, and that they keep their names when other lines change."""

import pytest
from mutation import mutants

CODE = '''"""A module: 1 + 1."""

import os

LIMIT: int = 3


def first(xs: list[int], floor=0.5) -> int:
    """Returns a - b."""
    xs.sort(key=abs, reverse=True)
    if not xs or len(xs) < 2 and floor is None:
        raise ValueError("no 1 < 2")
    xs[0] += 1
    self.best = torch.minimum(xs[0], xs[1])
    return xs[0] * 2
'''
HEADER = """// a < b
#include "x.h"
HD float f(float a, int b) {
    return a < 0.5f && b > 3 ? a : -a;  // 1 + 1
}
"""


@pytest.fixture
def faults(monkeypatch):
    """A function of {path: text} that returns {"before -> after": name} of all mutants."""

    def faults(files):
        monkeypatch.setattr(mutants, "text_of", files.__getitem__)
        monkeypatch.setattr(mutants, "lines_of", lambda path: files[path].splitlines())
        found = [mutant for path in files for mutant in mutants.mutants_of(path)]
        return {f"{mutant.before} -> {mutant.after}": mutant.name for mutant in found}

    return faults


def test_faults_of_python(faults):
    found = faults({"a.py": CODE})
    changes = ["< -> <=", "is -> is not", "or -> and", "and -> or", "* -> /", "not xs -> (xs)"]
    changes += ["3 -> 4", "3 -> 0", "0.5 -> 1.0", "reverse=True -> ", "xs[0] += 1 -> pass"]
    changes += ['raise ValueError("no 1 < 2") -> pass', "xs[0] * 2 -> None"]
    changes += ["xs.sort(key=abs, reverse=True) -> pass", "torch.minimum(xs[0], xs[1]) -> xs[0]"]
    changes += ["self.best = torch.minimum(xs[0], xs[1]) -> pass", "key=abs,  -> "]
    changes += [f"not xs or len(xs) < 2 and floor is None -> {value}" for value in (True, False)]
    assert set(changes) <= set(found)
    assert not any("->" in change and "a - b" in change for change in found), "not in texts"
    assert "+ -> -" not in found and "- -> +" not in found


def test_faults_of_headers(faults):
    assert set(faults({"a.h": HEADER})) == {
        "< -> <=",
        "&& -> ||",
        "> -> >=",
        "3 -> 4",
        "0.5f -> 1.0f",
    }


def test_edits_elsewhere_change_no_name(faults):
    before = faults({"a.py": CODE})
    after = faults({"a.py": CODE.replace("import os", "import os\n\nOTHER = 7")})
    assert before.items() <= after.items() and len(before) < len(after)


def test_sample_has_one_mutant_per_line_and_grows_with_n(faults):
    faults({"a.py": CODE})
    sample = list(mutants.in_order(["a.py"], seed=1))
    assert len({mutant.number for mutant in sample}) == len(sample) >= 6
    assert sample == list(mutants.in_order(["a.py"], seed=1))
    assert sample != list(mutants.in_order(["a.py"], seed=2))
    assert all(mutant.text() != CODE for mutant in sample)
