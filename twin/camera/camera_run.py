"""Analysis of a camera: all results of its report, its verdict, and the contents of optics.json and optics.nc."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr

from analysis.arrays import shows
from analysis.monitor import parameters
from optics.camera.ghosts import Ghost
from optics.geometry import zernike
from optics.geometry.tree import State
from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import Backend
from optics.raytrace.first_order import LineChange
from scenes.models.camera_design import with_plane
from scenes.models.camera_sharpness import BLURRED, field_text
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.models.job_state import job_state, motions_of
from scenes.models.thermal_model import ThermalModel
from scenes.specs.camera import CameraSpec
from scenes.specs.job import JobSpec, checked_nodes
from scenes.specs.perturbation import perturbation_text
from scenes.specs.resolved import CameraSetup
from twin.camera import aberrations
from twin.camera.camera_optics import RINGS, CameraOptics
from twin.camera.camera_results import Field, Mtf, Spot, Wavefront
from twin.camera.colour import COLOURS, Colours, colour_data, evaluate_colours
from twin.camera.first_order_data import FIRST_ORDER, FirstOrderData, first_order_data
from twin.camera.refocus import Refocus, find_focus, refocused_state
from twin.framework.procedure import Advance, silent
from twin.framework.record import Quantity, Record, frames_text
from twin.monitor.image_quality import CameraQuality, image_quality
from twin.monitor.truth import trace_truth

SHARP = 1.0 / 14.0
"""Marechal's limit of a diffraction-limited camera, waves rms (Strehl ratio 0.8)."""

MAX_WAVES_FOR_MTF = 10.0
"""Wavefront error beyond which no MTF is computed, waves rms: it would take minutes and be nearly zero."""

GRID: tuple[Field, ...] = tuple((x, y) for y in (1.0, 0.0, -1.0) for x in (-1.0, 0.0, 1.0))
"""Fields of wavefront maps and spot diagrams, row by row, as fractions of the half fields along line and track."""

MTF_FIELDS: tuple[Field, ...] = ((0.0, 0.0), (0.7, 0.0), (1.0, 0.0), (1.0, 1.0), (1.0, -1.0))
"""Fields, in fractions of the half fields along line and track, of MTF curves and of image quality through focus."""

FAN_FIELDS: tuple[Field, ...] = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))
"""Fields of the ray fans."""

ERROR_GRID = (25, 9)
"""Number of fields along the line and along the track at which the map of rms wavefront errors is computed."""

MAP_RINGS = 5
"""Number of rings of the quadrature over the stop for that map of a camera as designed."""

MAP_POINTS = 129
"""Number of points of a wavefront map along each axis of the stop."""

QUALITY_FIELDS = (-1.0, 0.0, 1.0)
"""Fields along the line, in fractions of half the line, at which obscuration by bodies of an instrument is computed."""


@dataclass(frozen=True, eq=False)
class Perturbed:
    """Effect of a perturbation on a camera.

    Attributes
    ----------
    job : JobSpec
        Job with the perturbation and the paths of the bodies.
    change : LineChange
        Change of the camera's geometry, of one state.
    errors : (A, B) ndarray
        Rms wavefront error before the perturbation, waves, at the map's A fields along and B fields across the line.
    mtf : (F, 2) ndarray
        MTF at Nyquist before the perturbation at the F fields MTF_FIELDS, along the line and along the track; empty
        where there is none.
    """

    job: JobSpec
    change: LineChange
    errors: np.ndarray
    mtf: np.ndarray

    @property
    def words(self) -> str:
        """Perturbation as text, e.g. ``base/gf7/M2 shift (0, 0, 20) um``."""
        return perturbation_text(self.job.perturb) or "nothing"


@shows("camera.name", "errors [waves]", "worst")
@dataclass(frozen=True, eq=False)
class CameraRun:
    """Results of a camera analysis.

    Attributes
    ----------
    setup : CameraSetup
        Camera as specified by the user.
    camera : CameraSpec
        Prescription that is analysed: the refocused one, if that was requested.
    optics : CameraOptics
        Its optical analysis.
    first_order : FirstOrderData
        First-order data.
    waves : tuple of Wavefront
        Wavefront errors at GRID.
    spots : tuple of Spot
        Spots at GRID.
    mtfs : tuple of Mtf
        MTF of the optics at MTF_FIELDS and the design wavelength; empty for a camera too blurred for it.
    without_mtf : str
        Reason why there is no MTF; empty where there is one.
    field : (A, B, 2) ndarray
        Fields of the map of wavefront errors: A fields along the line and B along the track.
    errors : (A, B) ndarray
        Rms wavefront errors of the map, waves.
    distortion : Distortion
        Distortion over the field and along the line.
    curves : FieldCurves
        Curves along the line.
    focus : ThroughFocus
        Image quality through focus at MTF_FIELDS.
    refocus : Refocus or None
        Result of refocusing; None if it was not requested.
    perturbed : Perturbed or None
        Effect of the perturbation; None without one.
    quality : CameraQuality or None
        Obscuration by bodies of the instrument; None for a camera without one.
    colours : Colours or None
        Results over the spectrum or band; None where neither is specified.
    mounted_in : Instrument or None
        Instrument that carries the camera; None for a camera alone in its nominal state.
    """

    setup: CameraSetup
    camera: CameraSpec
    optics: CameraOptics
    first_order: FirstOrderData
    waves: tuple[Wavefront, ...]
    spots: tuple[Spot, ...]
    mtfs: tuple[Mtf, ...]
    without_mtf: str
    field: np.ndarray
    errors: np.ndarray
    distortion: aberrations.Distortion
    curves: aberrations.FieldCurves
    focus: aberrations.ThroughFocus
    refocus: Refocus | None = None
    perturbed: Perturbed | None = None
    quality: CameraQuality | None = None
    colours: Colours | None = None
    mounted_in: Instrument | None = None

    @cached_property
    def instrument(self) -> Instrument:
        """Instrument that carries the camera, for the 3-D view; a camera alone forms one."""
        if self.mounted_in is not None:
            return self.mounted_in
        spec, _, name = self.setup.mounted_instrument
        return build_instrument(spec, {name: self.camera}, self.optics.path.backend)

    @cached_property
    def worst(self) -> tuple[float, Field]:
        """Largest wavefront error over the field, waves rms, and its field."""
        # of fields that are equal but for rounding, as in a symmetric camera, choose that at the line's left end
        same = np.round(self.errors / np.max(self.errors), 6)[::-1]
        k = np.unravel_index(int(np.argmax(same)), same.shape)
        k = (len(same) - 1 - k[0], k[1])
        return float(self.errors[k]), (float(self.field[k][0]), float(self.field[k][1]))

    @cached_property
    def limits(self) -> tuple[tuple[str, float], ...]:
        """Types of aberration at the worst field and their rms, waves, the largest first."""
        wave = self.optics.wavefront(self.worst[1], points=3)
        kinds: dict[str, float] = {}
        for j, part in enumerate(wave.parts[3:], start=4):
            kinds[aberration_name(j)] = kinds.get(aberration_name(j), 0.0) + float(part) ** 2
        ranked = sorted(((kind, float(np.sqrt(square))) for kind, square in kinds.items()), key=lambda k: -k[1])
        return tuple(ranked)

    @cached_property
    def third_order(self) -> aberrations.ThirdOrder | None:
        """Third-order aberrations of the nominal camera by surface; None for one that is not centred on an axis."""
        return aberrations.third_order(self.optics.model)

    @cached_property
    def ghosts(self) -> tuple[Ghost, ...]:
        """Ghosts of the nominal camera in the middle of the field, the largest irradiance first."""
        return aberrations.camera_ghosts(self.optics.model, self.optics.path.backend)

    @cached_property
    def fans(self) -> aberrations.RayFans:
        """Ray fans at FAN_FIELDS."""
        return aberrations.ray_fans(self.optics, FAN_FIELDS)

    @cached_property
    def images(self) -> aberrations.PointImages | None:
        """Point images and their energies at the design wavelength; None for a camera too blurred for an MTF."""
        return aberrations.point_images(self.optics) if self.mtfs else None


def aberration_name(index: int) -> str:
    """Return the name of the aberration of a Zernike term, such as coma, without its orientation.

    ``index`` is the Noll index.
    """
    words = zernike.name(index).split()
    return " ".join(words if zernike.noll_to_nm(index)[1] == 0 else words[: -1 if words[-1] in ("x", "y") else -2])


def run_camera(
    setup: CameraSetup,
    backend: Backend,
    seed: int = 0,
    advance: Advance = silent,
    refocus: bool = False,
    tilt: bool = False,
) -> CameraRun:
    """Analyse a camera.

    Parameters
    ----------
    setup : CameraSetup
        Camera.
    backend : Backend
        Array backend of the trace.
    seed : int
        Not used, since the analysis has no random numbers; present as for all commands.
    advance : Advance
        Called with the progress.
    refocus : bool
        Find the best focal plane of the camera in its state first and analyse the camera with it.
    tilt : bool
        Allow a tilt of that plane about the line as well.

    Raises
    ------
    InputError
        Light of the field does not pass, or has no focus after the last mirror.
    """
    advance("focus", 0, 1)
    refocus = refocus or setup.refocus
    camera, refocused = setup.camera, None
    built = setup.instrument is not None and bool(setup.instrument.as_built)
    if refocus and not (setup.perturb or built):
        refocused = find_focus(CameraOptics.alone(camera, backend), tilt, setup.mounted)
        camera = with_plane(camera, refocused.after)
    optics = CameraOptics.alone(camera, backend)
    quality, perturbed, instrument = None, None, None
    state: State = {}
    if setup.instrument is not None or setup.perturb:
        instrument_spec, cameras, mounted = setup.mounted_instrument
        cameras = {name: camera if spec == setup.camera else spec for name, spec in cameras.items()}
        instrument = build_instrument(instrument_spec, cameras, backend)
        optics = CameraOptics.within(instrument, mounted, backend)
        if setup.perturb:
            job = checked_nodes(setup.job, instrument.nodes)
            state = job_state(job, ThermalModel(instrument))
        if refocus and refocused is None:
            existing = motions_of(job) if setup.perturb else {}
            refocused, state = refocused_state(optics.in_state(state), existing, tilt, setup.mounted)
        if setup.instrument is not None:
            quality = image_quality(instrument, backend, [state], QUALITY_FIELDS).cameras[mounted]
    advance("focus", 1, 1)
    field = aberrations.field_grid(ERROR_GRID)
    where = tuple(map(tuple, field.reshape(-1, 2)))
    errors = optics.errors(where, RINGS if built else MAP_RINGS).reshape(field.shape[:2])
    if setup.perturb and instrument is not None:
        change = trace_truth(instrument, backend, [state]).cameras[mounted]
        perturbed = Perturbed(job, change, errors, _nyquist(optics, errors))
    if state:
        optics = optics.in_state(state)
        errors = optics.errors(where).reshape(field.shape[:2])
    sharp = float(errors.max()) < MAX_WAVES_FOR_MTF
    without_mtf = f"wavefront errors exceed {MAX_WAVES_FOR_MTF:g} waves, and it would be nearly zero"
    advance("wavefronts", 0, 1)
    waves, spots = optics.wavefronts(GRID, points=MAP_POINTS), optics.spots(GRID)
    advance("wavefronts", 1, 1)
    advance("MTF", 0, 1)
    try:
        mtfs = optics.mtfs(MTF_FIELDS) if sharp else ()
    except UnphysicalError as error:  # a pupil cut by edges, or a wavefront that is too irregular
        mtfs, sharp, without_mtf = (), False, f"it cannot be computed for this pupil: {error}"
    focus = aberrations.through_focus(optics, MTF_FIELDS, sharp)
    curves = aberrations.field_curves(optics, sharp)
    advance("MTF", 1, 1)
    colours, light = None, camera.light
    if light is not None and light.ends[0] < light.ends[1]:
        advance("colours", 0, 1)
        colours = evaluate_colours(optics, light, MTF_FIELDS, bool(mtfs))
        advance("colours", 1, 1)
    run = CameraRun(
        setup=setup,
        camera=camera,
        optics=optics,
        first_order=first_order_data(optics),
        waves=waves,
        spots=spots,
        mtfs=mtfs,
        without_mtf="" if mtfs else without_mtf,
        field=field,
        errors=errors,
        distortion=aberrations.distortion(optics),
        curves=curves,
        focus=focus,
        refocus=refocused,
        perturbed=perturbed,
        quality=quality,
        colours=colours,
        mounted_in=instrument,
    )
    for part in ("images", "ghosts"):  # what takes long is computed here, where its progress is shown
        advance(part, 0, 1)
        getattr(run, part)
        advance(part, 1, 1)
    return run


def _nyquist(optics: CameraOptics, errors: np.ndarray) -> np.ndarray:
    """Return the MTF at Nyquist at the F fields MTF_FIELDS, along line and track, (F, 2); empty if not computable."""
    with suppress(UnphysicalError):
        if errors.max() < MAX_WAVES_FOR_MTF:
            return np.array([mtf.at(optics.nyquist) for mtf in optics.mtfs(MTF_FIELDS)])
    return np.empty((0, 2))


def verdict(run: CameraRun) -> tuple[str, ...]:
    """Return the verdict: image quality, worst field and dominant aberration; then the MTF."""
    worst, field = run.worst
    position_text = field_text(run.camera, field)
    (kind, size), *_ = run.limits
    lead = f"{worst:.3g} waves rms at field {position_text}, mainly {kind} ({size:.3g})"
    marechal = f"Mar\N{LATIN SMALL LETTER E WITH ACUTE}chal's limit is {SHARP:.3f}"
    if worst <= SHARP:
        text = f"Diffraction limited over the whole field: the worst wavefront error is {lead} ({marechal})."
    elif worst <= BLURRED:
        share = float(np.mean(run.errors <= SHARP))
        part = "nowhere in"
        if share:
            percent = "less than 1" if share < 0.01 else "more than 99" if share > 0.99 else f"{100.0 * share:.0f}"
            part = f"in {percent} % of"
        text = f"Diffraction limited {part} the field: the worst wavefront error is {lead} ({marechal})."
    else:
        text = (
            f"Blurred: the worst wavefront error is {lead}; beyond {BLURRED:g} waves an image has almost no contrast."
        )
    if run.mtfs:
        low = min(float(np.min(mtf.at(run.optics.nyquist))) for mtf in run.mtfs)
        limit = max(float(np.interp(mtf.nyquist, mtf.frequency, row)) for mtf in run.mtfs for row in mtf.limit)
        lowest = f"The lowest MTF of the optics, without the pixel, at Nyquist is {low:.2g} over the field"
        return text, f"{lowest}; the diffraction limit is {limit:.2f}."
    return (text,)


def perturbed_text(run: CameraRun) -> str:
    """Describe the effect of the perturbation; empty without one."""
    perturbed = run.perturbed
    if perturbed is None:
        return ""
    changes = zip(parameters.ESTIMATED, perturbed.change.vector[0].tolist(), strict=True)
    change_text = ", ".join(
        f"{parameter.symbol} {parameter.per_si * value + 0.0:+.{parameter.decimals}f} {parameter.unit}"
        for parameter, value in changes
    )
    state = "Perturbed and refocused" if run.refocus else "Perturbed"
    text = (
        f"{state}: {perturbed.words}. The geometry changes by {change_text}; the worst wavefront error changes from "
        f"{perturbed.errors.max():.3g} to {run.worst[0]:.3g} waves rms"
    )
    if len(perturbed.mtf) and run.mtfs:
        after = min(float(np.min(mtf.at(run.optics.nyquist))) for mtf in run.mtfs)
        text += f", the lowest MTF of the optics at Nyquist from {float(np.min(perturbed.mtf)):.3f} to {after:.3f}"
    return f"{text}. {_OF_THE_DRAWING}"


_LONG = re.compile(r"-?\d+\.\d{3,}(e-?\d+)?")
"""Pattern of numbers with three or more decimals, which are rounded in sentences."""
_OF_THE_DRAWING = "First-order data refer to this state; layout and obscuration to the nominal camera."


def built_text(run: CameraRun) -> str:
    """Describe the as-built errors of the camera's instrument; empty without any."""
    instrument = run.setup.instrument
    words = "" if instrument is None or not instrument.as_built else perturbation_text(instrument.as_built)
    words = _LONG.sub(lambda number: f"{float(number.group()):.4g}", words)
    if not words:
        return ""
    return f"As built: {words}." if run.perturbed is not None else f"As built: {words}. {_OF_THE_DRAWING}"


def refocus_text(run: CameraRun) -> str:
    """Describe the result of refocusing; empty if it was not requested."""
    refocused = run.refocus
    if refocused is None:
        return ""
    along = "along" if refocused.downstream else "against"
    instead = " in place of the focal plane's own perturbation" if refocused.moved else ""
    return (
        f"Refocusing: {', '.join(refocused.words)}{instead} (+z points toward the scene, here {along} the light). The "
        f"worst wavefront error changes from {refocused.errors_before.max():.3g} to {refocused.errors_after.max():.3g} "
        f"waves rms, its rms over the field from {np.sqrt(np.mean(refocused.errors_before**2)):.3g} to "
        f"{np.sqrt(np.mean(refocused.errors_after**2)):.3g}."
    )


_WAVE: Record[Wavefront] = Record(
    "Wavefront error at one field, piston and tilt removed.",
    Quantity("field", lambda w: w.field, "shares of the half field, along the line and along the track"),
    Quantity(
        "position_mm", lambda w: np.array(w.position), "chief ray on the line CCD, along the line and along the track"
    ),
    Quantity("wfe_rms_waves", lambda w: w.rms, "rms over the stop"),
    Quantity("wfe_pv_waves", lambda w: w.peak_to_valley, "peak to valley over the stop"),
    Quantity("strehl", lambda w: w.strehl, "Strehl ratio"),
    Quantity("vignetted", lambda w: w.vignetted, "fraction of the stop's area whose light is blocked"),
)
_SPOT: Record[Spot] = Record(
    "Spot at one field.",
    Quantity("spot_rms_um", lambda s: s.rms, "rms distance from the centroid"),
    Quantity("spot_largest_um", lambda s: s.farthest, "largest distance of a ray from the centroid"),
)
_MTF: Record[Mtf] = Record(
    "MTF of the optics, without the pixel, at the Nyquist frequency.",
    Quantity("field", lambda m: m.field, "shares of the half field, along the line and along the track"),
    Quantity("along_line", lambda m: m.at(m.nyquist)[0]),
    Quantity("along_track", lambda m: m.at(m.nyquist)[1]),
    Quantity(
        "accuracy",
        lambda m: m.accuracy or None,
        "pupil vignetted by edges: largest change of the curve with a third of the lines through it",
        where_known=True,
    ),
)
_DISTORTION: Record[aberrations.Distortion] = Record(
    "Distortion relative to the best-fitting distortion-free camera, over the field and along the line.",
    Quantity("principal_distance_m", lambda d: d.distance, "f of the best-fitting distortion-free camera"),
    Quantity("principal_point_mm", lambda d: d.point, "principal point of that camera, from the line's middle"),
    Quantity("rms_um", lambda d: d.rms, "rms distance from the images of that camera over the field"),
    Quantity("largest_um", lambda d: d.largest, "largest distance from the images of that camera"),
    Quantity("line_principal_distance_m", lambda d: d.line_distance, "with the principal point in the line's middle"),
    Quantity("line_rms_um", lambda d: d.line_rms, "rms distortion along the line"),
    Quantity("line_largest_um", lambda d: d.line_largest, "largest distortion along the line"),
    Quantity(
        "line_fitted_with_point_m",
        lambda d: {"principal_distance": d.line_point[1], "principal_point": d.line_point[0]},
        "principal distance and point fitted to the line together",
    ),
)
_REFOCUS: Record[Refocus] = Record(
    "Focal plane before and after refocusing, with rms wavefront errors.",
    Quantity("perturb", lambda r: list(r.words), "motion of the focal plane, as --perturb and a job's file take it"),
    Quantity("z_before_m", lambda r: r.before.z),
    Quantity("z_after_m", lambda r: r.after.z),
    Quantity("tilt_before_deg", lambda r: r.before.tilt),
    Quantity("tilt_after_deg", lambda r: r.after.tilt),
    Quantity("wfe_worst_before_waves", lambda r: r.errors_before.max(), "error of the worst field"),
    Quantity("wfe_worst_after_waves", lambda r: r.errors_after.max(), "error of the worst field"),
    Quantity("wfe_rms_before_waves", lambda r: np.sqrt(np.mean(r.errors_before**2)), "rms over the fields"),
    Quantity("wfe_rms_after_waves", lambda r: np.sqrt(np.mean(r.errors_after**2)), "rms over the fields"),
)


_PERTURBED: Record[Perturbed] = Record(
    "Effect of a perturbation: changes of the camera's geometry by exact chief rays, and its values before.",
    Quantity("perturb", lambda p: p.job.plain()["perturb"], "perturbation as in a job's file"),
    *(
        Quantity(parameter.key, lambda p, k=k: p.change.vector[0, k], parameter.meaning)  # type: ignore[misc]
        for k, parameter in enumerate(parameters.ESTIMATED)
    ),
    Quantity("worst_as_designed_waves", lambda p: p.errors.max(), "wavefront error of the worst field"),
    Quantity(
        "mtf_as_designed",
        lambda p: p.mtf,
        "MTF of the optics at Nyquist, along the line and along the track, field by field",
    ),
)


def _field_numbers(run: CameraRun) -> list[dict[str, Any]]:
    """Return wavefront, spot and Zernike terms without piston and tilts of every field of ``GRID``."""
    out = []
    for wave, spot in zip(run.waves, run.spots, strict=True):
        out.append({**_WAVE(wave), **_SPOT(spot), "zernike_waves": dict(list(wave.terms.items())[3:])})
        if wave.is_vignetted:
            terms = dict(list(wave.orthonormal_terms.items())[3:])
            out[-1] |= {"wfe_accuracy": wave.accuracy, "polynomials": wave.polynomials, "orthonormal_waves": terms}
    return out


CAMERA: Record[CameraRun] = Record(
    "optics.json: analysis of a camera.",
    Quantity("camera", lambda run: run.camera.name),
    Quantity("instrument", lambda run: run.setup.where or None, "instrument in which the camera is mounted"),
    Quantity("mounted", lambda run: run.setup.mounted, "name of the camera in the instrument"),
    Quantity("wfe_worst_waves", lambda run: run.worst[0], "largest wavefront error over the field, rms"),
    Quantity("worst_field", lambda run: run.worst[1], "field of this error"),
    Quantity(
        "limited_by",
        lambda run: [{"aberration": kind, "wfe_rms_waves": size} for kind, size in run.limits[:4]],
        "types of aberration at the worst field, the largest first",
    ),
    Quantity("wavelength_nm", lambda run: run.camera.wavelength, "design wavelength"),
    Quantity(
        "image",
        lambda run: {"z_m": run.camera.image.z, "tilt_deg": np.degrees(run.camera.image.tilt or 0.0)},
        "focal plane in the prescription",
    ),
    Quantity("first_order", lambda run: run.first_order, record=FIRST_ORDER),
    Quantity("fields", _field_numbers, "wavefront and spot, field by field"),
    Quantity("mtf_at_nyquist", lambda run: run.mtfs, "MTF of the optics, field by field", record=_MTF),
    Quantity("energy", lambda run: run.images, "energy of point images", record=aberrations.ENERGY, where_known=True),
    Quantity(
        "third_order",
        lambda run: run.third_order,
        "Seidel and chromatic sums by surface",
        record=aberrations.THIRD_ORDER,
        where_known=True,
    ),
    Quantity("ghosts", lambda run: run.ghosts, "ghosts, the largest irradiance first", record=aberrations.GHOST),
    Quantity("colours", lambda run: run.colours, "polychromatic results", record=COLOURS, where_known=True),
    Quantity("distortion", lambda run: run.distortion, record=_DISTORTION),
    Quantity("refocus", lambda run: run.refocus, record=_REFOCUS),
    Quantity("perturbed", lambda run: run.perturbed, record=_PERTURBED),
    Quantity(
        "bodies_in_the_beam",
        lambda run: None if run.quality is None else {body: shares[0] for body, shares in run.quality.bodies.items()},
        "body of the instrument -> fraction of the beam that it blocks, at fields along the line",
    ),
)


def camera_data(run: CameraRun) -> xr.Dataset:
    """Return the contents of optics.nc: wavefront maps, Zernike terms, spots, MTF and curves along the line."""
    first = run.waves[0].to_xarray()
    fields = [list(wave.field) for wave in run.waves]
    waves, rms, metres = {"units": "waves"}, {"units": "waves rms"}, {"units": "m"}

    def named(text: str, axis_attributes: dict[str, str] | None = None) -> dict[str, str]:
        return {**(axis_attributes or {}), "long_name": text}

    mtf = ("mtf_field", "direction", "frequency")
    share = "fraction of the half field"
    maps = np.stack([w.map for w in run.waves])
    terms, parts = (np.stack([getattr(w, name) for w in run.waves]) for name in ("coefficients", "parts"))
    focus_attributes = named("MTF of the optics at the Nyquist frequency through focus")
    orthonormal = named("Zernike terms made orthonormal over the light of each pupil", rms)
    data: dict[str, Any] = {
        "wavefront": (("field", "y", "x"), maps, named("wavefront error over the stop", waves)),
        "zernike": (("field", "noll"), terms, named("Zernike terms of the wavefront error", rms)),
    }
    if any(w.is_vignetted for w in run.waves):
        data["orthonormal"] = (("field", "noll"), parts, orthonormal)
    data |= {
        "field_share": (("field", "direction"), np.array(fields), named(share)),
        "wfe": (("field_along", "field_across"), run.errors, named("wavefront error over the field", rms)),
        "through_focus_wfe": (("mtf_field", "defocus"), run.focus.error, named("wavefront error through focus", rms)),
        "through_focus_mtf": (("mtf_field", "direction", "defocus"), run.focus.mtf, focus_attributes),
        "distortion_line": (
            ("line",),
            run.distortion.residual,
            named("distortion along the line: L - f tan W", metres),
        ),
    }
    coords: dict[str, Any] = {
        "x": first["x"],
        "y": first["y"],
        "noll": first["noll"],
        "term": first["term"].assign_attrs(named("name of the Zernike term")),
        "direction": ("direction", ["along line", "along track"], named("direction on the focal plane")),
        "field_along": ("field_along", run.field[:, 0, 0], named(f"{share}, along the line")),
        "field_across": ("field_across", run.field[0, :, 1], named(f"{share}, along the track")),
        "defocus": ("defocus", run.focus.defocus, named("defocus of the detector, downstream positive", metres)),
        "line": ("line", run.distortion.position, named("position along the line, from its middle", metres)),
        "mtf_field_share": (("mtf_field", "direction"), np.array(MTF_FIELDS), named(share)),
    }
    if run.mtfs:
        data["mtf"] = (mtf, np.stack([m.values for m in run.mtfs]), named("MTF of the optics"))
        perfect = named("MTF of the optics without wavefront error, the diffraction limit")
        data["mtf_limit"] = (mtf, np.stack([m.limit for m in run.mtfs]), perfect)
        axis_attributes = named("spatial frequency in the image, cycles per length", {"units": "1/m"})
        coords["frequency"] = ("frequency", run.mtfs[0].frequency, axis_attributes)
    if run.colours is not None:
        colour_variables, colour_coords = colour_data(run.colours)
        data |= colour_variables
        coords |= colour_coords
    fan = ("fan_field", "fan", "direction", "pupil")
    data["ray_fan"] = (fan, run.fans.transverse, named("position of rays of a fan, chief ray at 0", metres))
    data["path_fan"] = (fan[:2] + fan[3:], run.fans.path, named("wavefront error of a fan, chief ray at 0", waves))
    coords["fan"] = ("fan", ["along line", "along track"], named("diameter of the stop"))
    coords["pupil"] = ("pupil", run.fans.pupil, named("coordinate in the stop, in units of its radius"))
    coords["fan_field_share"] = (("fan_field", "direction"), np.array(FAN_FIELDS), named(share))
    if run.ghosts:
        pairs = [f"{ghost.back} {ghost.forward}" for ghost in run.ghosts]
        coords["ghost"] = ("ghost", pairs, named("surfaces that reflect back and forward"))
        for key, text, units in (
            ("focus", "paraxial focus of a ghost from the image plane", metres),
            ("diameter", "diameter of a ghost in the image plane", metres),
            ("energy", "light of a ghost over that of the image", None),
            ("irradiance", "mean irradiance of a ghost over that of the image", None),
        ):
            data[f"ghost_{key}"] = (("ghost",), [getattr(g, key) for g in run.ghosts], named(text, units))
    attributes = {"title": "wavefronts, MTF and distortion of a camera over its field"}
    return xr.Dataset(data, coords, {**attributes, "reference_frames": frames_text("optics")})
