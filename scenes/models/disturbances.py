"""Prior of the disturbances of an instrument: components, correlations, time laws, and random states drawn from them.

A component is one motion or temperature of one body, such as ``M2 shift z``; a time law is the covariance of its
changes over time. Each time law is sampled exactly at arbitrary times, without intermediate steps, so that times may be
far apart: a drift is an Ornstein-Uhlenbeck process, a periodic motion the real part of a rotating random phasor.

``joint_disturbances`` goes the other way: it writes a covariance of components, such as that of an estimate of an
instrument's state, as a file of disturbances.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from optics.geometry.tree import ORIGIN, Motion, State, compose_each
from optics.numerics.array_math import covariance_root
from optics.thermal.heat import Temperature, Temperatures
from scenes.models.instrument_model import Instrument
from scenes.models.thermal_model import TemperatureError, ThermalModel
from scenes.specs import disturbances
from scenes.specs.course import noll
from scenes.specs.perturbation import NodeInfo, find_node
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, names_text, nearest, shown, unknown
from scenes.yaml.spec import validate
from scenes.yaml.units import ANGLE, parse_quantity
from scenes.yaml.yaml_file import YamlFile

AXES = "xyz"
INDEFINITE = -1e-9
"""Eigenvalue below which a correlation matrix is indefinite; values between it and 0 are rounding errors."""
UNITS: Mapping[str, tuple[str, float]] = {
    "shift": ("um", 1e-6),
    "rotate": ("arcsec", parse_quantity("1 arcsec", ANGLE)),
    "figure": ("nm", 1e-9),
    **dict.fromkeys(("scale", "radius", "conic", "index"), ("ppm", 1e-6)),
    "abbe": ("percent", 1e-2),
    "index_gradient": ("ppm/m", 1e-6),
    "temperature": ("K", 1.0),
    "gradient": ("mK/m", 1e-3),
}
"""Kind of component -> the unit in which its amounts are printed, and the size of that unit in SI."""
HEAT = ("temperature", "gradient")
"""Kinds of components that are temperatures; the thermal model computes their effect on the bodies."""
SINGLE = ("scale", "radius", "conic", "index", "temperature")
"""Kinds of components without an axis, of which a body has only one, such as its scale."""
_NEEDS = {"gradient": "temperature"}
"""Kind of component -> action that a node must allow for it, for kinds whose name differs from that of the action."""

_Where = Callable[[str, KeyPath, Problem], Issue]
"""Function that makes the issue (file, line and message) of a problem at a key of a cause, from these three."""


@dataclass(frozen=True)
class Component:
    """Component of the motion or of the temperature of one body.

    Attributes
    ----------
    cause : str
        Name of its cause.
    body : str
        Path of the body.
    kind : str
        Kind of the component, one of the keys of ``UNITS``.
    axis : int
        Axis 0, 1 or 2 of the body's own frame; Noll index of a figure term; 0 for kinds of a single component.
    pivot : str
        Pivot of rotations and of changes of scale.
    sigma : float
        Standard deviation, SI.
    """

    cause: str
    body: str
    kind: str
    axis: int
    pivot: str
    sigma: float

    @property
    def name(self) -> str:
        """Name of the component in a disturbances file, such as ``base/forward/M2 shift z``."""
        return f"{self.body} {self.what}"

    @property
    def what(self) -> str:
        """Kind and axis of the component without the body's path, such as ``shift z``."""
        if self.kind in SINGLE:
            return self.kind
        return f"{self.kind} {f'Z{self.axis}' if self.kind == 'figure' else AXES[self.axis]}"

    @property
    def unit(self) -> str:
        """Unit in which amounts of the component are printed, such as ``um``."""
        return UNITS[self.kind][0]

    @property
    def unit_size(self) -> float:
        """Size in SI of the unit in which amounts of the component are printed."""
        return UNITS[self.kind][1]


@dataclass(frozen=True, eq=False)
class DisturbancePrior:
    """Prior of the M disturbance components of an instrument: a multivariate normal distribution of mean zero.

    Attributes
    ----------
    name : str
        Name of the disturbances file.
    components : tuple[Component, ...]
        The M components, cause by cause, body by body.
    correlation : (M, M) ndarray
        Correlation matrix, positive semidefinite; zero between causes.
    laws : tuple[TimeLawSpec, ...]
        Time law of each component.
    jump_false_alarm : float or None
        Probability that a jump is reported in a series without one; None for the level of all other tests.
    """

    name: str
    components: tuple[Component, ...]
    correlation: np.ndarray
    laws: tuple[disturbances.TimeLawSpec, ...]
    jump_false_alarm: float | None = None

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations of the M components, (M,), SI."""
        return np.array([c.sigma for c in self.components])

    @property
    def covariance(self) -> np.ndarray:
        """Covariance matrix of the M components, (M, M), SI."""
        sigma = self.sigma
        return np.asarray(sigma[:, None] * self.correlation * sigma)

    def of_causes(self, names: Sequence[str]) -> DisturbancePrior:
        """Return the prior that contains only the components of these causes."""
        selected = [k for k, c in enumerate(self.components) if c.cause in names]
        return DisturbancePrior(
            self.name,
            tuple(self.components[k] for k in selected),
            self.correlation[np.ix_(selected, selected)],
            tuple(self.laws[k] for k in selected),
            self.jump_false_alarm,
        )

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw random amounts of the M components, SI.

        Parameters
        ----------
        rng : np.random.Generator
            Generator of the random numbers.
        count : int
            Number of states.

        Returns
        -------
        (count, M) ndarray
            Amounts in each state; numbers are drawn state by state, and component by component in each.
        """
        unit = rng.standard_normal((count, len(self.components)))
        return np.asarray(unit @ covariance_root(self.correlation) * self.sigma)


def disturbance_prior(resolved: ResolvedJob, instrument: Instrument) -> DisturbancePrior | None:
    """Return the disturbance prior of a job's instrument, or None if the job has none.

    Raises
    ------
    InputError
        The prior names a body that the instrument does not have or a motion that a body does not allow, or its
        correlations are not positive semidefinite. There is one issue for each fault.
    """
    spec = resolved.disturbances
    if spec is None:
        return None
    return prior_of_spec(spec, instrument, lambda *problem: _issue_at(resolved, *problem))


def prior_of_spec(
    spec: disturbances.DisturbancesSpec, instrument: Instrument, issue: _Where | None = None
) -> DisturbancePrior:
    """Return the prior that a disturbances file gives for an instrument.

    Parameters
    ----------
    spec : DisturbancesSpec
        Content of the file.
    instrument : Instrument
        Instrument whose bodies move.
    issue : callable or None
        Function that returns the error report for a fault, given the cause's name, the key in it and the text of the
        fault; by default the report points into the disturbances file.

    Raises
    ------
    InputError
        The prior names a body that the instrument does not have or a motion that a body does not allow, or its
        correlations are not positive semidefinite. There is one issue for each fault.
    """
    spec = spec.with_tables()
    issue_at = issue or (lambda cause, key, wrong: spec.issue(wrong, ("causes", cause, *key)))
    glass = {solid.path for solid in instrument.solids if solid.transparent}
    components: list[Component] = []
    laws: list[disturbances.TimeLawSpec] = []
    blocks: list[np.ndarray] = []
    issues, nodes = _unmatched_patterns(spec, instrument, issue_at), instrument.nodes
    for name, cause in spec.causes.items():
        bodies = [path for pattern in cause.bodies for path in nodes if _matches(pattern, path, instrument.cameras)]
        members, faults = _of_cause(spec, name, cause, list(dict.fromkeys(bodies)), instrument, glass, issue_at)
        matrix, correlation_faults = _correlation(name, cause, members, issue_at)
        # Where a component itself was refused, issues of its correlations would only repeat that.
        issues += faults or (correlation_faults if bodies else [])
        # Correlations may name components of zero sigma, so that a single number can be set to zero.
        moving = [k for k, c in enumerate(members) if c.sigma > 0.0]
        components += [members[k] for k in moving]
        laws += [cause.time] * len(moving)
        blocks.append(matrix[np.ix_(moving, moving)])
    if spec.joint is not None:
        members, matrix, faults = _of_joint(spec, spec.joint, instrument, glass)
        components += members
        laws += [spec.joint.time] * len(members)
        blocks.append(matrix)
        issues += faults
    if issues:
        raise InputError(*issues)
    return DisturbancePrior(spec.name, tuple(components), block_diag(*blocks), tuple(laws), spec.jump_false_alarm)


def check_heat(resolved: ResolvedJob, prior: DisturbancePrior, thermal: ThermalModel) -> None:
    """Check that the effect of the prior's temperature changes can be computed: dn/dT of heated glasses must be known.

    Parameters
    ----------
    resolved : ResolvedJob
        The job.
    prior : DisturbancePrior
        Its prior.
    thermal : ThermalModel
        Thermal model of its instrument.

    Raises
    ------
    InputError
        The data of a material do not cover the temperatures.
    """
    cause_of = {c.body: c.cause for c in prior.components if c.kind in HEAT}
    heated = {
        body: Temperature(sum(c.sigma for c in prior.components if (c.body, c.kind) == (body, "temperature")))
        for body in cause_of
    }
    try:
        thermal.check(heated)
    except TemperatureError as error:
        problem = Problem(str(error), allowed=error.allowed)
        raise InputError(_issue_at(resolved, cause_of[error.origin], ("temperature",), problem)) from error


def state_of(
    amounts: np.ndarray, components: Sequence[Component], thermal: ThermalModel, motions: State | None = None
) -> State:
    """Return the state of the instrument in which M components have given amounts.

    Parameters
    ----------
    amounts : (M,) ndarray
        Amounts of the components, SI.
    components : sequence of Component
        The M components.
    thermal : ThermalModel
        Thermal model of the instrument.
    motions : State or None
        Further motions, which act on top of those of the same bodies.
    """
    return states_of(np.asarray(amounts)[None], components, thermal, motions)[0]


def states_of(
    amounts: np.ndarray, components: Sequence[Component], thermal: ThermalModel, motions: State | None = None
) -> list[State]:
    """Return the S states of the instrument in which M components have given amounts.

    In a batch of many, a state takes a third of the time that it takes alone.

    Parameters
    ----------
    amounts : (S, M) ndarray
        Amounts of the components in each state, SI.
    components : sequence of Component
        The M components.
    thermal : ThermalModel
        Thermal model of the instrument.
    motions : State or None
        Further motions, which act in every state on top of those of the same bodies.
    """
    heat: dict[str, Temperatures] = {}
    moves: list[list[State]] = [[] for _ in amounts]
    bodies = {body.path: body for body in thermal.instrument.assembly.tree.bodies}
    for (_, body, pivot), group in _groups(components):
        values = {(components[k].kind, components[k].axis): amounts[:, k] for k in group}
        field = _field(values)
        if field is not None:
            heat[body] = heat[body] + field if body in heat else field
        for s, motion in enumerate(_motions(values, pivot)):
            moves[s].append({body: motion})
    if heat:
        moves = [[state] for state in thermal.states(heat, compose_each(moves, bodies))]
    return compose_each([[*moved, motions or {}] for moved in moves], bodies)


def _groups(components: Sequence[Component]) -> Iterator[tuple[tuple[str, str, str], list[int]]]:
    """Yield (cause, body, pivot) with the indices of the components that share these three."""
    groups: dict[tuple[str, str, str], list[int]] = {}
    for k, c in enumerate(components):
        groups.setdefault((c.cause, c.body, c.pivot), []).append(k)
    yield from groups.items()


_Values = Mapping[tuple[str, int], np.ndarray]
"""Kind and axis of components of one body -> their amounts in S states, (S,)."""


def _three(values: _Values, kind: str) -> np.ndarray:
    """Return the amounts of one kind of component along a body's three axes in S states, (S, 3), SI."""
    out = np.zeros((len(next(iter(values.values()))), 3))
    for axis in range(3):
        if (kind, axis) in values:
            out[:, axis] = values[kind, axis]
    return out


def _field(values: _Values) -> Temperatures | None:
    """Return the temperature fields of a body in S states, or None if no component heats it."""
    if not any(kind in HEAT for kind, _ in values):
        return None
    gradient = _three(values, "gradient")
    return Temperatures(values.get(("temperature", 0), np.zeros(len(gradient))), gradient)


def _motions(values: _Values, pivot: str) -> list[Motion]:
    """Return the motions of a body in S states; an empty list if only heat moves it."""
    if all(kind in HEAT for kind, _ in values):
        return []
    vectors = (map(tuple, _three(values, kind).tolist()) for kind in ("rotate", "shift", "index_gradient"))
    numbers = {
        kind: values_of_kind.tolist()
        for (kind, _), values_of_kind in values.items()
        if kind in ("scale", "index", "radius", "conic")
    }
    figures = {axis: values_of_kind.tolist() for (kind, axis), values_of_kind in values.items() if kind == "figure"}
    return [
        Motion(
            rotate,
            shift,
            pivot,
            index_gradient=slope,
            figure={axis: values_of_kind[s] for axis, values_of_kind in figures.items()},
            **{kind: values_of_kind[s] for kind, values_of_kind in numbers.items()},
        )
        for s, (rotate, shift, slope) in enumerate(zip(*vectors, strict=True))
    ]


CAMERA = "<camera>"
"""Placeholder in a pattern for the name of any camera of the instrument."""


def _matches(pattern: str, path: str, cameras: Iterable[str]) -> bool:
    """Return True if a body's path matches a pattern.

    Parameters
    ----------
    pattern : str
        Path in which ``*`` and ``?`` are wildcards that do not match ``/``, and ``CAMERA`` stands for any camera.
    path : str
        Path of the body.
    cameras : iterable of str
        Names of the instrument's cameras.
    """
    any_of = {"*": "[^/]*", "?": "[^/]", CAMERA: f"(?:{'|'.join(map(re.escape, cameras))})"}
    parts = re.split(f"({CAMERA}|[*?])", pattern)
    return re.fullmatch("".join(any_of.get(part, re.escape(part)) for part in parts), path) is not None


def _issue_at(resolved: ResolvedJob, cause: str, key: KeyPath, wrong: Problem) -> Issue:
    """Return an issue at the line of the job or of the disturbances file that caused it.

    That is a line of the job where it changes the file or names the bodies to which the file's motions are applied,
    else a line of the disturbances file.
    """
    changes = resolved.job.disturbances
    changed_cause = changes.causes.get(cause) if changes is not None else None
    at: KeyPath = ("disturbances", "causes", cause)
    if changed_cause is not None and (not key or key[0] in changed_cause.set_keys):
        return resolved.job.issue(wrong, (*at, *key))
    if changed_cause is not None and "bodies" in changed_cause.set_keys:
        text = f"{key[0]} of {cause}: {wrong.problem}"
        return resolved.job.issue(Problem(text, wrong.value, wrong.allowed, wrong.suggestion), (*at, "bodies"))
    assert resolved.disturbances is not None
    return resolved.disturbances.issue(wrong, ("causes", cause, *key))


def _unmatched_patterns(spec: disturbances.DisturbancesSpec, instrument: Instrument, where: _Where) -> list[Issue]:
    """Return an issue for each pattern that matches no body of the instrument, at the first cause that has it."""
    first: dict[str, tuple[str, int]] = {}
    causes: dict[str, list[str]] = {}
    for name, cause in spec.causes.items():
        for k, pattern in enumerate(cause.bodies):
            if not any(_matches(pattern, path, instrument.cameras) for path in instrument.nodes):
                first.setdefault(pattern, (name, k))
                causes.setdefault(pattern, []).append(name)
    out = []
    for pattern, (name, k) in first.items():
        also = f", nor for {names_text(causes[pattern][1:])}" if causes[pattern][1:] else ""
        text = f"{instrument.spec.name} has no body of this name{also}"
        meant, allowed = _nearest(pattern, instrument.nodes), names_text(sorted(instrument.nodes))
        out.append(where(name, ("bodies", k), Problem(text, shown(pattern), allowed, meant)))
    return out


def _nearest(pattern: str, nodes: Iterable[str]) -> str | None:
    """Return the known pattern or path most similar to a pattern that matches no body."""
    parts = pattern.split("/")
    alike = [path.split("/") for path in nodes if path.count("/") == pattern.count("/")]
    starred = ["/".join("*" if p == "*" else q for p, q in zip(parts, path, strict=True)) for path in alike]
    return nearest(pattern, dict.fromkeys(starred)) or nearest(pattern, nodes)


def _of_cause(
    spec: disturbances.DisturbancesSpec,
    name: str,
    cause: disturbances.CauseSpec,
    bodies: Sequence[str],
    instrument: Instrument,
    glass: set[str],
    where: _Where,
) -> tuple[list[Component], list[Issue]]:
    """Return the components that a cause gives to its bodies, and an issue for each faulty key.

    Components with a standard deviation of zero are included.
    """
    components: list[Component] = []
    rotated: list[str] = []
    refused: dict[KeyPath, list[str]] = {}
    for path in bodies:
        info = instrument.nodes[path]
        pivot = cause.pivot or default_pivot(info)
        if pivot not in (ORIGIN, *info.pivots):
            rotated.append(path)
        can = _possible(info, path in glass)
        for key, kind, axis, sigma in _sigmas(cause):
            if _NEEDS.get(kind, kind) in can:
                components.append(Component(name, path, kind, axis, pivot, sigma / spec.sigmas))
            elif path not in refused.setdefault(key[:1], []):
                refused[key[:1]].append(path)
    issues = []
    if rotated:
        known = tuple(dict.fromkeys((ORIGIN, *instrument.nodes[rotated[0]].pivots)))
        issues.append(where(name, ("pivot",), unknown(f"{_paths_text(rotated)} has no such pivot", cause.pivot, known)))
    for key, paths in refused.items():
        allowed = names_text(sorted(_possible(instrument.nodes[paths[0]], paths[0] in glass))) or "nothing"
        issues.append(where(name, key, Problem(f"{_paths_text(paths)} does not allow {key[0]}", allowed=allowed)))
    return components, issues


def default_pivot(info: NodeInfo) -> str:
    """Return the pivot of a body where a file of disturbances names none: its centre if it has one, else its origin."""
    return "centre" if "centre" in info.pivots else ORIGIN


def _of_joint(
    spec: disturbances.DisturbancesSpec, joint: disturbances.JointSpec, instrument: Instrument, glass: set[str]
) -> tuple[list[Component], np.ndarray, list[Issue]]:
    """Return the components of the key `joint` that move, their correlations, and the issues of faulty ones."""
    components: list[Component] = []
    issues: list[Issue] = []
    named: dict[tuple[str, str, int], str] = {}
    for name, sigma in joint.components.items():
        node, kind, what, about = disturbances.component_parts(name)
        axis = noll(what) if kind == "figure" else max(AXES.find(what), 0) if what else 0
        try:
            path = find_node(node, instrument.nodes)
            info = instrument.nodes[path]
            allowed = _possible(info, path in glass)
            if _NEEDS.get(kind, kind) not in allowed:
                raise Problem(f"{path} does not allow {kind}", allowed=names_text(sorted(allowed)) or "nothing")
            if about and about not in info.known_pivots:
                raise unknown(f"{path} has no such pivot", about, info.known_pivots)
            if (path, kind, axis) in named:
                same = f"once; it is the same as {named[path, kind, axis]}"
                raise Problem("a component is named twice", shown(name), same)
        except Problem as wrong:
            issues.append(spec.issue(wrong, (disturbances.JOINT, "components", name)))
            continue
        named[path, kind, axis] = name
        pivot = about or default_pivot(info)
        components.append(Component(disturbances.JOINT, path, kind, axis, pivot, sigma / spec.sigmas))
    matrix = np.eye(len(joint.components)) if joint.correlation is None else np.array(joint.correlation)
    if (least := _least(matrix)) < INDEFINITE:
        text = f"the correlation matrix is not positive definite: it has an eigenvalue of {least:.3g}"
        problem = Problem(text, allowed="correlations of real quantities")
        issues.append(spec.issue(problem, (disturbances.JOINT, "correlation")))
    if issues:
        return [], np.zeros((0, 0)), issues
    moving = [k for k, c in enumerate(components) if c.sigma > 0.0]
    return [components[k] for k in moving], matrix[np.ix_(moving, moving)], []


def _paths_text(paths: Sequence[str]) -> str:
    """Return a text that names the first path and the number of the others."""
    return paths[0] if len(paths) == 1 else f"{paths[0]}, like {len(paths) - 1} more,"


def _possible(info: NodeInfo, transparent: bool) -> set[str]:
    """Return the kinds of components (shift, figure, temperature ...) that a body allows."""
    return {*info.allows, *(("index_gradient",) if transparent else ())}


def _sigmas(cause: disturbances.CauseSpec) -> Iterator[tuple[KeyPath, str, int, float]]:
    """Yield key, kind, axis and standard deviation of every number of a cause."""
    for kind in ("shift", "rotate", "index_gradient"):
        for axis, value in enumerate(getattr(cause, kind) or ()):
            yield (kind,), kind, axis, value
    for kind in ("scale", "radius", "conic"):
        if (value := getattr(cause, kind)) is not None:
            yield (kind,), kind, 0, value
    for term, value in (cause.figure or {}).items():
        yield ("figure", term), "figure", noll(term), value
    if cause.temperature is not None:
        yield ("temperature", "change"), "temperature", 0, cause.temperature.change
        for axis, value in enumerate(cause.temperature.gradient):
            yield ("temperature", "gradient"), "gradient", axis, value


def _correlation(
    name: str, cause: disturbances.CauseSpec, components: Sequence[Component], where: _Where
) -> tuple[np.ndarray, list[Issue]]:
    """Return the correlation matrix of a cause's components and the issues found in it.

    ``correlations`` take precedence over ``together`` for a pair of components that both name.
    """
    matrix, issues = np.eye(len(components)), []
    if cause.together is not None:
        for i, component in enumerate(components):
            for j in range(i):
                if (components[j].kind, components[j].axis) == (component.kind, component.axis):
                    matrix[i, j] = matrix[j, i] = cause.together
        if _least(matrix) < INDEFINITE:
            count = len({c.body for c in components})
            allowed = f"at least {-1.0 / (count - 1):.4g} between {count} bodies"
            text = "bodies cannot all be so strongly anticorrelated"
            return matrix, [where(name, ("together",), Problem(text, shown(cause.together), allowed))]
    known = {c.name: k for k, c in enumerate(components)}
    values_of: dict[tuple[int, int], float] = {}
    for n, group in enumerate(cause.correlations):
        key: KeyPath = ("correlations", n)
        unknown_components = [k for k, text in enumerate(group.between) if text not in known]
        for k in unknown_components:
            problem = unknown(f"no component of {name}", group.between[k], sorted(known))
            issues.append(where(name, (*key, "between", k), problem))
        if unknown_components:
            continue
        at = [known[text] for text in group.between]
        for i, j in combinations(range(len(at)), 2):
            value = group.table[i][j]
            before = values_of.setdefault((min(at[i], at[j]), max(at[i], at[j])), value)
            if before != value:
                text = f"the correlation of {group.between[i]} and {group.between[j]} is already {before:g}"
                issues.append(where(name, key, Problem(text, shown(value), "one of them")))
        matrix[np.ix_(at, at)] = np.array(group.table)
    least = _least(matrix)
    if not issues and least < INDEFINITE:
        text = (
            "the correlation matrix, with these entries and those before them, is not positive definite: it has an "
            f"eigenvalue of {least:.3g}"
        )
        problem = Problem(text, allowed="smaller correlations, as between real quantities")
        issues.append(where(name, ("correlations", _first_impossible(cause, known)), problem))
    return matrix, issues


def _first_impossible(cause: disturbances.CauseSpec, known: Mapping[str, int]) -> int:
    """Return the index of the first entry of ``correlations`` with which the correlation matrix becomes indefinite."""
    matrix, last = np.eye(len(known)), len(cause.correlations) - 1
    for n, group in enumerate(cause.correlations[:last]):
        at = [known[text] for text in group.between]
        matrix[np.ix_(at, at)] = np.array(group.table)
        if _least(matrix) < INDEFINITE:
            return n
    return last


def _least(matrix: np.ndarray) -> float:
    """Return the smallest eigenvalue of a symmetric matrix; 0 for an empty one."""
    return float(np.linalg.eigvalsh(matrix)[0]) if len(matrix) else 0.0


Array = NDArray[np.float64]


def drawn_motions(prior: DisturbancePrior, seconds: Array, source: Callable[[int], np.random.Generator]) -> Array:
    """Draw random amounts of all M components at T times, without jumps.

    Parameters
    ----------
    prior : DisturbancePrior
        Prior of the components with their time laws.
    seconds : (T,) ndarray
        Increasing times in seconds, from the zero of the time laws.
    source : callable
        Function from the number of a cause to its random generator, so that the random numbers of one cause do not
        depend on the other causes.

    Returns
    -------
    (T, M) ndarray
        Amounts in SI.
    """
    out = np.zeros((len(seconds), len(prior.components)))
    for number, where in enumerate(causes_of(prior).values()):
        course = drawn_course(prior.laws[where[0]], seconds, source(number), len(where))
        out[:, where] = course @ covariance_root(prior.correlation[np.ix_(where, where)]) * prior.sigma[where]
    return out


def drawn_course(law: disturbances.TimeLawSpec, seconds: Array, rng: np.random.Generator, count: int) -> Array:
    """Draw independent random time series of unit standard deviation with the covariance of a time law.

    Parameters
    ----------
    law : TimeLawSpec
        Time law of all series. A jump has no effect here: its times are drawn per body.
    seconds : (T,) ndarray
        Increasing times, in seconds.
    rng : np.random.Generator
        Generator of the random numbers.
    count : int
        Number of series.

    Returns
    -------
    (T, count) ndarray
        Values at the T times.
    """
    each = (len(seconds), count)
    if law.kind == "white":
        return rng.standard_normal(each)
    if law.kind == "jump" or law.jump is not None:
        return np.zeros(each)
    if law.period is None:
        out = _drifting(law.drift, seconds, rng, count)
    else:
        # Real part of a random phasor that rotates once per period, and decorrelates if it drifts.
        phase = (2.0 * math.pi / law.period * seconds)[:, None]
        along = _drifting(law.drift, seconds, rng, count)
        out = along * np.cos(phase) + _drifting(law.drift, seconds, rng, count) * np.sin(phase)
    since = seconds - (law.since or 0.0)
    if law.trend is not None:
        out = out * (since / law.trend)[:, None]
    if law.relaxation is not None:
        out = out * -np.expm1(-np.maximum(since, 0.0) / law.relaxation)[:, None]
    if law.event is not None:
        out = out * (seconds >= law.event)[:, None]
    return np.asarray(out)


def _drifting(drift: float | None, seconds: Array, rng: np.random.Generator, count: int) -> Array:
    """Draw Ornstein-Uhlenbeck processes of unit variance at T times.

    Parameters
    ----------
    drift : float or None
        Correlation time, in seconds; None for values that are constant in time.
    seconds : (T,) ndarray
        Increasing times, in seconds.
    rng : np.random.Generator
        Generator of the random numbers.
    count : int
        Number of processes.

    Returns
    -------
    (T, count) ndarray
        Values at the T times.
    """
    unit = rng.standard_normal((len(seconds), count))
    if drift is None:
        return np.broadcast_to(unit[:1], unit.shape)
    decay = np.exp(-np.diff(seconds) / drift)
    innovation = np.sqrt(-np.expm1(-2.0 * np.diff(seconds) / drift))
    for k, (part, new) in enumerate(zip(decay, innovation, strict=True)):
        unit[k + 1] = part * unit[k] + new * unit[k + 1]
    return unit


def causes_of(prior: DisturbancePrior) -> dict[str, list[int]]:
    """Return name of each cause -> indices of its components in the prior."""
    out: dict[str, list[int]] = {}
    for k, component in enumerate(prior.components):
        out.setdefault(component.cause, []).append(k)
    return out


ABOUT = ("shift", "rotate", "scale")
"""Kinds of components whose written name may contain a pivot: ``NODE shift z about PIVOT``."""
DIGITS = 12
"""Decimals of written correlations: enough that eigenvalues stay above ``INDEFINITE``."""
FEW = 12
"""Number of components up to which a file holds their correlation matrix itself."""


def joint_disturbances(
    name: str,
    components: Sequence[Component],
    covariance: np.ndarray,
    nodes: Mapping[str, NodeInfo],
    reason: str,
    description: str = "",
) -> disturbances.DisturbancesSpec:
    """Return a disturbances specification, with `joint`, of components with a given covariance.

    ``prior_of_spec`` makes of it the components that move, in this order and with these standard deviations, and
    states drawn from it have this covariance.

    Parameters
    ----------
    name : str
        Name of the file.
    components : sequence of Component
        M components of different bodies, kinds or axes; their own standard deviations are ignored.
    covariance : (M, M) ndarray
        Covariance matrix, SI. Components of zero variance are omitted.
    nodes : Mapping[str, NodeInfo]
        Nodes of the instrument.
    reason : str
        Origin of the numbers, written into the file.
    description : str
        Description written into the file.

    Raises
    ------
    ValueError
        The matrix is not a covariance of these components.
    InputError
        A component is named twice, or moves by more than a file can express.
    """
    covariance = np.asarray(covariance, dtype=np.float64)
    if covariance.shape != (len(components),) * 2 or not np.all(np.isfinite(covariance)):
        raise ValueError(f"a covariance of {len(components)} components cannot have the shape {covariance.shape}")
    if np.min(np.diagonal(covariance), initial=0.0) < 0.0:
        raise ValueError("a variance is negative")
    sigma = np.sqrt(np.diagonal(covariance))
    moving = np.flatnonzero(sigma > 0.0).tolist()
    correlation = covariance[np.ix_(moving, moving)] / np.outer(sigma[moving], sigma[moving])
    if np.max(np.abs(correlation - correlation.T), initial=0.0) > -INDEFINITE:
        raise ValueError("the covariance is not symmetric")
    correlation = np.clip(0.5 * (correlation + correlation.T), -1.0, 1.0)
    correlation = np.asarray(np.round(correlation, DIGITS), dtype=np.float64)
    np.fill_diagonal(correlation, 1.0)
    if len(moving) and np.linalg.eigvalsh(correlation)[0] < INDEFINITE:
        raise ValueError("the covariance has a negative eigenvalue")
    names = [_name(components[k], nodes) for k in moving]
    sigmas = {key: disturbances.written_sigma(key, float(sigma[k])) for key, k in zip(names, moving, strict=True)}
    joint = {"components": sigmas, "correlation": correlation.tolist(), "time": {"kind": "constant"}, "reason": reason}
    plain = {"name": name, "description": description, "joint": joint}
    if len(set(names)) < len(names):
        raise ValueError("a component is named twice")
    return validate(disturbances.DisturbancesSpec, YamlFile(name, plain, {}))


def joint_files(spec: disturbances.DisturbancesSpec, stem: str, remark: str = "") -> dict[str, str]:
    """Return the files of a specification with `joint`: a YAML, and a CSV of the correlations if there are many.

    Parameters
    ----------
    spec : DisturbancesSpec
        The specification.
    stem : str
        Stem of the files' names.
    remark : str
        Comment lines at the top of the YAML.

    Returns
    -------
    dict[str, str]
        File name -> text.
    """
    joint = spec.joint
    if joint is None or joint.correlation is None or len(joint.components) <= FEW:
        return {f"{stem}.yaml": spec.file_text(remark)}
    table = io.StringIO()
    rows = csv.writer(table, lineterminator="\n")
    rows.writerow(joint.components)
    rows.writerows([[repr(value) for value in row] for row in joint.correlation])
    short = joint.model_copy(update={"correlation": None, "correlation_file": f"{stem}.csv"})
    return {f"{stem}.yaml": spec.model_copy(update={"joint": short}).file_text(remark), f"{stem}.csv": table.getvalue()}


def _name(component: Component, nodes: Mapping[str, NodeInfo]) -> str:
    """Return the name of a component, with its pivot where that is not the default."""
    if component.kind in ABOUT and component.pivot != default_pivot(nodes[component.body]):
        return f"{component.name} about {component.pivot}"
    return component.name
