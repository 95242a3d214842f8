"""Image quality of an instrument's cameras in many perturbed states: wavefront error, defocus, MTF at Nyquist.

All quantities are at fixed pixels of the line CCD, which see whatever part of the scene the state brings there: the
chief ray of the pixel is traced back to the scene, and the beam from that direction forward to the line. A field of +1
is the left end of the line (+Y'), -1 the right one.

Wavefront errors are rms over the stop's area. The reference sphere is centred on the pixel, where the chief ray
arrives, with the radius of the nominal exit pupil; piston and tilt are removed. Best focus is where the rms is smallest
along the light; the phase of a shift is exact, proportional to sqrt(1 - u^2 - v^2) for direction cosines u and v. The
MTF is that of the traced pupil, polychromatic if the camera describes a band, multiplied by those of the pixel and of
the other parts of the band's line CCD. Light blocked by prisms and other bodies of the instrument
(``scenes.models.shadow``) is missing in both, unless obstruction is ignored.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.arrays import shows
from optics.geometry import zernike
from optics.geometry.aperture import Circle
from optics.geometry.polygon import covered
from optics.geometry.tree import State
from optics.numerics import quadrature
from optics.numerics.array_math import UnphysicalError, check_at_most, check_close, check_range
from optics.numerics.backend import Backend, one_blas_thread
from optics.numerics.number_tree import FrozenMap
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.aim import AimError
from optics.raytrace.assembly import points_to_world
from optics.raytrace.first_order import chief_rays
from optics.raytrace.system import SystemBatch, assemble
from optics.raytrace.trace import BeamMissedError
from optics.waves.edge_shadow import StopOutlines
from optics.waves.imaging import ImagingRays, eikonal, imaging_rays, path_to_sphere
from optics.waves.line_transfer import LINE_SIDES, line_transfers, vignetted_pupils
from optics.waves.pupil_shadow import FEW_SIDES, SMALLEST
from optics.waves.pupil_stack import DEGREE, VIGNETTED_RINGS, WORST_RESIDUAL, PupilStack
from optics.waves.pupil_terms import WORST_BEND, products, smooth_terms, to_terms
from scenes.models import shadow
from scenes.models.camera_model import LAUNCH_DISTANCE, coloured, lenses, line_body
from scenes.models.instrument_model import Instrument
from scenes.models.shadow import Shadows
from scenes.specs.camera import CameraSpec
from scenes.specs.instrument import BASE
from scenes.specs.resolved import target_band
from scenes.specs.spectrum import SpectrumSpec
from twin.framework.record import Quantity, Record
from twin.sensors.line_ccd import band_factors

VIGNETTED_MEAN_DEGREE = 14
"""Degree of the polynomials that continue a wavefront into the part of the beam that edges of surfaces cut off."""


class PupilMean:
    """Mean over the unobstructed part of each stop, from values at the nodes of a quadrature.

    Polynomials continue the values into the shadows of bodies, and the contribution of the shadows is subtracted. They
    also replace rays in the shadow of edges, which may pass far outside the rims of lenses.

    Parameters
    ----------
    nodes
        N quadrature nodes of the stop.
    shadows
        Shadows of bodies in the B stops (one for each beam); None if no body is in the beams.
    free
        True for the illuminated nodes of each stop, (B, N); None if rays in the shadows can be used as well.
    """

    def __init__(self, nodes: PupilNodes, shadows: Shadows | None, free: np.ndarray | None = None) -> None:
        self._free, self._nodes = free, nodes
        tilts = zernike.basis(3, nodes.x, nodes.y)
        self._share, self._tilts = nodes.share[None], tilts[None]
        self._added: np.ndarray | None = None
        if shadows is None:
            return
        points, weight = shadows.points, shadows.weights
        count = len(points)
        all_weights = np.concatenate([np.broadcast_to(nodes.weight, (count, nodes.count)), -weight], axis=1)
        self._share = all_weights / np.maximum(np.sum(all_weights, axis=1, keepdims=True), _LEAST_SHARE)
        shadow_tilts = zernike.basis(3, points.real.ravel(), points.imag.ravel()).reshape(*points.shape, 3)
        self._tilts = np.concatenate([np.broadcast_to(tilts, (count, *tilts.shape)), shadow_tilts], axis=1)
        degree = DEGREE if free is None else VIGNETTED_MEAN_DEGREE
        self._to_terms = to_terms(nodes, degree)
        self._on_stop = products(nodes.x, nodes.y, degree)
        self._added = products(points.real, points.imag, degree)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Return the mean over the stop of each of B beams, (B,), from the node values that ``flat`` returned."""
        return np.asarray(np.sum(values * self._share, axis=-1))

    def flat(self, values: np.ndarray) -> np.ndarray:
        """Return values at the nodes of each stop, (B, N), without their mean (piston) and linear part (tilt).

        Q additional nodes in the shadows are appended, so the result is (B, N + Q), for B beams and N nodes of the
        stop.
        """
        values = values - values[:, :1]
        if self._added is not None:
            if self._free is None:
                terms = values @ self._to_terms.T
            else:
                terms = smooth_terms(self._on_stop, self._nodes.weight, self._free, values[..., None])[..., 0]
                values = np.where(self._free, values, terms @ self._on_stop.T)
            values = np.concatenate([values, np.squeeze(self._added @ terms[..., None], -1)], axis=1)
        weighted = self._tilts * self._share[..., None]
        transposed = np.swapaxes(weighted, 1, 2)
        level = np.linalg.solve(transposed @ self._tilts, transposed @ values[..., None])
        return np.asarray(values - np.squeeze(self._tilts @ level, -1))


_LEAST_SHARE = 1e-3
"""Smallest illuminated area of a stop, in units of its radius squared, for which a mean is defined."""


FIELDS = (1.0, 0.7, 0.0, -0.7, -1.0)
"""Field points along the line CCD, as fractions of half its length: +1 is its left end (+Y'), -1 its right end."""

POSITIONS = {"left": 1.0, "centre": 0.0, "right": -1.0}
"""Field points that result files name: name -> position, as a fraction of half the line's length."""

WAVELENGTH = 650e-9
"""Wavelength that is the unit of wavefront errors, in metres."""

RINGS = 7
"""Number of rings of the quadrature over the stop: exact for squares of wavefronts up to polynomial order 13."""

MOST_BLUR = 10.0
"""Wavefront error, in waves rms, above which the MTF of a vignetted pupil is not computed."""

_DARKEST = 0.99
"""Largest fraction of the light that bodies in the beam may block; above it, no image quality is given."""

COLOURS = 5
"""Number of wavelengths of a Gauss quadrature over a band.

Four are accurate to 1e-7 except near cut-offs inside the band, where the MTF vanishes.
"""

_ROUNDING = 1e-5
"""Rounding tolerance of the physical checks.

A blocked fraction may lie outside 0 to 1 by this amount. A wavefront error at best focus may exceed that on the line
CCD by this fraction plus this many waves.
"""

_MTF_ROUNDING = 1e-3
"""Amount by which a computed MTF may lie outside 0 to 1 because of rounding."""

_MOST_WAVES = 1e6
"""Largest plausible wavefront error, in waves rms; a larger one means that the result is wrong."""

_FEW, _APART = quadrature.even_disk(500), 0.02
"""Points of the stop, and allowed difference of fractions of the stop, for a check of the light that bodies block.

The fraction from outlines of shadows is compared with that of the points that are blocked.
"""

AT_ONCE = 40
"""Number of states (perturbed instruments) traced in one launch, to limit memory: 40 take 60 MB."""


@dataclass(frozen=True, eq=False)
class PupilOutline:
    """Outline of the pupil as seen from the image, and of the shadows in it, in units of the pupil's mean radius.

    The coordinate x is along the line CCD (Y'), y along the track (X').

    Attributes
    ----------
    axes : (2, 2) ndarray
        Linear map from the unit circle to the edge of the pupil.
    pieces : (K, V, 2) ndarray
        Shadows in the pupil, as K polygons of V vertices (x, y).
    """

    axes: np.ndarray
    pieces: np.ndarray


@shows()
@dataclass(frozen=True, eq=False)
class CameraQuality:
    """Image quality of one camera in S states at F fields; NaN where unknown, with ``reasons``.

    Attributes
    ----------
    wfe : (S, F) ndarray
        Rms wavefront error without piston and tilt, in waves.
    wfe_refocused : (S, F) ndarray
        Rms wavefront error at each field's own best focus, in waves.
    defocus : (S, F) ndarray
        Best focus minus line CCD along its normal, positive downstream (away from the optics), in metres.
    mtf_along_line, mtf_along_track : (S, F) ndarray
        MTF at the Nyquist frequency.
    light_lost : (S, F) ndarray
        Fraction of the light that bodies in the beam block.
    nyquist : float
        Nyquist frequency, in cycles/m.
    wavelengths : tuple of float
        First and last wavelength of the light of the MTF, in metres.
    reasons : tuple of str
        For every state, why values are unknown; empty if all are known.
    bodies : mapping of str to (S, F) ndarray
        Each body in the beam -> fraction of the stop's area that it blocks by itself.
    pupils : tuple of tuples of PupilOutline
        Outlines of the pupils and the shadows in them, by state and field.
    """

    wfe: np.ndarray
    wfe_refocused: np.ndarray
    defocus: np.ndarray
    mtf_along_line: np.ndarray
    mtf_along_track: np.ndarray
    light_lost: np.ndarray
    nyquist: float
    wavelengths: tuple[float, float]
    reasons: tuple[str, ...]
    bodies: Mapping[str, np.ndarray]
    pupils: tuple[tuple[PupilOutline, ...], ...]


@shows()
@dataclass(frozen=True, eq=False)
class ImageQuality:
    """Image quality of all cameras.

    Dimensions: F fields.

    Attributes
    ----------
    fields : (F,) tuple of float
        Field points, as fractions of half the line.
    cameras : mapping of str to CameraQuality
        Image quality by camera.
    obstruction : bool
        True if light blocked by bodies in the beams is missing in the pupils.
    """

    fields: tuple[float, ...]
    cameras: Mapping[str, CameraQuality]
    obstruction: bool = True

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about image quality values that could not be computed, with the reasons."""
        return tuple(
            f"image quality of {name}: {reason}" for name, c in self.cameras.items() for reason in c.reasons if reason
        )

    def state(self, number: int) -> dict[str, CameraState]:
        """Return the image quality of each camera in the state with index ``number``, for result files."""
        positions = {
            position: self.fields.index(field) for position, field in POSITIONS.items() if field in self.fields
        }
        return {name: CameraState(camera, number, positions) for name, camera in self.cameras.items()}


@dataclass(frozen=True, eq=False)
class CameraState:
    """Image quality of one camera in one state of the instrument, at the field points that result files name."""

    camera: CameraQuality
    number: int
    positions: Mapping[str, int]

    def named(self, values: np.ndarray) -> dict[str, float | None]:
        """Return the value at each field point in this state, by the name of the point.

        ``values`` holds the values in S states at F field points, (S, F).
        """
        return {position: _known(values[self.number, k]) for position, k in self.positions.items()}


def _known(value: float | np.floating[Any]) -> float | None:
    """Return a finite number unchanged, and None for NaN or infinity, which JSON cannot hold."""
    return float(value) if np.isfinite(value) else None


_WITH_PIXEL = "MTF of optics and line CCD, with its pixel, at Nyquist"
_REFOCUSED, _TAKEN = (
    "wavefront error at each field's own best focus",
    "fraction of the light that bodies in the beam block",
)
AT_FIELDS: Record[CameraQuality] = Record(
    "Image quality of a camera in every state at every field, (S, F).",
    Quantity("wfe_rms_waves", lambda c: c.wfe, "wavefront error without piston and tilt", "wavefront error, rms", 4),
    Quantity(
        "wfe_rms_waves_focus_removed", lambda c: c.wfe_refocused, _REFOCUSED, "wavefront error at best focus [waves]", 4
    ),
    Quantity("defocus_um", lambda c: c.defocus, "best focus less line CCD, + downstream", "best focus − line CCD", 1),
    Quantity(
        "mtf_along_line", lambda c: c.mtf_along_line, _WITH_PIXEL, "MTF with the pixel at Nyquist along the line", 4
    ),
    Quantity(
        "mtf_along_track", lambda c: c.mtf_along_track, _WITH_PIXEL, "MTF with the pixel at Nyquist along the track", 4
    ),
    Quantity("light_lost", lambda c: c.light_lost, _TAKEN, "light blocked by bodies in the beam", 2, shown="percent"),
)
"""Image quality quantities that are computed at every field point, with their keys, labels and units.

Result files, reports and scripts all take the quantities from this list.
"""


def _at_positions(quantity: Quantity[CameraQuality]) -> Quantity[CameraState]:
    """Return a quantity for one state at the named field points, made from that for all states and field points."""
    return Quantity(
        quantity.key,
        lambda camera_state: camera_state.named(quantity.of(camera_state.camera)),
        f"{quantity.meaning}, at positions of the line",
    )


_CAMERA: Record[CameraState] = Record(
    "Image quality of a camera in one state; null where it is not known.",
    Quantity("wfe_rms_waves", lambda of: _known(np.mean(of.camera.wfe[of.number])), "wavefront error, mean of RMS"),
    Quantity("wfe_rms_waves_focus_removed", lambda of: _known(np.mean(of.camera.wfe_refocused[of.number])), _REFOCUSED),
    Quantity(
        "wfe_worst_waves", lambda of: _known(np.max(of.camera.wfe[of.number])), "wavefront error of the worst field"
    ),
    *map(_at_positions, list(AT_FIELDS)[2:]),
    Quantity(
        "obstructed_by",
        lambda of: {k: of.named(v) for k, v in of.camera.bodies.items()},
        "body -> fraction of the stop that it blocks",
    ),
    Quantity("reason", lambda of: of.camera.reasons[of.number] or None, "why numbers are missing", where_known=True),
)
_LIGHT: Record[CameraQuality] = Record(
    "Light and limit of the MTF with the pixel.",
    Quantity("nyquist_per_mm", lambda camera: camera.nyquist, "Nyquist frequency of the line CCD"),
    Quantity("spectrum_nm", lambda camera: camera.wavelengths, "first and last wavelength of the light"),
)
QUALITY: Record[ImageQuality] = Record(
    "quality.json: image quality of the perturbed state, and before of the nominal one.",
    Quantity("cameras", lambda quality: quality.state(1), "perturbed, by camera", record=_CAMERA),
    Quantity(
        "before", lambda quality: {"cameras": quality.state(0)}, "by camera, in the nominal state", record=_CAMERA
    ),
    Quantity("obstruction", lambda q: "traced" if q.obstruction else "ignore", "whether bodies in the beams count"),
    Quantity("wavelength_nm", lambda quality: WAVELENGTH, "unit of wavefront errors"),
    Quantity(
        "fields", lambda quality: quality.fields, "field points as fractions of half the line, +1 at its left end"
    ),
    Quantity(
        "mtf", lambda quality: quality.cameras, "light and limit of the MTF with the pixel by camera", record=_LIGHT
    ),
)


@one_blas_thread()  # for small matrices, threads would only wait for each other
def image_quality(
    instrument: Instrument,
    backend: Backend,
    states: Sequence[State],
    fields: Sequence[float] = FIELDS,
    obstruction: bool = True,
) -> ImageQuality:
    """Compute the image quality of every camera in every state.

    Parameters
    ----------
    instrument : Instrument
        Instrument with its cameras.
    backend : Backend
        Backend of the ray trace.
    states : sequence of State
        S states, traced together.
    fields : sequence of float
        Field points from -1 to 1, as fractions of half the line, +1 at its left end (+Y').
    obstruction : bool
        True to include light blocked by bodies in the beams.

    Returns
    -------
    ImageQuality
        Values of each state, which do not depend on the others except for rounding. A state whose beam is lost or
        vignetted has NaN and the reason.

    Raises
    ------
    ValueError
        There is no field, or one is outside the line.
    UnphysicalError
        A value is physically impossible.
    """
    if not fields or not np.all(np.abs(fields) <= 1.0):
        raise ValueError(f"fields from -1 to 1 expected, got {list(fields)}")
    cameras = {}
    for name in instrument.cameras:
        shadows = shadow.imaging_shadows(instrument, name, backend) if obstruction else None
        bench = _CameraBench(instrument, name, backend, tuple(fields), shadows)
        out = np.full((len(_COLUMNS), len(states), len(fields)), np.nan)
        reasons = [""] * len(states)
        for start in range(0, len(states), AT_ONCE):
            bench.fill(list(states), np.arange(start, min(start + AT_ONCE, len(states))), out, reasons)
        cameras[name] = CameraQuality(
            nyquist=bench.nyquist,
            wavelengths=bench.ends,
            reasons=tuple(reasons),
            bodies=FrozenMap(bench.bodies(len(states))),
            pupils=tuple(bench.pupils.get(s, ()) for s in range(len(states))),
            **dict(zip(_COLUMNS, out, strict=True)),
        )
    return ImageQuality(tuple(fields), FrozenMap(cameras), obstruction)


def quality_dicts(
    instrument: Instrument, backend: Backend, states: Sequence[State], obstruction: bool = True
) -> list[dict[str, Any]]:
    """Return the contents of the file quality.json for each of many states, which are traced together."""
    quality = image_quality(instrument, backend, states, obstruction=obstruction)
    return [
        {"cameras": {k: _CAMERA(camera_state) for k, camera_state in quality.state(s).items()}}
        for s in range(len(states))
    ]


_COLUMNS = ("light_lost", "wfe", "wfe_refocused", "defocus", "mtf_along_line", "mtf_along_track")
"""Names of the arrays of ``CameraQuality`` that are computed together, in their order; new ones go at the end."""


@dataclass(frozen=True, eq=False)
class _Traced:
    """Traced beams of B images, each for one state and one field point.

    Dimensions: B images, N nodes of the stop.

    Attributes
    ----------
    rays : ImagingRays
        Rays at the design wavelength.
    size : (B,) ndarray
        Size of the line CCD relative to nominal.
    origin : (B, 1, 3) ndarray
        Image points on the line CCD.
    shadows : shadow.Shadows | None
        Shadows in the beams; None if no body is in them.
    outlines : StopOutlines | None
        Outlines of edges and bodies on the stops; None for a camera whose surfaces have no edges.
    free : (B, N) ndarray | None
        True for nodes that no edge and no body covers; None for a camera whose surfaces have no edges.
    again : callable
        Function of a wavelength, in metres, that returns the rays of the same beams.
    """

    rays: ImagingRays
    size: np.ndarray
    origin: np.ndarray
    shadows: shadow.Shadows | None
    outlines: StopOutlines | None
    free: np.ndarray | None
    again: Callable[[float], ImagingRays]


class _CameraBench:
    """Computation of one camera's image quality; it holds the data that do not depend on the state."""

    def __init__(
        self,
        instrument: Instrument,
        name: str,
        backend: Backend,
        fields: tuple[float, ...],
        shadows: shadow.ImagingShadows | None,
    ) -> None:
        self.shadows = shadows
        self.pupils: dict[int, tuple[PupilOutline, ...]] = {}
        self._taken: list[tuple[np.ndarray, dict[str, np.ndarray]]] = []
        self.instrument, self.name, self.backend = instrument, name, backend
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
        spectrum = spec.spectrum or SpectrumSpec.evenly(spec.wavelength, spec.wavelength)
        light = spectrum if band is None else band.spectrum
        self.ends = light.ends
        self.colours, self.weights = light.rule(COLOURS)
        x, y = self.frequency.T
        if band is None:
            self.detector = np.sinc(line.pitch * x) * np.sinc(line.pitch * y)
        else:
            self.detector = np.prod(list(band_factors(band, x, y).values()), axis=0)
        stop = instrument.assembly.elements[f"{name}/{spec.stop}"].aperture
        assert isinstance(stop, Circle)
        self.stop = stop
        self.refracts = len(self.colours) > 1 and bool(lenses(spec))
        self.nodes = quadrature.disk(VIGNETTED_RINGS if self.model.edges else RINGS)
        self.assembly = instrument.assembly

    def fill(self, states: list[State], which: np.ndarray, out: np.ndarray, reasons: list[str]) -> None:
        """Compute the image quality of some states and write it to ``out`` and ``reasons``.

        If the light of one state is lost, so that the joint ray trace fails, the states are divided into two halves
        that are computed separately.

        Parameters
        ----------
        states : list of State
            States (perturbed instruments) to compute.
        which : ndarray of int
            Indices of these states in ``out`` and ``reasons``.
        out : ndarray
            Array for the results, changed in place.
        reasons : list of str
            For each state, why its values are unknown, changed in place.
        """
        try:
            traced = self._trace([states[s] for s in which])
        except (AimError, BeamMissedError, UnphysicalError) as error:
            if len(which) == 1:
                reasons[which[0]] = str(error)
                return
            half = len(which) // 2
            self.fill(states, which[:half], out, reasons)
            self.fill(states, which[half:], out, reasons)
            return
        values, dark, rough = self._numbers(traced, which)
        count = len(self.points)
        out[:, which] = values.reshape(len(values), len(which), count)
        for k, s in enumerate(which):
            columns = slice(k * count, (k + 1) * count)
            if np.any(dark[columns]):
                out[:, s] = np.nan
                reasons[s] = f"an aperture other than the stop vignettes {np.max(dark[columns]):.1%} of the beam"
            elif np.any(values[0, columns] > _DARKEST):
                out[1:, s] = np.nan
                reasons[s] = f"bodies in the beam block {np.max(values[0, columns]):.1%} of it"
            elif np.any(rough[columns]):
                reasons[s] = "no MTF: the wavefront or the pupil's edge is too rough for a polynomial fit"
                if self.model.edges and np.max(values[1, columns]) > MOST_BLUR:
                    reasons[s] = (
                        f"no MTF: {np.max(values[1, columns]):.3g} waves of wavefront error are more than {MOST_BLUR:g}"
                    )

    def bodies(self, count: int) -> dict[str, np.ndarray]:
        """Return the fraction of the stop's area that each body in a beam blocks, (S, F).

        The fraction is NaN where the light is lost.

        Dimensions: S states, F field points.
        """
        out: dict[str, np.ndarray] = {}
        known = np.full((count, len(self.points)), np.nan)
        for which, _ in self._taken:
            known[which] = 0.0
        for which, shares in self._taken:
            for body, share in shares.items():
                out.setdefault(body, known.copy())[which] = share.reshape(len(which), -1)
        return dict(sorted(out.items()))

    def _trace(self, states: list[State]) -> _Traced:
        """Trace the beams to the line CCD, by state and field.

        Raises
        ------
        AimError, BeamMissedError
            The light of a state is lost.
        """
        assembly, name = self.assembly, self.name
        placed = assembly.place(states)
        to_stop, to_object = (
            assemble(assembly, [f"{name}/{sequence}"], states, placed=placed)
            for sequence in ("image_to_stop", "image_to_object")
        )
        axis = self.instrument.camera_axes(name)[:, 1]
        guess = self.instrument.toward_optics(placed, name)[:, None]
        points = points_to_world(placed, self.body, self.points).real
        points_of_line, sight = chief_rays(self.backend, to_stop, to_object, points, guess, axis)
        owner = np.repeat(np.arange(len(states)), len(self.points))
        launch = (points_of_line + LAUNCH_DISTANCE * sight).reshape(-1, 3)
        heading = -sight.reshape(-1, 3)

        def launch_beams(colour: float) -> tuple[SystemBatch, ImagingRays]:
            coloured_states = [coloured(self.model.spec, f"{BASE}/{name}", state, colour) for state in states]
            imaging, forward = (
                assemble(assembly, [f"{name}/{sequence}"], coloured_states, placed=placed).take(owner)
                for sequence in ("imaging", "to_stop")
            )
            return imaging, imaging_rays(
                self.backend, imaging, forward, heading, launch, self.stop, self.nodes, first=axis
            )

        imaging, rays = launch_beams(self.model.spec.wavelength)
        beams = shadow.TracedBeams(assembly, placed, owner, imaging, rays, heading, self.nodes)
        shadows = None if self.shadows is None else self.shadows.cast(beams)
        outlines: StopOutlines | None = None
        covers: np.ndarray | None = None
        if self.model.edges:
            free = shadow.no_shadows(len(owner)) if shadows is None else shadows
            edges = shadow.PupilEdges.of(beams, self.model, self.name, self.backend)
            outlines = edges.outlines(LINE_SIDES) + StopOutlines((), tuple(np.moveaxis(free.pieces, 1, 0)))
            shadows = free.and_edges(edges.outlines, f"edges of {name}")
            covers = ~covered(shadows.pieces, np.stack([self.nodes.x, self.nodes.y], axis=-1), SMALLEST)
        origin = (imaging.size[:, None] * np.tile(self.points, (len(states), 1)))[:, None]
        return _Traced(rays, imaging.size, origin, shadows, outlines, covers, lambda colour: launch_beams(colour)[1])

    def _numbers(self, traced: _Traced, which: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the values of the beams, the fraction of each that is cut off, and whether its MTF is unknown.

        The values are an array (V, B) for the V quantities named in ``_COLUMNS`` and B beams.
        """
        rays, shadows, free = traced.rays, traced.shadows, traced.free
        radius = float(self.model.first_order.exit_pupil_distance[0])
        error = path_to_sphere(rays.position, rays.direction, rays.path, traced.origin, radius)
        mean = PupilMean(self.nodes, None if shadows is None or not shadows.owners else shadows, free)
        error = -mean.flat(error)
        focus = mean.flat(np.abs(rays.direction[..., 2]))
        defocus = mean(error * focus) / mean(focus**2)
        rest = error - defocus[:, None] * focus
        wfe, refocused = (np.sqrt(np.maximum(mean(e**2), 0.0)) / WAVELENGTH for e in (error, rest))
        dark = np.mean((rays.amplitude == 0.0) & (True if free is None else free), axis=-1)
        mtf = np.full((2, len(dark)), np.nan)
        light_lost = np.zeros(len(dark))
        illuminated = np.flatnonzero(dark == 0.0)
        if len(illuminated):
            pupils, smooth, cosines = self._pupils(traced, rays, illuminated, float(np.min(self.colours)))
            light_lost[illuminated] = 1.0 - pupils.light
            if self.model.edges:
                # the nodes for such a phase would take minutes, for almost no contrast
                smooth &= wfe[illuminated] * WAVELENGTH <= MOST_BLUR * float(np.min(self.colours))
            good = np.flatnonzero(smooth & (pupils.bend <= WORST_BEND) & (pupils.light >= 1.0 - _DARKEST))
            if len(good):
                if self.refracts:
                    otf, known = self._in_colours(traced, illuminated[good])
                else:
                    good_pupils = pupils if len(good) == len(illuminated) else pupils.take(good)
                    good_cosines = tuple(part[good] for part in cosines)
                    otf, known = self._transfer(
                        traced, illuminated[good], good_pupils, good_cosines, self.colours, self.weights
                    )
                good, otf = good[known], otf[known]
                check_range(f"an MTF of the optics of camera {self.name}", np.abs(otf), 0.0, 1.0, _MTF_ROUNDING)
                mtf[:, illuminated[good]] = (np.abs(otf) * self.detector).T
            self._note(pupils, illuminated, which)
        if shadows is not None:
            self._taken.append((which, shadows.shares()))
        values = np.stack([light_lost, wfe, refocused, defocus, *mtf])
        self._require_possible(values, dark, shadows)
        return values, dark, np.isnan(mtf[0])

    def _pupils(
        self, traced: _Traced, rays: ImagingRays, illuminated: np.ndarray, colour: float
    ) -> tuple[PupilStack, np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Return the pupil functions of beams at a wavelength, their smoothness, and the rays' direction cosines.

        Parameters
        ----------
        traced : _Traced
            Traced beams.
        rays : ImagingRays
            Rays of these beams at the wavelength.
        illuminated : (B,) ndarray of int
            Indices of the B beams to use.
        colour : float
            Wavelength, in metres.

        Returns
        -------
        tuple
            Pupil functions, True for each smooth one (B,), and direction cosines (u, v), (B, N) each for N nodes of the
            stop.
        """
        # the image's first axis runs along the line, Y', the second along the track, X'
        # per length of the nominal CCD, in which the pixels keep their pitch
        v, u = np.moveaxis(traced.size[illuminated, None, None] * rays.direction[illuminated, :, :2], -1, 0)
        path = eikonal(
            rays.position[illuminated], rays.direction[illuminated], rays.path[illuminated], traced.origin[illuminated]
        )
        beams = u, v, path - path[:, :1], rays.amplitude[illuminated], self.nodes
        shadows = None if traced.shadows is None else traced.shadows.pieces[illuminated]
        if traced.free is None:
            pupils = PupilStack.fit(*beams, DEGREE, shadows, FEW_SIDES)
        else:
            pupils = PupilStack.fit_vignetted(*beams, colour, shadows, traced.free[illuminated])
        return pupils, pupils.residual <= WORST_RESIDUAL * colour, (u, v)

    def _in_colours(self, traced: _Traced, illuminated: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the polychromatic transfer functions of beams through lenses, from rays traced at each wavelength.

        All wavelengths refer to one image point, so that lateral colour blurs the image.

        Returns
        -------
        tuple of ndarray
            Complex transfer function (B, M) of B beams at the Nyquist frequency in M directions (along line and track),
            and a mask (B,), True where it is known.
        """
        total, known = np.zeros((len(illuminated), len(self.frequency)), complex), np.ones(len(illuminated), bool)
        for colour, weight in zip(self.colours, self.weights / np.sum(self.weights), strict=True):
            pupils, good, cosines = self._pupils(traced, traced.again(float(colour)), illuminated, float(colour))
            otf, computed = self._transfer(traced, illuminated, pupils, cosines, np.array([colour]), np.ones(1))
            known &= good & computed & (pupils.bend <= WORST_BEND)
            total += weight * otf
        return total, known

    def _transfer(
        self,
        traced: _Traced,
        illuminated: np.ndarray,
        pupils: PupilStack,
        cosines: tuple[np.ndarray, ...],
        colours: np.ndarray,
        weights: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the optical transfer functions of beams, and whether each could be computed.

        Pupils that are partly cut off (vignetted) are integrated line by line.

        Returns
        -------
        tuple of ndarray
            Complex transfer function (B, M) of B beams at the Nyquist frequency in M directions (along line and track),
            and a mask (B,), True where it is known.
        """
        known = np.ones(len(pupils.centre), bool)
        if traced.outlines is None or traced.free is None:
            return pupils.transfer(self.frequency, colours, weights), known
        total, shares = np.zeros((len(known), len(self.frequency)), complex), weights / np.sum(weights)
        for k, (beam, pupil) in enumerate(zip(illuminated, pupils.functions(), strict=True)):
            u, v = (part[k : k + 1] for part in cosines)
            beam_slice = slice(beam, beam + 1)
            try:
                vignetted = vignetted_pupils(
                    [pupil], u, v, self.nodes, traced.outlines.take(beam_slice), traced.free[beam_slice]
                )
                for colour, share in zip(colours, shares, strict=True):
                    (directions,) = line_transfers(vignetted, [float(colour)], np.eye(2), self.nyquist, 2)
                    total[k] += share * np.array([transfer.values[1] for transfer in directions])
            except UnphysicalError:
                known[k] = False
        return total, known

    def _require_possible(self, values: np.ndarray, dark: np.ndarray, shadows: shadow.Shadows | None) -> None:
        """Raise UnphysicalError if a computed value is physically impossible; the message names camera and quantity.

        Parameters
        ----------
        values : (V, B) ndarray
            V quantities, named in ``_COLUMNS``, of B beams.
        dark : (B,) ndarray
            Fraction of each beam that is blocked.
        shadows : shadow.Shadows | None
            Shadows of bodies in the beams; None if there are none.
        """
        # a vignetted or almost blocked beam has a reason instead of numbers
        judged = (dark == 0.0) & (values[0] <= _DARKEST)
        lost, wfe, refocused, _, along, track, *_ = values[:, judged]
        of = f"of camera {self.name}"
        check_range(f"the fraction of the light {of} that bodies block", lost, 0.0, 1.0, _ROUNDING)
        check_range(f"a wavefront error {of} in waves", wfe, 0.0, _MOST_WAVES, 0.0)
        most = wfe * (1.0 + _ROUNDING)
        check_at_most(f"a wavefront error {of} at best focus", refocused, most, "that on the line CCD", _ROUNDING)
        check_range(f"an MTF {of}", np.array([along, track]), 0.0, 1.0, _MTF_ROUNDING)
        if shadows is None or not shadows.owners:
            return
        shares = np.array(list(shadows.shares().values()))
        check_range(f"the fraction of the stop {of} that a body blocks", shares, 0.0, 1.0, _ROUNDING)
        together = np.sum(shares, axis=0)
        check_range(f"the fraction of the stop {of} that bodies block together", together, 0.0, 1.0, _ROUNDING)
        points = np.stack([_FEW.x, _FEW.y], axis=-1)
        counted = np.mean(covered(shadows.pieces, points, SMALLEST), axis=-1)
        check_close(
            f"the fraction of the stop {of} that bodies block", together, counted, "that of points in it", _APART
        )
        check_close(
            f"the fraction of the stop {of} that bodies block", together[judged], lost, "that of the light", _APART
        )

    def _note(self, pupils: PupilStack, illuminated: np.ndarray, which: np.ndarray) -> None:
        """Store the outlines of the pupils of the states in which light reaches all field points."""
        count = len(self.points)
        size = np.sqrt(np.abs(np.linalg.det(pupils.axes)))[:, None, None]
        axes = pupils.axes / size
        pieces = np.zeros((len(axes), 0, 3, 2)) if pupils.shadow is None else pupils.shadow.pieces
        pieces = np.einsum("bij,bkvj->bkvi", axes, pieces)
        where = {int(b): k for k, b in enumerate(illuminated)}
        for k, s in enumerate(which):
            beams = [where.get(b) for b in range(k * count, (k + 1) * count)]
            self.pupils[int(s)] = tuple(PupilOutline(axes[b], pieces[b]) for b in beams if b is not None)
