"""Perturbation of a body of an instrument, and the actions that each body allows."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Self, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field

from optics.geometry.tree import Motion
from optics.numerics.number_tree import FrozenMap
from scenes.specs import job_tables
from scenes.specs.course import (
    DEFAULT_PIVOT,
    NO_MOTION,
    AbbeChange,
    ConicChange,
    IndexChange,
    RadiusChange,
    Rotation,
    ScaleChange,
    Shift,
    Term,
    noll,
)
from scenes.specs.motion_text import AXES, find_node, matching_nodes, perturbation_in_words
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, names_text, shown, unknown
from scenes.yaml.spec import ZERO_IS_NONE, Name, Paths, Spec
from scenes.yaml.unit_fields import Quantity
from scenes.yaml.units import LENGTH

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

    rotate: Rotation = NO_MOTION
    shift: Shift = NO_MOTION
    pivot: Name = DEFAULT_PIVOT
    figure: Annotated[dict[Term, FigureTerm], AfterValidator(FrozenMap)] = Field(default_factory=FrozenMap)
    scale: ScaleChange = 0.0
    radius: RadiusChange | None = None
    conic: ConicChange | None = None
    index: IndexChange | None = None
    abbe: AbbeChange | None = None
    temperature: job_tables.PlainTemperature | None = None

    @property
    def heat(self) -> job_tables.TemperatureSpec:
        """Temperature change of the body; zero by default."""
        return job_tables.TemperatureSpec() if self.temperature is None else self.temperature

    def uses(self) -> tuple[str, ...]:
        """Return the names in ACTIONS of the changes that have an effect.

        A temperature of 0 K has one: it differs from that of a heated carrier.
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
        figure = {noll(term): value for term, value in self.figure.items()}
        return Motion(
            self.rotate,
            self.shift,
            self.pivot,
            self.scale,
            figure,
            index=self.index or 0.0,
            radius=self.radius or 0.0,
            conic=self.conic or 0.0,
            abbe=self.abbe or 0.0,
        )


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
    return float(f"{first + other:.15g}")  # 20 um + 3 um are 23 um, without the rounding of floats


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
        Reason why the body has no temperature of its own; empty if it has first or the reason is obvious.
    """

    pivots: tuple[str, ...] = (DEFAULT_PIVOT,)
    allows: frozenset[str] = frozenset({"rotate", "shift", "temperature"})
    cold: str = ""

    @property
    def known_pivots(self) -> tuple[str, ...]:
        """Names of all pivots that a perturbation may name: those of the body, and its origin."""
        return tuple(dict.fromkeys((*self.pivots, DEFAULT_PIVOT)))


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
    plain, about = what.plain(), "" if what.pivot == DEFAULT_PIVOT else f" about {what.pivot}"
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
    """Yield a temperature change as text, ``temperature 2 K``; a change of zero only where it is all."""
    if "table" in plain:
        yield f"temperature {plain['table']}"
    if heat.change or not heat.warms:
        yield f"temperature {plain['change']}"
    yield from _components("gradient", heat.gradient, plain["gradient"])


def _components(key: str, vector: Sequence[float], texts: Sequence[str], end: str = "") -> Iterator[str]:
    """Yield the components of a vector that are not zero as text, such as ``shift z 20 um``."""
    yield from (f"{key} {axis} {text}{end}" for axis, size, text in zip(AXES, vector, texts, strict=True) if size)
