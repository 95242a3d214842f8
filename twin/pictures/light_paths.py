"""Rays for drawing: imaging beams and monitor beams of a perturbed instrument, for plots and the 3-D view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from optics.geometry.aperture import Aperture
from optics.geometry.tree import PlacedBodies, State
from optics.numerics.backend import Backend
from optics.numerics.quadrature import circle
from optics.raytrace.aim import aimed_rays
from optics.raytrace.assembly import points_to_world
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.models.camera_model import line_body
from scenes.models.instrument_model import Instrument
from scenes.specs.instrument import BASE

RIM = 48
"""Number of rays around the edge of a beam; the first is at +x of the stop or face, then counterclockwise."""

FIELDS = ("left edge", "centre", "right edge")
"""Imaging beams that are drawn: the +Y end of the line CCD, its middle, its -Y end."""

_AIM = 1e-6
"""Aiming tolerance of edge rays, metres, sufficient for drawings."""


@dataclass(frozen=True, eq=False)
class Beam:
    """Beam with its middle ray and ``RIM`` rays along its edge.

    Attributes
    ----------
    camera : str
        Name of the camera.
    name : str
        ``imaging/left edge`` ... or ``monitor/`` and the channel's name.
    vertices : (1 + RIM, K, 3) ndarray
        Points in the base frame, middle ray first, metres; imaging beams run from the scene to the line CCD, monitor
        beams from the pinhole to the area CCD.
    footprints : mapping
        (mirror, pass) -> (1 + RIM, 2) points where the rays meet the mirror, in its x, y, metres; pass is 0 when the
        beam meets the mirror first, and 1 when it meets it again.
    """

    camera: str
    name: str
    vertices: np.ndarray
    footprints: Mapping[tuple[str, int], np.ndarray]

    @property
    def is_monitor(self) -> bool:
        """True for a beam of the autocollimation monitor, False for an imaging beam."""
        return self.name.startswith("monitor/")


@dataclass(frozen=True, eq=False)
class LightPaths:
    """All beams of an instrument in one state, and the poses of its bodies.

    Attributes
    ----------
    beams : tuple of Beam
        Beams of all cameras.
    placed : PlacedBodies
        Poses of the bodies.
    """

    beams: tuple[Beam, ...]
    placed: PlacedBodies

    def of(self, camera: str, monitor: bool) -> tuple[Beam, ...]:
        """Return the beams of one camera: of its autocollimation monitor if ``monitor`` is true, else imaging beams."""
        return tuple(b for b in self.beams if b.camera == camera and b.is_monitor == monitor)


def trace_light_paths(instrument: Instrument, backend: Backend, state: State, length: float = 0.0) -> LightPaths:
    """Trace the beams of an instrument.

    Parameters
    ----------
    instrument : Instrument
        Instrument.
    backend : Backend
        Array backend of the trace.
    state : State
        Perturbed state.
    length : float
        Length of the imaging beams beyond the first mirror toward the scene, metres; 0 takes the distance of the
        farthest 180-deg prism, without a monitor the longest camera's length.
    """
    placed = instrument.assembly.place([state])
    spec = instrument.spec
    distances = [c.prism_180.distance for name in spec.cameras for c in spec.channels_of(name).values()]
    length = length or max(distances, default=0.0) or _length(instrument, placed)
    beams = _imaging(instrument, backend, state, placed, length)
    if instrument.channels:
        beams += _monitor(instrument, backend, state, placed)
    return LightPaths(tuple(beams), placed)


def _length(instrument: Instrument, placed: PlacedBodies) -> float:
    """Return the largest distance between two surfaces of a camera, metres."""
    lengths = []
    for name, model in instrument.cameras.items():
        vertices = np.array([placed.pose(f"{BASE}/{name}/{surface}").translation for surface in model.mirrors])
        lengths.append(float(np.max(np.linalg.norm(vertices[:, None] - vertices, axis=-1))))
    return max(lengths) or float(max(model.spec.entrance_pupil for model in instrument.cameras.values()))


def _circle(radius: float) -> np.ndarray:
    """Return the centre and ``RIM`` points along the edge of a circle, (1 + RIM, 2), in the unit of its ``radius``."""
    return np.concatenate([np.zeros((1, 2)), radius * circle(RIM)])


def _radius(aperture: Aperture | None) -> float:
    """Return the radius of the largest circle inside an aperture about its centre, metres."""
    assert aperture is not None
    return aperture.inscribed


def _imaging(instrument: Instrument, backend: Backend, state: State, placed: PlacedBodies, length: float) -> list[Beam]:
    """Trace the imaging beams of all cameras backward, from points of the line CCDs through the edge of the stops."""
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
    position, direction = aimed_rays(
        backend, to_stop, np.array(points), np.array(guesses)[:, None], np.array(targets), _AIM
    )
    chains = [assembly.sequences[f"{camera}/image_to_object"] for camera in names]
    systems = assemble(assembly, chains, [state], placed=placed)
    traced = trace(backend, systems, make_rays(backend, position, direction), keep=range(len(chains[0])), world=True)
    assert traced.world is not None
    leaving = traced.numpy(traced.world)[1]
    out = []
    for i, (camera, chain) in enumerate(zip(names, chains, strict=True)):
        hits = [traced.hit(k)[i] for k in range(len(chain))]
        path = [placed.pose(assembly.elements[n].body).apply(h) for n, h in zip(chain, hits, strict=True)]
        # end on a plane perpendicular to the middle ray
        normal = leaving[i, rays]
        along = (path[-1][rays] + length * normal - path[-1]) @ normal / (leaving[i] @ normal)
        vertices = np.stack([path[-1] + along[:, None] * leaving[i], *path[::-1], position[i]], axis=1)
        for j, field in enumerate(FIELDS):
            field_rows = slice(j * rays, (j + 1) * rays)
            prints = {(name.rpartition("/")[2], 0): hit[field_rows, :2] for name, hit in zip(chain, hits, strict=True)}
            out.append(Beam(camera, f"imaging/{field}", vertices[field_rows], prints))
    return out


def _monitor(instrument: Instrument, backend: Backend, state: State, placed: PlacedBodies) -> list[Beam]:
    """Trace the monitor beams of all channels from the pinhole via the return face to the area CCD.

    The return face is the mirror surface that sends the light back.
    """
    assembly, channels = instrument.assembly, instrument.channels
    guess = np.array([instrument.toward_optics(placed, c.camera)[0] for c in channels])[:, None]
    start = np.array([placed.pose(c.reticle_body).translation for c in channels])[:, None]
    outgoing = assemble(assembly, [f"{c.key}/outgoing" for c in channels], [state], placed=placed)
    target = np.array([_circle(_radius(assembly.elements[f"{c.key}/return_face"].aperture)) for c in channels])
    position, direction = aimed_rays(backend, outgoing, start, guess, target, _AIM)
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
