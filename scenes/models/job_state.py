"""Perturbed state of a job, including tables at nodes, and the part of it that exceeds the disturbance prior.

Jobs may name tables at nodes: displacements of mirrors and faces from a finite-element program, and temperatures of
bodies. A table of temperatures is split. Its linear part, the best fit over the body's volume, acts like every linear
temperature (``ThermalModel``): the body expands, bends and changes its index, and what it carries follows. The residual
deforms the body's own finite elements, whose optical faces move and bend. It cannot be followed on bodies without
finite elements, nor for the index of glass; a table with a residual there that matters is refused.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optics.geometry.pose import Pose
from optics.geometry.tree import Motion, State, compose
from optics.numerics.number_tree import FrozenMap
from optics.thermal.heat import Temperature
from optics.thermal.nodal_deformation import (
    PRINTED,
    SEEN,
    TERMS,
    Coverage,
    NodalDeformation,
    NodalTemperature,
    NodesError,
    linear_part,
    nodal_deformation,
)
from optics.thermal.thermo_elastic import Displacement, FaceChange
from scenes.models.disturbances import UNITS, DisturbancePrior
from scenes.models.instrument_model import Instrument
from scenes.models.thermal_model import Held, TemperatureError, ThermalModel
from scenes.specs.course import NO_MOTION
from scenes.specs.job import JobSpec, PerturbationSpec
from scenes.specs.job_tables import DeformationSpec, TableTemperatureSpec
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.errors import KeyPath, unknown
from scenes.yaml.node_table import read_nodes, read_temperatures

COARSE_CELLS, FINE_CELLS = 12, 16
"""Numbers of finite elements across a mirror in the two computations of its deformation by nonlinear temperatures.

The difference of their results estimates the discretisation error.
"""
PER_SIDE = (4, 6)
"""Finite elements along the longest side of a prism, coarse and fine."""
LINEAR_TO = 1e-4
"""Largest departure from a linear temperature field, in kelvin, allowed at nodes of a body without finite elements. It
expands a metre of aluminium by 2 nm.
"""
ROUNDING = 1e-9
"""Departure from a linear temperature field, in kelvin, below which it counts as zero."""
LEAST_INSIDE = 0.5
"""Smallest fraction of the body's volume that the nodes must cover; with less they belong to another body, frame or
unit.
"""
SHOWN_OUTSIDE = 1e-3
"""Fraction of a body's volume outside the region that a table's nodes cover, above which a warning is given."""
SEEN_HEAT = 1e-3
"""Interpolation error between nodes, in kelvin rms, below which no warning is given."""
MESHED_TO = 0.1
"""Relative difference of a face's change with coarser finite elements above which a warning is given."""
INDEX_WAVES = 0.01
"""Largest optical path through the glass, in waves, that the index change of the nonlinear residual may cause."""


@dataclass(frozen=True, eq=False)
class HeatedFace:
    """Change of an optical face due to the nonlinear part of a table of temperatures.

    Attributes
    ----------
    motion : Motion
        Motion of the face's body: rigid, Zernike terms and, for a mirror, a grid with the residual sag.
    lost : float
        Part of the change that the motion does not represent, in metres rms of sag.
    unmeshed : float
        Difference from the result of coarser finite elements, in metres rms of sag.
    """

    motion: Motion
    lost: float
    mesh_error: float

    @property
    def figure_rms(self) -> float:
        """Rms of the figure's Zernike terms from Z4 on, in metres, over the disk on which they are defined."""
        return float(np.sqrt(sum(a * a for j, a in self.motion.figure.items() if j > 3)))


@dataclass(frozen=True, eq=False)
class HeatedBody:
    """Temperature table of a body, split into a linear field and the effects of the residual.

    Attributes
    ----------
    nodes : int
        Number of nodes.
    spacing : float
        Spacing of the nodes, in metres.
    linear : Temperature
        Best linear fit, in the body's frame.
    residual : tuple[float, float]
        Residual of that fit over the body's volume: rms and largest absolute value, in kelvin.
    between : float
        Leave-one-out error of the interpolation at the nodes, in kelvin rms.
    coverage : Coverage or None
        Coverage of the body by the nodes; None for a body without finite elements.
    faces : Mapping[str, HeatedFace]
        Body of each optical face -> its change due to the residual temperatures.
    index_path : float
        Largest optical path that the index change of the residual may cause, in metres; 0 for bodies that are not
        glass.
    """

    nodes: int
    spacing: float
    linear: Temperature
    residual: tuple[float, float]
    between: float
    coverage: Coverage | None
    faces: Mapping[str, HeatedFace]
    index_path: float

    def state(self, gridded: State | None = None) -> State:
        """Return the motions of the body's faces that the residual temperatures cause.

        They are in addition to those that the linear field causes.

        Parameters
        ----------
        gridded : State or None
            Motions of the same bodies to whose grids these grids are resampled, so that they can be added.
        """
        out = {}
        for path, face in self.faces.items():
            other = gridded[path].grid if gridded is not None and path in gridded else None
            grid = face.motion.grid
            out[path] = (
                face.motion if grid is None or other is None else replace(face.motion, grid=grid.sampled_as(other))
            )
        return out

    def warnings(self, path: str) -> tuple[str, ...]:
        """Return warnings about the temperature table of the body ``path``: coverage, interpolation and mesh."""
        out = []
        if self.coverage is not None and self.coverage.outside > SHOWN_OUTSIDE:
            out.append(
                f"{path}: {100.0 * self.coverage.outside:.2g} % of its volume lie outside of the table's nodes, up to "
                f"{1e3 * self.coverage.farthest:.3g} mm from the nearest node, whose departure from the linear part "
                "is used there; provide nodes throughout the body"
            )
        if self.between > max(SEEN_HEAT, PRINTED * self.residual[0]):
            out.append(
                f"{path}: the table is too coarse for its field: the leave-one-out error at its nodes is "
                f"{self.between:.3g} K rms, and the nonlinear part {self.residual[0]:.3g} K rms "
                f"({1e3 * self.spacing:.3g} mm between nodes); refine the mesh, or expect wrong effects on the images"
            )
        for face, change in self.faces.items():
            size = change.figure_rms
            if change.mesh_error > max(SEEN, MESHED_TO * size):
                out.append(
                    f"{face}: the finite elements follow the table to {1e9 * change.mesh_error:.3g} nm "
                    f"rms only, of {1e9 * size:.3g} nm; provide displacements of a structural program (deformation)"
                )
            if change.lost > max(SEEN, PRINTED * size):
                out.append(
                    f"{face}: {1e9 * change.lost:.3g} nm rms of its change by the table are beyond "
                    f"Z{TERMS} and omitted; provide displacements (deformation)"
                )
        if self.index_path > SEEN:
            out.append(
                f"{path}: the index of its glass follows the linear part of the table only; the residual causes up to "
                f"{1e9 * self.index_path:.2g} nm of optical path and is omitted"
            )
        return tuple(out)


def heated_body(thermal: ThermalModel, job: JobSpec, path: str, spec: TableTemperatureSpec) -> HeatedBody:
    """Return the effect of a job's temperature table on one body.

    Parameters
    ----------
    thermal : ThermalModel
        Thermal model of the instrument.
    job : JobSpec
        The job that names the table, for error messages.
    path : str
        Path of the body.
    spec : TableTemperatureSpec
        The table, as ``scenes.specs.job.with_tables`` returns it.

    Raises
    ------
    InputError
        The frame does not exist; the nodes do not cover the body or are too cold; or the residual from a linear field
        is larger than this body can follow.
    """
    key = ("perturb", path, "temperature")
    assert spec.table is not None
    table = read_temperatures(spec.table, spec.unit, spec.field, spec.values, spec.sha256)
    points = pose_of_frame(thermal.instrument, job, key, path, spec.frame).apply(table.points)
    values = table.values - (thermal.reference if table.absolute else 0.0)
    try:
        coldest = int(np.argmin(values))
        if not thermal.reference + values[coldest] > 0.0:
            text = f"a node would be at {thermal.reference + values[coldest]:.4g} K"
            raise NodesError(text, "absolute temperatures under 'T [K]' or 'T [degC]', changes under 'dT [K]'")
        known = thermal.known(path)
        if not known.contains(thermal.reference + float(values[coldest]), thermal.reference + float(np.max(values))):
            low, high = (thermal.reference + float(value) for value in (values[coldest], np.max(values)))
            raise NodesError(
                f"its nodes are at {low:.6g} K to {high:.6g} K, where {thermal.materials[path].name} is not known",
                f"{known.text} ({known.source}), or another material in the instrument",
            )
        return _heated(thermal, path, NodalTemperature(points, values))
    except NodesError as error:
        text = f"{spec.table} does not describe the temperature of {path}: {error}"
        raise job.error(text, (*key, "table"), allowed=error.allowed) from error


def _heated(thermal: ThermalModel, path: str, nodes: NodalTemperature) -> HeatedBody:
    """Split a table of temperatures of a body into linear field and residual, and solve for the residual's effects.

    Raises NodesError if the nodes do not describe the body.
    """
    if nodes.flat:
        allowed = "nodes throughout the body: a plane of nodes does not determine the gradient across it"
        raise NodesError("the nodes lie in a plane or on a line", allowed)
    coarse, fine = _elastic(thermal, path)
    if coarse is None or fine is None:
        if nodes.departure() > LINEAR_TO:
            kind = "consists of several pieces" if path in thermal.solids else "has no finite elements"
            raise NodesError(
                f"the body {kind} and can follow a linear field only, from which the nodes depart by up to "
                f"{nodes.departure():.3g} K",
                f"the nearest linear field, {_in_words(nodes.linear)}, and displacements of the structural program",
            )
        residual = float(np.sqrt(np.mean(nodes.departures**2))), nodes.departure()
        return HeatedBody(len(nodes.points), nodes.spacing, nodes.linear, residual, nodes.between, None, {}, 0.0)
    elastic, _ = fine
    coverage = nodes.coverage(elastic.points, elastic.volumes)
    if coverage.outside > 1.0 - LEAST_INSIDE:
        low, high = (1e3 * side for side in (elastic.nodes.min(axis=0), elastic.nodes.max(axis=0)))
        body = ", ".join(f"{a:.4g} .. {b:.4g}" for a, b in zip(low, high, strict=True))
        theirs = zip(1e3 * nodes.points.min(axis=0), 1e3 * nodes.points.max(axis=0), strict=True)
        raise NodesError(
            f"{100.0 * coverage.outside:.0f} % of its volume lie outside of the nodes, whose x, y, z are "
            + ", ".join(f"{a:.4g} .. {b:.4g}" for a, b in theirs)
            + " mm",
            f"nodes throughout the body, in {body} mm of its frame: check frame and unit",
        )
    linear, rest = linear_part(elastic.points, nodes.at(elastic.points), elastic.volumes)
    largest = float(np.max(np.abs(rest)))
    residual = float(np.sqrt(np.average(rest**2, weights=elastic.volumes))), largest
    index_path = thermal.index_path(path, linear, largest)
    if index_path > INDEX_WAVES * thermal.instrument.spec.autocollimator.wavelength:
        raise NodesError(
            f"rays through its glass follow a linear index only; the residual of the table, up to {largest:.3g} K, "
            f"causes up to {1e9 * index_path:.3g} nm of optical path",
            f"the nearest linear field, {_in_words(linear)}, or a table that departs from it by less",
        )
    faces: dict[str, HeatedFace] = {}
    if largest > ROUNDING and thermal.materials[path].expansion != 0.0:

        def field(points: np.ndarray) -> np.ndarray:
            return nodes.at(points) - linear.change - points @ np.array(linear.gradient)

        solved = [body.solve_many([field], support)[0] for body, support in (coarse, fine)]
        coarser, finer = (thermal.changes(path, moved, TERMS) for moved in solved)
        sizes = thermal.face_radii(path)
        for face, change in finer.items():
            motion, lost = Motion(change.rotate, change.shift, figure=FrozenMap(change.figure)), change.residual_rms
            if path in thermal.mirrors:
                nodal = _at_nodes(thermal, path, solved[1])
                motion, lost = nodal.motion(), nodal.rms(nodal.lost)
            faces[face] = HeatedFace(motion, lost, _apart(change, coarser[face], sizes[face]))
    return HeatedBody(len(nodes.points), nodes.spacing, linear, residual, nodes.between, coverage, faces, index_path)


def _at_nodes(thermal: ThermalModel, path: str, moved: Displacement) -> NodalDeformation:
    """Return a mirror's displacement at the nodes of its face, decomposed like a table of another program."""
    ((aperture, _),) = thermal.faces_of(path).values()
    surface = thermal.surface(path)
    x, y, z = moved.nodes.T
    face = np.abs(z - surface.sag(x, y)) <= 1e-9 * float(np.max(np.ptp(moved.nodes, axis=0)))
    return nodal_deformation(moved.nodes[face], moved.values[face], surface, aperture, TERMS)


def _elastic(thermal: ThermalModel, path: str) -> tuple[Held | None, Held | None]:
    """Return coarse and fine finite elements of a body with their supports; None for a body without them."""
    if path in thermal.mirrors:
        return thermal.elastic(path, cells=COARSE_CELLS), thermal.elastic(path, cells=FINE_CELLS)
    if path not in thermal.solids:
        return None, None
    longest = float(np.max(np.ptp(thermal.extent(path), axis=0)))
    coarse, fine = (thermal.elastic(path, spacing=longest / count) for count in PER_SIDE)
    return coarse, fine


def _apart(change: FaceChange, other: FaceChange, radius: float) -> float:
    """Return the rms difference in sag of two changes of a face, in metres, over the disk of their Zernike terms."""
    piston = change.shift[2] - other.shift[2]
    # a tilt t of a disk of radius R is t R / 2 rms
    tilts = [0.5 * radius * (a - b) for a, b in zip(change.rotate[:2], other.rotate[:2], strict=True)]
    terms = [a - other.figure.get(j, 0.0) for j, a in change.figure.items()]
    return float(np.sqrt(np.sum(np.square([piston, *tilts, *terms]))))


def _in_words(field: Temperature) -> str:
    """Return a linear temperature field as text in the form of a job's file."""
    slope = ", ".join(f"{g:.6g} K/m" for g in field.gradient)
    return f"temperature: {{change: {field.change:.6g} K, gradient: [{slope}]}}"


def heated_bodies(
    job: JobSpec, thermal: ThermalModel, known: dict[Any, HeatedBody] | None = None
) -> dict[str, HeatedBody]:
    """Return path of each body that a job heats by a table -> the table's linear field and its further effects.

    Parameters
    ----------
    job : JobSpec
        The job.
    thermal : ThermalModel
        Thermal model of its instrument.
    known : dict, optional
        Tables of earlier calls, to which new ones are added, so that each is read once.

    Raises
    ------
    InputError
        A table does not describe its body.
    """
    out, known = {}, {} if known is None else known
    for path, what in job.perturb.items():
        if what.heat.table is not None:
            # change and gradient are added to the table, and are not part of it
            spec = what.heat.model_copy(update={"change": 0.0, "gradient": NO_MOTION})
            if (path, spec) not in known:
                known[path, spec] = heated_body(thermal, job, path, spec)
            out[path] = known[path, spec]
    return out


def with_heat(fields: Mapping[str, Temperature], heated: Mapping[str, HeatedBody]) -> dict[str, Temperature]:
    """Return path of each body -> its linear temperature field, the linear part of its table included."""
    return {**fields, **{path: fields.get(path, Temperature()) + body.linear for path, body in heated.items()}}


def deformed_face(instrument: Instrument, job: JobSpec, path: str, spec: DeformationSpec) -> NodalDeformation:
    """Return the deformation of one body by a job's table of nodes.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    job : JobSpec
        The job that names the table, for error messages.
    path : str
        Path of the body, which has a reflecting or refracting surface.
    spec : DeformationSpec
        The table, as ``scenes.specs.job.with_tables`` returns it.

    Raises
    ------
    InputError
        The frame does not exist; nodes are not on the surface or do not cover it.
    """
    key = ("perturb", path, "deformation")
    face = instrument.assembly.face(path)
    assert face.outer_edge is not None
    nodes = read_nodes(spec.table, spec.unit, spec.field, spec.sha256)
    pose = pose_of_frame(instrument, job, key, path, spec.frame)
    points, moves = pose.apply(nodes.points), nodes.moves @ pose.rotation.T
    try:
        return nodal_deformation(points, moves, face.surface, face.outer_edge, spec.terms)
    except NodesError as error:
        text = f"{spec.table} does not describe {path}: {error}"
        raise job.error(text, (*key, "table"), allowed=error.allowed) from error


def pose_of_frame(instrument: Instrument, job: JobSpec, key: KeyPath, path: str, frame: str | None) -> Pose:
    """Return the pose of the nominal frame of a table relative to that of the body.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    job : JobSpec
        The job that names the table, for error messages.
    key : KeyPath
        Key of the table's specification in the job.
    path : str
        Path of the body.
    frame : str or None
        Path of the body in whose frame the nodes are given, None for the body's own.

    Raises
    ------
    InputError
        The frame does not exist.
    """
    if frame is None:
        return Pose()
    known = instrument.assembly.tree.paths
    if frame not in known:
        raise job.error(unknown("no such node", frame, sorted(known)), (*key, "frame"))
    placed = instrument.assembly.place()
    return placed.pose(path).inverse() @ placed.pose(frame)


def job_state(
    job: JobSpec,
    thermal: ThermalModel,
    progress: Callable[[str], None] = lambda path: None,
    moved: State | None = None,
    heated: Mapping[str, HeatedBody] | None = None,
) -> State:
    """Return the perturbed state that a job describes.

    Parameters
    ----------
    job : JobSpec
        The job, its perturbation checked by ``scenes.specs.job.checked_nodes``.
    thermal : ThermalModel
        Thermal model of its instrument.
    progress : callable
        Function called with the path of each body whose thermo-elastic solution begins.
    moved : State or None
        The state without its linear temperatures if it is known; None to derive it from the job.
    heated : Mapping[str, HeatedBody] or None
        Its temperature tables as ``heated_bodies`` returns them, if they are known.

    Raises
    ------
    InputError
        A temperature is at or below 0 K, or outside the data of a glass's index; or a table of nodes does not describe
        its body.
    """
    if job.refocus:
        problem = "only twin.render, twin.study and twin.camera refocus a job's cameras"
        raise job.error(problem, ("refocus",), allowed="a job without this key")
    heated = heated_bodies(job, thermal) if heated is None else heated
    fields = with_heat(job.fields(), heated)
    if moved is None:
        deformed = deformations_of(job, thermal.instrument)
        moved = on_deformed(thermal.instrument, deformed, motions_of(job), heated)
    try:
        thermal.check(fields)
        return thermal.state(fields, moved, progress)
    except TemperatureError as error:
        raise job.error(str(error), ("perturb", error.origin, "temperature"), allowed=error.allowed) from error


def deformations_of(
    job: JobSpec, instrument: Instrument, known: dict[Any, NodalDeformation] | None = None
) -> dict[str, NodalDeformation]:
    """Return path of each body with a table of displaced nodes in the job -> its deformation.

    ``known`` has the deformations of earlier calls, to which new ones are added, so that each table is read once.

    Raises
    ------
    InputError
        A table does not describe its body.
    """
    out, known = {}, {} if known is None else known
    for path, what in job.perturb.items():
        if what.deformation is not None:
            if (path, what.deformation) not in known:
                known[path, what.deformation] = deformed_face(instrument, job, path, what.deformation)
            out[path] = known[path, what.deformation]
    return out


def on_deformed(
    instrument: Instrument,
    deformed: Mapping[str, NodalDeformation],
    moved: State,
    heated: Mapping[str, HeatedBody] | None = None,
) -> State:
    """Return the state that combines motions of bodies with the deformations that tables of nodes describe.

    The motions act on the deformed bodies. The deformations are those of tables of displaced nodes and of the residuals
    of tables of temperatures.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    deformed : Mapping[str, NodalDeformation]
        Path of each body with a table of displaced nodes -> its deformation.
    moved : State
        Motions of the bodies.
    heated : Mapping[str, HeatedBody] or None
        Path of each body with a table of temperatures -> its effects.
    """
    bodies = {body.path: body for body in instrument.assembly.tree.bodies}
    face_motions = {path: face.motion() for path, face in deformed.items()}
    for warm in (heated or {}).values():
        moved = compose(warm.state(face_motions), moved, bodies) if warm.faces else moved
    return compose(face_motions, moved, bodies) if face_motions else moved


def motions_of(job: JobSpec, time: int | None = None) -> State:
    """Return the rigid motions, scales and shapes of surfaces that a job lists; its temperatures act on top of them.

    Parameters
    ----------
    job : JobSpec
        The job with its perturbation.
    time : int or None
        Index of a time of its course, whose motions are added; None to add none.
    """
    out = {path: what.motion() for path, what in job.perturb.items()}
    if job.course is not None and time is not None:
        for path, added in job.course.motions(time).items():
            out[path] = out.get(path, Motion()).plus(added)
    return out


LIKELY = 4.0
"""Number of standard deviations up to which an amount agrees with the prior: a normal variable exceeds it once in 16
000.
"""


@dataclass(frozen=True)
class Excess:
    """Component of a job's perturbation that exceeds the disturbance prior.

    Attributes
    ----------
    body : str
        Path of the body.
    what : str
        Name of the component, such as ``shift z``, ``figure Z7``, ``temperature``.
    kind : str
        Key of ``scenes.models.disturbances.UNITS``; ``table`` for tables at nodes.
    amount : float
        Amount, SI; 0 for a table.
    sigma : float
        Standard deviation of that component in the prior, SI; 0 if the prior does not include it.
    """

    body: str
    what: str
    kind: str
    amount: float
    sigma: float

    @property
    def text(self) -> str:
        """Text for messages: ``base/forward/M2 shift z (3 um, prior sigma 0.3 um)``."""
        if self.kind == "table":
            return f"{self.body} {self.what} (not in the prior)"
        unit, size = UNITS[self.kind]
        prior = f"prior sigma {self.sigma / size:.3g} {unit}" if self.sigma else "not in the prior"
        return f"{self.body} {self.what} ({self.amount / size:.3g} {unit}, {prior})"


def beyond_prior(resolved: ResolvedJob, prior: DisturbancePrior | None) -> tuple[Excess, ...]:
    """Return the components of a job's perturbation above `LIKELY` standard deviations of the prior, body by body.

    Pivots are ignored: for a rotation about another point the angle counts.

    Parameters
    ----------
    resolved : ResolvedJob
        The job.
    prior : DisturbancePrior or None
        Its prior; None if it has none.
    """
    return tuple(_excesses(resolved.job, _variances(prior)))


def _variances(prior: DisturbancePrior | None) -> Mapping[tuple[str, str], float]:
    """Return (body, name of the component) -> its variance in the prior, SI."""
    out: dict[tuple[str, str], float] = {}
    for c in prior.components if prior is not None else ():
        out[c.body, c.what] = out.get((c.body, c.what), 0.0) + c.sigma**2
    return out


def _excesses(job: JobSpec, variance: Mapping[tuple[str, str], float]) -> Iterator[Excess]:
    """Yield the components of a job's perturbation that exceed `LIKELY` standard deviations of the prior."""
    for body, what in job.perturb.items():
        for kind, name, amount in _components(what):
            sigma = variance.get((body, name), 0.0) ** 0.5
            if kind == "table" or abs(amount) > LIKELY * sigma:
                yield Excess(body, name, kind, amount, sigma)


def _components(what: PerturbationSpec) -> Iterator[tuple[str, str, float]]:
    """Yield kind, name and amount of each perturbation of a body."""
    vectors = {"shift": what.shift, "rotate": what.rotate, "gradient": what.heat.gradient}
    for kind, vector in vectors.items():
        yield from ((kind, f"{kind} {axis}", value) for axis, value in zip("xyz", vector, strict=True) if value)
    yield from (("figure", f"figure {term}", value) for term, value in what.figure.items() if value)
    for kind in ("scale", "radius", "conic", "index", "abbe"):
        if value := getattr(what, kind):
            yield kind, kind, value
    if what.heat.change:
        yield "temperature", "temperature", what.heat.change
    if what.heat.table is not None:
        yield "table", "temperatures at nodes", 0.0
    if what.deformation is not None:
        yield "table", "deformation", 0.0
