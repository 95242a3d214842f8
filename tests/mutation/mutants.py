"""Small faults in the source: where one can be put, and the source with it in.

One mutant is one expression or statement replaced by another. Slips of the pen are a sign, a factor, a term left out,
a sine for a cosine; faults of meaning stand in ``semantic_faults``. What cannot change a number or a decision is left
alone: annotations, decorators, docstrings, messages of errors, assertions, ``strict=`` of zip, -1 of reshape (any
negative number says the same), and floats below 1e-6 or above 1e6, which are tolerances and guards.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from tests.mutation.semantic_faults import FAULTS, Context, faults_at, name_of

SLIP = "slip"
"""Kind of every fault that is a slip of the pen and none of meaning."""
KINDS = (*FAULTS, SLIP)
_SWAPPED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Add,
}
_NEGATED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
_BOUNDARY: dict[type[ast.cmpop], type[ast.cmpop]] = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
_PAIRS = (
    ("sin", "cos"),
    ("min", "max"),
    ("minimum", "maximum"),
    ("argmin", "argmax"),
    ("any", "all"),
    ("floor", "ceil"),
    ("zeros", "ones"),
    ("zeros_like", "ones_like"),
    ("sum", "mean"),
    ("tan", "sin"),
    ("real", "imag"),
)
_OTHER_NAME = dict(_PAIRS) | {right: left for left, right in _PAIRS}
_TRANSPARENT = {"abs", "conj", "sqrt", "square", "log", "exp"}
"""Functions of one argument that a mutant leaves out."""
_ORDERED = {"arctan2", "cross", "solve", "outer"}
"""Functions whose first two arguments a mutant swaps."""
_SMALLEST, _LARGEST = 1e-6, 1e6


@dataclass(frozen=True)
class Mutant:
    """One fault in one place.

    Attributes:
        path: the source file, relative to the tree.
        scope: qualified name of the function or class, "" at module level.
        line: first and last line of what is replaced, counted from 1.
        span: where it stands, in bytes of the file.
        before: its text, white space folded.
        after: what stands there instead.
        number: which of the same replacements in the same scope, counted from 0.
        kind: one of `KINDS`.
    """

    path: str
    scope: str
    line: tuple[int, int]
    span: tuple[int, int]
    before: str
    after: str
    number: int
    kind: str = SLIP

    @property
    def key(self) -> str:
        """Ten hexadecimal digits that stay the same while other code of the file changes."""
        text = "\n".join((self.path, self.scope, self.before, self.after, str(self.number)))
        return hashlib.sha256(text.encode()).hexdigest()[:10]

    def applied(self, source: bytes) -> bytes:
        """The file with the fault in."""
        start, end = self.span
        return source[:start] + self.after.encode() + source[end:]


def mutants_of(path: str, source: bytes) -> list[Mutant]:
    """All mutants of a file, in the order of the source."""
    lines = source.splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))
    found: dict[tuple[int, int, str], Mutant] = {}
    counts: dict[tuple[str, str, str], int] = {}
    for scope, node, replacement, kind in _places(ast.parse(source), "", Context()):
        start = starts[node.lineno - 1] + node.col_offset
        end = starts[(node.end_lineno or node.lineno) - 1] + (node.end_col_offset or 0)
        at = (start, end, replacement)
        if at in found:
            if kind != SLIP:
                found[at] = replace(found[at], kind=kind)
            continue
        before = " ".join(source[start:end].decode().split())
        same = (scope, before, replacement)
        counts[same] = counts.get(same, -1) + 1
        lineno = (node.lineno, node.end_lineno or node.lineno)
        found[at] = Mutant(path, scope, lineno, (start, end), before, replacement, counts[same], kind)
    return list(found.values())


def mutants_below(root: Path, places: tuple[str, ...]) -> list[Mutant]:
    """All mutants of the Python files at or below some places of a tree, in the order of the paths."""
    files: set[Path] = set()
    for place in places:
        files |= {root / place} if (root / place).is_file() else set((root / place).rglob("*.py"))
    return [one for file in sorted(files) for one in mutants_of(file.relative_to(root).as_posix(), file.read_bytes())]


Place = tuple[str, "ast.expr | ast.stmt", str, str]


def _places(node: ast.AST, scope: str, where: Context) -> Iterator[Place]:
    """What can be replaced below a node, with its scope, the text to put there and the kind of fault."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        inside = f"{scope}.{node.name}".lstrip(".")
        if isinstance(node, ast.ClassDef):
            parts: list[ast.AST] = list(node.body)
            within = Context()
        else:
            parts = [*node.args.defaults, *(one for one in node.args.kw_defaults if one is not None), *node.body]
            within = Context(node.name)
        for part in parts:
            yield from _places(part, inside, within)
        return
    if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr | ast.Import | ast.ImportFrom):
        return
    if isinstance(node, ast.keyword) and node.arg == "strict":
        return
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "reshape":
        node = ast.copy_location(
            ast.Call(node.func, [one for one in node.args if ast.unparse(one) != "-1"], node.keywords), node
        )
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        return
    for replaced in _replacements(node):
        yield (scope, *replaced, SLIP)
    for replaced in faults_at(node, where):
        yield (scope, *replaced)
    for child, target in _children(node, where):
        yield from _places(child, scope, Context(where.function, target))


def _children(node: ast.AST, where: Context) -> Iterator[tuple[ast.AST, str]]:
    """The nodes below one, each with the name that its value is given to, "" for none."""
    match node:
        case ast.AnnAssign():
            if node.value is not None:
                yield node.value, name_of(node.target)
        case ast.Assign(targets=[target]):
            yield node.value, name_of(target)
        case ast.AugAssign():
            yield node.value, ""
        case ast.keyword():
            yield node.value, node.arg or ""
        case ast.Return(value=ast.expr() as value):
            yield value, where.function
        case ast.Dict():
            for key, value in zip(node.keys, node.values, strict=True):
                yield value, name_of(key) if key is not None else ""
        case _:
            for child in ast.iter_child_nodes(node):
                yield child, ""


def _replacements(node: ast.AST) -> Iterator[tuple[ast.expr | ast.AugAssign, str]]:
    match node:
        case ast.If():
            refuses = all(isinstance(one, ast.Raise) for one in node.body)
            yield node.test, "False" if refuses else f"not ({ast.unparse(node.test)})"
        case ast.IfExp():
            yield node.test, f"(not ({ast.unparse(node.test)}))"
        case ast.AugAssign() if type(node.op) in _SWAPPED:
            swapped = ast.AugAssign(node.target, _SWAPPED[type(node.op)](), node.value)
            yield node, ast.unparse(swapped)
        case ast.BinOp() if type(node.op) in _SWAPPED and not _is_text(node):
            yield node, f"({ast.unparse(ast.BinOp(node.left, _SWAPPED[type(node.op)](), node.right))})"
            if isinstance(node.op, ast.Add | ast.Sub):
                yield node, f"({ast.unparse(node.left)})"
        case ast.UnaryOp(op=ast.USub() | ast.Not() | ast.Invert()):
            yield node, f"({ast.unparse(node.operand)})"
        case ast.Compare() if len(node.ops) == 1:
            yield node, f"({_compared(node, _NEGATED)})"
            if type(node.ops[0]) in _BOUNDARY and (_is_count(node.left) or _is_count(node.comparators[0])):
                yield node, f"({_compared(node, _BOUNDARY)})"
        case ast.BoolOp():
            other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            yield node, f"({ast.unparse(ast.BoolOp(other, node.values))})"
        case ast.Constant(value=bool(value)):
            yield node, str(not value)
        case ast.Constant(value=int(value)):
            yield node, str(value + 1)
        case ast.Constant(value=float(value)) if value == 0 or _SMALLEST <= abs(value) <= _LARGEST:
            yield node, repr(1.1 * value if value else 1.0)
        case ast.Attribute(attr="T"):
            yield node, ast.unparse(node.value)
        case ast.Call():
            yield from _calls(node)


def _calls(node: ast.Call) -> Iterator[tuple[ast.expr, str]]:
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    arguments = [ast.unparse(one) for one in node.args]
    if name in _OTHER_NAME:
        if isinstance(node.func, ast.Attribute):
            function = f"{ast.unparse(node.func.value)}.{_OTHER_NAME[name]}"
        else:
            function = _OTHER_NAME[name]
        yield node.func, function
    if name in _TRANSPARENT and len(arguments) == 1 and not node.keywords:
        yield node, f"({arguments[0]})"
    if name in _ORDERED and len(arguments) >= 2:
        rest = [*arguments[2:], *(ast.unparse(one) for one in node.keywords)]
        yield node, f"{ast.unparse(node.func)}({', '.join([arguments[1], arguments[0], *rest])})"


def _compared(node: ast.Compare, table: dict[type[ast.cmpop], type[ast.cmpop]]) -> str:
    return ast.unparse(ast.Compare(node.left, [table[type(node.ops[0])]()], node.comparators))


def _is_text(node: ast.BinOp) -> bool:
    """Joins or formats strings, builds a path, unites types: no arithmetic."""
    texts = (ast.JoinedStr,)
    return any(
        isinstance(one, texts) or (isinstance(one, ast.Constant) and isinstance(one.value, str))
        for one in (node.left, node.right)
    )


def _is_count(node: ast.expr) -> bool:
    """A whole number, so that the boundary of a comparison can be met; between floats it practically is not."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int)
    if isinstance(node, ast.Call):
        return getattr(node.func, "id", "") == "len"
    return isinstance(node, ast.Attribute) and node.attr in {"size", "ndim"}
