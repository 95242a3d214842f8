"""Gradient of the monitor's spots by any number of motions, by reverse-mode AD through the trace.

A spot is the mean of its rays at the area CCD. Two backward passes (row and column) through the monitor's sequence
give its derivative by the numbers of every surface and by the direction in which each ray starts. That direction is
chosen so that the ray meets its node of the return face, hit(direction, numbers) = node. So by the implicit function
theorem the passes go on, through the sequence from pinhole to return face, with the weights

    w = -(d hit / d direction)^-T  dS / d direction.

The numbers of the surfaces follow the motions by the complex step in the rigid-body tree. The cost hardly depends on
how many motions there are; forward mode (``twin.monitor.monitor_derivative``) traces all rays once for each of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from optics.geometry.tree import AT_REST, COMPLEX_STEP, FIGURE, ORIGIN, PlacedBodies, State
from optics.numerics.number_tree import Path, leaves
from optics.raytrace.aim import RayFan, aim
from optics.raytrace.derivatives import vjp
from optics.raytrace.system import SystemBatch, assemble
from optics.raytrace.trace import make_rays, trace
from scenes.models.instrument_model import Instrument
from twin.monitor.monitor_beams import AIM_TOLERANCE, MonitorBeams
from twin.monitor.monitor_derivative import hit_slopes, size_steps
from twin.monitor.motions import FIGURE_TERMS, ElementaryMotion

CHUNK = 1 << 17
"""Rays, of all channels together, that go back through the trace at once: what they need is about 0.3 GB."""


def every_motion(instrument: Instrument) -> tuple[ElementaryMotion, ...]:
    """All elementary motions there are: shifts, turns and scale of every body, low Zernike figures of every mirror.

    Mirrors turn about the middle of their clear aperture, all other bodies about their origin.
    """
    out = []
    mirrors = {e.body for e in instrument.assembly.elements.values() if not e.surface.is_plane}
    for body in instrument.assembly.tree.bodies:
        pivot = "centre" if body.path in mirrors else ORIGIN
        for kind, axes in (("shift", 3), ("rotate", 3), ("scale", 1)):
            out += [ElementaryMotion(body.path, kind, axis, pivot) for axis in range(axes)]
        if body.path in mirrors:
            out += [ElementaryMotion(body.path, "figure", j, pivot) for j in FIGURE_TERMS]
    return tuple(out)


def spot_gradient(
    path: MonitorBeams, motions: Sequence[ElementaryMotion], about: State | None = None, chunk: int = CHUNK
) -> np.ndarray:
    """Derivative of every spot's position by elementary motions, as ``twin.monitor.monitor_derivative.spot_jacobian``.

    Args:
        path: the monitor; all of its nodes are traced (``path.coarse`` is enough for the mean of a smooth spot).
        motions: M elementary motions.
        about: the state at which to differentiate, by default the unperturbed instrument. A motion is added to the
            component of that name: the rotation vector's, the shift's, the scale's or the figure's.
        chunk: rays of all channels together that are traced back at once; bounds the memory.

    Returns:
        (C, 2, M): row and column, pixels per radian, metre or unit.

    Raises:
        ValueError: a motion has another pivot than the state's motion of that body.
        AimError: in the state ``about`` a beam does not reach its return face.
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
    once = np.arange(0, outgoing.count, 2)
    rays = max(chunk // len(path.channels), 1)
    size = monitor.size[once]
    pitch = path.pitch * monitor.size
    face_steps = size_steps(placed, [channel.face_body for channel in path.channels])
    chip_steps = size_steps(placed, [channel.ccd_body for channel in path.channels])
    for start in range(0, path.nodes.count, rays):
        piece = slice(start, start + rays)
        place, heading = launch[:, piece], launched[:, piece]
        across, slope = hit_slopes(path.backend, outgoing.take(once), place, heading)
        place, heading, across = (np.repeat(array, 2, axis=0) for array in (place, heading, across))
        # system 2c is the row of channel c's spot (y of the CCD), 2c + 1 its column (x)
        share = path.nodes.share[piece, None] * np.array([[[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]]])
        weight = np.tile(share, (len(path.channels), 1, 1)) / pitch[:, None, None]
        there = vjp(path.backend, monitor, place, heading, weight, monitor_steps.names)
        turn = np.einsum("bnkx,bnx->bnk", across, there.direction)
        back = -np.linalg.solve(np.repeat(np.swapaxes(slope, -1, -2), 2, axis=0), turn[..., None])[..., 0]
        aside = np.concatenate([back, np.zeros_like(back[..., :1])], axis=-1)
        node = vjp(path.backend, outgoing, place, heading, aside, outgoing_steps.names)
        pinhole = (there.position + node.position).sum(axis=1).reshape(len(path.channels), 2, 3)
        out += monitor_steps.dot(there.values) + outgoing_steps.dot(node.values)
        out += np.einsum("ckx,cmx->ckm", pinhole, source)
        # nodes ride on the return face as it grows, and places are counted in pixels, which grow with the chip
        goal = np.repeat(path.target[:, piece], 2, axis=0)
        ridden = np.einsum("bnx,bnx->b", back, goal).reshape(-1, 2)
        out -= ridden[:, :, None] * face_steps[:, None]
        start_rays = make_rays(path.backend, launch[:, piece], launched[:, piece])
        hit = trace(path.backend, monitor.take(once), start_rays).place()[..., ::-1]
        spot = np.einsum("n,bnk->bk", path.nodes.share[piece], hit) / (path.pitch * size[:, None] ** 2)
        out -= spot[:, :, None] * chip_steps[:, None]
    return out


@dataclass(frozen=True, eq=False)
class _Tangents:
    """Derivatives of one sequence's numbers by M motions, for C channels: per element, path -> (C, M)."""

    values: tuple[Mapping[Path, np.ndarray], ...]

    @classmethod
    def of(cls, systems: SystemBatch, channels: int) -> _Tangents:
        """Those that are not all zero, from a batch of C x M systems with a step each."""
        assert systems.tangents is not None
        return cls(
            tuple(
                {path: v.reshape(channels, -1) for path, v in leaves(own).items() if np.any(v)}
                for own in systems.tangents
            )
        )

    def dot(self, slopes: Sequence[Mapping[Path, np.ndarray]]) -> np.ndarray:
        """Sum over numbers of slope (C, 2) times derivative by the motions: (C, 2, M)."""
        parts = [
            slope[name].reshape(len(table), 2)[:, :, None] * table[:, None]
            for own, slope in zip(self.values, slopes, strict=True)
            for name, table in own.items()
        ]
        return np.asarray(sum(parts))

    @property
    def names(self) -> list[tuple[Path, ...]]:
        """Paths of the numbers that some motion changes, per element."""
        return [tuple(own) for own in self.values]


def _numbers(
    path: MonitorBeams,
    sequence: str,
    middle: State,
    states: Sequence[State],
    placed: PlacedBodies,
    steps: Sequence[tuple[str, str, int]],
) -> tuple[SystemBatch, _Tangents]:
    """The numbers of a sequence of all channels, each twice (for row and column), and their derivatives."""
    assembly = path.instrument.assembly
    names = [f"{channel.key}/{sequence}" for channel in path.channels]
    systems = assemble(assembly, names, [middle])
    # the union of the states decides the kernel, so that no state of its own adds a figure to another one's mirror
    tangents = assemble(assembly, names, states, steps, placed)
    return systems.take(np.repeat(np.arange(systems.count), 2)), _Tangents.of(tangents, len(names))


def _named(motion: ElementaryMotion, about: State) -> State:
    """The state ``about`` in which the motion's body names its pivot and, with zero amplitude, its figure term."""
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
    """``about`` with every figure term that some state names, so that all have the same structure."""
    figures: dict[str, dict[int, float]] = {}
    for state in states:
        for body, motion in state.items():
            if motion.figure:
                figures.setdefault(body, {}).update(motion.figure)
    return {**about, **{body: replace(about.get(body, AT_REST), figure=terms) for body, terms in figures.items()}}


def _aimed(path: MonitorBeams, about: State) -> tuple[np.ndarray, np.ndarray]:
    """Launch points and directions (C, N, 3) of the rays that meet the nodes of the return faces in the state."""
    nominal = path.nominal
    start = np.broadcast_to(nominal.position, nominal.direction.shape)
    if not about:
        return start, nominal.direction
    placed = path.instrument.assembly.place([about])
    systems = assemble(path.instrument.assembly, [f"{c.key}/outgoing" for c in path.channels], [about], placed=placed)
    origin = np.concatenate([placed.translation[:, placed.index[c.reticle_body]] for c in path.channels])
    place = np.broadcast_to(origin[:, None], start.shape)
    axes, slopes = hit_slopes(path.backend, systems, place, nominal.direction)
    fan = RayFan(place, nominal.direction, axes)
    q, _ = aim(path.backend, systems, fan, path.target, jacobian=slopes, tolerance=AIM_TOLERANCE)
    return fan.at(q)
