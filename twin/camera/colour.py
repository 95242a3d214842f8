"""A camera over all wavelengths of its light: where each is imaged, where each is sharp, and what all together make.

**Lateral colour** is where the chief ray of a wavelength meets the focal plane, **axial colour** where along the light
that wavelength has its least rms wavefront error; both from those of the reference wavelength. **Primary** is what
stands between the shortest and the longest wavelength, **secondary** what stands between the reference wavelength and
the middle of these two.

Transfer functions of all wavelengths are about one point of the image, that of the design wavelength's chief ray, so
that lateral and axial colour blur what they make together. The mean over the light is by Gauss' rule for this very
spectrum. Rules of more and more wavelengths are taken until the MTF does not change; by how much it still did is told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optics.numerics.quadrature import gauss, nodes_for
from optics.waves.diffraction import Grid, PupilField, image
from optics.waves.optical_transfer import LEAST_ACROSS
from optics.waves.pupil_stack import SHADOW_NODES, PupilFunction
from scenes.models.camera_model import lenses
from scenes.models.camera_sharpness import FocalPlane
from scenes.specs.spectrum import SpectrumSpec
from twin.camera.camera_optics import CameraOptics
from twin.camera.camera_results import Field, Mtf
from twin.framework.record import Quantity, Record
from twin.targets.target_images import wavelengths_enough

FIRST_RULE = 5
"""Wavelengths of the first rule."""

CURVE_POINTS = 21
"""Wavelengths of curves over the light, odd."""

FOCUS_RINGS = 6
"""Rings of the quadrature over the stop by which a focus is found."""

WINDOW, PSF_POINTS = 24.0, 129
"""Side of a point image's window at least, in the longest wavelength times the F-number, and its points along it."""


@dataclass(frozen=True, eq=False)
class Psf:
    """Image of a point in all of its light, of the optics alone.

    Attributes
    ----------
    field : Field
        where.
    place : np.ndarray
        Of columns and rows, from the design wavelength's chief ray, metres, (N,); columns along the line, rows along
        the track.
    values : np.ndarray
        Irradiance for unit light, 1/m^2, (N, N).
    strehl : float
        Largest value over that of the same pupils without wavefront error, every wavelength in its place.
    """

    field: Field
    place: np.ndarray
    values: np.ndarray
    strehl: float


@dataclass(frozen=True, eq=False)
class Colours:
    """A camera over its light.

    Attributes
    ----------
    spectrum : SpectrumSpec
        The light.
    reference : float
        Wavelength from which colours count: that of the design where the light holds it, else the mean.
    wavelengths : np.ndarray
        Ascending, first and last those of the light, metres, (K,).
    fields : tuple[Field, ...]
        F.
    lateral : np.ndarray | None
        Of chief rays from the reference's, along the line and along the track, metres, (F, K, 2); None for a camera
        without lenses, which has none.
    axial : np.ndarray | None
        Best focus from the focal plane, along its normal of the prescription's z, positive downstream, metres, (F, K);
        None likewise.
    axial_reference : np.ndarray | None
        The same of the reference wavelength, (F,); None likewise.
    mtfs : tuple[Mtf, ...]
        Over the light, at the fields; empty where there is none.
    psfs : tuple[Psf, ...]
        likewise.
    without_mtf : str
        Why there is none, empty where there is.
    """

    spectrum: SpectrumSpec
    reference: float
    wavelengths: np.ndarray
    fields: tuple[Field, ...]
    lateral: np.ndarray | None
    axial: np.ndarray | None
    axial_reference: np.ndarray | None
    mtfs: tuple[Mtf, ...] = ()
    psfs: tuple[Psf, ...] = ()
    without_mtf: str = ""

    @property
    def lateral_primary(self) -> np.ndarray | None:
        """Place of the shortest wavelength less that of the longest, metres, (F, 2)."""
        return None if self.lateral is None else np.asarray(self.lateral[:, 0] - self.lateral[:, -1])

    @property
    def lateral_secondary(self) -> np.ndarray | None:
        """Place of the reference wavelength less the middle between shortest and longest, metres, (F, 2)."""
        return None if self.lateral is None else np.asarray(-0.5 * (self.lateral[:, 0] + self.lateral[:, -1]))

    @property
    def axial_primary(self) -> np.ndarray | None:
        """Focus of the shortest wavelength less that of the longest, metres, (F,)."""
        return None if self.axial is None else np.asarray(self.axial[:, 0] - self.axial[:, -1])

    @property
    def axial_secondary(self) -> np.ndarray | None:
        """Focus of the reference wavelength less the middle between shortest and longest, metres, (F,)."""
        if self.axial is None or self.axial_reference is None:
            return None
        return np.asarray(self.axial_reference - 0.5 * (self.axial[:, 0] + self.axial[:, -1]))

    @property
    def error(self) -> float:
        """By how much the MTF still changed with more wavelengths, at most; 0 for lines."""
        return max((mtf.error for mtf in self.mtfs), default=0.0)


def reference_wavelength(optics: CameraOptics, spectrum: SpectrumSpec) -> float:
    """From which colours count, metres: the design wavelength where the light holds it, else the light's mean."""
    design, (first, last) = optics.model.spec.wavelength, spectrum.ends
    return float(design) if first <= design <= last else spectrum.mean


def lateral_colour(
    optics: CameraOptics, fields: Sequence[Field] | np.ndarray, wavelengths: np.ndarray, reference: float
) -> np.ndarray:
    """Where chief rays of wavelengths (K,) meet the focal plane, from those of a reference wavelength, metres.

    Returns
    -------
    np.ndarray
        (F, K, 2), along the line and along the track.

    Raises
    ------
    AimError, BeamMissedError
        a chief ray is lost.
    ValueError
        a glass is not known at a wavelength.
    """
    light = optics.directions(fields)

    def places(wavelength: float) -> np.ndarray:
        return optics.path.places(optics.path.coloured(optics.state, wavelength), light)

    start = places(reference)
    return np.stack([places(float(wavelength)) - start for wavelength in wavelengths], axis=1)


def axial_colour(optics: CameraOptics, fields: Sequence[Field], wavelengths: np.ndarray) -> np.ndarray:
    """Best focus of each field by itself at each wavelength (K,), from the focal plane, downstream positive, metres.

    It is along the prescription's z, on a plane with the focal plane's tilt; in a state as the focal plane has moved.

    Returns
    -------
    np.ndarray
        (F, K).

    Raises
    ------
    AimError, BeamMissedError
        Light is lost.
    ValueError
        a glass is not known at a wavelength.
    """
    own = FocalPlane.of(optics.model.spec)
    out = np.empty((len(fields), len(wavelengths)))
    for f, place in enumerate(fields):
        for k, wavelength in enumerate(wavelengths):
            beams = optics.at(float(wavelength)).beams((place,), FOCUS_RINGS)
            downstream = float(np.sign(np.mean(beams.direction[..., 2])))
            out[f, k] = downstream * (beams.best_plane().z - own.z)
    return out


def spectral_mtfs(
    optics: CameraOptics,
    fields: Sequence[Field] | np.ndarray,
    spectrum: SpectrumSpec,
    frequency: np.ndarray | None = None,
) -> tuple[Mtf, ...]:
    """MTF over a spectrum at fields (F, 2), with as many wavelengths as it takes.

    Parameters
    ----------
    optics : CameraOptics
        The camera.
    fields : Sequence[Field] | np.ndarray
        where.
    spectrum : SpectrumSpec
        The light.
    frequency : np.ndarray | None
        As for ``CameraOptics.mtfs``.

    Returns
    -------
    tuple[Mtf, ...]
        F, each with the change of its values by the rule before.

    Raises
    ------
    AimError, BeamMissedError, ValueError
        As ``CameraOptics.pupils``; also for light over which the MTF still changes by more than ``WORST_CHANGE`` at
        ``LARGEST_RULE`` wavelengths.
    """
    if frequency is None:
        # to the cut-off of the shortest wavelength, whatever the rule
        frequency = optics.at(spectrum.ends[0]).mtfs(fields)[0].frequency
    done: list[tuple[Mtf, ...]] = []

    def values(count: int) -> np.ndarray:
        done.append(optics.mtfs(fields, frequency, *spectrum.rule(count)))
        return np.array([mtf.values for mtf in done[-1]])

    if wavelengths_enough(spectrum, FIRST_RULE, values) == FIRST_RULE:
        return optics.mtfs(fields, frequency, *spectrum.rule(FIRST_RULE))
    before, after = done[-2:]
    changes = [float(np.max(np.abs(b.values - a.values))) for a, b in zip(before, after, strict=True)]
    return tuple(replace(mtf, error=change) for mtf, change in zip(after, changes, strict=True))


def spectral_psfs(
    optics: CameraOptics, fields: Sequence[Field] | np.ndarray, wavelengths: np.ndarray, weights: np.ndarray
) -> tuple[Psf, ...]:
    """Images of points over wavelengths (K,) with weights (K,) at fields (F, 2), on ``PSF_POINTS`` squared.

    Raises
    ------
    AimError, BeamMissedError, ValueError
        As ``CameraOptics.pupils``.
    """
    colours, shares = np.asarray(wavelengths, float), np.asarray(weights, float) / np.sum(weights)
    ends = (int(np.argmin(colours)), int(np.argmax(colours)))
    spots = [optics.at(float(colours[k])).spots(fields) for k in ends]
    design = optics.spots(fields)
    out = []
    for f, own in enumerate(optics.colour_pupils(fields, colours)):
        pupils = own if len(own) > 1 else own * len(colours)
        aperture = 0.5 * float(np.max(pupils[ends[1]].cutoff(np.eye(2), 1.0)))
        # about the design wavelength's chief ray, as the pupils are
        reach = max(float(np.max(np.abs(np.array(spot[f].place) - design[f].place + spot[f].rays))) for spot in spots)
        half = max(0.25 * WINDOW * colours[ends[1]] / aperture, 1.5 * reach)
        sampled = [_sampled(pupil, float(colour), half) for pupil, colour in zip(pupils, colours, strict=True)]

        def over_light(x: Grid, y: Grid, sampled: Sequence[PupilField] = sampled) -> np.ndarray:
            return np.asarray(sum(w * image(one, x, y, single=True)[0] for w, one in zip(shares, sampled, strict=True)))

        step = 2.0 * half / (PSF_POINTS - 1)
        grid = Grid(-half, step, PSF_POINTS)
        values = over_light(grid, grid)
        row, column = np.unravel_index(int(np.argmax(values)), values.shape)
        # the peak lies between points
        x, y = (Grid(float(grid.points()[k]) - step, step / 8.0, 17) for k in (column, row))
        peak = float(np.max(over_light(x, y)))
        limit = sum(
            w * float(np.sum(one.amplitude)) ** 2 / one.wavelength**2 for w, one in zip(shares, sampled, strict=True)
        )
        out.append(Psf(design[f].field, grid.points(), values, peak / limit))
    return tuple(out)


def _sampled(pupil: PupilFunction, wavelength: float, half: float) -> PupilField:
    """A pupil at as many nodes as its image up to ``half`` metres from its middle takes; its shadows are taken off."""
    aperture = 0.5 * float(np.max(pupil.cutoff(np.eye(2), 1.0)))
    nothing = np.zeros(1, complex)
    right, left, _ = pupil.edge.corners(nothing)
    bent = pupil.values(np.exp(2j * np.pi * np.arange(32) / 32))[0]
    phase = 2.0 * np.pi / wavelength * (np.sqrt(2.0) * aperture * half + 0.5 * float(np.ptp(bent)))
    count = nodes_for(phase, LEAST_ACROSS) + pupil.finer
    points, weight = pupil.edge.overlap(nothing, right, left, gauss(count), gauss(count))
    if pupil.shadow is not None:
        taken, area = pupil.shadow.overlap(nothing[None], max(SHADOW_NODES, count))
        points, weight = np.concatenate([points, taken[0]], axis=1), np.concatenate([weight, area[0]], axis=1)
    eikonal, amplitude = pupil.values(points)
    u, v, _ = pupil.cosines(points)
    scale = abs(np.linalg.det(pupil.axes)) / np.sqrt(pupil.power)
    return PupilField(u, v, eikonal, amplitude * weight * scale, wavelength)


def judge_colours(optics: CameraOptics, spectrum: SpectrumSpec, fields: tuple[Field, ...], sharp: bool) -> Colours:
    """Look at a camera over its light; without MTF for a camera that is not ``sharp``.

    Raises
    ------
    AimError, BeamMissedError, InputError
        Light is lost at a wavelength.
    """
    reference, wavelengths = reference_wavelength(optics, spectrum), spectrum.even(CURVE_POINTS)
    out = Colours(spectrum, reference, wavelengths, fields, None, None, None)
    if lenses(optics.model.spec):
        both = axial_colour(optics, fields, np.append(wavelengths, reference))
        lateral = lateral_colour(optics, fields, wavelengths, reference)
        out = replace(out, lateral=lateral, axial=both[:, :-1], axial_reference=both[:, -1])
    if not sharp:
        return out
    try:
        mtfs = spectral_mtfs(optics, fields, spectrum)
        psfs = spectral_psfs(optics, fields, mtfs[0].wavelengths, mtfs[0].weights)
    except ValueError as error:  # colours too far apart, or a wavefront too rough at one of them
        return replace(out, without_mtf=str(error))
    return replace(out, mtfs=mtfs, psfs=psfs)


@dataclass(frozen=True, eq=False)
class _AtField:
    """Colours at one of their fields."""

    colours: Colours
    number: int

    def of(self, values: np.ndarray | None) -> Any:
        """What stands for this field in an array (F, ...); None for none."""
        return None if values is None else values[self.number]

    @property
    def mtf(self) -> np.ndarray | None:
        """Over the light at Nyquist, along the line and along the track."""
        if not self.colours.mtfs:
            return None
        mtf = self.colours.mtfs[self.number]
        return mtf.at(mtf.nyquist)

    @property
    def strehl(self) -> float | None:
        """Over the light."""
        return self.colours.psfs[self.number].strehl if self.colours.psfs else None


_FIELD: Record[_AtField] = Record(
    "Colour at one field; along the line and along the track where there are two numbers.",
    Quantity("field", lambda a: a.colours.fields[a.number], "shares of the half field, along the line and the track"),
    Quantity(
        "lateral_primary_um",
        lambda a: a.of(a.colours.lateral_primary),
        "chief ray of the shortest wavelength from that of the longest",
        where_known=True,
    ),
    Quantity(
        "lateral_secondary_um",
        lambda a: a.of(a.colours.lateral_secondary),
        "chief ray of the reference wavelength from the middle of both",
        where_known=True,
    ),
    Quantity(
        "axial_primary_um",
        lambda a: a.of(a.colours.axial_primary),
        "best focus of the shortest wavelength from that of the longest, downstream positive",
        where_known=True,
    ),
    Quantity(
        "axial_secondary_um",
        lambda a: a.of(a.colours.axial_secondary),
        "best focus of the reference wavelength from the middle of both",
        where_known=True,
    ),
    Quantity("mtf_at_nyquist", lambda a: a.mtf, "of the optics over the light", where_known=True),
    Quantity("strehl", lambda a: a.strehl, "Strehl ratio over the light", where_known=True),
)

COLOURS: Record[Colours] = Record(
    "A camera over the wavelengths of its light.",
    Quantity("shortest_nm", lambda c: c.spectrum.ends[0], "wavelength with light"),
    Quantity("longest_nm", lambda c: c.spectrum.ends[1], "wavelength with light"),
    Quantity("reference_nm", lambda c: c.reference, "wavelength from which colours count"),
    Quantity("fields", lambda c: [_AtField(c, f) for f in range(len(c.fields))], "field by field", record=_FIELD),
    Quantity(
        "wavelengths_of_mtf",
        lambda c: len(c.mtfs[0].wavelengths) if c.mtfs else None,
        "of Gauss' rule, or all lines",
        where_known=True,
    ),
    Quantity(
        "mtf_error", lambda c: c.error if c.mtfs else None, "its change by more of them, at most", where_known=True
    ),
    Quantity("without_mtf", lambda c: c.without_mtf or None, "why there is none", where_known=True),
)


def colour_data(colours: Colours) -> tuple[dict[str, Any], dict[str, Any]]:
    """What optics.nc has of them: variables and coordinates."""
    metres = {"units": "m"}
    data: dict[str, Any] = {}
    coords: dict[str, Any] = {}
    if colours.lateral is not None and colours.axial is not None:
        about = {**metres, "long_name": "chief ray's place from that of the reference wavelength"}
        data["lateral_colour"] = (("mtf_field", "wavelength", "direction"), colours.lateral, about)
        about = {**metres, "long_name": "best focus from the focal plane, downstream positive"}
        data["axial_colour"] = (("mtf_field", "wavelength"), colours.axial, about)
        coords["wavelength"] = ("wavelength", colours.wavelengths, {**metres, "long_name": "wavelength of the light"})
    if colours.mtfs:
        dims = ("mtf_field", "direction", "light_frequency")
        data["light_mtf"] = (
            dims,
            np.stack([m.values for m in colours.mtfs]),
            {"long_name": "modulation over the light"},
        )
        about = {"long_name": "the same without wavefront error, every wavelength in its place"}
        data["light_mtf_limit"] = (dims, np.stack([m.limit for m in colours.mtfs]), about)
        about = {"units": "1/m", "long_name": "spatial frequency in the image, cycles per length"}
        coords["light_frequency"] = ("light_frequency", colours.mtfs[0].frequency, about)
        about = {"units": "1/m2", "long_name": "irradiance of a point's image for unit light"}
        data["psf"] = (("mtf_field", "row", "column"), np.stack([p.values for p in colours.psfs]), about)
        about = {**metres, "long_name": "place of columns and rows from the design wavelength's chief ray"}
        data["psf_place"] = (("mtf_field", "column"), np.stack([p.place for p in colours.psfs]), about)
    return data, coords
