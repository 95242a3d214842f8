"""Polychromatic analysis of a camera: lateral and axial colour, MTF and point images over its spectrum.

**Lateral colour** is the position of a wavelength's chief ray on the focal plane, **axial colour** the position of its
smallest rms wavefront error along the light; both relative to the reference wavelength. **Primary** colour is the
difference between the shortest and the longest wavelength, **secondary** colour that between the reference wavelength
and the mean of these two.

Transfer functions of all wavelengths are about one point of the image, that of the design wavelength's chief ray, so
that lateral and axial colour blur the polychromatic image. The mean over the spectrum is by the Gauss rule for this
very spectrum. The number of wavelengths is increased until the MTF does not change; the last change is reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optics.numerics.backend import one_blas_thread
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
"""Number of wavelengths of the first quadrature over the spectrum, which is refined if the MTF changes."""

CURVE_POINTS = 21
"""Number of wavelengths, odd, at which lateral and axial colour are computed over a band."""

FOCUS_RINGS = 6
"""Number of rings of the quadrature over the stop with which the best focus of a wavelength is found."""

WINDOW, PSF_POINTS = 24.0, 129
"""Smallest side of the window of a point image, in units of the longest wavelength times the F-number.

The second is the number of samples along a side of the window.
"""


@dataclass(frozen=True, eq=False)
class Psf:
    """Polychromatic point spread function of the optics alone.

    Attributes
    ----------
    field : Field
        Field of the point.
    position : (N,) ndarray
        Coordinates of the N columns (along the line) and the N rows (along the track) from the design wavelength's
        chief ray, metres.
    values : (N, N) ndarray
        Irradiance for unit light, 1/m^2.
    strehl : float
        Peak relative to that of the same pupils without wavefront error and without lateral colour.
    """

    field: Field
    position: np.ndarray
    values: np.ndarray
    strehl: float


@dataclass(frozen=True, eq=False)
class Colours:
    """Polychromatic results of a camera.

    Attributes
    ----------
    spectrum : SpectrumSpec
        Spectrum of the light.
    reference : float
        Reference wavelength of colour: that of the design if the spectrum contains it, else the mean, metres.
    wavelengths : (K,) ndarray
        The K wavelengths, ascending, first and last those of the spectrum, metres.
    fields : tuple of Field
        The F fields.
    lateral : (F, K, 2) ndarray, or None
        Chief rays relative to the reference's, along the line and along the track, metres; None for a camera without
        lenses, which has no lateral colour.
    axial : (F, K) ndarray, or None
        Best focus from the focal plane, along the prescription's z, positive downstream, metres; None without lenses.
    axial_reference : (F,) ndarray, or None
        Best focus of the reference wavelength, metres; None without lenses.
    mtfs : tuple of Mtf
        Polychromatic MTF at the fields; empty where there is none.
    psfs : tuple of Psf
        Polychromatic point images at the fields; empty where there are none.
    without_mtf : str
        Reason why there is no MTF; empty where there is one.
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
        """Chief-ray position of the shortest minus the longest wavelength at F fields, metres, (F, 2)."""
        return None if self.lateral is None else np.asarray(self.lateral[:, 0] - self.lateral[:, -1])

    @property
    def lateral_secondary(self) -> np.ndarray | None:
        """Chief-ray position of the reference wavelength minus the mean of shortest and longest, metres.

        An (F, 2) array for F fields, along the line and along the track.
        """
        return None if self.lateral is None else np.asarray(-0.5 * (self.lateral[:, 0] + self.lateral[:, -1]))

    @property
    def axial_primary(self) -> np.ndarray | None:
        """Best focus of the shortest wavelength minus that of the longest at F fields, metres, (F,)."""
        return None if self.axial is None else np.asarray(self.axial[:, 0] - self.axial[:, -1])

    @property
    def axial_secondary(self) -> np.ndarray | None:
        """Best focus of the reference wavelength minus the mean of shortest and longest at F fields, metres, (F,)."""
        if self.axial is None or self.axial_reference is None:
            return None
        return np.asarray(self.axial_reference - 0.5 * (self.axial[:, 0] + self.axial[:, -1]))

    @property
    def error(self) -> float:
        """Largest change of the MTF by the last increase of the number of wavelengths; 0 for spectral lines."""
        return max((mtf.error for mtf in self.mtfs), default=0.0)


def reference_wavelength(optics: CameraOptics, spectrum: SpectrumSpec) -> float:
    """Return the reference wavelength of colour, metres: the design wavelength if in the spectrum, else the mean."""
    design, (first, last) = optics.model.spec.wavelength, spectrum.ends
    return float(design) if first <= design <= last else spectrum.mean


def lateral_colour(
    optics: CameraOptics, fields: Sequence[Field] | np.ndarray, wavelengths: np.ndarray, reference: float
) -> np.ndarray:
    """Compute chief-ray positions at K wavelengths, (K,), relative to a reference wavelength, metres.

    Returns
    -------
    (F, K, 2) ndarray
        Positions along the line and along the track at F fields and K wavelengths.

    Raises
    ------
    AimError, BeamMissedError
        A chief ray is lost.
    ValueError
        The index of a glass is unknown at a wavelength.
    """
    light = optics.directions(fields)

    def places(wavelength: float) -> np.ndarray:
        return optics.path.positions(optics.path.coloured(optics.state, wavelength), light)

    start = places(reference)
    return np.stack([places(float(wavelength)) - start for wavelength in wavelengths], axis=1)


def axial_colour(optics: CameraOptics, fields: Sequence[Field], wavelengths: np.ndarray) -> np.ndarray:
    """Compute the best focus of each of F fields at each of K wavelengths, from the focal plane, metres.

    It is along the prescription's z, positive downstream, on a plane with the focal plane's tilt; in a perturbed state
    relative to the moved focal plane.

    Returns
    -------
    (F, K) ndarray
        Best focus, metres.

    Raises
    ------
    AimError, BeamMissedError
        Light is lost.
    ValueError
        The index of a glass is unknown at a wavelength.
    """
    nominal = FocalPlane.of(optics.model.spec)
    out = np.empty((len(fields), len(wavelengths)))
    for f, field in enumerate(fields):
        for k, wavelength in enumerate(wavelengths):
            beams = optics.at(float(wavelength)).beams((field,), FOCUS_RINGS)
            downstream = float(np.sign(np.mean(beams.direction[..., 2])))
            out[f, k] = downstream * (beams.best_plane().z - nominal.z)
    return out


def spectral_mtfs(
    optics: CameraOptics,
    fields: Sequence[Field] | np.ndarray,
    spectrum: SpectrumSpec,
    frequency: np.ndarray | None = None,
) -> tuple[Mtf, ...]:
    """Compute the polychromatic MTF at F fields, with as many wavelengths as are needed.

    Parameters
    ----------
    optics : CameraOptics
        Camera.
    fields : (F, 2) array_like
        The F fields.
    spectrum : SpectrumSpec
        Spectrum of the light.
    frequency : (M,) ndarray, optional
        M spatial frequencies, cycles/m; by default from 0 to the cut-off or twice Nyquist.

    Returns
    -------
    tuple of Mtf
        MTF of each field, with the change of its values from the previous rule.

    Raises
    ------
    AimError, BeamMissedError, ValueError
        The light is lost, or a pupil or wavefront is too irregular; also an MTF that still changes by more than
        ``WORST_CHANGE`` at ``LARGEST_RULE`` wavelengths.
    """
    if frequency is None:
        # up to the cut-off of the shortest wavelength, for any rule
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


@one_blas_thread()  # small matrices: threads would only wait for each other
def spectral_psfs(
    optics: CameraOptics,
    fields: Sequence[Field] | np.ndarray,
    wavelengths: np.ndarray,
    weights: np.ndarray,
    perfect: bool = False,
) -> tuple[Psf, ...]:
    """Compute point images of K weighted wavelengths at F fields, (F, 2), with ``PSF_POINTS`` on each side.

    With ``perfect`` the image of the first field's pupils without wavefront error is the last.

    Raises
    ------
    AimError, BeamMissedError, ValueError
        The light is lost, edges cut a pupil into too many pieces, or a wavefront is too irregular.
    """
    colours, shares = np.asarray(wavelengths, float), np.asarray(weights, float) / np.sum(weights)
    ends = (int(np.argmin(colours)), int(np.argmax(colours)))
    spots = [optics.at(float(colours[k])).spots(fields) for k in ends]
    design = optics.spots(fields)
    out = []
    for f, field_pupils in enumerate(optics.colour_pupils(fields, colours)):
        pupils = field_pupils if len(field_pupils) > 1 else field_pupils * len(colours)
        aperture = 0.5 * float(np.max(pupils[ends[1]].cutoff(np.eye(2), 1.0)))
        # about the design wavelength's chief ray, as the pupils are
        away = [np.array(spot[f].position) - design[f].position + spot[f].rays for spot in spots]
        extent = max(float(np.max(np.abs(rays))) for rays in away)
        half = max(0.25 * WINDOW * colours[ends[1]] / aperture, 1.5 * extent)
        sampled = [_sampled(pupil, float(colour), half) for pupil, colour in zip(pupils, colours, strict=True)]

        def over_light(x: Grid, y: Grid, sampled: Sequence[PupilField] = sampled) -> np.ndarray:
            pairs = zip(shares, sampled, strict=True)
            return np.asarray(sum(share * image(light, x, y, single=True)[0] for share, light in pairs))

        step = 2.0 * half / (PSF_POINTS - 1)
        grid = Grid(-half, step, PSF_POINTS)
        values = over_light(grid, grid)
        row, column = np.unravel_index(int(np.argmax(values)), values.shape)
        # the peak lies between grid points
        x, y = (Grid(float(grid.points()[k]) - step, step / 8.0, 17) for k in (column, row))
        peak = float(np.max(over_light(x, y)))
        limit = sum(
            w * float(np.sum(pupil_field.amplitude)) ** 2 / pupil_field.wavelength**2
            for w, pupil_field in zip(shares, sampled, strict=True)
        )
        out.append(Psf(design[f].field, grid.points(), values, peak / limit))
        if perfect and f == 0:
            flat = [replace(pupil_field, eikonal=np.zeros_like(pupil_field.eikonal)) for pupil_field in sampled]
            ideal = Psf(design[f].field, grid.points(), over_light(grid, grid, flat), 1.0)
    return (*out, ideal) if perfect else tuple(out)


def _sampled(pupil: PupilFunction, wavelength: float, half: float) -> PupilField:
    """Sample a pupil, without shadows, densely enough for its image up to ``half`` metres from the middle."""
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


def evaluate_colours(optics: CameraOptics, spectrum: SpectrumSpec, fields: tuple[Field, ...], sharp: bool) -> Colours:
    """Compute the polychromatic results of a camera.

    ``sharp`` is False for a camera with wavefront errors so large that no MTF and no point images are computed.

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
    except ValueError as error:  # too much lateral colour, or a wavefront too irregular at a wavelength
        return replace(out, without_mtf=str(error))
    return replace(out, mtfs=mtfs, psfs=psfs)


@dataclass(frozen=True, eq=False)
class _AtField:
    """View of the polychromatic results that gives the numbers of one field, for optics.json."""

    colours: Colours
    number: int

    def of(self, values: np.ndarray | None) -> Any:
        """Return the entry of this field in an array (F, ...) over F fields; None if there is no array."""
        return None if values is None else values[self.number]

    @property
    def mtf(self) -> np.ndarray | None:
        """Polychromatic MTF at Nyquist, along the line and along the track."""
        if not self.colours.mtfs:
            return None
        mtf = self.colours.mtfs[self.number]
        return mtf.at(mtf.nyquist)

    @property
    def strehl(self) -> float | None:
        """Polychromatic Strehl ratio."""
        return self.colours.psfs[self.number].strehl if self.colours.psfs else None


_COLOUR = {
    "lateral_primary": "chief-ray position of the shortest wavelength minus that of the longest",
    "lateral_secondary": "chief-ray position of the reference wavelength minus the mean of both",
    "axial_primary": "best focus of the shortest wavelength minus that of the longest, downstream positive",
    "axial_secondary": "best focus of the reference wavelength minus the mean of both",
}
"""Attribute of `Colours` with a value for each field -> its meaning."""
_FIELD: Record[_AtField] = Record(
    "Colour at one field; pairs of numbers are along the line and along the track.",
    Quantity("field", lambda a: a.colours.fields[a.number], "shares of the half field, along the line and the track"),
    *(
        Quantity(f"{name}_um", lambda a, name=name: a.of(getattr(a.colours, name)), text, where_known=True)  # type: ignore[misc]
        for name, text in _COLOUR.items()
    ),
    Quantity("mtf_at_nyquist", lambda a: a.mtf, "polychromatic MTF of the optics", where_known=True),
    Quantity("strehl", lambda a: a.strehl, "polychromatic Strehl ratio", where_known=True),
)

COLOURS: Record[Colours] = Record(
    "Polychromatic results of a camera.",
    Quantity("shortest_nm", lambda c: c.spectrum.ends[0], "shortest wavelength of the spectrum"),
    Quantity("longest_nm", lambda c: c.spectrum.ends[1], "longest wavelength of the spectrum"),
    Quantity("reference_nm", lambda c: c.reference, "reference wavelength of colour"),
    Quantity("fields", lambda c: [_AtField(c, f) for f in range(len(c.fields))], "field by field", record=_FIELD),
    Quantity(
        "wavelengths_of_mtf",
        lambda c: len(c.mtfs[0].wavelengths) if c.mtfs else None,
        "number of wavelengths of the Gauss rule, or of spectral lines",
        where_known=True,
    ),
    Quantity(
        "mtf_error",
        lambda c: c.error if c.mtfs else None,
        "largest change of the MTF with more wavelengths",
        where_known=True,
    ),
    Quantity("without_mtf", lambda c: c.without_mtf or None, "reason why there is no MTF", where_known=True),
)


def colour_data(colours: Colours) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the variables and coordinates of optics.nc for the polychromatic results."""
    metres = {"units": "m"}
    data: dict[str, Any] = {}
    coords: dict[str, Any] = {}
    if colours.lateral is not None and colours.axial is not None:
        about = {**metres, "long_name": "chief-ray position relative to the reference wavelength"}
        data["lateral_colour"] = (("mtf_field", "wavelength", "direction"), colours.lateral, about)
        about = {**metres, "long_name": "best focus from the focal plane, downstream positive"}
        data["axial_colour"] = (("mtf_field", "wavelength"), colours.axial, about)
        coords["wavelength"] = ("wavelength", colours.wavelengths, {**metres, "long_name": "wavelength of the light"})
    if colours.mtfs:
        dims = ("mtf_field", "direction", "light_frequency")
        about = {"long_name": "polychromatic modulation"}
        data["light_mtf"] = (dims, np.stack([m.values for m in colours.mtfs]), about)
        about = {"long_name": "polychromatic modulation without wavefront error and lateral colour"}
        data["light_mtf_limit"] = (dims, np.stack([m.limit for m in colours.mtfs]), about)
        about = {"units": "1/m", "long_name": "spatial frequency in the image, cycles per length"}
        coords["light_frequency"] = ("light_frequency", colours.mtfs[0].frequency, about)
        about = {"units": "1/m2", "long_name": "irradiance of a point image for unit light"}
        data["psf"] = (("mtf_field", "row", "column"), np.stack([p.values for p in colours.psfs]), about)
        about = {**metres, "long_name": "position of columns and rows from the design wavelength's chief ray"}
        data["psf_position"] = (("mtf_field", "column"), np.stack([p.position for p in colours.psfs]), about)
    return data, coords
