"""What is told of a camera's images at one field: wavefront, spot and MTF, and what these numbers must be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.arrays import shows
from optics.geometry import zernike
from optics.numerics.array_math import check_at_most, check_close, check_range
from twin.framework.reference_frames import frames_text

if TYPE_CHECKING:  # takes half a second with pandas, and only who asks for a data set needs it
    import xarray as xr

Field = tuple[float, float]
"""Shares of the half angles of view: along the line, along the track."""

TERMS = 37
"""Zernike terms (Noll's order) that are told of a wavefront: all to seventh order, and the spherical of eighth."""

ROUNDING = 1e-6
"""By which shares and Strehl ratios may leave 0 to 1: what quadratures over pieces of shadows are right to."""

MTF_ROUNDING = 1e-3
"""By which an MTF may leave 0 to 1 or exceed that of the perfect wavefront: what its quadrature is held to."""

MOST_ERROR = 1e6
"""Rms wavefront error beyond which a number is none of an image, waves: 0.6 m of path."""


@shows("field", "rms [waves]", "peak_to_valley [waves]", "strehl", "vignetted [percent]", "map [waves]")
@dataclass(frozen=True, eq=False)
class Wavefront:
    """Wavefront error at one field.

    Attributes
    ----------
    field : Field
        where.
    wavelength : float
        Metres; waves are of this.
    x, y : np.ndarray
        Coordinates of the map's columns and rows on the stop, in units of its radius, (n,); x runs along the line, y
        along the track.
    map : np.ndarray
        Waves, (n, n); NaN where no light is.
    coefficients : np.ndarray
        Zernike's circle terms in Noll's order, waves rms over the whole stop, (TERMS,), fitted to the light that comes
        through; their names are ``optics.geometry.zernike``'s.
    parts : np.ndarray
        Of the rms that each term makes, waves, (TERMS,): the coefficients, where all of the stop is lit; else those of
        the same terms made orthonormal over what is lit, each without what the earlier ones hold. Over a ring these are
        the annular Zernike terms (Mahajan, J. Opt. Soc. Am. 71, 75, 1981). Their squares and that of ``residual`` sum
        to that of ``rms``.
    rms : float
        Waves, exact for smooth wavefronts; ``accuracy`` says how far.
    peak_to_valley : float
        Waves, over the map and the edge.
    residual : float
        Rms that the Zernike terms leave, waves.
    strehl : float
        Strehl ratio, from the mean phasor over the stop.
    vignetted : float
        Share of the stop's area whose light other apertures and bodies stop.
    place : tuple[float, float]
        Of the chief ray on the line CCD, (along the line, along the track), metres.
    hole : float
        Radius of the hole of a pupil that is a ring about the stop's middle, in units of the stop's; 0 for a whole one,
        NaN for any other.
    accuracy : float
        Of a beam that edges cut: change of rms, as a share of it, or of the Strehl ratio by a finer quadrature,
        whichever is larger; 2e-3 where the shadows of edges are not known and 10 000 rays stand for the light. 0 for a
        free beam.
    """

    field: Field
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
    place: tuple[float, float]
    hole: float = 0.0
    accuracy: float = 0.0

    @property
    def is_cut(self) -> bool:
        """Whether edges or bodies take some of the light."""
        return self.hole != 0.0

    @property
    def polynomials(self) -> str:
        """What ``parts`` are numbers of."""
        if self.hole == 0.0:
            return "Zernike circle terms"
        if np.isfinite(self.hole):
            return f"annular Zernike terms, hole {self.hole:.4f} of the stop"
        return "terms orthonormal over the light of this pupil"

    @property
    def orthonormal_terms(self) -> dict[str, float]:
        """Name of each term -> waves rms of its part, of ``polynomials``."""
        return {zernike.name(j): float(c) for j, c in enumerate(self.parts, start=1)}

    @property
    def terms(self) -> dict[str, float]:
        """Name of each Zernike term -> waves rms."""
        return {zernike.name(j): float(c) for j, c in enumerate(self.coefficients, start=1)}

    def to_xarray(self) -> xr.Dataset:
        """``wavefront`` over pupil coordinates and ``zernike`` over Noll's index, with units and names."""
        import xarray as xr

        index = np.arange(1, len(self.coefficients) + 1)
        names = [zernike.name(int(j)) for j in index]
        along = "{} on the stop over its radius"
        return xr.Dataset(
            {
                "wavefront": (("y", "x"), self.map, {"units": "waves", "long_name": "wavefront error"}),
                "zernike": ("noll", self.coefficients, {"units": "waves rms"}),
            },
            {
                "x": ("x", self.x, {"long_name": along.format("along the line")}),
                "y": ("y", self.y, {"long_name": along.format("along the track")}),
                "noll": ("noll", index, {"long_name": "Noll's index"}),
                "term": ("noll", names),
            },
            {
                "reference_frames": frames_text("optics"),
                "field": self.field,
                "wavelength_m": self.wavelength,
                "wfe_rms_waves": self.rms,
                "strehl": self.strehl,
                **({} if not self.is_cut else {"polynomials": self.polynomials, "parts_waves": self.parts}),
            },
        )


@shows("field", "rms [um]", "farthest [um]", "airy [um]", "rays [um]")
@dataclass(frozen=True, eq=False)
class Spot:
    """Where the rays of one field meet the line CCD.

    Attributes
    ----------
    field : Field
        where.
    rays : np.ndarray
        From the chief ray, (along the line, along the track), metres, (N, 2); hexapolar on the stop, the chief ray
        first; those that an aperture stops are left out.
    centroid : np.ndarray
        Of all light from the chief ray, metres, (2,).
    rms : float
        Rms distance from the centroid, metres, exact for smooth wavefronts.
    rms_along : np.ndarray
        The same along the line and along the track, metres, (2,).
    farthest : float
        Of the rays from the centroid, metres.
    airy : float
        Radius of the Airy disk of the same numerical aperture, metres.
    place : tuple[float, float]
        Of the chief ray on the line CCD, (along the line, along the track), metres.
    """

    field: Field
    rays: np.ndarray
    centroid: np.ndarray
    rms: float
    rms_along: np.ndarray
    farthest: float
    airy: float
    place: tuple[float, float]

    def to_xarray(self) -> xr.Dataset:
        """The rays, metres from the chief ray."""
        import xarray as xr

        names = {"along_line": self.rays[:, 0], "along_track": self.rays[:, 1]}
        data = {name: ("ray", values, {"units": "m"}) for name, values in names.items()}
        told = {"reference_frames": frames_text("optics"), "field": self.field}
        return xr.Dataset(data, attrs={**told, "rms_m": self.rms, "airy_m": self.airy})


@shows("field", "at_nyquist", "nyquist [cycles/mm]", "frequency [cycles/mm]", "wavelengths [nm]")
@dataclass(frozen=True, eq=False)
class Mtf:
    """Modulation transfer at one field, of the optics alone.

    Attributes
    ----------
    field : Field
        where.
    frequency : np.ndarray
        cycles/m, (M,).
    values : np.ndarray
        Along the line and along the track, (2, M).
    limit : np.ndarray
        The same pupil without wavefront error, (2, M).
    wavelengths : np.ndarray
        Of the light, metres, (K,).
    nyquist : float
        Of the pixels, cycles/m.
    weights : np.ndarray
        Signal at each wavelength, sum 1, (K,).
    error : float
        By how much the values change at most where more wavelengths are taken; 0 for lines.
    accuracy : float
        Of a pupil that edges cut: change of the values by a third of the lines through it, at most; they are right to a
        tenth of that. 0 for a free pupil.
    """

    field: Field
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
        """Along the line and along the track at the pixels' Nyquist frequency, (2,); NaN beyond the table."""
        ends = {"left": np.nan, "right": np.nan}
        return np.array([np.interp(self.nyquist, self.frequency, row, **ends) for row in self.values])

    def at(self, frequency: float) -> np.ndarray:
        """Along the line and along the track at a frequency among the table's, cycles/m, (2,)."""
        return np.array([np.interp(frequency, self.frequency, row) for row in self.values])

    def to_xarray(self) -> xr.Dataset:
        """``mtf`` and ``limit`` over direction and frequency."""
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


def hold_wavefront(wave: Wavefront) -> None:
    """Hold a wavefront's numbers to what any has.

    Raises
    ------
    UnphysicalError
        One cannot be; with what it is.
    """
    check_range("the share of a stop that is vignetted", wave.vignetted, 0.0, 1.0, ROUNDING)
    check_range("a Strehl ratio", wave.strehl, 0.0, 1.0, ROUNDING)
    check_range("an rms wavefront error in waves", wave.rms, 0.0, MOST_ERROR, 0.0)
    square = float(np.sum(wave.parts**2)) + wave.residual**2
    check_close(
        "the squares of the parts of a wavefront error and of what they leave",
        square,
        wave.rms**2,
        "the square of the whole",
        1e-6 * wave.rms**2 + ROUNDING**2,
    )


def hold_mtf(mtf: Mtf) -> None:
    """Hold an MTF to what any has: by Schwarz' inequality no error raises one of the same light.

    Raises
    ------
    UnphysicalError
        It cannot be; with what it is.
    """
    check_range("an MTF", mtf.values, 0.0, 1.0, MTF_ROUNDING)
    check_range("the MTF of a perfect wavefront", mtf.limit, 0.0, 1.0, MTF_ROUNDING)
    check_at_most("an MTF", mtf.values, mtf.limit, "that of the perfect wavefront", MTF_ROUNDING)
    still = mtf.frequency == 0.0
    check_close("the MTF at zero frequency", mtf.values[:, still], 1.0, "all of the light", MTF_ROUNDING)
