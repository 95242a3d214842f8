"""What happens to one body of an instrument, as a file says it, and what may be done to which body."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

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
from scenes.specs.motion_text import meant, node_named, perturbation_in_words
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, names_text, shown, unknown
from scenes.yaml.spec import ZERO_IS_NONE, Name, Paths, Spec
from scenes.yaml.unit_fields import Quantity
from scenes.yaml.units import LENGTH

FigureTerm = Annotated[float, Quantity(LENGTH, largest="100 um"), ZERO_IS_NONE]

ACTIONS = ("rotate", "shift", "figure", "scale", "radius", "conic", "index", "abbe", "temperature")
"""What can be done to a node, as its perturbation names it; `NodeInfo.allows` says which of them."""


class PlainPerturbationSpec(Spec):
    """What happens to one body of the instrument: a small rigid motion, a scale change, a change of temperature, for a
    mirror or a face an error of its figure, radius or conic constant, and for a lens of its index.

    Attributes
    ----------
    rotate : Rotation
        Rotation vector in the body's own frame, about the pivot, radians; it comes before the shift.
    shift : Shift
        In the body's own frame, metres.
    pivot : Name
        Name of the body's point that the rotation leaves in place and that the scale change starts from.
    figure : dict[Term, FigureTerm]
        Zernike terms of the surface error, by Noll's numbering and normalisation, metres.
    scale : ScaleChange
        Relative growth of the body and all it carries, 1e-6 for 1 ppm.
    radius : RadiusChange | None
        Relative change of the vertex radius of curvature, 1e-6 for 1 ppm.
    conic : ConicChange | None
        Change of the conic constant, a pure number.
    index : IndexChange | None
        Change of the refractive index of the lens that begins at this face, a pure number.
    abbe : AbbeChange | None
        Relative change of the Abbe number of the lens that begins at this face; its index at the d line stays.
    temperature : job_tables.PlainTemperature | None
        Uniform change as `2 K`, or with a gradient, in place of what the body inherits from the one that carries it,
        also where the change is `0 K`; None for what it inherits.
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
        """Its own temperature; no change where none is given."""
        return job_tables.TemperatureSpec() if self.temperature is None else self.temperature

    def uses(self) -> tuple[str, ...]:
        """Which of ACTIONS do something; a temperature that is given does, since no change is another one than that of
        a warmed carrier.
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
        """Which of these a node has to allow: all but a temperature that is no change, which a node without heat may
        have as well.
        """
        return tuple(name for name in self.uses() if name != "temperature" or self.heat.warms)

    def motion(self) -> Motion:
        """All of it but the temperature, as a state has it."""
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


def _in_words(value: Any) -> Any:
    """`[M2 shift z 20 um]` is what it says of each node."""
    words = isinstance(value, list | tuple) and all(isinstance(text, str) for text in value)
    return perturbation_in_words(value) if words else value


IN_WORDS = BeforeValidator(_in_words)
"""Validator of a mapping from nodes to perturbations that may be written as a list of texts."""


@dataclass(frozen=True)
class NodeInfo:
    """What may be done to a body of the instrument.

    Attributes
    ----------
    pivots : tuple[str, ...]
        Names of its pivots.
    allows : frozenset[str]
        Which of ACTIONS.
    cold : str
        Why it has no temperature, where that is not plain.
    """

    pivots: tuple[str, ...] = (DEFAULT_PIVOT,)
    allows: frozenset[str] = frozenset({"rotate", "shift", "temperature"})
    cold: str = ""

    @property
    def known_pivots(self) -> tuple[str, ...]:
        """Names of its pivots and of the one that every body has."""
        return tuple(dict.fromkeys((*self.pivots, DEFAULT_PIVOT)))


BUILT = ("shift", "rotate", "pivot", "figure", "radius", "conic", "index")
"""Keys of a perturbation that tell how a body was built."""


def _standing(value: Mapping[str, PlainPerturbationSpec]) -> Mapping[str, PlainPerturbationSpec]:
    for path, what in value.items():
        if what.temperature is not None:
            problem = "a body as built has no temperature: it stands so at the instrument's own"
            allowed = f"{names_text(BUILT)}; a temperature below a job's perturb"
            raise Problem(problem, "temperature", allowed, within=(path, "temperature"))
        if what.scale:
            problem = "a body as built has no scale: each of its parts has its own place and shape"
            raise Problem(problem, "scale", names_text(BUILT), within=(path, "scale"))
    return value


AsBuilt = Annotated[Paths[PlainPerturbationSpec], IN_WORDS, AfterValidator(_standing)]
"""Node -> how it stands and is shaped against the drawing."""


Perturbed = TypeVar("Perturbed", bound=PlainPerturbationSpec)


def in_full(
    perturb: Mapping[str, Perturbed], nodes: Mapping[str, NodeInfo], issue: Callable[[Problem, str], Issue]
) -> FrozenMap[str, Perturbed]:
    """Perturbations by the paths of their nodes; names of no node stay as they are.

    Parameters
    ----------
    perturb : Mapping[str, Perturbed]
        By path, or by the last parts of it.
    nodes : Mapping[str, NodeInfo]
        Node path -> what may be done to it.
    issue : Callable[[Problem, str], Issue]
        What is wrong with a name -> the issue of it.

    Raises
    ------
    InputError
        a name of several nodes, or two names of one.
    """
    issues: list[Issue] = []
    named: dict[str, str] = {}
    for name in perturb:
        try:
            path = node_named(name, nodes) if meant(name, nodes) else name
            if path in named.values():
                raise Problem("this node is perturbed twice", shown(name), f"{path} once, under one name")
            named[name] = path
        except Problem as problem:
            issues.append(issue(problem, name))
    if issues:
        raise InputError(*issues)
    return FrozenMap({named[name]: what for name, what in perturb.items()})


def perturbation_issues(
    owner: Spec, nodes: Mapping[str, NodeInfo], path: str, what: PlainPerturbationSpec, key: KeyPath
) -> list[Issue]:
    """What is wrong with a perturbation of the node ``path`` that stands at ``key`` of a specification.

    Parameters
    ----------
    owner : Spec
        The specification.
    nodes : Mapping[str, NodeInfo]
        Node path -> what may be done to it.
    path : str
        Of the node.
    what : PlainPerturbationSpec
        Is done to it.
    key : KeyPath
        Where it is written.
    """
    if path not in nodes:
        return [no_such_node(owner, nodes, path, key)]
    info, issues = nodes[path], []
    for action in what.needs():
        # nodes are displaced where a surface has a figure
        if ("figure" if action == "deformation" else action) not in info.allows:
            issues.append(not_allowed(owner, info, action, (*key, action)))
    if what.pivot not in info.known_pivots:
        wrong = unknown("this node has no such pivot", what.pivot, info.known_pivots)
        issues.append(owner.issue(wrong, (*key, "pivot")))
    return issues


def no_such_node(owner: Spec, nodes: Mapping[str, NodeInfo], path: str, key: KeyPath) -> Issue:
    """An issue of a node that the instrument does not have."""
    return owner.issue(unknown("no such node", path, sorted(nodes)), key)


def not_allowed(owner: Spec, info: NodeInfo, action: str, key: KeyPath) -> Issue:
    """An issue of what a node does not allow."""
    allowed = names_text(sorted(info.allows)) or "nothing"
    why = f": {info.cold}" if action == "temperature" and info.cold else ""
    return owner.issue(f"this node does not allow {action}{why}", key, allowed=allowed)


def in_words(perturb: Mapping[str, PlainPerturbationSpec]) -> str:
    """Perturbations for people: ``base/gf7/M2 shift (0 um, 0 um, 20 um); ...``."""
    parts = []
    for path, what in perturb.items():
        plain = what.plain()
        parts.append(f"{path} {', '.join(f'{key} {_short(plain[key])}' for key in what.uses())}")
    return "; ".join(parts)


def _short(value: Any) -> str:
    """A quantity, or several, as a reader sees them."""
    if isinstance(value, dict):
        known = {key: part for key, part in value.items() if part not in ("0 K", ["0 K/m"] * 3)}
        return ", ".join(f"{key} {_short(part)}" for key, part in known.items())
    return f"({', '.join(map(str, value))})" if isinstance(value, list) else str(value)
