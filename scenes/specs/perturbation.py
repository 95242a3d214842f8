"""Perturbation of a body of an instrument, and the actions that each body allows.

Perturbations as text, ``M2 shift z 20 um``, and the short names of bodies.

Jobs, studies, the command line and scripts share this grammar. The controls of the live page use the same names.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Self, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field

from optics.geometry.tree import Motion
from optics.numerics.number_tree import FrozenMap
from scenes.specs import course, job_tables
from scenes.specs.course import noll
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, names_text, nearest, shown, unknown
from scenes.yaml.spec import ZERO_IS_NONE, Name, Paths, Spec
from scenes.yaml.unit_fields import Quantity
from scenes.yaml.units import ANGLE, LENGTH, SCALE, format_quantity, parse_quantity, split_quantity

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
    """Return a correct amount for an error message on a conic constant or an index, which take numbers without unit.

    A share such as ``10 ppm`` is converted: the message shows the same change as a number.
    """
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


FigureTerm = Annotated[float, Quantity(LENGTH, largest="100 um"), ZERO_IS_NONE]

ACTIONS = ("rotate", "shift", "figure", "scale", "radius", "conic", "index", "abbe", "temperature")
"""Actions on a node, by their keys in a perturbation; `NodeInfo.allows` has those that a node allows."""


class PlainPerturbationSpec(Spec):
    """Perturbation of one body: a small rigid motion, a change of scale, temperature, surface shape or index.

    Figure, radius and conic constant are those of a mirror or a face, the index that of a lens.

    Attributes
    ----------
    rotate : tuple[float, float, float]
        Rotation vector in the body's frame, about the pivot, in radians; the rotation precedes the shift.
    shift : tuple[float, float, float]
        Shift in the body's frame, in metres.
    pivot : str
        Name of the body's point that rotation and scale leave in place.
    figure : dict[str, float]
        Zernike term, by Noll's numbering and normalisation -> surface error of a mirror or a face, in metres.
    scale : float
        Relative change of scale of the body and all it carries.
    radius : float | None
        Relative change of the vertex radius of curvature of a mirror or a face; zero by default.
    conic : float | None
        Change of the conic constant, a pure number; zero by default.
    index : float | None
        Change of the refractive index of the lens that begins at this face, a pure number; zero by default.
    abbe : float | None
        Relative change of the Abbe number of the lens that begins at this face; its index at the d line is unchanged.
        Zero by default.
    temperature : TemperatureSpec | None
        Temperature change: uniform as `2 K`, or with a gradient. It replaces the change that the body inherits from its
        carrier, even if it is `0 K`; by default the change is inherited.
    """

    rotate: course.Rotation = course.NO_MOTION
    shift: course.Shift = course.NO_MOTION
    pivot: Name = course.DEFAULT_PIVOT
    figure: Annotated[dict[course.Term, FigureTerm], AfterValidator(FrozenMap)] = Field(default_factory=FrozenMap)
    scale: course.ScaleChange = 0.0
    radius: course.RadiusChange | None = None
    conic: course.ConicChange | None = None
    index: course.IndexChange | None = None
    abbe: course.AbbeChange | None = None
    temperature: job_tables.PlainTemperature | None = None

    @property
    def heat(self) -> job_tables.TemperatureSpec:
        """Temperature change of the body; zero by default."""
        return job_tables.TemperatureSpec() if self.temperature is None else self.temperature

    def uses(self) -> tuple[str, ...]:
        """Return the names in ACTIONS of the changes that have an effect.

        A temperature change of 0 K counts as an effect, because the body then stays cold on a heated carrier.
        """
        done = {
            "rotate": any(self.rotate),
            "shift": any(self.shift),
            "figure": any(self.figure.values()),
            **{name: bool(getattr(self, name)) for name in ("scale", "radius", "conic", "index", "abbe")},
            "temperature": self.temperature is not None,
        }
        return tuple(name for name, does in done.items() if does)

    def needs(self) -> tuple[str, ...]:
        """Return the names in ACTIONS of the changes that a node must allow for this perturbation.

        A temperature change of 0 K is not one of them, since a node without thermal properties may have it.
        """
        return tuple(name for name in self.uses() if name != "temperature" or self.heat.warms)

    def plus(self, other: Self) -> Self:
        """Return the sum of this and another perturbation of the same body, as if one had both.

        Components of vectors, figure terms, changes of scale, shape and index, and linear temperature changes add.

        Parameters
        ----------
        other : PlainPerturbationSpec
            The other perturbation.

        Raises
        ------
        Problem
            Both rotate or scale the body about different pivots, or both have a table of nodes.
        """
        pivots = list(dict.fromkeys(p.pivot for p in (self, other) if {"rotate", "scale"} & set(p.uses())))
        if len(pivots) > 1:
            text = "the body is rotated or scaled about another pivot already, and has only one"
            raise Problem(text, pivots[1], pivots[0], within=("pivot",))
        pivot = pivots[0] if pivots else other.pivot
        return self.model_copy(update={**_sums(self, other), "pivot": pivot})

    def motion(self) -> Motion:
        """Return the motion, SI, that the perturbation without its temperature gives the body in a state."""
        figure = {course.noll(term): value for term, value in self.figure.items()}
        shape: dict[str, Any] = {name: getattr(self, name) or 0.0 for name in ("index", "radius", "conic", "abbe")}
        return Motion(self.rotate, self.shift, self.pivot, self.scale, figure, **shape)


def _sums(first: Spec, other: Spec) -> dict[str, Any]:
    """Return the sums of the values of two specifications by key, without texts."""
    pairs = {key: (value, getattr(other, key)) for key, value in first if not isinstance(value, str)}
    return {key: _sum(key, *pair) for key, pair in pairs.items()}


def _sum(key: str, first: Any, other: Any) -> Any:
    """Return the sum of the values of a key of two perturbations; None is nothing."""
    if first is None or other is None:
        return other if first is None else first
    if isinstance(first, Spec):
        table = getattr(other, "table", None)
        if table and getattr(first, "table", None):
            text = "this body has a table of nodes already, and another cannot be added"
            raise Problem(text, table, "one table of each body", within=(key, "table"))
        return first.model_copy(update=_sums(first, other))
    if isinstance(first, Mapping):
        return FrozenMap({**first, **{name: _sum(key, first.get(name), value) for name, value in other.items()}})
    if isinstance(first, tuple):
        return tuple(_sum(key, *pair) for pair in zip(first, other, strict=True))
    total, rounding = first + other, 1e-15 * (abs(first) + abs(other))  # 3 + 0.1 arcsec are 3.1 arcsec
    if abs(total) <= rounding:
        return 0.0
    kind = {"shift": LENGTH, "figure": LENGTH, "rotate": ANGLE}.get(key)
    return parse_quantity(format_quantity(total, kind, rounding), kind) if kind else float(f"{total:.15g}")


def _in_words(value: Any) -> Any:
    """Expand a list of texts such as `[M2 shift z 20 um]` to a mapping from nodes to perturbations."""
    words = isinstance(value, list | tuple) and all(isinstance(text, str) for text in value)
    return perturbation_in_words(value) if words else value


IN_WORDS = BeforeValidator(_in_words)
"""Validator of a mapping from nodes to perturbations that may be written as a list of texts."""


@dataclass(frozen=True)
class NodeInfo:
    """Actions that a body of the instrument allows.

    Attributes
    ----------
    pivots : tuple[str, ...]
        Names of the pivots.
    allows : frozenset[str]
        Names in ACTIONS of the changes that are allowed.
    cold : str
        Reason why the body has no temperature of its own; empty if it has one or the reason is obvious.
    """

    pivots: tuple[str, ...] = (course.DEFAULT_PIVOT,)
    allows: frozenset[str] = frozenset({"rotate", "shift", "temperature"})
    cold: str = ""

    @property
    def known_pivots(self) -> tuple[str, ...]:
        """Names of all pivots that a perturbation may name: those of the body, and its origin."""
        return tuple(dict.fromkeys((*self.pivots, course.DEFAULT_PIVOT)))


BUILT = ("shift", "rotate", "pivot", "figure", "radius", "conic", "index")
"""Keys of a perturbation that describe a body as built."""


def _check_as_built(value: Mapping[str, PlainPerturbationSpec]) -> Mapping[str, PlainPerturbationSpec]:
    for path, what in value.items():
        if what.temperature is not None:
            problem = "a body as built has no temperature: its state is that at the instrument's temperature"
            allowed = f"{names_text(BUILT)}; a temperature below a job's perturb"
            raise Problem(problem, "temperature", allowed, within=(path, "temperature"))
        if what.scale:
            problem = "a body as built has no scale: position and shape are given for each part"
            raise Problem(problem, "scale", names_text(BUILT), within=(path, "scale"))
    return value


AsBuilt = Annotated[Paths[PlainPerturbationSpec], IN_WORDS, AfterValidator(_check_as_built)]
"""Path of a node -> deviation of the built body from the design."""


Perturbed = TypeVar("Perturbed", bound=PlainPerturbationSpec)


def with_full_paths(
    perturb: Mapping[str, Perturbed], nodes: Mapping[str, NodeInfo], issue: Callable[[Problem, str], Issue]
) -> FrozenMap[str, Perturbed]:
    """Return perturbations with the full paths of their nodes as keys; unknown names stay unchanged.

    Parameters
    ----------
    perturb : Mapping[str, Perturbed]
        Perturbations by path, or by the last parts of it.
    nodes : Mapping[str, NodeInfo]
        Node path -> allowed actions.
    issue : callable
        Function from a problem and a name to an issue.

    Raises
    ------
    InputError
        A name fits several nodes, or two names fit first node.
    """
    issues: list[Issue] = []
    named: dict[str, str] = {}
    for name in perturb:
        try:
            path = find_node(name, nodes) if matching_nodes(name, nodes) else name
            if path in named.values():
                raise Problem("this node is perturbed twice", shown(name), f"{path} once, under first name")
            named[name] = path
        except Problem as problem:
            issues.append(issue(problem, name))
    if issues:
        raise InputError(*issues)
    return FrozenMap({named[name]: what for name, what in perturb.items()})


def perturbation_issues(
    owner: Spec, nodes: Mapping[str, NodeInfo], path: str, what: PlainPerturbationSpec, key: KeyPath
) -> list[Issue]:
    """Return the issues of a perturbation: an unknown node, an unknown pivot, or changes that are not allowed.

    Parameters
    ----------
    owner : Spec
        The specification.
    nodes : Mapping[str, NodeInfo]
        Node path -> allowed actions.
    path : str
        Path of the node.
    what : PlainPerturbationSpec
        The perturbation.
    key : KeyPath
        Key path of the perturbation.
    """
    if path not in nodes:
        return [no_such_node(owner, nodes, path, key)]
    info, issues = nodes[path], []
    for action in what.needs():
        # a surface that allows a figure also allows displaced nodes
        if ("figure" if action == "deformation" else action) not in info.allows:
            issues.append(not_allowed(owner, info, action, (*key, action)))
    if what.pivot not in info.known_pivots:
        wrong = unknown("this node has no such pivot", what.pivot, info.known_pivots)
        issues.append(owner.issue(wrong, (*key, "pivot")))
    return issues


def no_such_node(owner: Spec, nodes: Mapping[str, NodeInfo], path: str, key: KeyPath) -> Issue:
    """Return the issue of a node that the instrument does not have."""
    return owner.issue(unknown("no such node", path, sorted(nodes)), key)


def not_allowed(owner: Spec, info: NodeInfo, action: str, key: KeyPath) -> Issue:
    """Return the issue of an action that a node does not allow."""
    allowed = names_text(sorted(info.allows)) or "nothing"
    why = f": {info.cold}" if action == "temperature" and info.cold else ""
    return owner.issue(f"this node does not allow {action}{why}", key, allowed=allowed)


def perturbation_text(perturb: Mapping[str, PlainPerturbationSpec]) -> str:
    """Return perturbations as a job takes them: ``base/gf7/M2 shift z 20 um; base/gf7/M2 rotate x 3 arcsec``."""
    return "; ".join(f"{path} {part}" for path, what in perturb.items() for part in _parts(what))


def _parts(what: PlainPerturbationSpec) -> Iterator[str]:
    """Yield the parts of a perturbation as text, such as ``shift z 20 um``; a table of nodes by its file."""
    plain, about = what.plain(), "" if what.pivot == course.DEFAULT_PIVOT else f" about {what.pivot}"
    for key in what.uses():
        text, end = plain[key], about if key in ("rotate", "scale") else ""
        if key in ("shift", "rotate"):
            yield from _components(key, getattr(what, key), text, end)
        elif key == "figure":
            yield from (f"figure {term} {text[term]}" for term, size in what.figure.items() if size)
        elif key == "deformation":
            yield f"deformation {text['table']}"
        elif key == "temperature":
            yield from _heat_parts(what.heat, text)
        else:
            yield f"{key} {text}{end}"


def _heat_parts(heat: job_tables.TemperatureSpec, plain: Mapping[str, Any]) -> Iterator[str]:
    """Yield a temperature change and its gradient as text, such as ``temperature 2 K``.

    A uniform change of zero is written only if there is no gradient, so that the text is never empty.
    """
    if "table" in plain:
        yield f"temperature {plain['table']}"
    if heat.change or not heat.warms:
        yield f"temperature {plain['change']}"
    yield from _components("gradient", heat.gradient, plain["gradient"])


def _components(key: str, vector: Sequence[float], texts: Sequence[str], end: str = "") -> Iterator[str]:
    """Yield the components of a vector that are not zero as text, such as ``shift z 20 um``."""
    yield from (f"{key} {axis} {text}{end}" for axis, size, text in zip(AXES, vector, texts, strict=True) if size)
