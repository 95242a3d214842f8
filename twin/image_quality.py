"""Image quality of an instrument's cameras in many perturbed states: wavefront error, defocus, MTF at Nyquist.

All of it at fixed pixels of the line CCD, which look at whatever place of the scene the state brings there: the chief
ray of the pixel is traced back to the scene, and the beam of that direction forward to the line. A field of +1 is the
left end of the line (+Y'), -1 the right one.

Wavefront errors are rms over the stop's area. The reference sphere stands about the pixel, which the chief ray meets,
with the radius of the nominal exit pupil; piston and tilt are taken out. Best focus is where along the light the rms
is least, with the exact phase sqrt(1 - u^2 - v^2) of a shift. The MTF is that of the traced pupil, polychromatic if
the camera describes a band, times the pixel and all else that the band says of its line CCD.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from optics import quadrature, zernike
from optics.aim import AimError
from optics.aperture import Circle
from optics.assembly import points_to_world
from optics.backend import Backend
from optics.imaging import ImagingRays, imaging_rays
from optics.line_of_sight import chief_rays
from optics.pupil_edge import WORST_BEND
from optics.pupil_function import WORST_RESIDUAL
from optics.pupil_stack import PupilStack
from optics.system import assemble
from optics.trace import BeamMissedError
from optics.tree import State
from optics.wavefront import eikonal, path_to_sphere
from scenes.camera import CameraSpec
from scenes.camera_assembly import line_body
from scenes.camera_model import LAUNCH_DISTANCE
from scenes.channel import BASE
from scenes.instrument_model import Instrument
from scenes.resolved import target_band
from twin.line_ccd import band_factors

FIELDS = (1.0, 0.7, 0.0, -0.7, -1.0)
"""Field points, as shares of half the line, left end first."""

PLACES = {"left": 1.0, "centre": 0.0, "right": -1.0}
"""Fields of which results are named."""

WAVELENGTH = 650e-9
"""Of the waves in which wavefront errors are told, metres."""

RINGS = 7
"""Of the quadrature over the stop: exact for squares of wavefronts up to order 13."""

COLOURS = 5
"""Gauss' wavelengths of a band. At one frequency inside of all cut-offs four are right to 1e-7; cut-offs inside the
band need more, but there the MTF is next to nothing."""

AT_ONCE = 40
"""States traced in one launch, to bound memory: 40 take 60 MB."""


@dataclass(frozen=True, eq=False)
class CameraQuality:
    """One camera in S states at F fields. NaN where it is not known; ``reasons`` says why.

    Attributes:
        wfe: rms wavefront error, piston and tilt removed, (S, F), waves.
        wfe_refocused: the same at each field's own best focus, (S, F), waves.
        defocus: best focus minus line CCD along its normal, positive downstream (away from the optics), (S, F), metres.
        mtf_along_line, mtf_along_track: at the Nyquist frequency, (S, F).
        nyquist: cycles/m.
        wavelengths: first and last of the light of the MTF, metres.
        reasons: of every state; empty if all is known.
    """

    wfe: np.ndarray
    wfe_refocused: np.ndarray
    defocus: np.ndarray
    mtf_along_line: np.ndarray
    mtf_along_track: np.ndarray
    nyquist: float
    wavelengths: tuple[float, float]
    reasons: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class ImageQuality:
    """All cameras.

    Attributes:
        fields: shares of half the line, (F,).
        wavelength: of the waves, metres.
        cameras: by name.
    """

    fields: tuple[float, ...]
    wavelength: float
    cameras: Mapping[str, CameraQuality]

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is not known, and why."""
        return tuple(
            f"image quality of {name}: {reason}" for name, c in self.cameras.items() for reason in c.reasons if reason
        )

    def to_dicts(self) -> list[dict[str, Any]]:
        """Contents of quality.json of every state; what is not known is null.

        Of each camera mean and worst wavefront error over the fields, the mean of those at best focus, and defocus and
        MTF at those of PLACES that are among the fields.
        """
        where = {place: self.fields.index(field) for place, field in PLACES.items() if field in self.fields}
        states = range(len(next(iter(self.cameras.values())).reasons))
        return [{"cameras": {name: _camera_dict(c, s, where) for name, c in self.cameras.items()}} for s in states]


def _camera_dict(camera: CameraQuality, s: int, where: Mapping[str, int]) -> dict[str, Any]:
    def at(values: np.ndarray, unit: float = 1.0) -> dict[str, float | None]:
        return {place: _known(unit * values[s, k]) for place, k in where.items()}

    out: dict[str, Any] = {
        "wfe_rms_waves": _known(np.mean(camera.wfe[s])),
        "wfe_rms_waves_focus_removed": _known(np.mean(camera.wfe_refocused[s])),
        "wfe_worst_waves": _known(np.max(camera.wfe[s])),
        "defocus_um": at(camera.defocus, 1e6),
        "mtf_along_line": at(camera.mtf_along_line),
        "mtf_along_track": at(camera.mtf_along_track),
    }
    return {**out, "reason": camera.reasons[s]} if camera.reasons[s] else out


def _known(value: float | np.floating[Any]) -> float | None:
    return float(value) if np.isfinite(value) else None


def image_quality(
    instrument: Instrument,
    backend: Backend,
    states: Sequence[State],
    fields: Sequence[float] = FIELDS,
    wavelength: float = WAVELENGTH,
) -> ImageQuality:
    """Image quality of every camera in every state.

    Args:
        instrument: with its cameras.
        backend: where to trace.
        states: S states, traced together.
        fields: shares of half the line, +1 at its left end (+Y'), from -1 to 1.
        wavelength: of the waves in which wavefront errors are told, metres.

    Returns:
        Numbers of each state, which do not depend on the others but for rounding. A state whose beam is lost or cut has
        NaN and the reason.

    Raises:
        ValueError: no field, or one outside of the line.
    """
    if not fields or not np.all(np.abs(fields) <= 1.0):
        raise ValueError(f"fields from -1 to 1 expected, got {list(fields)}")
    cameras = {}
    for name in instrument.cameras:
        bench = _CameraBench(instrument, name, backend, tuple(fields), wavelength)
        out = np.full((_COLUMNS, len(states), len(fields)), np.nan)
        reasons = [""] * len(states)
        for start in range(0, len(states), AT_ONCE):
            bench.fill(list(states), np.arange(start, min(start + AT_ONCE, len(states))), out, reasons)
        light = (float(np.min(bench.spectrum)), float(np.max(bench.spectrum)))
        cameras[name] = CameraQuality(
            wfe=out[0],
            wfe_refocused=out[1],
            defocus=out[2],
            mtf_along_line=out[3],
            mtf_along_track=out[4],
            nyquist=bench.nyquist,
            wavelengths=light,
            reasons=tuple(reasons),
        )
    return ImageQuality(tuple(fields), wavelength, MappingProxyType(cameras))


def quality_dicts(instrument: Instrument, backend: Backend, states: Sequence[State]) -> list[dict[str, Any]]:
    """Contents of quality.json for each of many states, traced together."""
    return image_quality(instrument, backend, states).to_dicts() if states else []


_COLUMNS = 5
"""Arrays of ``CameraQuality``, in its order."""


class _CameraBench:
    """What of a camera does not change with its state."""

    def __init__(
        self, instrument: Instrument, name: str, backend: Backend, fields: tuple[float, ...], wavelength: float
    ) -> None:
        self.instrument, self.name, self.backend, self.wavelength = instrument, name, backend, wavelength
        self.model = instrument.cameras[name]
        spec: CameraSpec = self.model.spec
        band = spec.bands[target_band(spec)] if spec.bands else None
        line = spec.line if band is None else band
        along = 0.5 * line.pixels * line.pitch * np.array(fields)
        across = np.full(len(along), 0.0 if band is None else band.offset)
        self.body = line_body(f"{BASE}/{name}")
        self.points = np.stack([across, along, np.zeros_like(along)], axis=-1)
        self.nyquist = 0.5 / line.pitch
        self.frequency = self.nyquist * np.eye(2)
        self.spectrum = (spec.wavelength, spec.wavelength) if band is None else band.spectrum
        first, last = self.spectrum
        node, self.weights = np.polynomial.legendre.leggauss(COLOURS if last > first else 1)
        self.colours = 0.5 * (first + last) + 0.5 * (last - first) * node
        x, y = self.frequency.T
        if band is None:
            self.detector = np.sinc(line.pitch * x) * np.sinc(line.pitch * y)
        else:
            self.detector = np.prod(list(band_factors(band, x, y).values()), axis=0)
        stop = instrument.assembly.elements[f"{name}/{spec.stop}"].aperture
        assert isinstance(stop, Circle)
        self.stop = stop
        self.nodes = quadrature.disk(RINGS)
        self.tilts = zernike.basis(3, self.nodes.x, self.nodes.y)
        self.assembly = instrument.assembly

    def fill(self, states: list[State], which: np.ndarray, out: np.ndarray, reasons: list[str]) -> None:
        """Work out some states; where the light of one is lost, both halves by themselves."""
        try:
            rays, size = self._trace([states[s] for s in which])
        except (AimError, BeamMissedError) as error:
            if len(which) == 1:
                reasons[which[0]] = str(error)
                return
            half = len(which) // 2
            self.fill(states, which[:half], out, reasons)
            self.fill(states, which[half:], out, reasons)
            return
        values, dark, rough = self._numbers(rays, size)
        count = len(self.points)
        out[:, which] = values.reshape(len(values), len(which), count)
        for k, s in enumerate(which):
            own = slice(k * count, (k + 1) * count)
            if np.any(dark[own]):
                out[:, s] = np.nan
                reasons[s] = f"an aperture beside the stop cuts {np.max(dark[own]):.1%} of the beam"
            elif np.any(rough[own]):
                reasons[s] = "no MTF: the wavefront or the pupil's edge is too rough for its polynomials"

    def _trace(self, states: list[State]) -> tuple[ImagingRays, np.ndarray]:
        """Beams to the line CCD, state by state and field by field, and for each the CCD's size, (B,).

        Raises:
            AimError, BeamMissedError: the light of some state is lost.
        """
        assembly, name = self.assembly, self.name
        placed = assembly.place(states)
        to_stop, to_object = (
            assemble(assembly, [f"{name}/{way}"], states, placed=placed) for way in ("image_to_stop", "image_to_object")
        )
        axis = self.instrument.camera_axes(name)[:, 1]
        guess = self.instrument.toward_optics(placed, name)[:, None]
        points = points_to_world(placed, self.body, self.points).real
        places, sight = chief_rays(self.backend, to_stop, to_object, points, guess, axis)
        every = np.repeat(np.arange(len(states)), len(self.points))
        imaging, forward = (
            assemble(assembly, [f"{name}/{way}"], states, placed=placed).take(every) for way in ("imaging", "to_stop")
        )
        launch = (places + LAUNCH_DISTANCE * sight).reshape(-1, 3)
        rays = imaging_rays(
            self.backend, imaging, forward, -sight.reshape(-1, 3), launch, self.stop, self.nodes, first=axis
        )
        return rays, imaging.size

    def _numbers(self, rays: ImagingRays, size: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values (_COLUMNS, B), the share of each beam that is cut, and whether an MTF is not to be had."""
        origin = (size[:, None] * np.tile(self.points, (len(rays.path) // len(self.points), 1)))[:, None]
        radius = float(self.model.first_order.exit_pupil_distance[0])
        share = self.nodes.share

        def flat(values: np.ndarray) -> np.ndarray:
            values = values - values[:, :1]
            return np.asarray(values - (values * share) @ self.tilts @ self.tilts.T)

        error = -flat(path_to_sphere(rays.position, rays.direction, rays.path, origin, radius))
        focus = flat(np.abs(rays.direction[..., 2]))
        defocus = np.sum(error * focus * share, axis=-1) / np.sum(focus**2 * share, axis=-1)
        rest = error - defocus[:, None] * focus
        wfe, refocused = (np.sqrt(np.sum(e**2 * share, axis=-1)) / self.wavelength for e in (error, rest))
        dark = np.mean(rays.amplitude == 0.0, axis=-1)
        mtf = np.full((2, len(dark)), np.nan)
        lit = np.flatnonzero(dark == 0.0)
        if len(lit):
            # the image's first axis runs along the line, Y', the second along the track, X'
            # per length of the nominal CCD, in which the pixels keep their pitch
            v, u = np.moveaxis(size[lit, None, None] * rays.direction[lit, :, :2], -1, 0)
            path = eikonal(rays.position[lit], rays.direction[lit], rays.path[lit], origin[lit])
            pupils = PupilStack.fit(u, v, path - path[:, :1], rays.amplitude[lit], self.nodes)
            smooth = pupils.residual <= WORST_RESIDUAL * float(np.min(self.colours))
            good = np.flatnonzero(smooth & (pupils.bend <= WORST_BEND))
            if len(good):
                found = pupils.take(good).transfer(self.frequency, self.colours, self.weights)
                mtf[:, lit[good]] = (np.abs(found) * self.detector).T
        values = np.stack([wfe, refocused, defocus, *mtf])
        return values, dark, np.isnan(mtf[0])
