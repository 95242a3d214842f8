"""Knobs of the live twin: adjustable motions of bodies, factors of a study, and the resulting perturbations.

A knob has the name of its motion in scripts and in the tables of a job's time series (``course``): ``base/forward/M2
shift z``. Its value is a number in the knob's unit; it has exactly the effect of a job's file that contains this number
with this unit, to the last bit.
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
"""Zernike terms (Noll) of a surface figure that have knobs, from defocus (Z4) to Z15.

Piston and tilts are rigid motions.
"""


@dataclass(frozen=True)
class _KnobKind:
    """Common properties of all knobs of one kind.

    Attributes
    ----------
    key : str
        Key of the perturbation in a job's file.
    unit : str
        Unit of the values.
    extent : float
        Initial half range of the slider.
    limit : float
        Largest absolute value that may be typed.
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
"""Kind of knob (rotate, shift, ...) -> its properties. The limits are those that a job's file may have."""


@dataclass(frozen=True)
class Knob:
    """Adjustable number of the page: the amount of one motion of a body, or a number of a camera's design.

    Attributes
    ----------
    name : str
        Name, such as ``base/forward/M2 shift z`` or ``design/M2 radius``.
    node : str
        Path of the body, or of the part of the design, in the page's tree.
    kind : str
        Key in ``KINDS``; ``design`` or ``field`` for the knobs of `CameraDesign`.
    axis : str
        Axis, term or number of a surface, such as ``x``, ``Z5`` or ``radius``; empty if there is only one.
    unit : str
        Unit of the values.
    value : float
        Initial value.
    extent : float
        Initial half range of the slider.
    limit : float
        Largest absolute value that may be typed.
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
    """Return the axes or terms of the knobs of a kind."""
    if kind in ("rotate", "shift", "gradient"):
        return AXES
    return FIGURE_TERMS if kind == "figure" else ("",)


def knob_name(node: str, kind: str, axis: str) -> str:
    """Return the name of a knob, such as ``base/forward/M2 shift z`` or ``base/forward temperature``."""
    return f"{node} {kind} {axis}" if axis else f"{node} {kind}"


def knobs_of(nodes: Mapping[str, NodeInfo], job: JobSpec) -> dict[str, Knob]:
    """Return name -> knob for all adjustable motions of an instrument, with the values of a job.

    Parameters
    ----------
    nodes : Mapping[str, NodeInfo]
        Path of a body -> its possible perturbations.
    job : JobSpec
        Job whose ``perturb`` gives the initial values.
    """
    out = {}
    plain = job.plain().get("perturb", {})
    for node, info in nodes.items():
        for kind, knob_kind in KINDS.items():
            if knob_kind.key not in info.allows:
                continue
            quantities = _job_quantities(plain.get(node, {}), kind)
            unit = _unit(quantities.values(), knob_kind.unit)
            for axis in dict.fromkeys((*axes_of(kind), *quantities)):
                value = _number(quantities.get(axis), unit, 0.0)
                size = 1.0 if knob_kind.unit == unit else unit_ratio(knob_kind.unit, unit)
                extent = max(knob_kind.extent * size, 2.0 * abs(value))
                name = knob_name(node, kind, axis)
                out[name] = Knob(name, node, kind, axis, unit, value, extent, knob_kind.limit * size)
    return out


def _job_quantities(what: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """Return axis -> quantity (text with unit) of one kind in a body's perturbation, as written in the job's file."""
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
    """Return the unit that all non-zero quantities have in common, or else the usual unit.

    With the common unit, numbers stay as they were written.
    """
    parts = [split_quantity(q) for q in quantities]
    units = {part[1] for part in parts if part is not None and part[0] != 0}
    return units.pop() if len(units) == 1 else usual


def perturbation(
    values: Mapping[str, float], pivots: Mapping[str, str], knobs: Mapping[str, Knob], first: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Return the section ``perturb`` of a job's file for values of knobs.

    It contains every body that a knob or the job moves.

    Parameters
    ----------
    values : Mapping[str, float]
        Name of a knob -> its value; the others are zero.
    pivots : Mapping[str, str]
        Body -> name of its pivot; the others keep the job's.
    knobs : Mapping[str, Knob]
        All knobs of the instrument.
    first : Mapping[str, Any]
        Section ``perturb`` of the initial job, whose deformations by tables of nodes are kept.

    Raises
    ------
    InputError
        A knob does not exist, or a value exceeds its limit.
    """
    out: dict[str, dict[str, Any]] = {node: _without_knobs(what) for node, what in first.items()}
    by_axis: dict[tuple[str, str], dict[str, float]] = {}
    for name, value in values.items():
        knob = checked_knob(name, value, knobs)
        if value != 0.0:
            by_axis.setdefault((knob.node, knob.kind), {})[knob.axis] = value
    for (node, kind), numbers in by_axis.items():
        unit = next(knobs[knob_name(node, kind, axis)].unit for axis in numbers)
        _set_quantities(out.setdefault(node, {}), kind, numbers, unit)
    for node, pivot in pivots.items():
        if node in out and pivot != DEFAULT_PIVOT and {"rotate", "scale"} & set(out[node]):
            out[node]["pivot"] = pivot
    return out


def checked_knob(name: str, value: float, knobs: Mapping[str, Knob]) -> Knob:
    """Return the knob of a name.

    Raises
    ------
    InputError
        The knob does not exist, or the value exceeds its limit.
    """
    knob = knobs.get(name)
    if knob is None:
        raise InputError(unknown("no such knob", name, knobs).at())
    if not abs(value) <= knob.limit:
        amount, allowed = f"{value:g} {knob.unit}".strip(), f"up to {knob.limit:g} {knob.unit}".strip()
        raise InputError(Issue(f"{name} is too large", value=amount, allowed=allowed))
    return knob


def _without_knobs(what: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parts of a perturbation that have no knob.

    They are tables of nodes and of temperatures, a body's own temperature, radii, conic constants and indices.
    """
    kinds = {kind.key for kind in KINDS.values()}
    out = {key: value for key, value in what.items() if key not in (*kinds, "pivot")}
    heat = what.get("temperature")
    if isinstance(heat, Mapping):
        out["temperature"] = {key: value for key, value in heat.items() if key not in ("change", "gradient")}
    return out


def _set_quantities(what: dict[str, Any], kind: str, numbers: Mapping[str, float], unit: str) -> None:
    """Write the quantities of one kind into a body's perturbation, from axis -> number and a unit."""

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
    """Numeric factor of a study that is adjustable on the page.

    Attributes
    ----------
    name : str
        Name of the factor in the study.
    unit : str
        Unit of the numbers; empty for pure numbers.
    low, high : float
        Smallest and largest value of the study.
    value : float
        Initial value: of the study's base (1 for a ratio), or of the opened run.
    whole : bool
        Whether the values are whole numbers.
    knobs : Mapping[str, float]
        Knob of a body -> number of its units in one unit of the factor; empty for a factor that changes the instrument
        itself, which is then built again.
    """

    name: str
    unit: str
    low: float
    high: float
    value: float
    whole: bool
    knobs: Mapping[str, float]

    def scalar(self, value: float) -> Any:
        """Return a value of the factor in the notation of a study's file."""
        number = int(value) if self.whole and value == int(value) else value
        return with_unit(number, self.unit) if self.unit else number

    def starting_at(self, scalar: Any) -> FactorKnob:
        """Return the factor with the value of a run as its initial value.

        A random value may lie outside the range of the slider, which is then extended.
        """
        value = _number(scalar, self.unit, self.value)
        return replace(self, value=value, low=min(self.low, value), high=max(self.high, value))


def factor_knobs(setup: StudySetup) -> tuple[FactorKnob, ...]:
    """Return the knobs of the numeric factors of a study."""
    factors = (_factor(name, factor, setup) for name, factor in setup.study.factors.items())
    return tuple(factor for factor in factors if factor is not None)


def base_with_factors(setup: StudySetup, scalars: Mapping[str, Any]) -> Tree:
    """Return the study's base job with given values of factors, including the values that scale with them.

    Parameters
    ----------
    setup : StudySetup
        Study with its base job, factors and responses.
    scalars : Mapping[str, Any]
        Factor -> value in the notation of a study's file; the others leave the base unchanged.

    Raises
    ------
    InputError
        A value is not possible.
    """
    factors = {name: _fixed(setup.study.factors[name], scalar) for name, scalar in scalars.items()}
    grid = setup.study.model_copy(update={"factors": factors, "design": DesignSpec(kind="grid")})
    return with_values(setup.base, Plan.of(replace(setup, study=grid)).run(0).values)


def _fixed(factor: FactorSpec, scalar: Any) -> FactorSpec:
    """Return a factor of a study with a single value instead of its distribution."""
    keys = {"key": factor.key, "keys": factor.keys, "scales": factor.scales}
    return FactorSpec.model_validate({**{k: v for k, v in keys.items() if v}, "values": (scalar,)})


def _factor(name: str, factor: FactorSpec, setup: StudySetup) -> FactorKnob | None:
    """Return the knob for a factor of a study; None if the factor is not numeric."""
    numbers = factor.numbers()
    if not numbers.numeric or not numbers.values:
        return None
    unit = numbers.unit or ""
    values = list(numbers.values)
    if factor.kind in ("normal", "truncated"):
        mean, sigma = values[:2]
        values = [mean - 4.0 * sigma, mean + 4.0 * sigma] if factor.kind == "normal" else values[2:]
    base = 1.0
    if factor.key_paths:
        try:
            base = number_at(setup.base, factor.key_paths[0], unit)
        except Problem as problem:
            raise setup.error(problem, ("factors", name, *factor.key_of(0))) from None
    knobs = {} if factor.scales else _knobs(factor.key_paths, unit)
    return FactorKnob(name, unit, min(*values, base), max(*values, base), base, numbers.whole, knobs)


def _number(value: Any, unit: str, otherwise: float) -> float:
    """Return a quantity as a number in a unit; ``otherwise`` if it is not such a quantity."""
    if isinstance(value, int | float):
        return float(value)
    part = split_quantity(value)
    if part is None:
        return otherwise
    number, own_unit = part
    # division keeps decimal fractions that a product would not
    return float(number) if own_unit == unit else float(number) / unit_ratio(unit, own_unit)


def _knobs(keys: tuple[KeyPath, ...], unit: str) -> dict[str, float]:
    """Return knob -> number of its units per unit of a factor, for the factor's keys; empty if any is no knob."""
    out = {}
    for key in keys:
        knob = _knob(key)
        if knob is None:
            return {}
        name, knob_unit = knob
        out[name] = 1.0 if unit == knob_unit else unit_ratio(unit, knob_unit) if unit else 0.0
    return out


def _knob(place: KeyPath) -> tuple[str, str] | None:
    """Return name and unit of the knob that corresponds to a key of a resolved job."""
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
