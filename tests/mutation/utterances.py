"""Every refusal and warning that the program can utter: where it stands, which tests see it, which see it absent."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.mutation.coverage_map import CoverageMap
from tests.mutation.semantic_faults import WARNING, name_of

INTERNAL = {
    "NotImplementedError",
    "AssertionError",
    "StopIteration",
    "KeyError",
    "AttributeError",
    "SystemExit",
    "Exit",
}
"""Raised for programmers or passed on, no words to a user."""


@dataclass(frozen=True)
class Utterance:
    """One refusal or warning.

    Attributes:
        path: source file.
        line: that it stands on.
        scope: function.
        body: first and last line of the function's body.
        text: beginning of what is said.
        always: the function does nothing else, so that who calls it decides.
    """

    path: str
    line: int
    scope: str
    body: tuple[int, int]
    text: str
    always: bool

    def tests(self, known: CoverageMap) -> tuple[set[str], set[str]]:
        """The tests that run its line, and those that run its function without it."""
        by_line = known.tests.get(self.path, {})
        seen = {name for name in by_line.get(self.line, []) if name}
        inside = {name for line in range(self.body[0], self.body[1] + 1) for name in by_line.get(line, []) if name}
        return seen, inside - seen


def utterances_below(root: Path, places: tuple[str, ...]) -> Iterator[Utterance]:
    """Yield all of the Python files at or below some places of a tree."""
    for place in places:
        files = [root / place] if (root / place).is_file() else sorted((root / place).rglob("*.py"))
        for file in files:
            yield from _of(ast.parse(file.read_bytes()), file.relative_to(root).as_posix(), "", (0, 0))


def _of(node: ast.AST, path: str, scope: str, body: tuple[int, int], always: bool = False) -> Iterator[Utterance]:
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        scope = f"{scope}.{node.name}".lstrip(".")
        if not isinstance(node, ast.ClassDef):
            body = (node.body[0].lineno, node.end_lineno or node.lineno)
    said = _said(node, scope.split(".")[-1])
    if said is not None and isinstance(node, ast.stmt):
        yield Utterance(path, node.lineno, scope, body, said, always)
    leaves = isinstance(node, ast.FunctionDef) and not any(isinstance(one, ast.Return) for one in ast.walk(node))
    for child in ast.iter_child_nodes(node):
        yield from _of(child, path, scope, body, leaves and isinstance(child, ast.Raise))


def _said(node: ast.AST, function: str) -> str | None:
    """The beginning of what a statement says, None for one that says nothing to a user."""
    match node:
        case ast.Raise(exc=ast.Call() as call) if name_of(call) not in INTERNAL:
            return ast.unparse(call)[:80]
        case ast.Expr(value=ast.Yield(value=ast.expr() as value)) if WARNING.search(function):
            return ast.unparse(value)[:80]
        case ast.Expr(value=ast.Call(args=[first, *_]) as call) if name_of(call) in {"append", "warn"} and (
            WARNING.search(function) or WARNING.search(ast.unparse(call.func))
        ):
            return ast.unparse(first)[:80]
        case ast.Return(value=ast.JoinedStr() as value) if WARNING.search(function):
            return ast.unparse(value)[:80]
    return None
