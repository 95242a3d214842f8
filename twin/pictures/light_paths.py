"""Rays to be drawn: imaging beams and monitor beams of a perturbed instrument, for figures and the 3-D view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from optics.geometry.aperture import Aperture
from optics.geometry.tree import PlacedBodies, State
from optics.numerics.backend import Backend
from optics.raytrace.aim import RayFan, aim, transverse_axes
from optics.raytrace.assembly import points_to_world
from optics.raytrace.system import SystemBatch, assemble
from optics.raytrace.trace import make_rays, trace
from scenes.models.camera_model import line_body
from scenes.models.instrument_model import Instrument
from scenes.specs.instrument import BASE

RIM = 48
"""Rays around the edge of a beam; the first is at +x of the stop or face, then counterclockwise."""

FIELDS = ("left edge", "centre", "right edge")
"""Imaging beams that are drawn: the +Y end of the line CCD, its middle, its -Y end."""

_AIM = 1e-6
"""How well an edge ray meets the edge, metres: drawings need no better."""


@dataclass(frozen=True, eq=False)
class Beam:
    """One beam: its middle ray and ``RIM`` rays along its edge.

    Attributes
    ----------
    camera : str
        whose.
    name : str
        ``imaging/left edge`` ... or ``monitor/`` and the channel's name.
    vertices : np.ndarray
        (1 + RIM, K, 3) world points, middle ray first, metres; imaging beams run from the scene to the line CCD,
        monitor beams from the pinhole to the area CCD.
    footprints : Mapping[tuple[str, int], np.ndarray]
        (mirror, pass) -> (1 + RIM, 2) points in the mirror's x, y, metres; pass 0 first, then 1.
    """

    camera: str
    name: str
    vertices: np.ndarray
    footprints: Mapping[tuple[str, int], np.ndarray]

    @property
    def is_monitor(self) -> bool:
        """Whether it belongs to the monitor."""
        return self.name.startswith("monitor/")


@dataclass(frozen=True, eq=False)
class LightPaths:
    """All beams of an instrument in one state, and where its bodies stand."""

    beams: tuple[Beam, ...]
    placed: PlacedBodies

    def of(self, camera: str, monitor: bool) -> tuple[Beam, ...]:
        """The beams of one camera and kind."""
        return tuple(b for b in self.beams if b.camera == camera and b.is_monitor == monitor)


def trace_light_paths(instrument: Instrument, backend: Backend, state: State, reach: float = 0.0) -> LightPaths:
    """Trace the beams.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    backend : Backend
        Where to trace.
    state : State
        What is perturbed.
    reach : float
        How far the imaging beams are drawn beyond the first mirror toward the scene, metres; 0 takes the distance of
        the farthest 180-deg prism, without a monitor the longest camera's length.
    """
    placed = instrument.assembly.place([state])
    spec = instrument.spec
    distances = [one.prism_180.distance for name in spec.cameras for one in spec.channels_of(name).values()]
    reach = reach or max(distances, default=0.0) or _length(instrument, placed)
    beams = _imaging(instrument, backend, state, placed, reach)
    if instrument.channels:
        beams += _monitor(instrument, backend, state, placed)
    return LightPaths(tuple(beams), placed)


def _length(instrument: Instrument, placed: PlacedBodies) -> float:
    """How far the surfaces of the longest camera lie apart, metres."""
    lengths = []
    for name, model in instrument.cameras.items():
        places = np.array([placed.pose(f"{BASE}/{name}/{surface}").translation for surface in model.mirrors])
        lengths.append(float(np.max(np.linalg.norm(places[:, None] - places, axis=-1))))
    return max(lengths) or float(max(model.spec.entrance_pupil for model in instrument.cameras.values()))


def _circle(radius: float) -> np.ndarray:
    """(1 + RIM, 2): the centre, then the edge."""
    angle = 2.0 * np.pi * np.arange(RIM) / RIM
    edge = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([np.zeros((1, 2)), radius * edge])


def _radius(aperture: Aperture | None) -> float:
    assert aperture is not None
    return aperture.inscribed


def _imaging(instrument: Instrument, backend: Backend, state: State, placed: PlacedBodies, reach: float) -> list[Beam]:
    """Traced backward, from points of the line CCDs through the edge of the stops; all cameras at once."""
    assembly, names = instrument.assembly, list(instrument.cameras)
    rays = 1 + RIM
    points, guesses, targets = [], [], []
    for camera in names:
        model = instrument.cameras[camera]
        half = 0.5 * model.spec.line.pixels * model.spec.line.pitch
        ends = np.array([[0.0, y, 0.0] for y in (half, 0.0, -half)])
        ends = points_to_world(placed, line_body(f"{BASE}/{camera}"), ends)[0]
        points.append(np.repeat(ends, rays, axis=0))
        guesses.append(instrument.toward_optics(placed, camera)[0])
        stop = assembly.elements[f"{camera}/{model.spec.stop}"].aperture
        targets.append(np.tile(_circle(_radius(stop)), (len(FIELDS), 1)))
    to_stop = assemble(assembly, [f"{camera}/image_to_stop" for camera in names], [state], placed=placed)
    position, direction = _aimed(backend, to_stop, np.array(points), np.array(guesses)[:, None], np.array(targets))
    chains = [assembly.sequences[f"{camera}/image_to_object"] for camera in names]
    systems = assemble(assembly, chains, [state], placed=placed)
    traced = trace(backend, systems, make_rays(backend, position, direction), keep=range(len(chains[0])), world=True)
    assert traced.world is not None
    leaving = traced.numpy(traced.world)[1]
    out = []
    for i, (camera, chain) in enumerate(zip(names, chains, strict=True)):
        hits = [traced.hit(k)[i] for k in range(len(chain))]
        path = [placed.pose(assembly.elements[n].body).apply(h) for n, h in zip(chain, hits, strict=True)]
        # end on a plane square to the middle ray
        square = leaving[i, rays]
        along = (path[-1][rays] + reach * square - path[-1]) @ square / (leaving[i] @ square)
        vertices = np.stack([path[-1] + along[:, None] * leaving[i], *path[::-1], position[i]], axis=1)
        for j, field in enumerate(FIELDS):
            own = slice(j * rays, (j + 1) * rays)
            prints = {(name.rpartition("/")[2], 0): hit[own, :2] for name, hit in zip(chain, hits, strict=True)}
            out.append(Beam(camera, f"imaging/{field}", vertices[own], prints))
    return out


def _monitor(instrument: Instrument, backend: Backend, state: State, placed: PlacedBodies) -> list[Beam]:
    """From every pinhole through the edge of its return face and back to the area CCD; all channels at once."""
    assembly, channels = instrument.assembly, instrument.channels
    guess = np.array([instrument.toward_optics(placed, c.camera)[0] for c in channels])[:, None]
    start = np.array([placed.pose(c.reticle_body).translation for c in channels])[:, None]
    outgoing = assemble(assembly, [f"{c.key}/outgoing" for c in channels], [state], placed=placed)
    target = np.array([_circle(_radius(assembly.elements[f"{c.key}/return_face"].aperture)) for c in channels])
    position, direction = _aimed(backend, outgoing, start, guess, target)
    systems = assemble(assembly, [f"{c.key}/monitor" for c in channels], [state], placed=placed)
    count = len(assembly.sequences[f"{channels[0].key}/monitor"])
    traced = trace(backend, systems, make_rays(backend, position, direction), keep=range(count))
    hits = [traced.hit(k) for k in range(count)]
    out = []
    for i, channel in enumerate(channels):
        path = [position[i]]
        prints: dict[tuple[str, int], np.ndarray] = {}
        for k, name in enumerate(assembly.sequences[f"{channel.key}/monitor"]):
            path.append(placed.pose(assembly.elements[name].body).apply(hits[k][i]))
            mirror = name.rpartition("/")[2]
            if mirror in instrument.cameras[channel.camera].mirrors:
                prints[mirror, int((mirror, 0) in prints)] = hits[k][i][:, :2]
        out.append(Beam(channel.camera, f"monitor/{channel.name}", np.stack(path, axis=1), prints))
    return out


def _aimed(
    backend: Backend, systems: SystemBatch, points: np.ndarray, guess: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rays from points (B, N or 1, 3) through targets (B, N, 2) of the last element; position, direction (B, N, 3)."""
    points = np.broadcast_to(points, (*target.shape[:2], 3))
    guesses = np.broadcast_to(guess, points.shape)
    fan = RayFan(points, guesses, transverse_axes(guesses, np.broadcast_to([0.0, 1.0, 0.0], guesses.shape)))
    q, _ = aim(backend, systems, fan, target, tolerance=_AIM)
    return fan.at(q)
