"""Elementary motions by name, as scripts write them: ``base/forward/M2 shift z``."""

from __future__ import annotations

from collections.abc import Mapping

from optics.geometry.tree import ORIGIN
from scenes.specs.course import noll
from scenes.specs.job import NodeInfo
from scenes.yaml.errors import InputError, Issue, Problem, names_text, nearest
from twin.monitor.motions import ElementaryMotion

_AXES = {"x": 0, "y": 1, "z": 2}
_FORMS = "NODE shift x|y|z, NODE rotate x|y|z, NODE scale, NODE figure Z5; 'about PIVOT' may follow a turn or a scale"


def motion_named(text: str, nodes: Mapping[str, NodeInfo]) -> ElementaryMotion:
    """The elementary motion that a text names.

    Args:
        text: ``NODE shift x``, ``NODE rotate x``, ``NODE scale`` or ``NODE figure Z5``, then perhaps ``about PIVOT``.
        nodes: path -> what may be done to it, for all bodies of the instrument.

    Returns:
        The motion, labelled with the text.

    Raises:
        InputError: not of this form, no such node or pivot, or a motion that the node does not have.
    """
    words = text.split()
    pivot = ORIGIN
    if len(words) > 2 and words[-2] == "about":
        pivot, words = words[-1], words[:-2]
    if len(words) < 2:
        raise _wrong("not a motion of a node", text, _FORMS)
    node, kind, *rest = words
    if node not in nodes:
        raise _wrong("no such node", node, names_text(sorted(nodes)), nearest(node, nodes))
    info = nodes[node]
    rigid = tuple(name for name in ("shift", "rotate", "scale", "figure") if name in info.allows)
    if kind not in rigid:
        raise _wrong(f"{node} cannot be differentiated by this", kind, names_text(rigid), nearest(kind, rigid))
    known = tuple(dict.fromkeys((ORIGIN, *info.pivots)))
    if pivot not in known:
        raise _wrong(f"{node} has no such pivot", pivot, names_text(known), nearest(pivot, known))
    return ElementaryMotion(node, kind, _axis(text, kind, rest), pivot, text)


def _axis(text: str, kind: str, rest: list[str]) -> int:
    if kind == "scale" and not rest:
        return 0
    if len(rest) == 1:
        if kind == "figure":
            try:
                return noll(rest[0])
            except Problem as problem:
                raise InputError(Issue(problem.problem, found=problem.found, allowed=problem.allowed)) from None
        if kind in ("shift", "rotate") and rest[0].lower() in _AXES:
            return _AXES[rest[0].lower()]
    raise _wrong("not a motion of a node", text, _FORMS)


def _wrong(problem: str, found: str, allowed: str, suggestion: str | None = None) -> InputError:
    return InputError(Issue(problem, found=repr(found), allowed=allowed, suggestion=suggestion))
