"""Varied parameters of a tolerance budget, each a motion of bodies per unit, and the states that result from them.

Several parameters may move one body. Their rotation vectors and shifts are added, each rotation about its own point, so
that the order in a file does not matter.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optics.geometry.aperture import Circle
from optics.geometry.pose import Pose, rotation_matrix, triple
from optics.geometry.tree import Body, Motion, State
from optics.geometry.zernike import noll_to_nm, zernike
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.assembly import Element
from optics.thermal.heat import Temperature
from scenes.models.instrument_model import Instrument
from scenes.models.thermal_model import TemperatureError, ThermalModel
from scenes.specs.course import noll
from scenes.specs.perturbation import AXES, PlainPerturbationSpec, find_node, perturbation_issues
from scenes.specs.tolerance import CompensatorSpec, ToleranceSpec, Varied
from scenes.yaml.errors import InputError, KeyPath, Problem, shown
from scenes.yaml.spec import Spec

HEAT = ("temperature", "gradient")
"""Kinds of motions that are thermal: a body's temperature, or a gradient in it."""
SHAPE = ("scale", "expansion", "radius", "conic", "index", "abbe")
"""Kinds of motions that change a body's shape or material, and are neither rigid nor a figure error."""


@dataclass(frozen=True, eq=False)
class BodyMove:
    """Motion of one body per SI unit of a varied parameter, in the body's frame.

    Attributes
    ----------
    rotate : (3,) ndarray
        Rotation vector, rad.
    shift : (3,) ndarray
        Shift, metres.
    pivot : (3,) ndarray
        Point that the rotation leaves in place, metres.
    figure : FrozenMap
        Noll index -> rms of the sag, metres.
    shape : FrozenMap
        Kind of shape change in ``SHAPE`` -> change, SI units.
    """

    rotate: np.ndarray = field(default_factory=lambda: np.zeros(3))
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3))
    pivot: np.ndarray = field(default_factory=lambda: np.zeros(3))
    figure: FrozenMap[int, float] = field(default_factory=FrozenMap)
    shape: FrozenMap[str, float] = field(default_factory=FrozenMap)


@dataclass(frozen=True, eq=False)
class VariedParameter:
    """Varied parameter of a tolerance budget: a motion, temperature or shape change of bodies, per unit.

    Attributes
    ----------
    name : str
        Name of the entry in the file, with the Zernike term if it is one of a whole figure error.
    entry : str
        Name of the entry.
    kind : str
        Kind of the motion.
    size : float
        Amount of one unit, in SI units: the limit of a tolerance, 1 for a compensator, the standard deviation for a
        term of a figure error.
    moves : FrozenMap
        Path of a body -> its motion.
    """

    name: str
    entry: str
    kind: str
    size: float
    moves: FrozenMap[str, BodyMove]


@dataclass(frozen=True, eq=False)
class ParameterMaker:
    """Builder of varied parameters (motions per unit) from the entries of a budget's file."""

    test: Spec
    instrument: Instrument
    thermal: ThermalModel

    def tolerance(self, name: str, spec: ToleranceSpec) -> list[VariedParameter]:
        """Return the varied parameters of a tolerance: one, or one for each term of a figure error."""
        key: KeyPath = ("tolerances", name)
        kind = spec.parts[1]
        if not spec.spectrum:
            return [VariedParameter(name, name, kind, spec.limit_si, self._moves(spec, key, spec.limit_si))]
        body = self._node(spec, spec.parts[0], key)
        sizes = spec.limit_si * spectrum_over(self.instrument.assembly.face(body), spec.spectrum, spec.power)
        return [
            VariedParameter(
                f"{name} Z{j}", name, kind, float(size), FrozenMap({body: BodyMove(figure=FrozenMap({j: 1.0}))})
            )
            for j, size in zip(spec.spectrum, sizes, strict=True)
        ]

    def compensator(self, name: str, spec: CompensatorSpec, section: str = "compensators") -> VariedParameter:
        """Return the varied parameter of a compensator or actuator, in SI units."""
        moves = self._moves(spec, (section, name), spec.range_si or 1.0)
        return VariedParameter(name, name, spec.parts[1], 1.0, moves)

    def _node(self, spec: Varied, name: str, key: KeyPath) -> str:
        """Return the path of a body named in the budget if it allows the motion; else raise InputError."""
        try:
            body = find_node(name, self.instrument.nodes)
        except Problem as problem:
            raise self.test.error(problem, (*key, "motion" if name == spec.parts[0] else "carrying")) from None
        _, kind, axis, _, pivot = spec.parts
        does: dict[str, Any] = {} if kind in HEAT else {kind: 1.0}
        if kind in ("shift", "rotate"):
            does = {kind: tuple(float(k == AXES[axis]) for k in range(3))}
        elif kind == "figure":
            does = {kind: FrozenMap({axis: 1.0})}
        if pivot:
            does["pivot"] = pivot
        perturbation = PlainPerturbationSpec.model_construct(**does)
        issues = perturbation_issues(self.test, self.instrument.nodes, body, perturbation, key)
        if issues:
            raise InputError(*issues)
        if kind in HEAT and "temperature" not in self.instrument.nodes[body].allows:
            raise self.test.error("this node does not allow temperature", (*key, "motion"), value=spec.motion)
        return body

    def _moves(self, spec: Varied, key: KeyPath, limit: float) -> FrozenMap[str, BodyMove]:
        name, kind, axis, _, pivot = spec.parts
        body = self._node(spec, name, key)
        if kind in HEAT:
            return self._heat(body, kind, axis, key, limit)
        if kind == "figure":
            return FrozenMap({body: BodyMove(figure=FrozenMap({noll(axis): 1.0}))})
        if kind not in ("shift", "rotate"):
            about = np.array(self._body(body).pivots[pivot or "origin"])
            shift = -about if kind == "scale" else np.zeros(3)
            return FrozenMap({body: BodyMove(shift=shift, shape=FrozenMap({kind: 1.0}))})
        bodies = [body, *(self._node(spec, other, key) for other in spec.carrying)]
        for other in bodies:
            above = next((path for path in bodies if other.startswith(f"{path}/")), None)
            if above is not None or bodies.count(other) > 1:
                problem = f"{other} is carried already" if above is None else f"{other} moves with {above} already"
                raise self.test.error(problem, (*key, "carrying"), value=shown(list(spec.carrying)))
        first = self.instrument.assembly.nominal_pose(body)
        direction = first.rotation[:, AXES[axis]]
        point = first.apply(np.array(self._body(body).pivots[pivot or "origin"]))
        return FrozenMap(
            {path: _rigid(self.instrument.assembly.nominal_pose(path), kind, direction, point) for path in bodies}
        )

    def _body(self, path: str) -> Body:
        return self.instrument.assembly.tree[path]

    def _heat(self, body: str, kind: str, axis: str, key: KeyPath, limit: float) -> FrozenMap[str, BodyMove]:
        """Return the motion of each body per kelvin or K/m of a temperature change.

        It is the mean slope between zero and ``limit``.
        """
        try:
            return heat_moves(self.thermal, self.instrument, body, kind, AXES.get(axis, 0), limit)
        except TemperatureError as error:
            raise self.test.error(str(error), (*key, "limit"), allowed=error.allowed) from error


def heat_moves(
    thermal: ThermalModel,
    instrument: Instrument,
    body: str,
    kind: str,
    axis: int,
    amount: float,
    others: Mapping[str, Temperature] = FrozenMap(),
) -> FrozenMap[str, BodyMove]:
    """Return the motion and shape change of each body due to a change of temperature, per kelvin or K/m.

    It is the effect of ``amount`` divided by ``amount``.

    Parameters
    ----------
    thermal : ThermalModel
        Thermal model of the instrument.
    instrument : Instrument
        Instrument with the bodies.
    body : str
        Path of the body that is warmed, with all that it carries.
    kind : str
        ``temperature`` or ``gradient``.
    axis : int
        Axis of a gradient, 0 to 2.
    amount : float
        Change of temperature, K, or gradient, K/m.
    others : dict
        Temperatures of other bodies at the same time.

    Raises
    ------
    TemperatureError
        Expansion or index is not known at that temperature.
    """
    heat = Temperature(amount) if kind == "temperature" else Temperature(0.0, triple(amount * np.eye(3)[axis]))
    fields = {**others, body: heat}
    thermal.check(fields)
    return FrozenMap(
        {
            path: _per_unit(instrument.assembly.tree[path], motion, amount)
            for path, motion in thermal.state(fields).items()
        }
    )


def _per_unit(body: Body, motion: Motion, amount: float) -> BodyMove:
    about = np.array(body.pivots[motion.pivot])
    scale = (1.0 + motion.scale) * (1.0 + motion.expansion) - 1.0
    rotation = rotation_matrix(np.array(motion.rotate))
    shift = about + np.array(motion.shift) - (1.0 + scale) * rotation @ about
    return BodyMove(
        rotate=np.array(motion.rotate) / amount,
        shift=shift / amount,
        figure=FrozenMap({j: a / amount for j, a in motion.figure.items()}),
        shape=FrozenMap({name: getattr(motion, name) / amount for name in SHAPE if getattr(motion, name)}),
    )


def _rigid(pose: Pose, kind: str, direction: np.ndarray, point: np.ndarray) -> BodyMove:
    """Return a rotation about, or shift along, a world direction (3,) as a motion in a body's own frame.

    A rotation is about the world point ``point`` (3,).
    """
    axis = pose.rotation.T @ direction
    if kind == "shift":
        return BodyMove(shift=axis)
    return BodyMove(rotate=axis, pivot=pose.inverse().apply(point))


def spectrum_shares(terms: Sequence[int], power: float) -> np.ndarray:
    """Return the standard deviation of each of T polynomial terms of a figure error whose rms is 1, (T,).

    The variance of a term with radial order n is proportional to (n + 1)^-power.

    Parameters
    ----------
    terms : sequence of int
        Noll indices.
    power : float
        Exponent of the variance's decrease with radial order.
    """
    order = np.array([noll_to_nm(j)[0] for j in terms])
    variance = (order + 1.0) ** -power
    return np.asarray(np.sqrt(variance / np.sum(variance)))


def spectrum_over(element: Element, terms: Sequence[int], power: float) -> np.ndarray:
    """Return the standard deviation of each of T terms of a figure error whose rms over a clear aperture is 1, (T,).

    The mean square is that of an ensemble of surfaces, about each surface's mean over its clear aperture. Terms have
    unit rms over the smallest circle around that aperture, and another rms over a rectangle or a ring in it.

    Parameters
    ----------
    element : Element
        The surface.
    terms : sequence of int
        Noll indices.
    power : float
        Exponent of the decrease of a term's variance with its radial order n, (n + 1)^-power.
    """
    shares, disk, outer = spectrum_shares(terms, power), element.figure_disk, element.outer_edge
    assert outer is not None
    if outer == Circle(disk.radius, disk.centre) and not any(edge.blocks for edge in element.edges):
        return shares
    x0, x1, y0, y1 = outer.bounds
    cells = (np.arange(_CELLS) + 0.5) / _CELLS
    x, y = (part.ravel() for part in np.meshgrid(x0 + (x1 - x0) * cells, y0 + (y1 - y0) * cells))
    clear = element.clear(x, y)
    u, v = (x[clear] - disk.centre[0]) / disk.radius, (y[clear] - disk.centre[1]) / disk.radius
    return np.asarray(shares / np.sqrt(np.sum(shares**2 * [np.var(zernike(j, u, v)) for j in terms])))


_CELLS = 200
"""Number of cells along each side of the box around a clear aperture, over which the rms of terms is summed.

The rms is accurate to 1e-3.
"""


def states_of(numbers: Sequence[VariedParameter], amounts: np.ndarray) -> list[State]:
    """Return the states that result from amounts of the varied parameters.

    Parameters
    ----------
    numbers : sequence of VariedParameter
        K parameters.
    amounts : (S, K) ndarray
        Amounts, SI units.

    Returns
    -------
    list of State
        S states; bodies that no parameter moves are omitted.
    """
    count = len(amounts)
    bodies = tuple(dict.fromkeys(path for number in numbers for path in number.moves))
    motions_by_body: dict[str, list[Motion]] = {}
    for path in bodies:
        rotate, offset = np.zeros((count, 3)), np.zeros((count, 3))
        rotations: dict[tuple[float, float, float], np.ndarray] = {}
        figure: dict[int, np.ndarray] = {}
        shape: dict[str, np.ndarray] = {}
        for k, number in enumerate(numbers):
            move = number.moves.get(path)
            if move is None:
                continue
            amount = amounts[:, k]
            offset += np.outer(amount, move.shift)
            if np.any(move.rotate):
                rotation = np.outer(amount, move.rotate)
                rotate += rotation
                about = triple(move.pivot)
                rotations[about] = rotations.get(about, 0.0) + rotation
            for j, per in move.figure.items():
                figure[j] = figure.get(j, 0.0) + per * amount
            for name, per in move.shape.items():
                shape[name] = shape.get(name, 0.0) + per * amount
        for about, rotation in rotations.items():
            point = np.array(about)
            if np.any(point):
                offset += point - np.einsum("sij,j->si", rotation_matrix(rotation), point)
        motions_by_body[path] = _motions(count, rotate, offset, figure, shape)
    return [FrozenMap({path: motions[s] for path, motions in motions_by_body.items()}) for s in range(count)]


def _motions(
    count: int, rotate: np.ndarray, shift: np.ndarray, figure: dict[int, np.ndarray], shape: dict[str, np.ndarray]
) -> list[Motion]:
    """Return the motions of one body in S states, from arrays with one entry per state.

    The arrays hold rotations, shifts, figure terms and changes of shape.
    """
    rotations, shifts = rotate.tolist(), shift.tolist()
    figures = {j: values.tolist() for j, values in figure.items()}
    shapes = {name: values.tolist() for name, values in shape.items()}
    return [
        Motion(
            rotate=tuple(rotations[s]),
            shift=tuple(shifts[s]),
            figure={j: values[s] for j, values in figures.items()},
            **{name: values[s] for name, values in shapes.items()},
        )
        for s in range(count)
    ]
