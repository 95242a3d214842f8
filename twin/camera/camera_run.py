"""A camera judged: everything that its report shows, its numbers, and the sentence that comes first."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr

from analysis.arrays import shows
from analysis.monitor import parameters
from optics.geometry import zernike
from optics.geometry.tree import State
from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import Backend
from optics.raytrace.first_order import LineChange
from scenes.models.camera_design import with_plane
from scenes.models.camera_sharpness import BLURRED, FIELDS, FieldBeams, FocalPlane, field_text
from scenes.models.instrument_builder import build_instrument
from scenes.models.job_state import job_state
from scenes.models.thermal_model import ThermalModel
from scenes.specs.camera import CameraSpec
from scenes.specs.job import JobSpec, checked_nodes
from scenes.specs.perturbation import perturbation_text
from scenes.specs.resolved import CameraSetup
from scenes.yaml.errors import InputError, Issue
from twin.camera import field_maps
from twin.camera.camera_optics import CameraOptics
from twin.camera.camera_results import Field, Mtf, Spot, Wavefront
from twin.camera.colour import COLOURS, Colours, colour_data, judge_colours
from twin.camera.first_order_data import FIRST_ORDER, FirstOrderData, first_order_data
from twin.framework.procedure import Advance, silent
from twin.framework.record import Quantity, Record
from twin.framework.reference_frames import frames_text
from twin.monitor.image_quality import CameraQuality, image_quality
from twin.monitor.truth import trace_truth

SHARP = 1.0 / 14.0
"""Marechal's limit: Strehl ratio 0.8, waves rms."""

MOST_WAVES = 10.0
"""Wavefront error beyond which no MTF is worked out: it would take minutes and be nothing."""

GRID: tuple[Field, ...] = tuple((x, y) for y in (1.0, 0.0, -1.0) for x in (-1.0, 0.0, 1.0))
"""Fields of wavefront maps and spot diagrams, row by row."""

MTF_FIELDS: tuple[Field, ...] = ((0.0, 0.0), (0.7, 0.0), (1.0, 0.0), (1.0, 1.0), (1.0, -1.0))
"""Fields of MTF curves and through focus."""

ERROR_GRID = (25, 9)
"""Fields along the line and along the track of the map of wavefront errors."""

MAP_POINTS = 129
"""Points of a wavefront's map on each axis."""

QUALITY_FIELDS = (-1.0, 0.0, 1.0)
"""Shares of half the line at which bodies of an instrument are looked for in the beam."""


@shows("errors_before [waves]", "errors_after [waves]", "tilt")
@dataclass(frozen=True, eq=False)
class Refocus:
    """A focal plane found anew.

    Attributes
    ----------
    before, after : FocalPlane
        The plane of the file and the best one.
    errors_before, errors_after : np.ndarray
        Rms wavefront error at ``FIELDS``, waves.
    tilt : bool
        Whether it was turned, too.
    """

    before: FocalPlane
    after: FocalPlane
    errors_before: np.ndarray
    errors_after: np.ndarray
    tilt: bool


@dataclass(frozen=True, eq=False)
class Perturbed:
    """What a perturbation does to a camera.

    Attributes
    ----------
    job : JobSpec
        That says it, with the paths of the bodies.
    change : LineChange
        Of the camera's geometry, of one state.
    errors : np.ndarray
        Rms wavefront error before it at the fields of the run's map, waves, (A, B).
    mtf : np.ndarray
        At Nyquist before it at MTF_FIELDS, along the line and along the track, (F, 2); empty where there is none.
    """

    job: JobSpec
    change: LineChange
    errors: np.ndarray
    mtf: np.ndarray

    @property
    def words(self) -> str:
        """What was done: ``base/gf7/M2 shift (0, 0, 20) um``."""
        return perturbation_text(self.job.perturb) or "nothing"


@shows("camera.name", "errors [waves]", "worst")
@dataclass(frozen=True, eq=False)
class CameraRun:
    """A judged camera.

    Attributes
    ----------
    setup : CameraSetup
        As it was given.
    camera : CameraSpec
        The prescription that is judged: the refocused one, if that was asked for.
    optics : CameraOptics
        It, ready to be looked at.
    first_order : FirstOrderData
        Its data.
    waves : tuple[Wavefront, ...]
        Wavefront errors at GRID.
    spots : tuple[Spot, ...]
        Spots at GRID.
    mtfs : tuple[Mtf, ...]
        MTF of the optics at MTF_FIELDS and the design wavelength; empty for a camera too blurred for it.
    without_mtf : str
        Why there is none, empty where there is.
    field : np.ndarray
        Fields of the map of wavefront errors, (A, B, 2).
    errors : np.ndarray
        Rms wavefront error there, waves, (A, B).
    distortion : field_maps.Distortion
        Over the field and along the line.
    curves : field_maps.FieldCurves
        Along the line.
    focus : field_maps.ThroughFocus
        Through focus at MTF_FIELDS.
    refocus : Refocus | None
        What refocusing did, None where nobody asked.
    perturbed : Perturbed | None
        What was done to it, None for a camera as designed.
    quality : CameraQuality | None
        Of a camera in an instrument: what its bodies take of the beam.
    colours : Colours | None
        Over the light of its spectrum or band; None where neither is described.
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
    distortion: field_maps.Distortion
    curves: field_maps.FieldCurves
    focus: field_maps.ThroughFocus
    refocus: Refocus | None = None
    perturbed: Perturbed | None = None
    quality: CameraQuality | None = None
    colours: Colours | None = None

    @cached_property
    def worst(self) -> tuple[float, Field]:
        """Largest wavefront error over the field, waves rms, and where."""
        # of places that are the same but for rounding, as in a symmetric camera, the one at the line's left end
        same = np.round(self.errors / np.max(self.errors), 6)[::-1]
        k = np.unravel_index(int(np.argmax(same)), same.shape)
        k = (len(same) - 1 - k[0], k[1])
        return float(self.errors[k]), (float(self.field[k][0]), float(self.field[k][1]))

    @cached_property
    def limits(self) -> tuple[tuple[str, float], ...]:
        """Kinds of aberration at the worst field and their rms, waves, the largest first."""
        wave = self.optics.wavefront(self.worst[1], points=3)
        kinds: dict[str, float] = {}
        for j, part in enumerate(wave.parts[3:], start=4):
            kinds[kind_of(j)] = kinds.get(kind_of(j), 0.0) + float(part) ** 2
        found = sorted(((kind, float(np.sqrt(square))) for kind, square in kinds.items()), key=lambda k: -k[1])
        return tuple(found)


def kind_of(index: int) -> str:
    """Name of a Zernike term without its direction."""
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
    """Judge a camera.

    Parameters
    ----------
    setup : CameraSetup
        The camera.
    backend : Backend
        Where to trace.
    seed : int
        Of nothing; nothing is drawn.
    advance : Advance
        Told what is being done.
    refocus : bool
        Find the best focal plane first and judge the camera with it.
    tilt : bool
        Let it turn about the line, too.

    Raises
    ------
    InputError
        Light of the field does not come through, or has no focus after the last mirror.
    """
    advance("focus", 0, 1)
    camera, moved = setup.camera, None
    built = setup.instrument is not None and bool(setup.instrument.as_built)
    if refocus and (setup.perturb or built):
        what = "perturbed" if setup.perturb else "as built"
        text = f"the best image plane is that of a camera as designed, and this one is {what}"
        raise InputError(Issue(text, found="--refocus", allowed="one of the two"))
    if refocus:
        moved = find_focus(camera, backend, tilt)
        camera = with_plane(camera, moved.after)
    advance("focus", 1, 1)
    optics = CameraOptics.alone(camera, backend)
    quality, done = None, None
    state: State = {}
    if setup.instrument is not None or setup.perturb:
        instrument_spec, cameras, mounted = setup.mounted_instrument
        cameras = {name: camera if one == setup.camera else one for name, one in cameras.items()}
        instrument = build_instrument(instrument_spec, cameras, backend)
        optics = CameraOptics.within(instrument, mounted, backend)
        if setup.perturb:
            job = checked_nodes(setup.job, instrument.nodes)
            state = job_state(job, ThermalModel(instrument))
        if setup.instrument is not None:
            quality = image_quality(instrument, backend, [state], QUALITY_FIELDS).cameras[mounted]
    field = field_maps.field_grid(ERROR_GRID)
    where = tuple(map(tuple, field.reshape(-1, 2)))
    errors = (
        optics.errors(where) if built else FieldBeams.field_errors(optics.model, backend, where, 5, optics.cut)
    ).reshape(field.shape[:2])
    if setup.perturb:
        change = trace_truth(instrument, backend, [state]).cameras[mounted]
        done = Perturbed(job, change, errors, _nyquist(optics) if errors.max() < MOST_WAVES else np.empty((0, 2)))
        optics = optics.in_state(state)
        errors = optics.errors(where).reshape(field.shape[:2])
    sharp, why = (
        float(errors.max()) < MOST_WAVES,
        f"of wavefront errors beyond {MOST_WAVES:g} waves: it is next to nothing",
    )
    advance("wavefronts", 0, 1)
    waves, spots = optics.wavefronts(GRID, points=MAP_POINTS), optics.spots(GRID)
    advance("wavefronts", 1, 1)
    advance("MTF", 0, 1)
    try:
        mtfs = optics.mtfs(MTF_FIELDS) if sharp else ()
    except UnphysicalError as error:  # of a pupil that edges cut, or whose wavefront is too rough
        mtfs, sharp, why = (), False, f"of this pupil: {error}"
    focus = field_maps.through_focus(optics, MTF_FIELDS, sharp)
    curves = field_maps.field_curves(optics, sharp)
    advance("MTF", 1, 1)
    colours, light = None, camera.light
    if light is not None and light.ends[0] < light.ends[1]:
        advance("colours", 0, 1)
        colours = judge_colours(optics, light, MTF_FIELDS, bool(mtfs))
        advance("colours", 1, 1)
    return CameraRun(
        setup=setup,
        camera=camera,
        optics=optics,
        first_order=first_order_data(optics),
        waves=waves,
        spots=spots,
        mtfs=mtfs,
        without_mtf="" if mtfs else why,
        field=field,
        errors=errors,
        distortion=field_maps.distortion(optics),
        curves=curves,
        focus=focus,
        refocus=moved,
        perturbed=done,
        quality=quality,
        colours=colours,
    )


def _nyquist(optics: CameraOptics) -> np.ndarray:
    """MTF at Nyquist at MTF_FIELDS, (F, 2); empty where the pupil has none."""
    try:
        return np.array([mtf.at(optics.nyquist) for mtf in optics.mtfs(MTF_FIELDS)])
    except UnphysicalError:
        return np.empty((0, 2))


def find_focus(camera: CameraSpec, backend: Backend, tilt: bool) -> Refocus:
    """The focal plane with the least mean square wavefront error over ``FIELDS``.

    Raises
    ------
    InputError
        Light does not come through, or has no focus after the last mirror.
    """
    beams = FieldBeams.trace(CameraOptics.alone(camera, backend).model, backend, FIELDS, 6)
    best, own = beams.best_plane(tilt), FocalPlane.of(camera)
    if not beams.reaches(best):
        problem = f"refocusing cannot help: the light has no focus after {list(camera.mirrors)[-1]}"
        raise camera.error(problem, ("mirrors",), allowed="mirrors that make a real image")
    return Refocus(own, best, beams.errors(own), beams.errors(best), tilt)


def verdict(run: CameraRun) -> tuple[str, ...]:
    """Sentences: how good the camera is, where it is worst and what limits it; then its MTF."""
    worst, where = run.worst
    place = field_text(run.camera, where)
    (kind, size), *_ = run.limits
    lead = f"{worst:.3g} waves rms at field {place}, most of it {kind} ({size:.3g})"
    if worst <= SHARP:
        text = f"Diffraction limited over the whole field: the worst wavefront error is {lead}"
        text += f" (Mar\N{LATIN SMALL LETTER E WITH ACUTE}chal's limit is {SHARP:.3f})."
    elif worst <= BLURRED:
        share = float(np.mean(run.errors <= SHARP))
        text = f"Not diffraction limited in {100.0 * (1.0 - share):.0f}% of the field: the worst wavefront error is "
        text += f"{lead} (Mar\N{LATIN SMALL LETTER E WITH ACUTE}chal's limit is {SHARP:.3f})."
    else:
        text = f"Blurred: the worst wavefront error is {lead}, and beyond {BLURRED:g} an image has almost no contrast."
    if run.mtfs:
        low = min(float(np.min(mtf.at(run.optics.nyquist))) for mtf in run.mtfs)
        limit = max(float(np.interp(mtf.nyquist, mtf.frequency, row)) for mtf in run.mtfs for row in mtf.limit)
        return text, f"The lowest MTF of the optics at Nyquist is {low:.2g}; diffraction would allow {limit:.2f}."
    return (text,)


def perturbed_text(run: CameraRun) -> str:
    """What the perturbation did, empty for a camera as designed."""
    done = run.perturbed
    if done is None:
        return ""
    told = zip(parameters.ESTIMATED, done.change.vector[0].tolist(), strict=True)
    moved = ", ".join(f"{one.symbol} {one.per_si * value + 0.0:+.{one.decimals}f} {one.unit}" for one, value in told)
    text = (
        f"Perturbed: {done.words}. The geometry changes by {moved}; the worst wavefront error goes from "
        f"{done.errors.max():.3g} to {run.worst[0]:.3g} waves rms"
    )
    if len(done.mtf) and run.mtfs:
        after = min(float(np.min(mtf.at(run.optics.nyquist))) for mtf in run.mtfs)
        text += f", the least MTF at Nyquist from {float(np.min(done.mtf)):.3f} to {after:.3f}"
    return f"{text}. {_OF_THE_DRAWING}"


_LONG = re.compile(r"-?\d+\.\d{3,}(e-?\d+)?")
"""Numbers with more digits than a sentence bears."""
_OF_THE_DRAWING = "First-order data are those of this state; layout and obscuration are of the camera as designed."


def built_text(run: CameraRun) -> str:
    """How the camera's instrument was built, empty for one as drawn."""
    instrument = run.setup.instrument
    words = "" if instrument is None or not instrument.as_built else perturbation_text(instrument.as_built)
    words = _LONG.sub(lambda number: f"{float(number.group()):.4g}", words)
    if not words:
        return ""
    return f"As built: {words}." if run.perturbed is not None else f"As built: {words}. {_OF_THE_DRAWING}"


def refocus_text(run: CameraRun) -> str:
    """What refocusing did, empty where nobody asked for it."""
    moved = run.refocus
    if moved is None:
        return ""
    shift = 1e3 * (moved.after.z - moved.before.z)
    turn = f" and turns it by {np.degrees(moved.after.tilt - moved.before.tilt) * 60:+.3g} arcmin" if moved.tilt else ""
    return (
        f"Refocusing moves image.z by {shift:+.4g} mm{turn}: the worst wavefront error falls from "
        f"{moved.errors_before.max():.3g} to {moved.errors_after.max():.3g} waves rms, its rms over the field from "
        f"{np.sqrt(np.mean(moved.errors_before**2)):.3g} to {np.sqrt(np.mean(moved.errors_after**2)):.3g}."
    )


_WAVE: Record[Wavefront] = Record(
    "Wavefront error at one field, piston and tilt taken out.",
    Quantity("field", lambda w: w.field, "shares of the half field, along the line and along the track"),
    Quantity("place_mm", lambda w: np.array(w.place), "of the chief ray on the line CCD"),
    Quantity("wfe_rms_waves", lambda w: w.rms, "rms over the stop"),
    Quantity("wfe_pv_waves", lambda w: w.peak_to_valley, "peak to valley over the stop"),
    Quantity("strehl", lambda w: w.strehl, "Strehl ratio"),
    Quantity("vignetted", lambda w: w.vignetted, "share of the stop's area whose light does not come through"),
)
_SPOT: Record[Spot] = Record(
    "Spot at one field.",
    Quantity("spot_rms_um", lambda s: s.rms, "rms distance from the centroid"),
    Quantity("spot_largest_um", lambda s: s.farthest, "distance of the farthest ray from the centroid"),
)
_MTF: Record[Mtf] = Record(
    "MTF of the optics alone at the pixels' Nyquist frequency.",
    Quantity("field", lambda m: m.field, "shares of the half field, along the line and along the track"),
    Quantity("along_line", lambda m: m.at(m.nyquist)[0]),
    Quantity("along_track", lambda m: m.at(m.nyquist)[1]),
    Quantity(
        "accuracy",
        lambda m: m.accuracy or None,
        "of a pupil that edges cut: change of the curve by a third of the lines through it, at most",
        where_known=True,
    ),
)
_DISTORTION: Record[field_maps.Distortion] = Record(
    "Where the camera images directions, against the nearest perfect camera: over the field, and along its line.",
    Quantity("principal_distance_m", lambda d: d.distance, "of the nearest perfect camera"),
    Quantity("principal_point_mm", lambda d: d.point, "of the nearest perfect camera, from the line's middle"),
    Quantity("rms_um", lambda d: d.rms, "distance from the perfect camera's images over the field"),
    Quantity("largest_um", lambda d: d.largest, "the largest such distance"),
    Quantity("line_principal_distance_m", lambda d: d.line_distance, "with the principal point in the line's middle"),
    Quantity("line_rms_um", lambda d: d.line_rms, "distortion along the line"),
    Quantity("line_largest_um", lambda d: d.line_largest, "distortion along the line"),
    Quantity(
        "line_fitted_with_point_m",
        lambda d: {"principal_distance": d.line_point[1], "principal_point": d.line_point[0]},
        "both fitted to the line together",
    ),
)
_REFOCUS: Record[Refocus] = Record(
    "The focal plane of the file and the one found, with wavefront errors rms over some fields.",
    Quantity("z_before_m", lambda r: r.before.z),
    Quantity("z_after_m", lambda r: r.after.z),
    Quantity("tilt_before_deg", lambda r: r.before.tilt),
    Quantity("tilt_after_deg", lambda r: r.after.tilt),
    Quantity("wfe_worst_before_waves", lambda r: r.errors_before.max(), "of the worst field"),
    Quantity("wfe_worst_after_waves", lambda r: r.errors_after.max(), "of the worst field"),
    Quantity("wfe_rms_before_waves", lambda r: np.sqrt(np.mean(r.errors_before**2)), "over the fields"),
    Quantity("wfe_rms_after_waves", lambda r: np.sqrt(np.mean(r.errors_after**2)), "over the fields"),
)


_PERTURBED: Record[Perturbed] = Record(
    "What a perturbation does: changes of the camera's geometry by exact chief rays, and what it had as designed.",
    Quantity("perturb", lambda p: p.job.plain()["perturb"], "as in a job's file"),
    *(
        Quantity(
            one.key,
            lambda p, k=k: p.change.vector[0, k],  # type: ignore[misc]
            one.meaning,
        )
        for k, one in enumerate(parameters.ESTIMATED)
    ),
    Quantity("worst_as_designed_waves", lambda p: p.errors.max(), "of the worst field"),
    Quantity("mtf_as_designed", lambda p: p.mtf, "at Nyquist, along the line and along the track, field by field"),
)


def _field_numbers(run: CameraRun) -> list[dict[str, Any]]:
    """Wavefront, spot and Zernike terms without piston and tilts of every field of ``GRID``."""
    return [
        {**_WAVE(wave), **_SPOT(spot), "zernike_waves": dict(list(wave.terms.items())[3:]), **_cut_numbers(wave)}
        for wave, spot in zip(run.waves, run.spots, strict=True)
    ]


def _cut_numbers(wave: Wavefront) -> dict[str, Any]:
    """What there is beside circle terms to tell of a beam that edges cut; nothing of a whole one."""
    if not wave.is_cut:
        return {}
    return {
        "wfe_accuracy": wave.accuracy,
        "polynomials": wave.polynomials,
        "orthonormal_waves": dict(list(wave.orthonormal_terms.items())[3:]),
    }


CAMERA: Record[CameraRun] = Record(
    "optics.json: a camera judged.",
    Quantity("camera", lambda run: run.camera.name),
    Quantity("instrument", lambda run: run.setup.where or None, "that the camera is mounted in"),
    Quantity("mounted", lambda run: run.setup.mounted, "its name there"),
    Quantity("wfe_worst_waves", lambda run: run.worst[0], "largest wavefront error over the field, rms"),
    Quantity("worst_field", lambda run: run.worst[1], "where it is"),
    Quantity(
        "limited_by",
        lambda run: [{"aberration": kind, "wfe_rms_waves": size} for kind, size in run.limits[:4]],
        "kinds of aberration at the worst field, the largest first",
    ),
    Quantity("wavelength_nm", lambda run: run.camera.wavelength, "of design"),
    Quantity(
        "image",
        lambda run: {"z_m": run.camera.image.z, "tilt_deg": np.degrees(run.camera.image.tilt or 0.0)},
        "the focal plane in the prescription",
    ),
    Quantity("first_order", lambda run: run.first_order, record=FIRST_ORDER),
    Quantity("fields", _field_numbers, "wavefront and spot, field by field"),
    Quantity("mtf_at_nyquist", lambda run: run.mtfs, record=_MTF),
    Quantity("colours", lambda run: run.colours, "over all wavelengths", record=COLOURS, where_known=True),
    Quantity("distortion", lambda run: run.distortion, record=_DISTORTION),
    Quantity("refocus", lambda run: run.refocus, record=_REFOCUS),
    Quantity("perturbed", lambda run: run.perturbed, record=_PERTURBED),
    Quantity(
        "bodies_in_the_beam",
        lambda run: None if run.quality is None else {body: own[0] for body, own in run.quality.bodies.items()},
        "body of the instrument -> share of the beam that it takes, at fields along the line",
    ),
)


def camera_data(run: CameraRun) -> xr.Dataset:
    """Contents of optics.nc: wavefront maps, Zernike terms, spots, MTF, fields and curves along the line."""
    first = run.waves[0].to_xarray()
    fields = [list(wave.field) for wave in run.waves]
    waves, rms, metres = {"units": "waves"}, {"units": "waves rms"}, {"units": "m"}

    def named(text: str, about: dict[str, str] | None = None) -> dict[str, str]:
        return {**(about or {}), "long_name": text}

    mtf = ("mtf_field", "direction", "frequency")
    share = "share of the half field"
    maps = np.stack([w.map for w in run.waves])
    terms, parts = (np.stack([getattr(w, name) for w in run.waves]) for name in ("coefficients", "parts"))
    orthonormal = named("the same terms made orthonormal over the light of each pupil", rms)
    data: dict[str, Any] = {
        "wavefront": (("field", "y", "x"), maps, named("wavefront error over the stop", waves)),
        "zernike": (("field", "noll"), terms, named("Zernike terms of the wavefront error", rms)),
        **({} if not any(w.is_cut for w in run.waves) else {"orthonormal": (("field", "noll"), parts, orthonormal)}),
        "field_share": (("field", "direction"), np.array(fields), named(share)),
        "wfe": (("field_along", "field_across"), run.errors, named("wavefront error over the field", rms)),
        "through_focus_wfe": (("mtf_field", "defocus"), run.focus.error, named("wavefront error through focus", rms)),
        "through_focus_mtf": (
            ("mtf_field", "direction", "defocus"),
            run.focus.mtf,
            named("modulation at the Nyquist frequency through focus"),
        ),
        "distortion_line": (
            ("line",),
            run.distortion.residual,
            named("distortion along the line: place less that of the principal distance", metres),
        ),
    }
    coords: dict[str, Any] = {
        "x": first["x"],
        "y": first["y"],
        "noll": first["noll"],
        "term": first["term"].assign_attrs(named("name of the Zernike term")),
        "direction": ("direction", ["along line", "along track"], named("on the focal plane")),
        "field_along": ("field_along", run.field[:, 0, 0], named(f"{share}, along the line")),
        "field_across": ("field_across", run.field[0, :, 1], named(f"{share}, along the track")),
        "defocus": ("defocus", run.focus.defocus, named("of the detector, downstream positive", metres)),
        "line": ("line", run.distortion.position, named("place along the line, from its middle", metres)),
        "mtf_field_share": (("mtf_field", "direction"), np.array(MTF_FIELDS), named(share)),
    }
    if run.mtfs:
        data["mtf"] = (mtf, np.stack([m.values for m in run.mtfs]), named("modulation of the optics"))
        data["mtf_limit"] = (mtf, np.stack([m.limit for m in run.mtfs]), named("the same without wavefront error"))
        about = named("spatial frequency in the image, cycles per length", {"units": "1/m"})
        coords["frequency"] = ("frequency", run.mtfs[0].frequency, about)
    if run.colours is not None:
        own_data, own_coords = colour_data(run.colours)
        data |= own_data
        coords |= own_coords
    told = {"title": "wavefronts, MTF and distortion of a camera over its field"}
    return xr.Dataset(data, coords, {**told, "reference_frames": frames_text("optics")})
