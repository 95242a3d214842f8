"""Derivatives of the monitor's spots with respect to motions of bodies, and the motion models of the estimators.

A spot's position is the mean of its rays on the area CCD. In reverse mode, two backward passes (row and column) through
the monitor's sequence of surfaces give its derivative with respect to the parameters of every surface (position,
orientation, shape) and to the launch direction of each ray. That direction is such that the ray hits its node of the
return face: hit(direction, parameters) = node. By the implicit function theorem the passes therefore continue through
the sequence from pinhole to return face with the weights

    w = -(d hit / d direction)^-T  dS / d direction

for the spot position S. How the surfaces' parameters depend on the motions is found by the complex step in the
rigid-body tree. The cost hardly depends on the number of motions, whereas forward mode traces all rays once for each of
them.

Estimators that retrace states use the exact spot shifts and camera changes of the motions that they estimate.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise

import numpy as np

from analysis.monitor import model_fit
from analysis.monitor.disturbances import FALSE_ALARM, Disturbances, TimeLaw
from analysis.monitor.limits import Split, split
from analysis.monitor.monitor_formulas import GroundGeometry
from analysis.monitor.parameters import CameraCalibration
from analysis.monitor.recovery import MotionModel, Retraced, joint
from analysis.spots.likelihood import image_bound
from optics.geometry.tree import AT_REST, COMPLEX_STEP, FIGURE, Motion, PlacedBodies, State, compose
from optics.numerics.array_math import PhysicalError, inverse, matvec
from optics.numerics.backend import Backend
from optics.numerics.number_tree import Path, leaves
from optics.raytrace.aim import RayFan, aim, transverse_axes
from optics.raytrace.system import SystemBatch, assemble
from optics.raytrace.trace import RayTangents, jvp, make_rays, trace, vjp
from scenes.models.disturbances import Component, DisturbancePrior, prior_of_spec, states_of
from scenes.models.instrument_model import Instrument
from scenes.models.thermal_model import ThermalModel
from scenes.specs.disturbances import DisturbancesSpec, TimeLawSpec
from scenes.specs.instrument import BASE
from twin.monitor.monitor_beams import AIM_TOLERANCE, MonitorBeams
from twin.monitor.monitor_path import MonitorPath
from twin.monitor.truth import (
    FIGURE_TERMS,
    ElementaryMotion,
    LineSight,
    ground_geometry,
    line_family,
    pivot_states,
    trace_truth,
    truth_jacobian,
)
from twin.sensors.area_detector import EmvaDetector


def _size_steps(placed: PlacedBodies, bodies: Sequence[str]) -> np.ndarray:
    """Return the derivatives of the sizes of C bodies with respect to the amplitude of each of M motions, (C, M)."""
    return np.stack([placed.scale[:, placed.index[body]].imag for body in bodies]) / COMPLEX_STEP


def ray_tangents(path: MonitorBeams, motions: Sequence[ElementaryMotion]) -> tuple[RayTangents, np.ndarray]:
    """Return the derivatives of the monitor's rays with respect to motions, with each ray fixed to its node.

    The motions of the bodies are differentiated by a complex step in the rigid-body tree, the trace by Dr.Jit.

    Returns
    -------
    tuple of (RayTangents, ndarray)
        Derivatives for C channels x M motions (all motions of a channel together), in each CCD's frame, per radian,
        metre or unit; and those of the CCDs' sizes, (C*M,).
    """
    states, steps = _of_equal_structure(path, pivot_states(motions)), [motion.step for motion in motions]
    placed = path.instrument.assembly.place(states, steps)
    source = np.concatenate([placed.translation[:, placed.index[c.reticle_body]].imag for c in path.channels])
    nominal, m = path.nominal, len(motions)
    direction = np.repeat(nominal.direction, m, axis=0)
    position = np.broadcast_to(np.repeat(nominal.position, m, axis=0), direction.shape)
    position_step = source[:, None] / COMPLEX_STEP

    def propagate(sequence: str, direction_step: np.ndarray | float) -> RayTangents:
        names = [f"{channel.key}/{sequence}" for channel in path.channels]
        systems = assemble(path.instrument.assembly, names, states, steps, placed)
        return jvp(path.backend, systems, position, direction, position_step, direction_step)

    drift = propagate("outgoing", 0.0).position[..., :2]
    outgoing = assemble(path.instrument.assembly, [f"{channel.key}/outgoing" for channel in path.channels])
    start = np.broadcast_to(nominal.position, nominal.direction.shape)
    axes, slopes = hit_slopes(path.backend, outgoing, start, nominal.direction)
    faces = _size_steps(placed, [channel.face_body for channel in path.channels]).reshape(-1, 1, 1)
    q_step = matvec(np.repeat(inverse(slopes), m, axis=0), faces * path.targets(m) - drift)
    sizes = _size_steps(placed, [channel.ccd_body for channel in path.channels]).ravel()
    return propagate("monitor", np.einsum("bnk,bnkx->bnx", q_step, np.repeat(axes, m, axis=0))), sizes


def _of_equal_structure(path: MonitorBeams, states: list[State]) -> list[State]:
    """Return states that all have the same numerical structure, so that one compiled kernel serves all motions.

    The first state gets the highest figure term of every mirror, with amplitude 0.
    """
    if not states:
        return states
    first, term = dict(states[0]), max(FIGURE_TERMS)
    for element in path.instrument.assembly.elements.values():
        if not element.surface.is_plane:
            motion = first.get(element.body, AT_REST)
            first[element.body] = replace(motion, figure={term: 0.0, **motion.figure})
    return [first, *states[1:]]


def hit_slopes(
    backend: Backend, systems: SystemBatch, position: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivative of the points where rays hit the last element with respect to their launch directions.

    Dimensions: B systems, N rays of each.

    Parameters
    ----------
    backend : Backend
        Backend of the ray trace.
    systems : SystemBatch
        B optical systems that carry no derivative.
    position : (B, N, 3) ndarray
        Launch points in the world frame, in metres.
    direction : (B, N, 3) ndarray
        Unit directions.

    Returns
    -------
    tuple of ndarray
        Two unit vectors perpendicular to each direction, (B, N, 2, 3), and the derivatives of the hit point (x, y) with
        respect to a rotation of the direction toward each, (B, N, 2, 2), in metres per radian.
    """
    axes = transverse_axes(direction, np.broadcast_to([0.0, 1.0, 0.0], direction.shape))
    launch, unit = np.repeat(position, 2, axis=1), np.repeat(direction, 2, axis=1)
    tangents = jvp(backend, systems, launch, unit, 0.0, axes.reshape(len(direction), -1, 3))
    return axes, np.swapaxes(tangents.position[..., :2].reshape(*direction.shape[:2], 2, 2), -1, -2)


def spot_jacobian(path: MonitorBeams, motions: Sequence[ElementaryMotion]) -> np.ndarray:
    """Return the derivative of every spot's position with respect to elementary motions, by forward differentiation.

    The position is the mean of the rays over the aperture, which is the energy centroid of the diffraction image.

    Dimensions: C channels (one spot each).

    Parameters
    ----------
    path : MonitorBeams
        Beams of the monitor.
    motions : sequence of ElementaryMotion
        M elementary motions.

    Returns
    -------
    (C, 2, M) ndarray
        Row and column, in pixels per radian, metre or unit.
    """
    tangents, sizes = ray_tangents(path.coarse, motions)
    position = tangents.traced.numpy()[0]
    # positions are in pixels, which expand with the chip
    moved = tangents.position - sizes[:, None, None] * position
    mean = np.einsum("n,bnk->bk", path.coarse.nodes.share, moved[..., 1::-1])
    return np.asarray(mean.reshape(len(path.channels), len(motions), 2).swapaxes(1, 2)) / path.pitch


CHUNK = 1 << 17
"""Number of rays, of all channels together, that are traced back at once: they need about 0.3 GB."""


def spot_gradient(
    path: MonitorBeams, motions: Sequence[ElementaryMotion], about: State | None = None, chunk: int = CHUNK
) -> np.ndarray:
    """Return the derivative of every spot's position with respect to elementary motions, by reverse differentiation.

    Parameters
    ----------
    path : MonitorBeams
        Beams of the monitor; all of its nodes are traced (``path.coarse`` is enough for the mean of a smooth spot).
    motions : sequence of ElementaryMotion
        M elementary motions.
    about : State | None
        State at which to differentiate; None for the unperturbed instrument. Each motion is added to the same component
        of that state: of the rotation vector, shift, scale or figure.
    chunk : int
        Number of rays, of all channels together, that are traced back at once, to limit memory.

    Returns
    -------
    (C, 2, M) ndarray
        Derivatives of row and column for C channels (one spot each) and M motions, in pixels per radian, metre or unit.

    Raises
    ------
    ValueError
        A motion's pivot differs from that of the state's motion of the same body.
    AimError
        In the state ``about`` a beam does not reach its return face.
    """
    about = {} if about is None else about
    launch, launched = _aimed(path, about)
    states = [_named(motion, about) for motion in motions]
    middle = _union(states, about)
    steps = [motion.step for motion in motions]
    placed = path.instrument.assembly.place(states, steps)
    source = np.stack([placed.translation[:, placed.index[c.reticle_body]].imag for c in path.channels]) / COMPLEX_STEP
    monitor, monitor_steps = _numbers(path, "monitor", middle, states, placed, steps)
    outgoing, outgoing_steps = _numbers(path, "outgoing", middle, states, placed, steps)

    out = np.zeros((len(path.channels), 2, len(motions)))
    single_systems = np.arange(0, outgoing.count, 2)
    rays = max(chunk // len(path.channels), 1)
    size = monitor.size[single_systems]
    pitch = path.pitch * monitor.size
    face_steps = _size_steps(placed, [channel.face_body for channel in path.channels])
    chip_steps = _size_steps(placed, [channel.ccd_body for channel in path.channels])
    for start in range(0, path.nodes.count, rays):
        piece = slice(start, start + rays)
        start_point, start_direction = launch[:, piece], launched[:, piece]
        across, slope = hit_slopes(path.backend, outgoing.take(single_systems), start_point, start_direction)
        start_point, start_direction, across = (
            np.repeat(array, 2, axis=0) for array in (start_point, start_direction, across)
        )
        # system 2c is the row of channel c's spot (y of the CCD), 2c + 1 its column (x)
        share = path.nodes.share[piece, None] * np.array([[[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]]])
        weight = np.tile(share, (len(path.channels), 1, 1)) / pitch[:, None, None]
        back_monitor = vjp(
            path.backend, monitor, start_point, start_direction, weight, [tuple(tangent) for tangent in monitor_steps]
        )
        slope_direction = np.einsum("bnkx,bnx->bnk", across, back_monitor.direction)
        weights_direction = -np.linalg.solve(
            np.repeat(np.swapaxes(slope, -1, -2), 2, axis=0), slope_direction[..., None]
        )[..., 0]
        hit_weights = np.concatenate([weights_direction, np.zeros_like(weights_direction[..., :1])], axis=-1)
        tangents = [tuple(tangent) for tangent in outgoing_steps]
        back_outgoing = vjp(path.backend, outgoing, start_point, start_direction, hit_weights, tangents)
        pinhole = (back_monitor.position + back_outgoing.position).sum(axis=1).reshape(len(path.channels), 2, 3)
        out += _dot(monitor_steps, back_monitor.values) + _dot(outgoing_steps, back_outgoing.values)
        out += np.einsum("ckx,cmx->ckm", pinhole, source)
        # nodes move with the return face as it expands, and positions are in pixels, which expand with the chip
        target_nodes = np.repeat(path.target[:, piece], 2, axis=0)
        node_motion = np.einsum("bnx,bnx->b", weights_direction, target_nodes).reshape(-1, 2)
        out -= node_motion[:, :, None] * face_steps[:, None]
        start_rays = make_rays(path.backend, launch[:, piece], launched[:, piece])
        hit = trace(path.backend, monitor.take(single_systems), start_rays).xy()[..., ::-1]
        spot = np.einsum("n,bnk->bk", path.nodes.share[piece], hit) / (path.pitch * size[:, None] ** 2)
        out -= spot[:, :, None] * chip_steps[:, None]
    return out


_Tangents = list[dict[Path, np.ndarray]]
"""For each surface of a sequence, path of a parameter -> its derivative with respect to M motions, (C, M).

C is the number of channels; derivatives that are all zero are omitted.
"""


def _dot(tangents: _Tangents, slopes: Sequence[Mapping[Path, np.ndarray]]) -> np.ndarray:
    """Return the derivatives of spots with respect to motions, (C, 2, M), by the chain rule.

    It is the sum over the surfaces' parameters of the derivative of the spot (row, column) with respect to a parameter,
    (C, 2), times that of the parameter with respect to the motions, (C, M).

    Dimensions: C channels (one spot each), M motions.
    """
    parts = [
        slope[name].reshape(len(table), 2)[:, :, None] * table[:, None]
        for tangent, slope in zip(tangents, slopes, strict=True)
        for name, table in tangent.items()
    ]
    return np.asarray(sum(parts))


def _numbers(
    path: MonitorBeams,
    sequence: str,
    middle: State,
    states: Sequence[State],
    placed: PlacedBodies,
    steps: Sequence[tuple[str, str, int]],
) -> tuple[SystemBatch, _Tangents]:
    """Return a sequence's systems, each channel twice (for row and column), and the derivatives of their parameters.

    The derivatives are those of the surfaces' parameters with respect to the motions.
    """
    assembly = path.instrument.assembly
    names = [f"{channel.key}/{sequence}" for channel in path.channels]
    systems = assemble(assembly, names, [middle])
    # the union of the states determines the kernel, so that no state adds a figure to another mirror
    tangents = assemble(assembly, names, states, steps, placed).tangents
    assert tangents is not None
    nonzero = [
        {path: v.reshape(len(names), -1) for path, v in leaves(tangent).items() if np.any(v)} for tangent in tangents
    ]
    return systems.take(np.repeat(np.arange(systems.count), 2)), nonzero


def _named(motion: ElementaryMotion, about: State) -> State:
    """Return the state ``about`` with the pivot and (at zero amplitude) the figure term of the motion's body."""
    start = about.get(motion.body)
    if start is None:
        return {**about, **motion.state(0.0)}
    if motion.kind in ("rotate", "scale") and start.pivot != motion.pivot:
        raise ValueError(
            f"{motion.body} moves about {start.pivot!r}; it cannot be differentiated about {motion.pivot!r}"
        )
    if motion.kind != FIGURE:
        return about
    return {**about, motion.body: replace(start, figure={motion.axis: 0.0, **start.figure})}


def _union(states: Sequence[State], about: State) -> State:
    """Return the state ``about`` with every figure term of any of the states, so that all have the same structure."""
    figures: dict[str, dict[int, float]] = {}
    for state in states:
        for body, motion in state.items():
            if motion.figure:
                figures.setdefault(body, {}).update(motion.figure)
    return {**about, **{body: replace(about.get(body, AT_REST), figure=terms) for body, terms in figures.items()}}


def _aimed(path: MonitorBeams, about: State) -> tuple[np.ndarray, np.ndarray]:
    """Return launch points and directions of the rays that hit the nodes of the return faces in a state.

    Both arrays are (C, N, 3) for C channels (one spot each) and N nodes of the aperture.
    """
    nominal = path.nominal
    start = np.broadcast_to(nominal.position, nominal.direction.shape)
    if not about:
        return start, nominal.direction
    placed = path.instrument.assembly.place([about])
    systems = assemble(path.instrument.assembly, [f"{c.key}/outgoing" for c in path.channels], [about], placed=placed)
    origin = np.concatenate([placed.translation[:, placed.index[c.reticle_body]] for c in path.channels])
    launch = np.broadcast_to(origin[:, None], start.shape)
    axes, slopes = hit_slopes(path.backend, systems, launch, nominal.direction)
    fan = RayFan(launch, nominal.direction, axes)
    q, _ = aim(path.backend, systems, fan, path.target, jacobian=slopes, tolerance=AIM_TOLERANCE)
    return fan.at(q)


STEPS = {"temperature": 0.1, "gradient": 0.1, "index_gradient": 1e-6, "radius": 1e-5, "conic": 1e-5, "index": 1e-6}
"""Kind of motion -> half step of its central difference, in SI units.

Spots move by some tenths of a pixel, over which they are linear to 1e-6.
"""


def disturbances_of(
    prior: DisturbancePrior, path: MonitorPath, thermal: ThermalModel, instrument: Instrument, backend: Backend
) -> Disturbances:
    """Return the motions of a prior with their effects on spots and camera parameters, as the analysis uses them.

    Rigid motions, scale and figures are differentiated by automatic differentiation. Temperatures and index gradients
    affect light through many bodies at once, and radii, conic constants and indices are rare in priors; all of these
    use central differences of the traced spots.

    Parameters
    ----------
    prior : DisturbancePrior
        Motions of the prior.
    path : MonitorPath
        Optical path of the monitor.
    thermal : ThermalModel
        Thermal model of the instrument.
    instrument : Instrument
        Nominal instrument.
    backend : Backend
        Backend of the ray trace.

    Raises
    ------
    AimError, BeamMissedError
        A step of a temperature loses the light.
    """
    spots = np.empty((2 * len(path.channels), len(prior.components)))
    parameters = np.empty((4 * len(instrument.cameras), len(prior.components)))
    moved = [k for k, c in enumerate(prior.components) if c.kind not in STEPS]
    if moved:
        motions = [_elementary(prior.components[k]) for k in moved]
        spots[:, moved] = spot_jacobian(path, motions).reshape(-1, len(moved))
        parameters[:, moved] = np.concatenate(list(truth_jacobian(instrument, backend, motions).values()))
    stepped = [k for k, c in enumerate(prior.components) if c.kind in STEPS]
    if stepped:
        stepped_components = [prior.components[k] for k in stepped]
        spots[:, stepped], parameters[:, stepped] = _by_differences(
            stepped_components, path, thermal, instrument, backend
        )
    return linear_disturbances(prior, spots, parameters)


def linear_disturbances(prior: DisturbancePrior, spots: np.ndarray, parameters: np.ndarray) -> Disturbances:
    """Return a prior with the given effects of its M motions, as the analysis uses them.

    Parameters
    ----------
    prior : DisturbancePrior
        Motions of the prior.
    spots : (D, M) ndarray
        Change of each reading per SI unit of each motion.
    parameters : (P, M) ndarray
        Change of each parameter per SI unit of each motion.
    """
    sigma = prior.sigma
    return Disturbances(
        name=prior.name,
        labels=tuple(c.name for c in prior.components),
        bodies=tuple(c.body for c in prior.components),
        causes=tuple(c.cause for c in prior.components),
        sigmas=np.array([c.sigma / c.unit_size for c in prior.components]),
        units=tuple(c.unit for c in prior.components),
        spots=spots * sigma,
        parameters=parameters * sigma,
        correlation=prior.correlation,
        laws=tuple(_law(law) for law in prior.laws),
        jump_false_alarm=prior.jump_false_alarm or FALSE_ALARM,
    )


def _elementary(component: Component) -> ElementaryMotion:
    """Return the elementary motion (body, kind and axis) that a component of the prior describes."""
    return ElementaryMotion(component.body, component.kind, component.axis, component.pivot, component.name)


def single_states(components: Sequence[Component], amounts: np.ndarray, thermal: ThermalModel) -> list[State]:
    """Return M states, in each of which one component of the prior has a given amount.

    Parameters
    ----------
    components : sequence of Component
        M components (motions or temperatures of bodies).
    amounts : (M,) ndarray
        Amounts, in SI units.
    thermal : ThermalModel
        Thermal model of the instrument.
    """
    thermal_kind = np.array([c.kind in STEPS for c in components], bool)
    thermal_components = [c for c in components if c.kind in STEPS]
    # all bodies have their own temperature in every state, as in drawn states, so that none inherits one
    thermal_states = iter(states_of(np.diag(amounts[thermal_kind]), thermal_components, thermal))
    return [
        next(thermal_states) if is_thermal else _elementary(c).state(amount)
        for c, is_thermal, amount in zip(components, thermal_kind.tolist(), amounts.tolist(), strict=True)
    ]


def _by_differences(
    components: Sequence[Component], path: MonitorPath, thermal: ThermalModel, instrument: Instrument, backend: Backend
) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of spots and camera parameters with respect to motions, by central differences.

    Returns
    -------
    tuple of ndarray
        Derivatives of the spot coordinates, (2 C, M), in px, and of the camera parameters, (4 K, M), in rad and m, per
        SI unit of each motion, for C channels (one spot each), M motions and K cameras.
    """
    steps = np.array([STEPS[c.kind] for c in components])
    # all bodies have their own temperature in every state, as in drawn states, so that none inherits one
    states = states_of(np.concatenate([np.diag(steps), np.diag(-steps)]), components, thermal)
    position = path.coarse_trace(states).centre
    count = len(components)
    rows = np.moveaxis(position, 1, 2).reshape(-1, 2 * count)
    truth = trace_truth(instrument, backend, states)
    both = np.concatenate([truth.vector(name).T for name in truth.cameras])
    return (rows[:, :count] - rows[:, count:]) / (2.0 * steps), (both[:, :count] - both[:, count:]) / (2.0 * steps)


SMALL: Mapping[str, float] = {"rotate": 1e-6, "shift": 1e-6, "scale": 1e-6, "figure": 1e-8}
"""Kind of motion -> step of its one-sided difference, in SI units, where two derivatives with equal steps are compared.
"""


def derivative_changes(
    prior: DisturbancePrior, path: MonitorPath, sight: LineSight, thermal: ThermalModel, built: Sequence[State]
) -> tuple[np.ndarray, np.ndarray]:
    """Return how the derivatives of spots and camera parameters of instruments as built differ from the design's.

    The derivatives are with respect to the motions of the prior. Both are one-sided differences of exact traces with
    the same steps, so that their truncation errors cancel.

    Parameters
    ----------
    prior : DisturbancePrior
        M motions of the prior, about an instrument as built.
    path : MonitorPath
        Optical path of the monitor, D spot coordinates.
    sight : LineSight
        Lines of sight of the K line CCDs.
    thermal : ThermalModel
        Thermal model of the instrument.
    built : sequence of State
        Z states as built.

    Returns
    -------
    tuple of ndarray
        Differences for spots, (Z, D, M), in pixels, and for parameters, (Z, 4 K, M), in rad and m, per standard
        deviation of each motion.

    Raises
    ------
    AimError, BeamMissedError
        The light of a state is lost.
    """
    components = prior.components
    steps = np.array([{**STEPS, **SMALL}[c.kind] for c in components])
    singles = single_states(components, steps, thermal)
    bodies = {body.path: body for body in path.instrument.assembly.tree.bodies}
    roots = {name: f"{BASE}/{name}" for name in path.instrument.cameras}

    def affected_cameras(state: State) -> set[str]:
        """Return the cameras whose spots or lines of sight a state changes."""
        inside = {name for name, root in roots.items() if any(f"{body}/".startswith(f"{root}/") for body in state)}
        return inside | set(path.moved_cameras(state))

    cameras_of_singles = [affected_cameras(single) for single in singles]

    def slopes(about: State, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return one-sided differences of spots and camera parameters about a state, per unit of each motion."""
        states = [about, *(compose(singles[m], about, bodies) for m in which.tolist())]
        spots = np.moveaxis(path.coarse_trace(states).centre, 1, 2).reshape(-1, len(states))
        truth = sight.truth(states)
        effects = spots, np.concatenate([truth.vector(name).T for name in truth.cameras])
        size = prior.sigma[which] / steps[which]
        return tuple((values[:, 1:] - values[:, :1]) * size for values in effects)

    designed = slopes({}, np.arange(len(components)))
    out = tuple(np.zeros((len(built), *derivative.shape)) for derivative in designed)
    for z, about in enumerate(built):
        # a motion does not change the effect of another motion on light that it does not affect
        affected = affected_cameras(about)
        which = np.array([m for m, cameras in enumerate(cameras_of_singles) if affected & cameras], dtype=int)
        if which.size:
            for change, now, before in zip(out, slopes(about, which), designed, strict=True):
                change[z][:, which] = now - before[:, which]
    return out[0], out[1]


def _law(law: TimeLawSpec) -> TimeLaw:
    """Convert a time law of a disturbances file to the class that the analysis uses."""
    events, since = () if law.event is None else ((law.event, 1.0),), law.since or 0.0
    jumps = law.kind == "jump" or law.jump is not None
    drifts = law.drift, law.period, law.trend, law.relaxation
    return TimeLaw(law.kind == "white", *drifts, since, events, jumps, law.jump)


NEAR = 3.0
"""Shift of a spot, in pixels, up to which the motions of the prior are treated as linear.

The leading nonlinear term is a product of two motions: the spot shift due to one times the angle of the other, which is
its own shift divided by the distance of the spots, some 10 000 px. For 3 px that is 1e-3 px, the noise of a spot, while
sigmas of a prior are tens of times larger; the few motions of the estimator `model` are traced again in every state.
"""
LOST = (PhysicalError, ArithmeticError)
"""Exceptions that mean that a state cannot be traced."""


def motion_models(
    path: MonitorPath,
    sight: LineSight,
    cameras: Mapping[str, CameraCalibration],
    thermal: ThermalModel,
    prior: DisturbancePrior | None,
    disturbances: Disturbances | None,
) -> dict[str, MotionModel]:
    """Return for each estimator whose result is checked by a ray trace the motions that it assumes.

    The motions are either the four of each camera that paper 001 (Wang et al. 2018) considers, or those of the prior.

    Parameters
    ----------
    path : MonitorPath
        Optical path of the monitor.
    sight : LineSight
        Lines of sight of the cameras.
    cameras : mapping of str to CameraCalibration
        Calibration of the cameras, in the order of the spots.
    thermal : ThermalModel
        Thermal model of the instrument.
    prior : DisturbancePrior | None
        Motions of the prior; None if there is none.
    disturbances : Disturbances | None
        The same motions with their derivatives.

    Returns
    -------
    dict of str to MotionModel
        Estimator -> motion model.
    """
    trace = partial(_traced, path, sight)
    out = {"model": _of_families(cameras, trace)}
    if prior is not None and disturbances is not None:
        states = partial(_prior_states, prior, thermal)
        out["posterior"] = MotionModel(
            disturbances.spots, disturbances.parameters, disturbances.best_amounts, states, trace, NEAR
        )
    return out


# Models call functions of this module, since a run is pickled for the process that draws it.


def _prior_states(prior: DisturbancePrior, thermal: ThermalModel, amounts: np.ndarray) -> list[State]:
    """Return the states of the instrument that result from given amounts of the prior's motions.

    The amounts (S, P) of P motions in S states are in prior standard deviations.
    """
    return states_of(amounts * prior.sigma, prior.components, thermal)


def _of_families(cameras: Mapping[str, CameraCalibration], trace: Callable[[Sequence[State]], Retraced]) -> MotionModel:
    """Return the model of the four motions of each camera in the formulas of paper 001 (Wang et al. 2018)."""
    families = {name: line_family(name) for name in cameras}
    spot_slices, count = _spots_of(cameras), sum(map(len, families.values()))
    spots, parameters = np.zeros((spot_slices[-1].stop, count)), np.zeros((4 * len(cameras), count))
    for k, (camera, spot_rows) in enumerate(zip(cameras.values(), spot_slices, strict=True)):
        block = slice(4 * k, 4 * k + 4)
        spots[spot_rows, block], parameters[block, block] = camera.spot_jacobian, camera.parameter_jacobian
    motions = [motion for family in families.values() for motion in family]
    return MotionModel(spots, parameters, partial(_family_amounts, cameras), partial(_together, motions), trace)


def _spots_of(cameras: Mapping[str, CameraCalibration]) -> list[slice]:
    """Return for each camera the slice of its spot coordinates (rows and columns) among those of all cameras."""
    ends = np.cumsum([0, *(2 * len(camera.channels) for camera in cameras.values())]).tolist()
    return [slice(a, b) for a, b in pairwise(ends)]


def _family_amounts(cameras: Mapping[str, CameraCalibration], noise: np.ndarray) -> np.ndarray:
    """Return the matrix from spot shifts (px) to the amounts of each camera's own four motions, (S, P, D).

    It is the weighted least-squares solution; ``noise`` holds the covariances of the shifts, (S, D, D), in px^2.

    Dimensions: S states, P motions, D spot coordinates (row and column of every spot).
    """
    spot_slices = _spots_of(cameras)
    out = np.zeros((len(noise), 4 * len(cameras), spot_slices[-1].stop))
    for k, (camera, spot_rows) in enumerate(zip(cameras.values(), spot_slices, strict=True)):
        block = slice(4 * k, 4 * k + 4)
        out[:, block, spot_rows] = model_fit.gain(
            noise[:, spot_rows, spot_rows], camera.spot_jacobian, np.eye(4), camera.motions
        )
    return out


def _together(motions: Sequence[ElementaryMotion], amounts: np.ndarray) -> list[State]:
    """Return the states of the instrument that result from given amounts of elementary motions.

    The amounts (S, P) of P motions in S states are in SI units; all motions of a body have the same pivot.
    """
    states: list[State] = []
    for row in amounts.tolist():
        out: dict[str, Motion] = {}
        for motion, amount in zip(motions, row, strict=True):
            out[motion.body] = out.get(motion.body, Motion()).plus(motion.motion(amount))
        states.append(out)
    return states


def _traced(path: MonitorPath, sight: LineSight, states: Sequence[State]) -> Retraced:
    """Return the spot shifts and camera changes of S states; NaN for a state whose light is lost."""
    try:
        return traced_states(path, sight, states)
    except LOST:
        if len(states) == 1:
            return Retraced(*(np.full((1, n), np.nan) for n in (2 * len(path.channels), 4 * len(path.cameras))))
    parts = [_traced(path, sight, [state]) for state in states]
    return Retraced(np.concatenate([p.spots for p in parts]), np.concatenate([p.parameters for p in parts]))


def traced_states(path: MonitorPath, sight: LineSight, states: Sequence[State]) -> Retraced:
    """Return the spot shifts and the changes of the cameras in S states, by an exact trace.

    Parameters
    ----------
    path : MonitorPath
        Optical path of the monitor.
    sight : LineSight
        Lines of sight of the cameras.
    states : sequence of State
        S states.

    Raises
    ------
    AimError, BeamMissedError
        The light of a state is lost.
    """
    placed = path.instrument.assembly.place(states)
    shifts = np.moveaxis(path.coarse_trace(states, placed).centre - path.centre_at_rest, 1, 0).reshape(len(states), -1)
    truth = sight.truth(states, placed)
    return Retraced(shifts, np.concatenate([truth.vector(name) for name in truth.cameras], axis=1))


NOISE = "noise"
"""Name of the images' noise among the causes of an estimate's variance."""
_SLOPE = 2  # pixels more on every side of an image, for its slopes
_PARAMETERS = 4


@dataclass(frozen=True, eq=False)
class Information:
    """Fisher information of a monitor layout's spots about its cameras.

    Dimensions: C spots, D = 2 C spot coordinates (row and column), K cameras.

    Attributes
    ----------
    disturbances : Disturbances
        Prior of the motions, with their derivatives of the spot coordinates and of the cameras' parameters.
    noise : (D, D) ndarray
        Covariance of the spot shifts due to the noise of the images before and after the change, in px^2.
    quantities : mapping of str to (n, 4 K) ndarray
        Name of a quantity -> n linear combinations of the parameters of all cameras, as rows of coefficients; the
        quantity's variance is the mean of the variances of these combinations.
    brightest : (C,) ndarray
        Expected signal of every spot's brightest pixel, as a fraction of saturation.
    """

    disturbances: Disturbances
    noise: np.ndarray
    quantities: Mapping[str, np.ndarray]
    brightest: np.ndarray

    @cached_property
    def gain(self) -> np.ndarray:
        """Matrix from spot shifts to camera parameters with the smallest variance, (4 K, D), in rad or m per pixel.

        Dimensions: K cameras, D spot coordinates (row and column of every spot).
        """
        return self.disturbances.best_gain(self.noise)

    @cached_property
    def splits(self) -> Mapping[str, Split]:
        """Name of each quantity -> the contribution of each motion to its variance, in SI units squared."""
        return {name: split(rows, self.disturbances, self.noise, self.gain) for name, rows in self.quantities.items()}

    def sigma(self, name: str) -> float:
        """Return the posterior standard deviation of a quantity, in SI units."""
        return float(np.sqrt(np.mean(self.splits[name].sigma ** 2)))

    def sigma_before(self, name: str) -> float:
        """Return the prior standard deviation of a quantity, in SI units."""
        return float(np.sqrt(np.mean(self.splits[name].sigma_before ** 2)))

    def slopes(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of a quantity's posterior sigma with respect to the spot Jacobian and to the noise.

        The posterior-variance-minimizing gain does not contribute by its own change. With w = gain' q for a row q of
        the quantity's coefficients, spot Jacobian A, camera Jacobian B, correlations C of the motions and noise
        covariance R, the variance changes by 2 w' dA C (A' w - B' q) + w' dR w.

        Returns
        -------
        tuple of ndarray
            Derivative with respect to A (spot shifts in px per standard deviation of each motion), (D, M), and to R
            (covariance of the spot noise, px^2), (D, D), in the quantity's SI unit per px and per px^2, for D spot
            coordinates (row and column of every spot) and M motions.
        """
        prior, rows = self.disturbances, self.quantities[name]
        weights = rows @ self.gain
        residual = (weights @ prior.spots - rows @ prior.parameters) @ prior.correlation
        scale = 2.0 * self.sigma(name) * len(rows)
        return 2.0 * weights.T @ residual / scale, weights.T @ weights / scale

    def shares(self, name: str, measured: bool = True) -> dict[str, float]:
        """Return the contribution of each cause to the variance of a quantity, in SI units squared.

        A cause is a motion of the prior, or the noise of the images.

        The causes are independent, so that the contributions sum to the variance.

        Parameters
        ----------
        name : str
            Name of the quantity.
        measured : bool
            True for the posterior variance, including noise; False for the prior variance.
        """
        variances = self.splits[name]
        shares = Split.by(variances.after if measured else variances.before, self.disturbances.causes)
        out = {cause: float(np.mean(share)) for cause, share in shares.items()}
        return {**out, NOISE: float(np.mean(variances.noise))} if measured else out

    @property
    def spot_sigma(self) -> np.ndarray:
        """Prior standard deviations of the spot coordinates, (D,), in pixels.

        Dimensions: D spot coordinates (row and column of every spot).
        """
        return np.sqrt(np.diag(self.disturbances.spot_covariance))


def information_of(
    instrument: Instrument,
    prior: Sequence[DisturbancesSpec],
    detector: EmvaDetector,
    backend: Backend,
    ground: GroundGeometry | None = None,
    same_shape: bool = False,
    single: bool = True,
) -> list[Information]:
    """Return the Fisher information of an instrument's monitor spots, one for each prior of the motions.

    Parameters
    ----------
    instrument : Instrument
        Instrument.
    prior : sequence of DisturbancesSpec
        Disturbances files, each of which specifies a prior of the motions.
    detector : EmvaDetector
        Model of the area CCDs.
    backend : Backend
        Backend of the ray trace.
    ground : GroundGeometry | None
        Ground geometry of a stereo pair, which adds the height to the quantities.
    same_shape : bool
        True to assume the same noise for spots of one camera with the same beam width.
    single : bool
        True to compute images in single precision, as elsewhere; False (double) if they are differentiated.

    Raises
    ------
    InputError
        The disturbances name a body that the instrument does not have.
    BeamMissedError, AimError
        Light does not reach the area CCDs.
    """
    path, thermal = MonitorPath(instrument, backend), ThermalModel(instrument)
    noise, brightest = spot_noise(path, detector, same_shape, single)
    rows = quantity_rows(instrument, ground)
    return [
        Information(
            disturbances_of(prior_of_spec(spec, instrument), path, thermal, instrument, backend), noise, rows, brightest
        )
        for spec in prior
    ]


def quantity_rows(instrument: Instrument, ground: GroundGeometry | None) -> dict[str, np.ndarray]:
    """Return the coefficients of each quantity, by name, on the parameters of all cameras, (n, 4 K).

    The quantities are d_alpha, d_beta, d_gamma (rad) and d_f (m) of every camera, as ``camera/d_alpha``; the
    intersection angle of the first two cameras (rad); and the height (m) at the line's centre.

    Dimensions: n linear combinations, over which the quantity's variance is averaged; K cameras with 4 parameters each.
    """
    names = list(instrument.cameras)
    unit = np.eye(_PARAMETERS * len(names))
    out = {
        f"{name}/{key}": unit[None, _PARAMETERS * c + k]
        for c, name in enumerate(names)
        for k, key in enumerate(("d_alpha", "d_beta", "d_gamma", "d_f"))
    }
    if len(names) > 1:
        out["angle"] = (unit[0] - unit[_PARAMETERS])[None]
    if ground is not None:
        first, second = (instrument.cameras[name].line_principal_distance for name in names[:2])
        rows = ground.rows((first, second))
        out["height"] = rows[len(rows) // 2, 2:3]
    return out


def ground_of(instrument: Instrument) -> GroundGeometry | None:
    """Return the ground geometry of a stereo pair of known altitude; None for other instruments.

    It is computed for the focal lengths along the pair's line CCDs.

    Raises
    ------
    InputError
        The rays of the pair do not intersect on the ground.
    """
    distances = {name: model.line_principal_distance for name, model in instrument.cameras.items()}
    return ground_geometry(instrument, distances)


def spot_noise(
    path: MonitorPath, detector: EmvaDetector, same_shape: bool = False, single: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Return the noise covariance of all spot shifts, and the signal of each spot's brightest pixel.

    The covariance of each spot is twice (images before and after) the Cramer-Rao bound of any unbiased fit of its
    image, with the light of its channel and the instrument's number of frames.

    Dimensions: D spot coordinates (row and column of every spot), C spots.

    Parameters
    ----------
    path : MonitorPath
        Optical path of the monitor.
    detector : EmvaDetector
        Model of the area CCDs.
    same_shape : bool
        True to assume the same shape, but not the same light, for spots of one camera with the same beam width.
    single : bool
        True to compute the images in single precision.

    Returns
    -------
    tuple of ndarray
        Covariance (D, D), in px^2, and signal of the brightest pixels (C,), as a fraction of saturation.

    Raises
    ------
    BeamMissedError, AimError
        Light does not reach the area CCDs.
    """
    channels = path.channels
    groups = {(c.camera, c.aperture) if same_shape else c.key: c for c in reversed(channels)}
    shown = tuple(c for c in channels if c in groups.values())
    shown_path = (
        path if len(shown) == len(channels) else MonitorPath(replace(path.instrument, channels=shown), path.backend)
    )
    photons = shown_path.expected_photons([{}], margin=_SLOPE, single=single)[0]
    images = []
    for channel in channels:
        representative = groups[(channel.camera, channel.aperture) if same_shape else channel.key]
        images.append(photons[shown.index(representative)] * (channel.photons / representative.photons))
    bounds, brightest = _image_bounds(np.stack(images)[None], path, detector)
    return joint(2.0 * bounds)[0], brightest[0]


def noise_as_built(path: MonitorPath, detector: EmvaDetector, states: Sequence[State]) -> np.ndarray:
    """Return the noise covariance of all spot shifts for S instruments as built, (S, D, D), in px^2.

    The covariance of each spot is twice the Cramer-Rao bound of its image. Both images, before and after, are those of
    the instrument as built.

    Dimensions: D spot coordinates (row and column of every spot).

    Parameters
    ----------
    path : MonitorPath
        Optical path of the monitor.
    detector : EmvaDetector
        Model of the area CCDs.
    states : sequence of State
        S states as built.

    Raises
    ------
    BeamMissedError, AimError
        Light does not reach the area CCDs, or no image can be computed.
    """
    bounds = [_image_bounds(photons, path, detector)[0] for _, photons in path.iterate_photons(states, margin=_SLOPE)]
    return joint(2.0 * np.concatenate(bounds))


def _image_bounds(photons: np.ndarray, path: MonitorPath, detector: EmvaDetector) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest covariance of each spot's position, (S, C, 2, 2) px^2, and its peak signal, (S, C).

    The covariance is the Cramer-Rao bound; the signal is that of the brightest pixel as a fraction of saturation. The
    images are wider than the CCD by ``_SLOPE`` pixels on every side.

    Dimensions: S states, C spots.
    """
    spec = path.instrument.spec.autocollimator
    exposure = spec.area_ccd.exposure
    model, dark = detector.noise_model(exposure), float(detector.expected_dn(np.zeros((1, 1)), exposure)[0, 0])
    bounds, brightest = np.zeros((*photons.shape[:2], 2, 2)), np.zeros(photons.shape[:2])
    for k in range(photons.shape[1]):
        light = detector.expected_dn(photons[:, k], exposure) - dark
        bounds[:, k] = image_bound(light, dark, model, spec.frames)
        brightest[:, k] = light.max(axis=(1, 2)) / (detector.saturation_dn - dark)
    return bounds, brightest
