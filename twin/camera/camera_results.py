"""Results of a camera's images at one field: wavefront, spot and MTF, with checks of their physical limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.arrays import shows
from optics.geometry import zernike
from optics.numerics.array_math import check_at_most, check_close, check_range
from scenes.yaml.errors import Problem
from scenes.yaml.units import ANGLE, Kind, parse_quantity, split_row
from twin.framework.record import frames_text

if TYPE_CHECKING:  # takes half a second with pandas, and only who asks for a data set needs it
    import xarray as xr

Field = tuple[float, float]
"""Position in the field: fractions, from -1 to 1, of the half angles of view along the line and along the track."""

FieldText = str | tuple[str, str]
"""Position in the field as angles from its middle, along the line and along the track: ``"0.2 -0.1 deg"``, ``"(0.2,
-0.1) deg"`` as results show it, or ``("0.2 deg", "-0.1 deg")``.
"""

Frequencies = np.ndarray | Sequence[float] | Sequence[str] | float | str
"""Spatial frequencies in cycles/m, or with their unit, such as ``"50 cycles/mm"``."""

LAST_DIGIT = 1e-3
"""Relative amount by which a field in angles may lie beyond the edge of the field, since results show four digits."""

SMALLEST_HALF_FIELD = 1e-12
"""Half angle of view that stands for zero in a quotient, radians: only the field's middle lies within it."""

SPATIAL_FREQUENCY = Kind("a spatial frequency", "1/m", ("cycles/mm", "cycles/m"), "50 cycles/mm")

_NO_BRACKETS = str.maketrans("(),", "   ")

TERMS = 37
"""Number of Zernike terms of a wavefront in Noll's order.

They are all terms to the seventh radial order, and the spherical term of the eighth.
"""

ROUNDING = 1e-6
"""Tolerance by which fractions of light and Strehl ratios may lie outside 0 to 1.

It is the accuracy of quadratures over the polygons that represent shadows.
"""

MTF_ROUNDING = 1e-3
"""Tolerance by which an MTF may lie outside 0 to 1 or exceed that of the perfect wavefront.

It is the accuracy of its quadrature.
"""

MAX_RMS_WAVES = 1e6
"""Rms wavefront error beyond which a result is rejected as unphysical, waves; it is 0.6 m of path."""


@shows("field_rad [deg]", "rms [waves]", "peak_to_valley [waves]", "strehl", "vignetted [percent]", "map [waves]")
@dataclass(frozen=True, eq=False)
class Wavefront:
    """Wavefront error at one field.

    Attributes
    ----------
    field : Field
        Field of the beam, as fractions of the half angles.
    field_rad : tuple of float
        Angles of the field from its middle, along the line and along the track, radians.
    wavelength : float
        Wavelength, metres; errors "in waves" are in this unit.
    x, y : (n,) ndarray
        Coordinates of the map's n columns and n rows on the stop, in units of its radius; x runs along the line, y
        along the track.
    map : (n, n) ndarray
        Wavefront error, waves; NaN where there is no light.
    coefficients : (TERMS,) ndarray
        Zernike circle terms in Noll's order, waves rms over the whole stop, fitted to the light that passes;
        ``optics.geometry.zernike`` names them.
    parts : (TERMS,) ndarray
        Contribution of each term to the rms, waves: the coefficients if the whole stop is illuminated; else those of
        the same terms made orthonormal over the illuminated area, each without the contribution of the earlier ones.
        Over a ring these are the annular Zernike terms (Mahajan, J. Opt. Soc. Am. 71, 75, 1981). Their squares and that
        of ``residual`` sum to that of ``rms``.
    rms : float
        Rms wavefront error, waves, exact for smooth wavefronts up to ``accuracy``.
    peak_to_valley : float
        Peak-to-valley wavefront error over the map and the edge, waves.
    residual : float
        Rms of the wavefront error minus the fitted Zernike terms, waves.
    strehl : float
        Strehl ratio, from the mean phasor over the stop.
    vignetted : float
        Fraction of the stop's area whose light other apertures and bodies block.
    position : tuple of float
        Chief ray on the line CCD, (along the line, along the track), metres.
    hole : float
        Radius of the central hole of an annular pupil, in units of the stop's radius; 0 for a whole pupil, NaN for any
        other.
    accuracy : float
        For a beam vignetted by edges: change of the rms, as a fraction of it, or of the Strehl ratio by a finer
        quadrature, whichever is larger; 2e-3 where the shadows of edges are not known and 10 000 rays sample the light.
        0 for a free beam.
    """

    field: Field
    field_rad: tuple[float, float]
    wavelength: float
    x: np.ndarray
    y: np.ndarray
    map: np.ndarray
    coefficients: np.ndarray
    parts: np.ndarray
    rms: float
    peak_to_valley: float
    residual: float
    strehl: float
    vignetted: float
    position: tuple[float, float]
    hole: float = 0.0
    accuracy: float = 0.0

    @property
    def is_vignetted(self) -> bool:
        """True if edges or bodies block some of the light."""
        return self.hole != 0.0

    @property
    def polynomials(self) -> str:
        """Name of the polynomials to which ``parts`` refer."""
        if self.hole == 0.0:
            return "Zernike circle terms"
        if np.isfinite(self.hole):
            return f"annular Zernike terms, obscuration ratio {self.hole:.4f}"
        return "terms orthonormal over the illuminated part of this pupil"

    @property
    def orthonormal_terms(self) -> dict[str, float]:
        """Name of each orthonormal polynomial -> its contribution to the rms wavefront error, in waves."""
        return {zernike.name(j): float(c) for j, c in enumerate(self.parts, start=1)}

    @property
    def terms(self) -> dict[str, float]:
        """Name of each Zernike circle term -> its coefficient, in waves rms."""
        return {zernike.name(j): float(c) for j, c in enumerate(self.coefficients, start=1)}

    def to_xarray(self) -> xr.Dataset:
        """Return a data set of the wavefront map over pupil coordinates and of the Zernike terms over Noll index.

        The variables are ``wavefront`` and ``zernike``, with units and descriptive names as attributes.
        """
        import xarray as xr

        index = np.arange(1, len(self.coefficients) + 1)
        names = [zernike.name(int(j)) for j in index]
        axis_name = "{} on the stop over its radius"
        return xr.Dataset(
            {
                "wavefront": (("y", "x"), self.map, {"units": "waves", "long_name": "wavefront error"}),
                "zernike": ("noll", self.coefficients, {"units": "waves rms"}),
            },
            {
                "x": ("x", self.x, {"long_name": axis_name.format("along the line")}),
                "y": ("y", self.y, {"long_name": axis_name.format("along the track")}),
                "noll": ("noll", index, {"long_name": "Noll's index"}),
                "term": ("noll", names),
            },
            {
                "reference_frames": frames_text("optics"),
                "field": self.field,
                "wavelength_m": self.wavelength,
                "wfe_rms_waves": self.rms,
                "strehl": self.strehl,
                **({} if not self.is_vignetted else {"polynomials": self.polynomials, "parts_waves": self.parts}),
            },
        )


@shows("field_rad [deg]", "rms [um]", "farthest [um]", "airy [um]", "rays [um]")
@dataclass(frozen=True, eq=False)
class Spot:
    """Spot diagram of one field on the line CCD.

    Attributes
    ----------
    field : Field
        Field of the beam, as fractions of the half angles.
    field_rad : tuple of float
        Angles of the field from its middle, along the line and along the track, radians.
    rays : (N, 2) ndarray
        Positions of N rays relative to the chief ray, (along the line, along the track), metres; hexapolar on the stop,
        the chief ray first, without vignetted rays.
    centroid : (2,) ndarray
        Centroid of all light relative to the chief ray, metres.
    rms : float
        Rms distance from the centroid, metres, exact for smooth wavefronts.
    rms_along : (2,) ndarray
        Rms distance along the line and along the track, metres.
    farthest : float
        Largest distance of a ray from the centroid, metres.
    airy : float
        Radius of the Airy disk of equal numerical aperture, metres.
    position : tuple of float
        Chief ray on the line CCD, (along the line, along the track), metres.
    """

    field: Field
    field_rad: tuple[float, float]
    rays: np.ndarray
    centroid: np.ndarray
    rms: float
    rms_along: np.ndarray
    farthest: float
    airy: float
    position: tuple[float, float]

    @property
    def half_width(self) -> float:
        """Half width of a picture about the centroid that contains all rays and the Airy disk, metres."""
        return max(1.15 * self.airy, 1.1 * self.farthest)

    def to_xarray(self) -> xr.Dataset:
        """Return a data set of the rays' positions on the line CCD relative to the chief ray, metres."""
        import xarray as xr

        names = {"along_line": self.rays[:, 0], "along_track": self.rays[:, 1]}
        data = {name: ("ray", values, {"units": "m"}) for name, values in names.items()}
        attributes = {"reference_frames": frames_text("optics"), "field": self.field}
        return xr.Dataset(data, attrs={**attributes, "rms_m": self.rms, "airy_m": self.airy})


@shows(
    "field_rad [deg]",
    "frequency [cycles/mm]",
    "along_line",
    "along_track",
    "nyquist [cycles/mm]",
    "mtf_at_nyquist",
    "wavelengths [nm]",
)
@dataclass(frozen=True, eq=False)
class Mtf:
    """Modulation transfer function at one field, of the optics alone.

    Attributes
    ----------
    field : Field
        Field of the beam, as fractions of the half angles.
    field_rad : tuple of float
        Angles of the field from its middle, along the line and along the track, radians.
    frequency : (M,) ndarray
        The M spatial frequencies, cycles/m.
    values : (2, M) ndarray
        MTF along the line and along the track.
    limit : (2, M) ndarray
        MTF of the same pupil without wavefront error, the diffraction limit.
    wavelengths : (K,) ndarray
        The K wavelengths of the light, metres.
    nyquist : float
        Nyquist frequency of the pixels, cycles/m.
    weights : (K,) ndarray
        Signal at each wavelength, sum 1.
    error : float
        Largest change of the values if more wavelengths are taken; 0 for spectral lines.
    accuracy : float
        For a pupil vignetted by edges: largest change of the values if only a third of the integration lines across the
        pupil are used; the error of the values is about a tenth of it. 0 for a pupil without vignetting.
    """

    field: Field
    field_rad: tuple[float, float]
    frequency: np.ndarray
    values: np.ndarray
    limit: np.ndarray
    wavelengths: np.ndarray
    nyquist: float
    weights: np.ndarray
    error: float = 0.0
    accuracy: float = 0.0

    @property
    def at_nyquist(self) -> np.ndarray:
        """MTF along the line and along the track at the Nyquist frequency, (2,); NaN if not tabulated."""
        ends = {"left": np.nan, "right": np.nan}
        return np.array([np.interp(self.nyquist, self.frequency, row, **ends) for row in self.values])

    @property
    def mtf_at_nyquist(self) -> np.ndarray | None:
        """MTF along the line and along the track at the Nyquist frequency, (2,); None if not tabulated."""
        return None if np.isnan(self.at_nyquist).any() else self.at_nyquist

    @property
    def along_line(self) -> np.ndarray:
        """MTF along the line, (M,)."""
        return self.values[0]

    @property
    def along_track(self) -> np.ndarray:
        """MTF along the track, (M,)."""
        return self.values[1]

    def at(self, frequency: float | str) -> np.ndarray:
        """Return the MTF along the line and along the track at a frequency.

        Parameters
        ----------
        frequency : float or str
            Frequency in cycles/m, or with its unit, such as ``"50 cycles/mm"``.

        Returns
        -------
        (2,) ndarray
            MTF, interpolated between the tabulated frequencies; beyond a table that ends at the cut-off, its end.

        Raises
        ------
        ValueError
            The frequency is not a frequency, or beyond a table that ends before the cut-off.
        """
        asked = float(in_cycles_per_m(frequency)[0])
        first, last = float(self.frequency[0]), float(self.frequency[-1])
        cut_off = float(np.max(self.limit[:, -1])) <= MTF_ROUNDING
        if not (first <= asked and (asked <= last or cut_off)):
            raise ValueError(
                f"frequency: {asked:.6g} cycles/m is outside the tabulated range, {first:.6g} to {last:.6g} cycles/m; "
                "mtf(field, frequency) computes others"
            )
        return np.array([np.interp(asked, self.frequency, row) for row in self.values])

    def to_xarray(self) -> xr.Dataset:
        """Return a data set of the MTF (``mtf``) and its diffraction limit (``limit``) over direction and frequency."""
        import xarray as xr

        return xr.Dataset(
            {"mtf": (("direction", "frequency"), self.values), "limit": (("direction", "frequency"), self.limit)},
            {
                "direction": ["along line", "along track"],
                "frequency": ("frequency", self.frequency, {"units": "1/m", "long_name": "spatial frequency"}),
            },
            {
                "reference_frames": frames_text("optics"),
                "field": self.field,
                "nyquist_per_m": self.nyquist,
                **({"accuracy": self.accuracy} if self.accuracy else {}),
            },
        )


def in_si(value: float | str, kind: Kind, name: str) -> float:
    """Return a quantity in SI units, from a number in SI units or from text with a unit.

    Parameters
    ----------
    value : float or str
        Number in SI units, or text such as ``"20 um"``.
    kind : Kind
        Kind of quantity.
    name : str
        Name of the argument, for messages.

    Raises
    ------
    ValueError
        The text is not such a quantity, or the number is not finite.
    """
    try:
        number = parse_quantity(value, kind) if isinstance(value, str) else float(value)
    except (Problem, TypeError) as problem:
        raise ValueError(f"{name}: {problem}, {value!r}; allowed: {kind.allowed}, or a number in {kind.si}") from None
    if not np.isfinite(number):
        raise ValueError(f"{name}: {value!r} is not finite; allowed: {kind.allowed}, or a number in {kind.si}")
    return number


def in_cycles_per_m(frequency: Frequencies) -> np.ndarray:
    """Return spatial frequencies, (M,), in cycles/m, from numbers in cycles/m or from text such as ``"50 cycles/mm"``.

    Raises
    ------
    ValueError
        A text is not a spatial frequency, or a number is not finite.
    """
    texts = [
        str(value).replace("cycles/", "1/").replace("lp/", "1/") if isinstance(value, str) else value
        for value in np.atleast_1d(np.asarray(frequency, dtype=object))
    ]
    return np.array([in_si(text, SPATIAL_FREQUENCY, "frequency") for text in texts])


def field_fractions(field: Field | FieldText, half: tuple[float, float]) -> Field:
    """Return a field as fractions of the half angles of view.

    Parameters
    ----------
    field : Field or FieldText
        Fractions, or angles with a unit.
    half : tuple of float
        Half angles of view along the line and along the track, radians.

    Raises
    ------
    ValueError
        It is neither, or lies beyond the camera's field of view, for which it has no clear apertures.
    """
    parts: Any = split_row(field.translate(_NO_BRACKETS), 2) or () if isinstance(field, str) else field
    try:
        angles = all(isinstance(part, str) for part in parts)
        numbers = [in_si(part, ANGLE, "field") if angles else float(part) for part in parts]
        shares = np.array(
            [n / max(h, SMALLEST_HALF_FIELD) for n, h in zip(numbers, half, strict=True)] if angles else numbers
        )
        inside = len(numbers) == 2 and bool(np.all(np.abs(shares) <= (1.0 + LAST_DIGIT if angles else 1.0)))
    except (TypeError, ValueError):
        inside = False
    if not inside:
        along, across = np.degrees(half)
        raise ValueError(
            f"field: {field!r} is not in the field; a field is a pair (along the line, along the track) of angles from "
            f"its middle, such as '{0.5 * along:.4g} {0.5 * across:.4g} deg', up to ({along:.4g}, {across:.4g}) deg, "
            "or of fractions of these half angles, from -1 to 1"
        )
    shares = np.clip(shares, -1.0, 1.0)
    return float(shares[0]), float(shares[1])


def check_wavefront(wave: Wavefront) -> None:
    """Check that a wavefront's numbers are physically possible.

    Raises
    ------
    UnphysicalError
        A number is impossible; the message names it.
    """
    check_range("the vignetted fraction of a stop", wave.vignetted, 0.0, 1.0, ROUNDING)
    check_range("a Strehl ratio", wave.strehl, 0.0, 1.0, ROUNDING)
    check_range("an rms wavefront error in waves", wave.rms, 0.0, MAX_RMS_WAVES, 0.0)
    square = float(np.sum(wave.parts**2)) + wave.residual**2
    what, margin = "the sum of squares of a wavefront error's parts and of their residual", 1e-6 * wave.rms**2
    check_close(what, square, wave.rms**2, "the square of its rms", margin + ROUNDING**2)


def check_mtf(mtf: Mtf) -> None:
    """Check that an MTF is physically possible: by Schwarz' inequality aberrations cannot increase it.

    Raises
    ------
    UnphysicalError
        A value is impossible; the message names it.
    """
    check_range("an MTF", mtf.values, 0.0, 1.0, MTF_ROUNDING)
    check_range("the MTF of a perfect wavefront", mtf.limit, 0.0, 1.0, MTF_ROUNDING)
    check_at_most("an MTF", mtf.values, mtf.limit, "that of the perfect wavefront", MTF_ROUNDING)
    still = mtf.frequency == 0.0
    check_close("the MTF at zero frequency", mtf.values[:, still], 1.0, "all of the light", MTF_ROUNDING)
