"""Faults of meaning that people commit: a lost root, a sigma too small, another unit, axis or camera, a missing check.

Each fault is one expression or statement replaced. Names decide where a fault makes sense: a factor 0.8 is put on what
is called a sigma, a dropped entry into what computes a key or a digest. `FAULTS` lists the kinds.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass

SIGMA = re.compile(r"(^|_)(sigmas?|stds?|rms|deviations?|uncertaint(y|ies)|scatter|standard_errors?)(_|$)")
VARIANCE = re.compile(r"(^|_)(variances?|covariances?)(_|$)")
FREEDOM = re.compile(r"(^|_)(freedom|dof|redundancy|degrees_of_freedom)(_|$)")
WARNING = re.compile(r"(warn|doubt|caution|caveat|remark|notice|complaint|unsure|question)")
KEY = re.compile(r"(^|_)(key|digest|fingerprint|identity|checksum|token)(_|$)")
SEED = re.compile(r"(^|_)(seeds?|stream|default_rng|SeedSequence|spawn_key|entropy)($|_)")
CHECK = re.compile(
    r"^_?(fsync|sync|flock|locked|lock|require|refuse|check|verify|guard|validate|ensure|limit|reject|forbid)(_|$)"
)
LIMIT = re.compile(r"(^|_)(MAX|MOST|LIMIT|LARGEST|LONGEST|AT_MOST|SECONDS|BYTES|HOURS|TIMEOUT)(_|$)")
BOUND = re.compile(r"(^|_)(most|least|limit|limits|max|min|largest|smallest|count|number|required|allowed)(_|$)")
MATRIX = re.compile(r"(^|_)(rotations?|matrix|matrices|attitude|frames?|axes|basis|R|body_to|to_body|orientation)(_|$)")
TURN = re.compile(r"(rotation|rotate|rotated|turned|about_axis|from_euler|rotvec|rodrigues|tilt)")
_SWAPS = [
    pair.split("/")
    for pair in """
        forward/backward left/right along/across roll/pitch line/pixel lines/pixels before/after
        row/column rows/columns x/y north/east latitude/longitude
    """.split()
]
OTHER = dict(_SWAPS) | {right: left for left, right in _SWAPS}
_UNITS = {"MICRO": "1e-3", "MICROMETRE": "1e-3", "NANO": "1e-6", "MILLI": "1e-6", "ARCSEC": "1.0", "DEGREE": "1.0"}
"""Name of a unit -> what another unit multiplies with."""
_POWERS = {1e3: 1e6, 1e6: 1e3, 1e-3: 1e-6, 1e-6: 1e-3, 1e9: 1e6, 1e-9: 1e-6}
_ANGLES = {"radians", "degrees", "deg2rad", "rad2deg"}
FAULTS = (
    "root lost, root added, sigma x 0.8, sigma x 1.25, variance for sigma, freedom off by one, "
    "radians for degrees, other unit, axis swapped, name swapped, transposed, rotation reversed, "
    "index off by one, first for last, boundary, warning dropped, refusal passed, check skipped, "
    "key forgets, seed reused, limit x 10"
).split(", ")
Found = tuple[ast.expr | ast.stmt, str, str]


@dataclass(frozen=True)
class Context:
    """Where an expression stands.

    Attributes:
        function: name of the innermost function, "" at module level.
        target: name that the value is given to: a variable, argument, key of a mapping or function that returns it.
    """

    function: str = ""
    target: str = ""


def name_of(node: ast.AST) -> str:
    """Return the last name of an expression, "" where it has none."""
    match node:
        case ast.Name():
            return node.id
        case ast.Attribute():
            return node.attr
        case ast.Call():
            return name_of(node.func)
        case ast.Subscript():
            return name_of(node.value)
        case ast.Constant(value=str(text)):
            return text
    return ""


def faults_at(node: ast.AST, where: Context) -> Iterator[Found]:
    """Yield the faults of one node: what is replaced, by which text, and the kind."""
    if isinstance(node, ast.stmt):
        yield from _of_statement(node, where)
    if isinstance(node, ast.expr):
        yield from _of_value(node, where)
        yield from _of_expression(node, where)


def _of_statement(node: ast.stmt, where: Context) -> Iterator[Found]:
    match node:
        case ast.If() if any(isinstance(one, ast.Raise) for one in node.body):
            yield node.test, "False", "refusal passed"
        case ast.If() if _says(node.body, where):
            yield node.test, "False", "warning dropped"
        case ast.Expr(value=ast.Call() as call) if CHECK.search(name_of(call)):
            yield node, "pass", "check skipped"
        case ast.Expr(value=ast.Yield() | ast.YieldFrom()) if WARNING.search(where.function):
            yield node, "yield from ()", "warning dropped"
        case ast.Assign(targets=[ast.Name(id=name)], value=ast.Constant(value=int() | float() as value)) if (
            name.isupper() and LIMIT.search(name) and not isinstance(value, bool)
        ):
            yield node.value, repr(10 * value), "limit x 10"


def _says(body: list[ast.stmt], where: Context) -> bool:
    """Whether a branch utters a warning."""
    for one in body:
        call = one.value if isinstance(one, ast.Expr) else None
        if isinstance(call, ast.Yield | ast.YieldFrom) and WARNING.search(where.function):
            return True
        if isinstance(call, ast.Call) and name_of(call) in {"append", "extend", "warn", "add"}:
            holder = ast.unparse(call.func)
            if WARNING.search(holder) or WARNING.search(where.function):
                return True
        if isinstance(one, ast.Return) and one.value is not None and WARNING.search(where.function):
            return True
    return False


def _of_value(node: ast.expr, where: Context) -> Iterator[Found]:
    """Faults in what is given to a name that says what it is."""
    if isinstance(node, ast.Constant | ast.Lambda | ast.Dict | ast.DictComp | ast.Starred) or not where.target:
        return
    text = f"({ast.unparse(node)})"
    if isinstance(node, ast.Call | ast.BinOp | ast.Name | ast.Attribute | ast.Subscript):
        if SIGMA.search(where.target):
            yield node, f"(0.8 * {text})", "sigma x 0.8"
            yield node, f"(1.25 * {text})", "sigma x 1.25"
            yield node, f"({text} ** 0.5)", "root added"
        if VARIANCE.search(where.target) and not SIGMA.search(where.target):
            yield node, f"(0.64 * {text})", "sigma x 0.8"
        if FREEDOM.search(where.target):
            yield node, f"({text} + 1)", "freedom off by one"
            yield node, f"({text} - 1)", "freedom off by one"
    if KEY.search(where.target) and isinstance(node, ast.Tuple | ast.List) and len(node.elts) > 1:
        if isinstance(node.elts[0], ast.Constant):  # the place of an error in a file, not what a cache goes by
            return
        yield from ((one, *rest) for one, *rest in _without_one(node, "key forgets"))


def _without_one(node: ast.Tuple | ast.List, kind: str) -> Iterator[Found]:
    for k in range(len(node.elts)):
        left = [*node.elts[:k], *node.elts[k + 1 :]]
        yield node, ast.unparse(type(node)(left, ast.Load())), kind


def _of_expression(node: ast.expr, where: Context) -> Iterator[Found]:
    match node:
        case ast.BinOp(op=ast.Pow(), right=ast.Constant(value=0.5)):
            yield node, f"({ast.unparse(node.left)})", "root lost"
        case ast.BinOp(op=ast.Pow(), right=ast.Constant(value=2)) if SIGMA.search(name_of(node.left)):
            yield node, f"({ast.unparse(node.left)})", "variance for sigma"
        case ast.BinOp(op=ast.MatMult()):
            left, right = ast.unparse(node.left), ast.unparse(node.right)
            if MATRIX.search(name_of(node.left)):
                yield node, f"(({left}).swapaxes(-1, -2) @ ({right}))", "transposed"
            if MATRIX.search(name_of(node.right)):
                yield node, f"(({left}) @ ({right}).swapaxes(-1, -2))", "transposed"
        case ast.BinOp(op=ast.Mult() | ast.Div()):
            yield from _units(node)
        case ast.Compare(ops=[ast.Lt() | ast.LtE() | ast.Gt() | ast.GtE() as operator]) if _met(node):
            other = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}[type(operator)]
            yield node, f"({ast.unparse(ast.Compare(node.left, [other()], node.comparators))})", "boundary"
        case ast.Subscript():
            yield from _indices(node)
        case ast.Constant(value=str(text)) if text in OTHER:
            yield node, repr(OTHER[text]), "name swapped"
        case ast.Attribute(attr=name, value=value) if name in OTHER and name_of(value) != "np":
            yield node, f"{ast.unparse(value)}.{OTHER[name]}", "name swapped"
        case ast.Call():
            yield from _calls(node, where)


def _met(node: ast.Compare) -> bool:
    """Whether the boundary of a comparison can be met: between other floats it practically is not."""
    for one in (node.left, node.comparators[0]):
        whole = isinstance(one, ast.Constant) and isinstance(one.value, int)
        if whole or name_of(one) in {"len", "size", "ndim"} or BOUND.search(name_of(one).lower()):
            return True
    return False


def _units(node: ast.BinOp) -> Iterator[Found]:
    for one in (node.left, node.right):
        if isinstance(one, ast.Name | ast.Attribute) and name_of(one) in _UNITS:
            yield one, f"({_UNITS[name_of(one)]})", "other unit"
        if isinstance(one, ast.Constant) and isinstance(one.value, float) and one.value in _POWERS:
            yield one, repr(_POWERS[one.value]), "other unit"


def _indices(node: ast.Subscript) -> Iterator[Found]:
    places = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
    for one in places:
        number = one.operand if isinstance(one, ast.UnaryOp) and isinstance(one.op, ast.USub) else one
        if isinstance(number, ast.Constant) and isinstance(number.value, int) and not isinstance(number.value, bool):
            value = -number.value if number is not one else number.value
            if value in (0, -1):
                yield one, str(-1 - value), "first for last"
            if value in (0, 1, 2):
                yield one, str({0: 1, 1: 0, 2: 1}[value]), "axis swapped" if len(places) > 1 else "index off by one"
        elif isinstance(one, ast.Slice):
            if one.lower is not None:
                yield one.lower, f"({ast.unparse(one.lower)}) + 1", "index off by one"
            if one.upper is not None:
                yield one.upper, f"({ast.unparse(one.upper)}) - 1", "index off by one"


def _calls(node: ast.Call, where: Context) -> Iterator[Found]:
    name = name_of(node)
    first = ast.unparse(node.args[0]) if node.args else ""
    if name == "sqrt" and len(node.args) == 1:
        yield node, f"({first})", "root lost"
    if name == "square" and len(node.args) == 1 and SIGMA.search(name_of(node.args[0])):
        yield node, f"({first})", "variance for sigma"
    if name in _ANGLES and len(node.args) == 1:
        yield node, f"({first})", "radians for degrees"
    if name == "range" and len(node.args) == 1:
        yield node, f"range({first} - 1)", "index off by one"
    if TURN.search(name) and node.args:
        angle = next((one for one in reversed(node.args) if _numeric(one)), None)
        if angle is not None:
            yield angle, f"(-({ast.unparse(angle)}))", "rotation reversed"
    if name == "swapaxes" and isinstance(node.func, ast.Attribute) and name_of(node.func.value) != "np":
        yield node, f"({ast.unparse(node.func.value)})", "transposed"
    for keyword in node.keywords:
        if keyword.arg == "ddof" and isinstance(keyword.value, ast.Constant):
            yield keyword.value, str(1 - int(keyword.value.value)), "freedom off by one"
        if keyword.arg == "axis" and isinstance(keyword.value, ast.Constant) and keyword.value.value in (0, 1):
            yield keyword.value, str(1 - keyword.value.value), "axis swapped"
    if KEY.search(where.function) or KEY.search(name):
        for k in range(len(node.args) if len(node.args) > 1 else 0):
            left = [*node.args[:k], *node.args[k + 1 :]]
            yield node, ast.unparse(ast.Call(node.func, left, node.keywords)), "key forgets"
    if SEED.search(name):
        for one in node.args:
            if isinstance(one, ast.List | ast.Tuple) and len(one.elts) > 1:
                yield from _without_one(one, "seed reused")
            elif not isinstance(one, ast.Constant):
                yield one, "0", "seed reused"


def _numeric(node: ast.expr) -> bool:
    return isinstance(node, ast.Name | ast.Attribute | ast.BinOp | ast.UnaryOp | ast.Subscript)
