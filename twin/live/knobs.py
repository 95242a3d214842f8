"""Knobs of the live twin: what of an instrument can be turned, a study's factors, and what their values perturb.

A knob is called as a script or a course's table calls the motion: ``base/forward/M2 shift z``. Its value is a number in
the knob's unit, and what it does is what a job's file does that writes this number with this unit, to the last bit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from scenes.specs.course import DEFAULT_PIVOT
from scenes.specs.job import JobSpec
from scenes.specs.perturbation import NodeInfo
from scenes.specs.study import DesignSpec, FactorSpec
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, unknown
from scenes.yaml.units import split_quantity, unit_ratio, with_unit
from twin.study.runs.base_job import Tree, with_values
from twin.study.runs.plan import Plan, number_at
from twin.study.runs.setup import StudySetup

AXES = ("x", "y", "z")
FIGURE_TERMS = tuple(f"Z{j}" for j in range(4, 16))
"""Noll's terms of a figure that have knobs: defocus to secondary spherical aberration's neighbours. Piston and tilts
are rigid motions."""


@dataclass(frozen=True)
class _KnobKind:
    """What all knobs of one kind have in common.

    Attributes
    ----------
    key : str
        Of the perturbation in a job's file.
    unit : str
        Of the values.
    extent : float
        Largest value of the slider at first, either way.
    limit : float
        Largest value that may be typed.
    """

    key: str
    unit: str
    extent: float
    limit: float


KINDS: Mapping[str, _KnobKind] = {
    "rotate": _KnobKind("rotate", "arcsec", 10.0, 18_000.0),
    "shift": _KnobKind("shift", "um", 10.0, 100_000.0),
    "figure": _KnobKind("figure", "nm", 50.0, 100_000.0),
    "scale": _KnobKind("scale", "ppm", 20.0, 10_000.0),
    "temperature": _KnobKind("temperature", "K", 1.0, 1000.0),
    "gradient": _KnobKind("temperature", "mK/m", 50.0, 1_000_000.0),
}
"""By name. Limits are those of a job's file."""


@dataclass(frozen=True)
class Knob:
    """One number that can be turned.

    Attributes
    ----------
    name : str
        ``base/forward/M2 shift z``.
    node : str
        The body.
    kind : str
        One of ``KINDS``.
    axis : str
        ``x``, ``Z5``; empty where there is one only.
    unit : str
        Of the values.
    value : float
        At the start.
    extent : float
        The slider's ends at the start, either way.
    limit : float
        Largest value that may be typed.
    """

    name: str
    node: str
    kind: str
    axis: str
    unit: str
    value: float
    extent: float
    limit: float


def axes_of(kind: str) -> tuple[str, ...]:
    """What knobs of a kind are called after it."""
    if kind in ("rotate", "shift", "gradient"):
        return AXES
    return FIGURE_TERMS if kind == "figure" else ("",)


def knob_name(node: str, kind: str, axis: str) -> str:
    """``base/forward/M2 shift z``, ``base/forward temperature``."""
    return f"{node} {kind} {axis}" if axis else f"{node} {kind}"


def knobs_of(nodes: Mapping[str, NodeInfo], job: JobSpec) -> dict[str, Knob]:
    """All knobs of an instrument by their names, set as a job perturbs it.

    Parameters
    ----------
    nodes : Mapping[str, NodeInfo]
        Path -> what may be done to it.
    job : JobSpec
        Whose ``perturb`` is where the knobs begin.
    """
    out = {}
    plain = job.plain().get("perturb", {})
    for node, info in nodes.items():
        for kind, what in KINDS.items():
            if what.key not in info.allows:
                continue
            given = _job_quantities(plain.get(node, {}), kind)
            unit = _unit(given.values(), what.unit)
            for axis in dict.fromkeys((*axes_of(kind), *given)):
                value = _number(given.get(axis), unit, 0.0)
                size = 1.0 if what.unit == unit else unit_ratio(what.unit, unit)
                extent = max(what.extent * size, 2.0 * abs(value))
                name = knob_name(node, kind, axis)
                out[name] = Knob(name, node, kind, axis, unit, value, extent, what.limit * size)
    return out


def _job_quantities(what: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """Axis -> quantity as the job's plain data have it."""
    value = what.get(KINDS[kind].key)
    if value is None:
        return {}
    if kind == "temperature":
        change = value.get("change") if isinstance(value, Mapping) else value
        return {} if change is None else {"": change}
    if kind == "gradient":
        value = value.get("gradient") if isinstance(value, Mapping) else None
        return {} if value is None else dict(zip(AXES, value, strict=True))
    if kind == "figure":
        return dict(value)
    return {"": value} if kind == "scale" else dict(zip(AXES, value, strict=True))


def _unit(quantities: Iterable[Any], usual: str) -> str:
    """The unit of quantities when all that are not zero have the same one, so that their numbers stay as written."""
    parts = [split_quantity(q) for q in quantities]
    units = {part[1] for part in parts if part is not None and part[0] != 0}
    return units.pop() if len(units) == 1 else usual


def perturbation(
    values: Mapping[str, float], pivots: Mapping[str, str], knobs: Mapping[str, Knob], first: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """What knobs come to: ``perturb`` of a job's file, for every body that any of them moves or that the job moves.

    Parameters
    ----------
    values : Mapping[str, float]
        Name of a knob -> its value; others stand at zero.
    pivots : Mapping[str, str]
        Body -> name of the point about which it turns and grows; others keep the job's.
    knobs : Mapping[str, Knob]
        All of the instrument's.
    first : Mapping[str, Any]
        ``perturb`` of the job in which the knobs begin, whose deformations by tables of nodes stay.

    Raises
    ------
    InputError
        No such knob, or a value beyond its limit.
    """
    out: dict[str, dict[str, Any]] = {node: _without_knobs(what) for node, what in first.items()}
    by_axis: dict[tuple[str, str], dict[str, float]] = {}
    for name, value in values.items():
        knob = knobs.get(name)
        if knob is None:
            raise InputError(unknown("no such knob", name, knobs).at())
        if not abs(value) <= knob.limit:
            raise InputError(
                Issue(
                    f"{name} is too large", found=f"{value:g} {knob.unit}", allowed=f"up to {knob.limit:g} {knob.unit}"
                )
            )
        if value != 0.0:
            by_axis.setdefault((knob.node, knob.kind), {})[knob.axis] = value
    for (node, kind), numbers in by_axis.items():
        unit = next(knobs[knob_name(node, kind, axis)].unit for axis in numbers)
        _set_quantities(out.setdefault(node, {}), kind, numbers, unit)
    for node, pivot in pivots.items():
        if node in out and pivot != DEFAULT_PIVOT and {"rotate", "scale"} & set(out[node]):
            out[node]["pivot"] = pivot
    return out


def _without_knobs(what: Mapping[str, Any]) -> dict[str, Any]:
    """What has no knob: tables of nodes and of temperatures, that a body has a temperature of its own, radii, conic
    constants and indices.
    """
    turned = {kind.key for kind in KINDS.values()}
    out = {key: value for key, value in what.items() if key not in (*turned, "pivot")}
    heat = what.get("temperature")
    if isinstance(heat, Mapping):
        out["temperature"] = {key: value for key, value in heat.items() if key not in ("change", "gradient")}
    return out


def _set_quantities(what: dict[str, Any], kind: str, numbers: Mapping[str, float], unit: str) -> None:
    def quantity(axis: str) -> str:
        return f"{numbers.get(axis, 0.0)!r} {unit}"

    if kind in ("rotate", "shift"):
        what[kind] = [quantity(axis) for axis in AXES]
    elif kind == "figure":
        what[kind] = {axis: quantity(axis) for axis in numbers}
    elif kind == "scale":
        what[kind] = quantity("")
    elif kind == "temperature":
        what.setdefault("temperature", {})["change"] = quantity("")
    else:
        what.setdefault("temperature", {})["gradient"] = [quantity(axis) for axis in AXES]


@dataclass(frozen=True)
class FactorKnob:
    """A study's factor that is a number.

    Attributes
    ----------
    name : str
        As the study calls it.
    unit : str
        Of the numbers; empty for pure numbers.
    low, high : float
        The study's smallest and largest value.
    value : float
        Where it begins: in the study's base, for a ratio 1, or in the run that was opened.
    whole : bool
        Whether it counts.
    knobs : Mapping[str, float]
        Knob of a body -> how many of its units one of the factor's is; empty for what changes the instrument itself,
        which is then built anew.
    """

    name: str
    unit: str
    low: float
    high: float
    value: float
    whole: bool
    knobs: Mapping[str, float]

    def scalar(self, value: float) -> Any:
        """A value as a study's file writes it."""
        number = int(value) if self.whole and value == int(value) else value
        return with_unit(number, self.unit) if self.unit else number

    def starting_at(self, scalar: Any) -> FactorKnob:
        """Begin the factor at a value of a run, which a distribution may have drawn from beyond the range."""
        value = _number(scalar, self.unit, self.value)
        return replace(self, value=value, low=min(self.low, value), high=max(self.high, value))


def factor_knobs(setup: StudySetup) -> tuple[FactorKnob, ...]:
    """Knobs of those of a study's factors that are numbers."""
    turned = (_factor(name, factor, setup) for name, factor in setup.study.factors.items())
    return tuple(factor for factor in turned if factor is not None)


def base_with_factors(setup: StudySetup, scalars: Mapping[str, Any]) -> Tree:
    """The study's base where factors have these values, and all that follows them does.

    Parameters
    ----------
    setup : StudySetup
        The study.
    scalars : Mapping[str, Any]
        Factor -> value as a study's file writes it; the others leave the base as it is.

    Raises
    ------
    InputError
        a value that cannot be.
    """
    factors = {name: _fixed(setup.study.factors[name], scalar) for name, scalar in scalars.items()}
    one = setup.study.model_copy(update={"factors": factors, "design": DesignSpec(kind="grid")})
    return with_values(setup.base, Plan.of(replace(setup, study=one)).run(0).values)


def _fixed(factor: FactorSpec, scalar: Any) -> FactorSpec:
    """The factor with this value alone."""
    kept = {"key": factor.key, "keys": factor.keys, "scales": factor.scales}
    return FactorSpec.model_validate({**{k: v for k, v in kept.items() if v}, "values": (scalar,)})


def _factor(name: str, factor: FactorSpec, setup: StudySetup) -> FactorKnob | None:
    """The knob of a factor; None where it is no number."""
    numbers = factor.numbers()
    if not numbers.numeric or not len(numbers):
        return None
    unit = numbers.unit or ""
    values = list(numbers.values)
    if factor.kind in ("normal", "truncated"):
        mean, sigma = values[:2]
        values = [mean - 4.0 * sigma, mean + 4.0 * sigma] if factor.kind == "normal" else values[2:]
    base = 1.0
    if factor.places:
        try:
            base = number_at(setup.base, factor.places[0], unit)
        except Problem as problem:
            raise setup.error(problem, ("factors", name, *factor.key_of(0))) from None
    knobs = {} if factor.scales else _knobs(factor.places, unit)
    return FactorKnob(name, unit, min(*values, base), max(*values, base), base, numbers.whole, knobs)


def _number(value: Any, unit: str, otherwise: float) -> float:
    """A quantity in a unit."""
    if isinstance(value, int | float):
        return float(value)
    part = split_quantity(value)
    if part is None:
        return otherwise
    number, own = part
    # dividing keeps decimal fractions where a product would not
    return float(number) if own == unit else float(number) / unit_ratio(unit, own)


def _knobs(places: tuple[KeyPath, ...], unit: str) -> dict[str, float]:
    """Knobs that stand for the places of a factor; none where any is something else."""
    out = {}
    for place in places:
        found = _knob(place)
        if found is None:
            return {}
        name, own = found
        out[name] = 1.0 if unit == own else unit_ratio(unit, own) if unit else 0.0
    return out


def _knob(place: KeyPath) -> tuple[str, str] | None:
    """Name and unit of the knob that a place in a resolved job is."""
    match place:
        case ("job", "perturb", str(node), ("rotate" | "shift") as kind, int(axis)):
            return knob_name(node, kind, AXES[axis]), KINDS[kind].unit
        case ("job", "perturb", str(node), "figure", str(term)):
            return knob_name(node, "figure", term), KINDS["figure"].unit
        case ("job", "perturb", str(node), "scale"):
            return knob_name(node, "scale", ""), KINDS["scale"].unit
        case ("job", "perturb", str(node), "temperature", "change"):
            return knob_name(node, "temperature", ""), KINDS["temperature"].unit
        case ("job", "perturb", str(node), "temperature", "gradient", int(axis)):
            return knob_name(node, "gradient", AXES[axis]), KINDS["gradient"].unit
    return None
