"""Which prisms stand in the way of light: of the imaging beams, and of monitor beams that are not their own.

A 180-deg prism has to stand before its camera, since its channel uses a part of the pupil; what it takes of the imaging
beam is reported, and how much of that its channel uses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import ConvexHull

from optics.geometry.aperture import Circle
from optics.geometry.solid import solid_mesh
from optics.numerics.backend import Backend
from optics.raytrace.aim import RayFan, aim, transverse_axes
from optics.raytrace.assembly import points_to_world
from optics.raytrace.system import assemble, media_along
from optics.raytrace.trace import make_rays, trace
from scenes.models.camera_assembly import line_body
from scenes.specs.channel import BASE, PRISM_180

if TYPE_CHECKING:
    from scenes.models.instrument_model import Instrument

RAYS = 400
"""Rays in a beam, spread evenly over its cross-section: shares are good to about half a percent."""

_TOUCHING = 1e-6  # length inside a body below which a ray only touches it, metres
_AIM = 1e-6  # how well rays meet their places on a stop or face, metres
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True)
class Obstruction:
    """A prism in a beam.

    Attributes:
        body: path of the prism.
        beam: e.g. ``forward/imaging`` or ``forward/left``.
        share: of the beam's cross-section that it takes; for imaging the largest along the line.
        used: part of ``share`` that its own channel's clear aperture uses; 0 for beams that it has no business in.
    """

    body: str
    beam: str
    share: float
    used: float = 0.0


def find_obstructions(instrument: Instrument, backend: Backend) -> tuple[Obstruction, ...]:
    """All prisms, the central one included, that take a part of a beam; by beam, then by body.

    Faces that a monitor beam means to meet, and the glass between them, are not in its way.
    """
    placed = instrument.assembly.place()
    solids = {}
    for solid in instrument.solids:
        corners = placed.pose(solid.path).apply(solid_mesh(solid, placed).mesh.vertices)
        solids[solid.path] = ConvexHull(corners).equations
    found: dict[tuple[str, str], Obstruction] = {}
    for camera in instrument.cameras:
        for segments in imaging_segments(instrument, backend, camera):
            for path, planes in solids.items():
                taken = rays_taken(segments, planes)
                if not taken.any():
                    continue
                used = float(np.mean(taken & _used(instrument, path, segments)))
                new = Obstruction(path, f"{camera}/imaging", float(np.mean(taken)), used)
                if (new.beam, path) not in found or found[new.beam, path].share < new.share:
                    found[new.beam, path] = new
    for key, segments, inside in _monitor(instrument, backend):
        for path, planes in solids.items():
            outside = segments[:, [medium != path for medium in inside]]
            taken = rays_taken(outside, planes)
            if taken.any():
                found[key, path] = Obstruction(path, key, float(np.mean(taken)))
    return tuple(found[name] for name in sorted(found))


def rays_taken(segments: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Which rays, segments (N, K, 2, 3), go through the body ``planes`` . (x, 1) <= 0, (F, 4); (N,)."""
    start, way = segments[:, :, 0], segments[:, :, 1] - segments[:, :, 0]
    height = start @ planes[:, :3].T + planes[:, 3]
    slope = way @ planes[:, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        at = -height / slope
    enter = np.max(np.where(slope < 0.0, at, 0.0), axis=-1, initial=0.0)
    leave = np.min(np.where(slope > 0.0, at, 1.0), axis=-1, initial=1.0)
    beside = np.any((slope == 0.0) & (height >= 0.0), axis=-1)
    length = (leave - enter) * np.linalg.norm(way, axis=-1)
    return np.asarray(np.any((length > _TOUCHING) & ~beside, axis=-1))


def _disk(radius: float) -> np.ndarray:
    """Points spread evenly over a disk, (RAYS, 2)."""
    k = np.arange(RAYS)
    r = radius * np.sqrt((k + 0.5) / RAYS)
    return np.stack([r * np.cos(_GOLDEN * k), r * np.sin(_GOLDEN * k)], axis=-1)


def imaging_segments(instrument: Instrument, backend: Backend, camera: str) -> list[np.ndarray]:
    """Rays from the scene to both ends and the middle of the line, (N, K, 2, 3) each, world."""
    assembly, model, placed = instrument.assembly, instrument.cameras[camera], instrument.assembly.place()
    half = 0.5 * model.spec.line.pixels * model.spec.line.pitch
    line = np.array([[0.0, y, 0.0] for y in (half, 0.0, -half)])
    points = points_to_world(placed, line_body(f"{BASE}/{camera}"), line)[0]
    stop = assembly.elements[f"{camera}/{model.spec.stop}"].aperture
    assert stop is not None
    radius = stop.inscribed
    start = np.repeat(points, RAYS, axis=0)[None]
    chain = assembly.sequences[f"{camera}/image_to_object"]
    position, direction = _aimed(
        instrument, backend, camera, f"{camera}/image_to_stop", start, np.tile(_disk(radius), (3, 1))
    )
    systems = assemble(assembly, [chain])
    traced = trace(backend, systems, make_rays(backend, position, direction), keep=range(len(chain)), world=True)
    assert traced.world is not None
    places = [position[0]]
    for k, name in enumerate(chain):
        places.append(placed.pose(assembly.elements[name].body).apply(traced.hit(k)[0]))
    everything = placed.translation[0] - places[-1].mean(axis=0)
    reach = 2.0 * float(np.max(np.linalg.norm(everything, axis=-1)))
    places.append(places[-1] + reach * traced.numpy(traced.world)[1][0])
    return np.split(_segments(places), 3)


def _monitor(instrument: Instrument, backend: Backend) -> list[tuple[str, np.ndarray, list[str | None]]]:
    """For every channel its key, its rays (N, K, 2, 3) from pinhole to area CCD, and the solid around each segment."""
    assembly, placed, out = instrument.assembly, instrument.assembly.place(), []
    for channel in instrument.channels:
        face = assembly.elements[f"{channel.key}/return_face"].aperture
        assert isinstance(face, Circle)
        start = np.broadcast_to(placed.pose(channel.reticle_body).translation, (1, RAYS, 3))
        position, direction = _aimed(
            instrument, backend, channel.camera, f"{channel.key}/outgoing", start, _disk(face.radius)
        )
        chain = assembly.sequences[f"{channel.key}/monitor"]
        systems = assemble(assembly, [chain])
        traced = trace(backend, systems, make_rays(backend, position, direction), keep=range(len(chain)))
        places = [position[0]]
        for k, name in enumerate(chain):
            places.append(placed.pose(assembly.elements[name].body).apply(traced.hit(k)[0]))
        media = media_along(assembly.sequence(f"{channel.key}/monitor"))
        out.append((channel.key, _segments(places), [medium.solid for medium in media[:-1]]))
    return out


def _segments(places: list[np.ndarray]) -> np.ndarray:
    """Segments (N, K, 2, 3) between consecutive places of N rays."""
    way = np.stack(places, axis=1)
    return np.stack([way[:, :-1], way[:, 1:]], axis=2)


def _aimed(
    instrument: Instrument, backend: Backend, camera: str, sequence: str, start: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rays from points (1, N, 3) of a focal plane through targets (N, 2) of a sequence's last element."""
    guess = np.broadcast_to(instrument.toward_optics(instrument.assembly.place(), camera)[0], start.shape)
    fan = RayFan(start, guess, transverse_axes(guess, np.broadcast_to([0.0, 1.0, 0.0], guess.shape)))
    systems = assemble(instrument.assembly, [sequence])
    q, _ = aim(backend, systems, fan, target[None], tolerance=_AIM)
    return fan.at(q)


def _used(instrument: Instrument, path: str, segments: np.ndarray) -> np.ndarray:
    """Which imaging rays (N, K, 2, 3) pass the clear aperture through which a channel's beam enters a prism, (N,)."""
    assembly, placed = instrument.assembly, instrument.assembly.place()
    for channel in instrument.channels:
        prism = channel.prism_body(PRISM_180)
        if path == prism or path.startswith(f"{prism}/"):
            mirrors = len(instrument.cameras[channel.camera].mirrors)
            element = assembly.elements[assembly.sequences[f"{channel.key}/outgoing"][mirrors]]
            assert element.aperture is not None
            into = placed.pose(element.body).inverse()
            start, end = into.apply(segments[:, -1, 0]), into.apply(segments[:, -1, 1])
            at = start - (start[:, 2:] / (end - start)[:, 2:]) * (end - start)
            return np.asarray(element.aperture.contains(at[:, 0], at[:, 1]))
    return np.zeros(len(segments), dtype=bool)
