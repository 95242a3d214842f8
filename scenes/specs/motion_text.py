"""Perturbations as text, ``M2 shift z 20 um``, and the short names of bodies.

Jobs, studies, the command line and scripts share this grammar. The controls of the live page use the same names.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from scenes.specs.course import noll
from scenes.yaml.errors import Problem, names_text, nearest, shown, unknown
from scenes.yaml.units import SCALE, parse_quantity, split_quantity

AXES = {"x": 0, "y": 1, "z": 2}
KINDS = {
    "shift": "x|y|z LENGTH",
    "rotate": "x|y|z ANGLE",
    "scale": "SHARE",
    "radius": "SHARE",
    "conic": "NUMBER",
    "index": "NUMBER",
    "abbe": "SHARE",
    "figure": "Z5 LENGTH",
    "temperature": "DIFFERENCE",
    "gradient": "x|y|z DIFFERENCE/LENGTH",
}
"""Kind of a perturbation -> form of the text after the kind, such as `x|y|z LENGTH`."""
PURE = ("conic", "index")
"""Kinds of perturbation whose amounts are numbers without a unit."""
NOTHING = {"shift": "0 um", "rotate": "0 arcsec", "gradient": "0 K/m"}
"""Kind of a vector -> value of the components that no text sets."""
FORMS = (
    '"M2 shift z 20 um", "M2 rotate x 3 arcsec about centre", "M2 figure Z5 10 nm", "M2 radius 100 ppm", '
    '"M2 conic 1e-4", "forward scale 20 ppm", "base temperature 2 K", "base gradient z 50 mK/m"'
)
"""Examples of perturbations as text, for messages and help."""
_ABOUT = "about"


def matching_nodes(name: str, nodes: Iterable[str]) -> list[str]:
    """Return the bodies to which a name may refer: the one with this path, else all whose paths end with it.

    Parameters
    ----------
    name : str
        Name such as ``base/forward/M2``, ``forward/M2`` or ``M2``.
    nodes : Iterable[str]
        Paths of all bodies.
    """
    paths = tuple(nodes)
    return [name] if name in paths else [path for path in paths if path.endswith(f"/{name}")]


def find_node(name: str, nodes: Iterable[str]) -> str:
    """Return the path of the body to which a name refers.

    Parameters
    ----------
    name : str
        Path, or the last parts of a path that only one body has: ``base/forward/M2``, ``forward/M2``, or ``M2`` in an
        instrument with one.
    nodes : Iterable[str]
        Paths of all bodies.

    Raises
    ------
    Problem
        The name fits no body, or several.
    """
    matches = matching_nodes(name, nodes)
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise Problem("several nodes have this name", shown(name), names_text(matches))
    raise unknown("no such node", name, sorted(nodes))


def short_name(path: str, nodes: Iterable[str]) -> str:
    """Return the shortest unique name of a body: the last parts of its path.

    Parameters
    ----------
    path : str
        Path of the body.
    nodes : Iterable[str]
        Paths of all bodies.
    """
    parts, paths = path.split("/"), tuple(nodes)
    tails = ("/".join(parts[-count:]) for count in range(1, len(parts) + 1))
    return next((tail for tail in tails if matching_nodes(tail, paths) == [path]), path)


def motion_of(text: str) -> tuple[str, str, str, str, str]:
    """Return the parts of a motion's text: node, kind, axis or term, quantity, and pivot.

    Parameters
    ----------
    text : str
        Text of the form ``NODE KIND [AXIS] [QUANTITY] [about PIVOT]``; missing parts are empty.

    Raises
    ------
    Problem
        The text is not of this form.
    """
    words = text.split()
    pivot = ""
    if len(words) > 2 and words[-2] == _ABOUT:
        pivot, words = words[-1], words[:-2]
    if len(words) < 2:
        raise Problem("not a motion of a node", shown(text), FORMS)
    node, kind, *rest = words
    if kind not in KINDS:
        raise Problem("no such kind of perturbation", shown(kind), names_text(KINDS), nearest(kind, KINDS))
    axis = ""
    if kind in ("shift", "rotate", "gradient"):
        axis = rest.pop(0).lower() if rest else ""
        if axis not in AXES:
            raise Problem("not a motion of a node", shown(text), f"{kind} x, {kind} y or {kind} z: {FORMS}")
    elif kind == "figure":
        axis = rest.pop(0) if rest else ""
        noll(axis)
    if pivot and kind not in ("shift", "rotate", "scale"):
        raise Problem(f"a {kind} has no pivot", shown(f"{_ABOUT} {pivot}"), "about after shift, rotate or scale alone")
    return node, kind, axis, " ".join(rest), pivot


def key_below(kind: str, axis: str) -> tuple[str | int, ...]:
    """Return the key of a component in a node's perturbation: ``("shift", 2)``, ``("temperature", "gradient", 0)``.

    Parameters
    ----------
    kind : str
        One of ``KINDS``.
    axis : str
        ``x``, ``y`` or ``z``, a figure's term, or empty.
    """
    heat = {"temperature": ("temperature", "change"), "gradient": ("temperature", "gradient")}
    path: tuple[str | int, ...] = heat.get(kind, (kind,))
    return (*path, AXES.get(axis, axis)) if axis else path


def put(keys: dict[str, Any], kind: str, axis: str, value: Any, nothing: Any) -> None:
    """Store one component, such as shift z, in the mapping of a node's perturbation.

    Parameters
    ----------
    keys : dict[str, Any]
        Perturbation, which is extended.
    kind : str
        Kind of the perturbation, one of ``KINDS``.
    axis : str
        ``x``, ``y`` or ``z``, a figure's term, or empty.
    value : str or float
        Value of the component.
    nothing : str or float
        Value of the other components of a vector, if they are not set.
    """
    *above, last = key_below(kind, axis)
    inner: Any = keys
    for k, key in enumerate(above):
        vector = isinstance(last, int) and k == len(above) - 1
        inner = inner.setdefault(key, [nothing] * len(AXES) if vector else {})
    inner[last] = value


def _pure(kind: str, quantity: str, text: str) -> float:
    """Return an amount that is a pure number; raise `Problem` for other text."""
    try:
        amount = float(quantity)
    except ValueError:
        amount = math.nan
    if not math.isfinite(amount):
        raise Problem(
            f"a change of the {kind} is a pure number", shown(quantity or text), _instead(kind, quantity, text)
        )
    return amount


def _instead(kind: str, quantity: str, text: str) -> str:
    """Return what is allowed in place of an amount that is no pure number; for a share, the same change as a number."""
    node = text.split()[0]
    try:
        share = parse_quantity(quantity, SCALE)
    except Problem:
        return f"M2 {kind} 1e-4"
    value, name = (-1.0, "conic constant") if kind == "conic" else (1.5, "refractive index")
    example = f"{node} {kind} {share * value:.6g} if that is {value:g}"
    return f"a number; {quantity} is {share:.6g} times the {name} of {node} in its camera file, such as {example}"


def perturbation_in_words(texts: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return the mapping `perturb` of a job's file that a list of texts describes.

    Nodes keep the names of the texts.

    Parameters
    ----------
    texts : Iterable[str]
        Texts such as ``M2 shift z 20 um``; several of one body are combined.

    Raises
    ------
    Problem
        A text is not of this form, or two texts set the same component.
    """
    out: dict[str, dict[str, Any]] = {}
    components: set[tuple[str, str, str]] = set()
    for text in texts:
        node, kind, axis, quantity, pivot = motion_of(text)
        amount: str | float = quantity
        if kind in PURE:
            amount = _pure(kind, quantity, text)
        elif split_quantity(quantity) is None:
            raise Problem("the amount with its unit is missing", shown(quantity or text), FORMS)
        if (node, kind, axis) in components:
            raise Problem("this component is set twice", shown(text), f"one {kind} {axis}".rstrip() + f" of {node}")
        components.add((node, kind, axis))
        what = out.setdefault(node, {})
        put(what, kind, axis, amount, NOTHING.get(kind))
        if pivot:
            if what.setdefault("pivot", pivot) != pivot:
                raise Problem(f"{node} can have only one pivot for all its rotations", shown(pivot), what["pivot"])
    return out
