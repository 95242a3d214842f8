"""The perturbed state that a job describes, and what of it moves beyond what is stated to move.

Tables of nodes that jobs name: mirrors and faces that finite-element programs deformed, and bodies that tables of
temperatures warm: what is linear of such a table, and what the rest does to mirrors and glass.

The linear part, nearest over the body's volume, goes the way of every linear temperature (``ThermalModel``): the body
grows, bends and changes its index with it, and what it carries follows. What is left deforms the body's own finite
elements, whose optical faces move and bend; on bodies without finite elements, and for the index of glass, it cannot be
followed, and a table that has more of it than does not matter is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from optics.geometry.pose import Pose, triple
from optics.geometry.tree import Motion, State, compose
from optics.numerics.number_tree import FrozenMap
from optics.thermal.heat import Temperature
from optics.thermal.nodal_deformation import PRINTED, SEEN, TERMS, NodalDeformation, NodesError, nodal_deformation
from optics.thermal.nodal_temperature import Coverage, NodalTemperature, linear_part
from optics.thermal.thermo_elastic import Displacement, FaceChange
from scenes.models.disturbances import UNITS, StatedMotions
from scenes.models.instrument_model import Instrument
from scenes.models.thermal_model import Held, TemperatureError, ThermalModel
from scenes.specs.job import JobSpec, PerturbationSpec
from scenes.specs.job_tables import DeformationSpec, TableTemperatureSpec
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.errors import KeyPath, unknown
from scenes.yaml.node_table import read_nodes, read_temperatures

COARSE_CELLS, FINE_CELLS = 12, 16
"""Finite elements across a mirror for what is not linear; the difference of the two says how well they follow it."""
PER_SIDE = (4, 6)
"""Finite elements along the longest side of a prism, coarse and fine."""
LINEAR_TO = 1e-4
"""Kelvin by which nodes on a body without finite elements may depart from a linear field: a metre of aluminium grows by
2 nm."""
ROUNDING = 1e-9
"""Kelvin below which nothing is left of a field."""
LEAST_INSIDE = 0.5
"""Share of the body's volume that the nodes must cover; with less they are of another body, frame or unit."""
SHOWN_OUTSIDE = 1e-3
"""Share of the body's volume beyond the nodes above which is warned."""
SEEN_HEAT = 1e-3
"""Kelvin rms below which nothing is said of what a table does not know between its nodes."""
MESHED_TO = 0.1
"""Share of the change of a face by which coarser finite elements may differ."""
INDEX_WAVES = 0.01
"""Waves of optical path through the glass that the index of what is not linear may be worth."""


@dataclass(frozen=True, eq=False)
class HeatedFace:
    """What a table does to an optical face beyond its linear part.

    Attributes
    ----------
    motion : Motion
        Of the face's body: rigid, Zernike terms and, of a mirror, a grid with the rest.
    lost : float
        What is not carried, metres rms of sag.
    unmeshed : float
        By how much coarser finite elements differ, metres rms of sag.
    """

    motion: Motion
    lost: float
    unmeshed: float

    @property
    def figure_rms(self) -> float:
        """Figure from Z4 on, metres rms over the disk of the terms."""
        return float(np.sqrt(sum(a * a for j, a in self.motion.figure.items() if j > 3)))


@dataclass(frozen=True, eq=False)
class HeatedBody:
    """What a table of temperatures is for its body.

    Attributes
    ----------
    nodes : int
        How many there are.
    spacing : float
        Of the nodes, metres.
    linear : Temperature
        The nearest linear field, in the body's frame.
    left : tuple[float, float]
        What it leaves, over the body's volume: rms and largest, kelvin.
    between : float
        Rms of the error at nodes that are left out, kelvin.
    coverage : Coverage | None
        Of the body by the nodes, None for a body without finite elements.
    faces : Mapping[str, HeatedFace]
        Body of a face -> what the rest does to it.
    index_path : float
        Largest optical path that the index of the rest may be worth, metres; 0 for what is not glass.
    """

    nodes: int
    spacing: float
    linear: Temperature
    left: tuple[float, float]
    between: float
    coverage: Coverage | None
    faces: Mapping[str, HeatedFace]
    index_path: float

    def state(self, gridded: State | None = None) -> State:
        """What the rest does, beyond the linear field.

        Parameters
        ----------
        gridded : State | None
            Motions of the same bodies whose grids these are to be added to.
        """
        out = {}
        for path, face in self.faces.items():
            other = gridded[path].grid if gridded is not None and path in gridded else None
            own = face.motion.grid
            out[path] = (
                face.motion if own is None or other is None else replace(face.motion, grid=own.sampled_as(other))
            )
        return out

    def warnings(self, path: str) -> tuple[str, ...]:
        """What the user should know of the table of the body ``path``."""
        out = []
        if self.coverage is not None and self.coverage.outside > SHOWN_OUTSIDE:
            out.append(
                f"{path}: {100.0 * self.coverage.outside:.2g} % of its volume lie outside of the table's nodes, up to "
                f"{1e3 * self.coverage.farthest:.3g} mm from the nearest; there its departure from the linear part "
                "is taken: give nodes all through the body"
            )
        if self.between > max(SEEN_HEAT, PRINTED * self.left[0]):
            out.append(
                f"{path}: the table is coarser than its field: nodes left out are foretold to {self.between:.3g} K "
                f"rms only, of {self.left[0]:.3g} K that are not linear ({1e3 * self.spacing:.3g} mm between nodes); "
                "refine the mesh, or doubt what it does to images"
            )
        for face, change in self.faces.items():
            size = change.figure_rms
            if change.unmeshed > max(SEEN, MESHED_TO * size):
                out.append(
                    f"{face}: finite elements here follow the table to {1e9 * change.unmeshed:.3g} nm rms only, of "
                    f"{1e9 * size:.3g} nm; give the displacements of the structural program (deformation)"
                )
            if change.lost > max(SEEN, PRINTED * size):
                out.append(
                    f"{face}: {1e9 * change.lost:.3g} nm rms of its change by the table are finer than "
                    f"Z{TERMS} and not carried; give displacements (deformation)"
                )
        if self.index_path > SEEN:
            out.append(
                f"{path}: the index of glass follows the linear part of the table; the rest is worth up to "
                f"{1e9 * self.index_path:.2g} nm of path and not carried"
            )
        return tuple(out)


def heated_body(thermal: ThermalModel, job: JobSpec, path: str, spec: TableTemperatureSpec) -> HeatedBody:
    """What a job's table of temperatures does to one body.

    Parameters
    ----------
    thermal : ThermalModel
        Of the instrument.
    job : JobSpec
        That names the table, for what is wrong.
    path : str
        Of the body.
    spec : TableTemperatureSpec
        The table, as ``scenes.specs.job.with_tables`` has left it.

    Raises
    ------
    InputError
        No such frame; nodes that do not cover the body, are too cold, or have more that is not linear than this body
        can follow.
    """
    key = ("perturb", path, "temperature")
    assert spec.table is not None
    read = read_temperatures(spec.table, spec.unit, spec.field, spec.values, spec.sha256)
    points = pose_of_frame(thermal.instrument, job, key, path, spec.frame).apply(read.points)
    values = read.values - (thermal.reference if read.absolute else 0.0)
    try:
        coldest = int(np.argmin(values))
        if not thermal.reference + values[coldest] > 0.0:
            text = f"a node would be at {thermal.reference + values[coldest]:.4g} K"
            raise NodesError(text, "absolute temperatures under 'T [K]' or 'T [degC]', changes under 'dT [K]'")
        known = thermal.known(path)
        if not known.holds(thermal.reference + float(values[coldest]), thermal.reference + float(np.max(values))):
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
    if nodes.flat:
        allowed = "nodes all through the body: across a plane they do not tell the gradient"
        raise NodesError("the nodes lie in a plane or on a line", allowed)
    coarse, fine = _elastic(thermal, path)
    if coarse is None or fine is None:
        if nodes.departure() > LINEAR_TO:
            kind = "consists of several pieces" if path in thermal.solids else "has no shape here"
            raise NodesError(
                f"it {kind} and can follow a linear field only, from which the nodes depart by up to "
                f"{nodes.departure():.3g} K",
                f"the nearest linear field, {_in_words(nodes.linear)}, and displacements of the structural program",
            )
        left = float(np.sqrt(np.mean(nodes.departures**2))), nodes.departure()
        return HeatedBody(len(nodes.points), nodes.spacing, nodes.linear, left, nodes.between, None, {}, 0.0)
    elastic, _ = fine
    coverage = nodes.coverage(elastic.places, elastic.volumes)
    if coverage.outside > 1.0 - LEAST_INSIDE:
        low, high = (1e3 * side for side in (elastic.nodes.min(axis=0), elastic.nodes.max(axis=0)))
        body = ", ".join(f"{a:.4g} .. {b:.4g}" for a, b in zip(low, high, strict=True))
        theirs = zip(1e3 * nodes.points.min(axis=0), 1e3 * nodes.points.max(axis=0), strict=True)
        raise NodesError(
            f"{100.0 * coverage.outside:.0f} % of its volume lie outside of the nodes, whose x, y, z are "
            + ", ".join(f"{a:.4g} .. {b:.4g}" for a, b in theirs)
            + " mm",
            f"nodes all through the body, in {body} mm of its frame: check frame and unit",
        )
    linear, rest = linear_part(elastic.places, nodes.at(elastic.places), elastic.volumes)
    largest = float(np.max(np.abs(rest)))
    left = float(np.sqrt(np.average(rest**2, weights=elastic.volumes))), largest
    index_path = thermal.index_path(path, linear, largest)
    if index_path > INDEX_WAVES * thermal.instrument.spec.autocollimator.wavelength:
        raise NodesError(
            f"the rays through its glass follow a linear index only; what the table has beyond, up to {largest:.3g} K, "
            f"is worth up to {1e9 * index_path:.3g} nm of path",
            f"the nearest linear field, {_in_words(linear)}, or a table that departs from it by less",
        )
    faces: dict[str, HeatedFace] = {}
    if largest > ROUNDING and thermal.materials[path].expansion != 0.0:

        def field(places: np.ndarray) -> np.ndarray:
            return nodes.at(places) - linear.change - places @ np.array(linear.gradient)

        solved = [body.solve_many([field], support)[0] for body, support in (coarse, fine)]
        coarser, finer = (thermal.changes(path, moved, TERMS) for moved in solved)
        sizes = thermal.face_radii(path)
        for face, change in finer.items():
            motion, lost = Motion(change.rotate, change.shift, figure=FrozenMap(change.figure)), change.residual_rms
            if path in thermal.mirrors:
                nodal = _at_nodes(thermal, path, solved[1])
                motion, lost = nodal.motion(), nodal.rms(nodal.lost)
            faces[face] = HeatedFace(motion, lost, _apart(change, coarser[face], sizes[face]))
    return HeatedBody(len(nodes.points), nodes.spacing, linear, left, nodes.between, coverage, faces, index_path)


def _at_nodes(thermal: ThermalModel, path: str, moved: Displacement) -> NodalDeformation:
    """A mirror's displacement at its face's nodes, as those of another program's table are taken apart."""
    ((aperture, _),) = thermal.faces_of(path).values()
    surface = thermal.surface(path)
    x, y, z = moved.nodes.T
    face = np.abs(z - surface.sag(x, y)) <= 1e-9 * float(np.max(np.ptp(moved.nodes, axis=0)))
    return nodal_deformation(moved.nodes[face], moved.values[face], surface, aperture, TERMS)


def _elastic(thermal: ThermalModel, path: str) -> tuple[Held | None, Held | None]:
    """Coarse and fine finite elements of a body with what holds them."""
    if path in thermal.mirrors:
        return thermal.elastic(path, cells=COARSE_CELLS), thermal.elastic(path, cells=FINE_CELLS)
    if path not in thermal.solids:
        return None, None
    longest = float(np.max(np.ptp(thermal.extent(path), axis=0)))
    coarse, fine = (thermal.elastic(path, spacing=longest / count) for count in PER_SIDE)
    return coarse, fine


def _apart(one: FaceChange, other: FaceChange, radius: float) -> float:
    """Difference of two changes of a face, metres rms of sag over the disk of their terms."""
    piston = one.shift[2] - other.shift[2]
    # a tilt t of a disk of radius R is t R / 2 rms
    tilts = [0.5 * radius * (a - b) for a, b in zip(one.rotate[:2], other.rotate[:2], strict=True)]
    terms = [a - other.figure.get(j, 0.0) for j, a in one.figure.items()]
    return float(np.sqrt(np.sum(np.square([piston, *tilts, *terms]))))


def _in_words(field: Temperature) -> str:
    slope = ", ".join(f"{g:.6g} K/m" for g in field.gradient)
    return f"temperature: {{change: {field.change:.6g} K, gradient: [{slope}]}}"


def heated_bodies(job: JobSpec, thermal: ThermalModel) -> dict[str, HeatedBody]:
    """Body -> what the table of temperatures is that warms it.

    Raises
    ------
    InputError
        a table that does not describe its body.
    """
    named = {path: what.heat for path, what in job.perturb.items() if what.heat.table is not None}
    return {path: heated_body(thermal, job, path, spec) for path, spec in named.items()}


def with_heat(fields: Mapping[str, Temperature], heated: Mapping[str, HeatedBody]) -> dict[str, Temperature]:
    """The linear fields of bodies with those of their tables added."""
    return {**fields, **{path: fields.get(path, Temperature()) + body.linear for path, body in heated.items()}}


def deformed_face(instrument: Instrument, job: JobSpec, path: str, spec: DeformationSpec) -> NodalDeformation:
    """What a job's table does to one body.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    job : JobSpec
        That names the table, for what is wrong.
    path : str
        Of the body, which has a reflecting or refracting surface.
    spec : DeformationSpec
        The table, as ``scenes.specs.job.with_tables`` has left it.

    Raises
    ------
    InputError
        No such frame; nodes that are not on the surface or do not cover it.
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
    """Where the nominal frame in which a table is told stands in that of the body.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    job : JobSpec
        That names the table, for what is wrong.
    key : KeyPath
        Of the table's specification in there.
    path : str
        Of the body.
    frame : str | None
        Path of the body in whose frame the nodes are told, None for its own.

    Raises
    ------
    InputError
        No such frame.
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
    """The perturbed state that a job describes.

    Parameters
    ----------
    job : JobSpec
        Its perturbation, checked by ``scenes.specs.job.checked_nodes``.
    thermal : ThermalModel
        Of its instrument.
    progress : Callable[[str], None]
        Called with the path of each body whose thermo-elastic solution begins.
    moved : State | None
        The state without its linear temperatures, where it is known; None for all that the job says.
    heated : Mapping[str, HeatedBody] | None
        What its tables of temperatures are, where it is known.

    Raises
    ------
    InputError
        a temperature at or below 0 K, or one at which a glass's index is not known; a table of nodes that does not
        describe its body.
    """
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


def deformations_of(job: JobSpec, instrument: Instrument) -> dict[str, NodalDeformation]:
    """Body -> what the table of nodes is that a job deforms it by.

    Raises
    ------
    InputError
        a table that does not describe its body.
    """
    named = {path: what.deformation for path, what in job.perturb.items() if what.deformation is not None}
    return {path: deformed_face(instrument, job, path, table) for path, table in named.items()}


def on_deformed(
    instrument: Instrument,
    deformed: Mapping[str, NodalDeformation],
    moved: State,
    heated: Mapping[str, HeatedBody] | None = None,
) -> State:
    """The motions of a state on top of its bodies' deformations, by tables of nodes and by what is not linear of tables
    of temperatures.
    """
    bodies = {body.path: body for body in instrument.assembly.tree.bodies}
    own = {path: face.motion() for path, face in deformed.items()}
    for warm in (heated or {}).values():
        moved = compose(warm.state(own), moved, bodies) if warm.faces else moved
    return compose(own, moved, bodies) if own else moved


def motions_of(job: JobSpec, time: int | None = None) -> State:
    """The rigid motions, scales and shapes of surfaces that a job asks for; its temperatures come on top of them.

    Parameters
    ----------
    job : JobSpec
        Its perturbation.
    time : int | None
        Number of a time of its course, whose motions are added; None for none.
    """
    out = {path: what.motion() for path, what in job.perturb.items()}
    if job.course is not None and time is not None:
        for path, added in job.course.motions(time).items():
            own = out.get(path, Motion())
            rotate = triple(a + b for a, b in zip(own.rotate, added.rotate, strict=True))
            shift = triple(a + b for a, b in zip(own.shift, added.shift, strict=True))
            out[path] = replace(own, rotate=rotate, shift=shift, pivot=added.pivot, scale=own.scale + added.scale)
    return out


LIKELY = 4.0
"""Standard deviations up to which an amount is what was stated: a normal number is larger once in 16 000."""


@dataclass(frozen=True)
class Excess:
    """A component of a job's perturbation that its statement does not hold.

    Attributes
    ----------
    body : str
        path.
    what : str
        ``shift z``, ``figure Z7``, ``temperature``.
    kind : str
        Of `scenes.models.disturbances.UNITS`; ``table`` for what files of nodes say.
    amount : float
        SI; 0 for a table.
    sigma : float
        Stated of that component, SI; 0 for one that is not stated.
    """

    body: str
    what: str
    kind: str
    amount: float
    sigma: float

    @property
    def text(self) -> str:
        """In words: ``base/forward/M2 shift z (3 um, stated 0.3 um)``."""
        if self.kind == "table":
            return f"{self.body} {self.what} (not stated)"
        unit, size = UNITS[self.kind]
        stated = f"stated {self.sigma / size:.3g} {unit}" if self.sigma else "not stated"
        return f"{self.body} {self.what} ({self.amount / size:.3g} {unit}, {stated})"


def beyond_statement(resolved: ResolvedJob, stated: StatedMotions | None) -> tuple[Excess, ...]:
    """Components of a job's perturbation that are larger than `LIKELY` times what is stated of them, body by body.

    Pivots are left aside: of a turn about another point its angle counts.

    Parameters
    ----------
    resolved : ResolvedJob
        The job.
    stated : StatedMotions | None
        Of it; None for nothing.
    """
    return tuple(_excesses(resolved.job, _variances(stated)))


def _variances(stated: StatedMotions | None) -> Mapping[tuple[str, str], float]:
    out: dict[tuple[str, str], float] = {}
    for c in stated.components if stated is not None else ():
        out[c.body, c.what] = out.get((c.body, c.what), 0.0) + c.sigma**2
    return out


def _excesses(job: JobSpec, variance: Mapping[tuple[str, str], float]) -> Iterator[Excess]:
    for body, what in job.perturb.items():
        for kind, name, amount in _components(what):
            sigma = variance.get((body, name), 0.0) ** 0.5
            if kind == "table" or abs(amount) > LIKELY * sigma:
                yield Excess(body, name, kind, amount, sigma)


def _components(what: PerturbationSpec) -> Iterator[tuple[str, str, float]]:
    """Kind, name and amount of all that is done to a body."""
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
