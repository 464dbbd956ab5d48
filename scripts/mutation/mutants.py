"""Mutants: copies of the code with one small fault each, in Python files and in kernels' headers.

A mutant is named by a digest of its file, its line's text and its fault, so edits elsewhere do not
change its name or its place in the seeded order.
"""

import ast
import collections
import dataclasses
import functools
import hashlib
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SWAPS = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==", "+": "-", "-": "+"}
SWAPS |= {"*": "/", "/": "*", "//": "*", "%": "*", "**": "*", "|": "&", "&": "|"}
SWAPS |= {"and": "or", "or": "and", "&&": "||", "||": "&&"}
SWAPS |= {"is": "is not", "is not": "is", "in": "not in", "not in": "in"}
OPERATOR = re.compile(r"is\s+not|not\s+in|\b(?:is|in|and|or)\b|<<|>>|\*\*|//|[<>=!]=|[-<>+*/%|&^@]")
#: Calls that return something like what they are called on, or like their first argument.
METHODS = {"abs", "clamp", "clip", "clone", "copy", "cumsum", "detach", "exp", "flip", "log"}
METHODS |= {"masked_fill", "resolve", "round", "sqrt", "square"}
FUNCTIONS = {"abs", "int", "max", "maximum", "min", "minimum", "round", "sorted", "sqrt"}
#: In headers, formatters put blanks around binary operators and around nothing that looks like one.
HEADER_SITE = re.compile(
    r"(?<= )(?:[<>=!]=|&&|\|\||[-<>+*/%])(?= )|(?<![\w.])\d+(?:\.\d*f)?(?![\w.])"
)
HEADER_NOT_CODE = re.compile(r'//.*|/\*[\s\S]*?\*/|"[^"\n]*"|^#.*', re.M)


@dataclasses.dataclass(frozen=True)
class Mutant:
    """A fault: in the file at `path`, `after` replaces `before` at `start`.

    Attributes:
        lines: (first, last) of the statement, from 1; of one that has a body, without it.
        copy: number of equal faults in equal lines before this one.
    """

    path: str
    start: int
    before: str
    after: str
    lines: tuple[int, int]
    copy: int = 0

    @functools.cached_property
    def number(self):
        return text_of(self.path).count("\n", 0, self.start) + 1

    @functools.cached_property
    def fault(self):
        line = lines_of(self.path)[self.number - 1].strip()
        change = " ".join(f"{self.before} -> {self.after or 'nothing'}".split())
        return f"{change}: {line}"

    @functools.cached_property
    def name(self):
        text = f"{self.path}: {self.fault}: {self.copy}"
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def __str__(self):
        return f"{self.name} {self.path}:{self.number}: {self.fault}"

    def text(self):
        """Returns the file's text with the fault."""
        text = text_of(self.path)
        return text[: self.start] + self.after + text[self.start + len(self.before) :]


@functools.cache
def text_of(path):
    return (ROOT / path).read_text()


@functools.cache
def lines_of(path):
    return text_of(path).splitlines()


def in_order(files, seed):
    """Yields one mutant of each line that has any, in an order of which each start is a sample."""

    def order(mutant):
        return hashlib.sha256(f"{seed} {mutant.name}".encode()).digest()

    by_line = collections.defaultdict(list)
    for path in files:
        for mutant in mutants_of(path):
            by_line[path, mutant.number].append(mutant)
    for mutant in sorted((min(mutants, key=order) for mutants in by_line.values()), key=order):
        if not mutant.path.endswith(".py") or _is_another_program(mutant):
            yield mutant


def mutants_of(path):
    """Returns all mutants of a file."""
    text = text_of(path)
    sites = _Sites(text).found if path.endswith(".py") else _header_sites(text)
    mutants, copies = [], collections.Counter()
    for start, before, after, lines in sites:
        mutant = Mutant(path, start, before, after, lines)
        mutants.append(dataclasses.replace(mutant, copy=copies[mutant.fault]))
        copies[mutant.fault] += 1
    return mutants


def _is_another_program(mutant):
    try:
        program = ast.dump(ast.parse(mutant.text()))
    except SyntaxError:
        return False
    return program != ast.dump(ast.parse(text_of(mutant.path)))


def _header_sites(text):
    code = HEADER_NOT_CODE.sub(lambda match: re.sub(r"\S", "_", match[0]), text)
    for match in HEADER_SITE.finditer(code):
        before, line = match[0], code.count("\n", 0, match.start()) + 1
        yield match.start(), before, SWAPS.get(before) or _other_number(before), (line, line)


def _other_number(text):
    """Returns twice a float, such as 0.5f, or the next integer."""
    return f"{2 * float(text[:-1]) or 1.0}f" if text.endswith("f") else str(int(text) + 1)


class _Sites(ast.NodeVisitor):
    """Lists (start, before, after, lines) of a Python file's faults.

    Imports, annotations, decorators, texts and asserts have none.
    """

    def __init__(self, text):
        self.text, self.found, self.lines, self.function = text, [], (1, 1), None
        rows = text.splitlines(keepends=True)
        starts = [sum(map(len, rows[:i])) for i in range(len(rows))]
        # ast counts bytes
        self.offset = lambda line, n: starts[line - 1] + len(rows[line - 1].encode()[:n].decode())
        self.visit(ast.parse(text))

    def add(self, node, after, end=None):
        start = self.offset(node.lineno, node.col_offset)
        end = end or self.offset(node.end_lineno, node.end_col_offset)
        self.found.append((start, self.text[start:end], after, self.lines))

    def source(self, node):
        return ast.get_source_segment(self.text, node)

    def swap(self, left, right):
        """Swaps the operator between two nodes."""
        start = self.offset(left.end_lineno, left.end_col_offset)
        end = self.offset(right.lineno, right.col_offset)
        match = OPERATOR.search(self.text, start, end)
        after = match and SWAPS.get(" ".join(match[0].split()))
        if after:
            self.found.append((match.start(), match[0], after, self.lines))

    def visit(self, node):
        if isinstance(node, ast.stmt):
            body = getattr(node, "body", None)
            self.lines = node.lineno, max(node.lineno, body[0].lineno - 1 if body else 0)
            self.lines = self.lines if body else (node.lineno, node.end_lineno)
        super().visit(node)

    def visit_FunctionDef(self, node):
        for part in (*node.args.defaults, *filter(None, node.args.kw_defaults)):
            self.visit(part)
        outer, self.function = self.function, node.name
        for part in node.body:
            self.visit(part)
        self.function = outer

    def skip(self, node):
        pass

    visit_Import = visit_ImportFrom = visit_Assert = visit_JoinedStr = skip

    def visit_AnnAssign(self, node):
        if node.value:
            self.visit(node.value)

    def visit_Subscript(self, node):
        if self.source(node.value) != "Annotated":
            self.generic_visit(node)

    def visit_Raise(self, node):
        self.add(node, "pass")

    def visit_Expr(self, node):
        if not isinstance(node.value, ast.Constant):
            self.add(node, "pass")
            self.visit(node.value)

    def visit_Assign(self, node):
        # names and attributes that are never set raise at once
        is_first = self.function == "__init__" or not all(
            isinstance(target, (ast.Attribute, ast.Subscript)) for target in node.targets
        )
        if not is_first:
            self.add(node, "pass")
        self.visit(node.value)

    def visit_AugAssign(self, node):
        self.add(node, "pass")
        self.visit(node.value)

    def visit_Return(self, node):
        if node.value:
            is_bool = isinstance(node.value, (ast.Compare, ast.BoolOp))
            self.add(node.value, f"not ({self.source(node.value)})" if is_bool else "None")
            self.visit(node.value)

    def visit_If(self, node):
        if "TYPE_CHECKING" not in self.source(node.test):
            self.add(node.test, "True")
            self.add(node.test, "False")
            self.generic_visit(node)

    visit_IfExp = visit_If

    def visit_Compare(self, node):
        for left, right in zip([node.left, *node.comparators], node.comparators):
            self.swap(left, right)
        self.generic_visit(node)

    def visit_BoolOp(self, node):
        for left, right in zip(node.values, node.values[1:]):
            self.swap(left, right)
        self.generic_visit(node)

    def visit_BinOp(self, node):
        self.swap(node.left, node.right)
        if isinstance(node.op, (ast.BitOr, ast.BitAnd)):
            self.add(node, self.source(node.right))
        self.generic_visit(node)

    def visit_UnaryOp(self, node):
        self.add(node, f"({self.source(node.operand)})")
        self.visit(node.operand)

    def visit_Constant(self, node):
        value = node.value
        if isinstance(value, bool):
            self.add(node, str(not value))
        elif isinstance(value, (int, float)):
            if not 0 < value < 1e-4:  # it only keeps a divisor from 0, and twice that does as well
                self.add(node, str(value + 1 if isinstance(value, int) else 2 * value or 1.0))
            if value:
                self.add(node, str(type(value)(0)))

    def visit_Call(self, node):
        name = self.source(node.func).rpartition(".")[2]
        if isinstance(node.func, ast.Attribute) and name in METHODS:
            self.add(node, self.source(node.func.value))
        elif name in FUNCTIONS and node.args and not isinstance(node.args[0], ast.Starred):
            self.add(node, self.source(node.args[0]))
        for keyword in node.keywords:
            if keyword.arg:
                end = self.offset(keyword.end_lineno, keyword.end_col_offset)
                self.add(keyword, "", re.compile(r",?\s*").match(self.text, end).end())
        self.generic_visit(node)
