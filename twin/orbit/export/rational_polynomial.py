"""A line sensor as rational polynomials (RPC00B, NIMA STDI-0002): line and sample as ratios of cubics in latitude,
longitude and height, the one model that all photogrammetric software reads.

Coordinates are scaled to -1 .. 1 over the ground that the fit covers; beyond it the polynomials say nothing. Image
coordinates count from the centre of the first pixel, heights are above the ellipsoid (WGS84).

Rational polynomials of other people's files: RPC00B as text beside an image or inside a GeoTIFF, and the RPC files
of DIMAP 2 and 3.

DIMAP's model from the ground to the image is read. Version 2 counts lines and samples from 1, which becomes 0 here;
version 3 counts them from 0, as a scene of Pléiades Neo shows, whose RPC file has the first pixel at 0.0005, -0.0006.

Rational polynomials corrected by control points: what is off in the image, with its covariance and residuals, and
polynomials of the same form with the correction inside.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from analysis.arrays import Array
from analysis.orbit.image_correction import ImageCorrection, Kind, image_correction
from optics.numerics.backend import one_blas_thread
from scenes.yaml.errors import InputError, Issue, names_text, nearest, shown
from scenes.yaml.input_file import why_unreadable
from twin.orbit.flight.earth import Earth, curvature_radii, east_north_up
from twin.orbit.flight.sensor import Sensor
from twin.orbit.measured.xml_file import Element, first_lines, numbers, read_xml, text_lines

TERMS = 20
_POWERS = np.array(
    [
        *((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2)),
        *((1, 1, 1), (3, 0, 0), (1, 2, 0), (1, 0, 2), (2, 1, 0), (0, 3, 0), (0, 1, 2), (2, 0, 1), (0, 2, 1), (0, 0, 3)),
    ]
)
"""Powers of longitude, latitude and height in the order of RPC00B."""
_GRID = (24, 24, 9)
"""Lines, pixels and heights that are fitted; the checks lie between them."""
_ROUNDS = 6
_RANK = 1e-11
"""Smallest singular value that counts, relative to the largest. A cubic ratio has more coefficients than an image has
shape, and the rest stay small."""
_DAMPING = (0.0, 1e-8, 1e-6, 1e-4, 1e-2, 1.0)
"""Damping of the denominators that is tried; the last leaves polynomials."""


@dataclass(frozen=True, eq=False)
class RationalPolynomial:
    """The model, and how well it agrees.

    Attributes
    ----------
    offset : Array
        Of line, sample, latitude, longitude (degrees) and height (metres), (5,).
    scale : Array
        likewise.
    line_numerator, line_denominator, sample_numerator, sample_denominator : Array
        (20,) each.
    error_px : tuple[float, float]
        Largest difference from the rigorous sensor at places that were not fitted, lines and samples; NaN of
        polynomials that were read.
    rms_px : tuple[float, float]
        Root mean square of them.
    bias_m : float | None
        ERR_BIAS, metres: root mean square error on the ground of each horizontal axis that does not go with time, so
        that points and images have it in common (GDAL's RFC 22; 68 % in STDI-0002); None where nobody states it.
    random_m : float | None
        ERR_RAND, likewise of what goes with time and is another in every image or point.
    """

    offset: Array
    scale: Array
    line_numerator: Array
    line_denominator: Array
    sample_numerator: Array
    sample_denominator: Array
    error_px: tuple[float, float] = (np.nan, np.nan)
    rms_px: tuple[float, float] = (np.nan, np.nan)
    bias_m: float | None = None
    random_m: float | None = None

    @classmethod
    def fit(cls, sensor: Sensor, first_pixel: int, pixels: int, heights: tuple[float, float]) -> RationalPolynomial:
        """Rational polynomials of an image, or of a window of it.

        Parameters
        ----------
        sensor : Sensor
            The line on its trajectory; its lines are those of the window.
        first_pixel : int
            Of the window on the line.
        pixels : int
            Of the window.
        heights : tuple[float, float]
            Lowest and highest ground above the ellipsoid, metres.

        Raises
        ------
        ValueError
            a look misses the Earth, or the ground crosses a pole or the 180th meridian.
        """
        fitted = _seen(sensor, first_pixel, pixels, heights, _GRID, at_ends=True)
        others = tuple(count - 1 for count in _GRID)
        return cls.through(fitted, _seen(sensor, first_pixel, pixels, heights, others, at_ends=False))

    @classmethod
    def through(cls, fitted: Array, checked: Array) -> RationalPolynomial:
        """Rational polynomials through places of an image and of the ground.

        Parameters
        ----------
        fitted : Array
            (N, 5) line, sample, latitude, longitude (degrees) and height (metres).
        checked : Array
            (M, 5) of the same, between them.

        Raises
        ------
        ValueError
            The ground crosses a pole or the 180th meridian.
        """
        ends = np.stack([np.min(fitted, axis=0), np.max(fitted, axis=0)])
        if ends[1, 3] - ends[0, 3] > _WIDEST:
            raise ValueError("the ground lies on the 180th meridian or a pole, where longitudes jump")
        offset, scale = np.mean(ends, axis=0), 0.5 * (ends[1] - ends[0])
        sides = [(_monomials((seen[:, 2:] - offset[2:]) / scale[2:]), seen) for seen in (fitted, checked)]
        best = [_best(sides, k, offset[k], scale[k]) for k in range(2)]
        (line, line_most, line_rms), (sample, sample_most, sample_rms) = best
        return cls(offset, scale, *line, *sample, (line_most, sample_most), (line_rms, sample_rms))

    def ground(self, line: ArrayLike, sample: ArrayLike, height: ArrayLike) -> tuple[Array, Array]:
        """Latitude and longitude (N,), degrees, that a line and a sample (N,) see at a height, metres (N,).

        Newton steps from the middle of the ground; NaN where they do not arrive.
        """
        wanted = np.stack(np.broadcast_arrays(line, sample), axis=-1).astype(np.float64)
        at = np.broadcast_to(np.asarray(height, np.float64), wanted.shape[:-1])
        place = np.tile(self.offset[2:4], (len(wanted), 1))
        step = _STEP * self.scale[2:4]
        for _ in range(_MOST_STEPS):
            here, north, east = (
                np.stack(self.image(place[:, 0] + up, place[:, 1] + aside, at), axis=-1)
                for up, aside in ((0.0, 0.0), (step[0], 0.0), (0.0, step[1]))
            )
            slope = np.stack([(north - here) / step[0], (east - here) / step[1]], axis=-1)
            move = np.linalg.solve(slope, (wanted - here)[..., None])[..., 0]
            # a step over the whole ground leaves where the polynomials say anything
            place = place + np.clip(move, -self.scale[2:4], self.scale[2:4])
            if np.all(np.abs(move) < _ARRIVED * self.scale[2:4]):
                break
        arrived = np.all(np.abs(move) < _ARRIVED * self.scale[2:4], axis=-1)
        found = np.where(arrived[:, None], place, np.nan)
        return found[:, 0], found[:, 1]

    def image(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> tuple[Array, Array]:
        """Line and sample (N,) of ground points: degrees (N,), degrees, metres above the ellipsoid."""
        unit = (np.stack([latitude, longitude, height], axis=-1) - self.offset[2:]) / self.scale[2:]
        basis = _monomials(unit)
        line = basis @ self.line_numerator / (basis @ self.line_denominator)
        sample = basis @ self.sample_numerator / (basis @ self.sample_denominator)
        return self.offset[0] + self.scale[0] * line, self.offset[1] + self.scale[1] * sample

    def text(self) -> str:
        """Contents of NAME_RPC.TXT, as GDAL reads it beside NAME.tif."""
        names = (("LINE", "pixels"), ("SAMP", "pixels"), ("LAT", "degrees"), ("LONG", "degrees"), ("HEIGHT", "meters"))
        errors = (("ERR_BIAS", self.bias_m), ("ERR_RAND", self.random_m))
        rows = [f"{name}: {value!r} meters" for name, value in errors if value is not None]
        rows += [
            f"{name}_{what}: {value!r} {unit}"
            for what, values in (("OFF", self.offset), ("SCALE", self.scale))
            for (name, unit), value in zip(names, values.tolist(), strict=True)
        ]
        parts = {
            "LINE_NUM": self.line_numerator,
            "LINE_DEN": self.line_denominator,
            "SAMP_NUM": self.sample_numerator,
            "SAMP_DEN": self.sample_denominator,
        }
        rows += [f"{name}_COEFF_{k + 1}: {v!r}" for name, part in parts.items() for k, v in enumerate(part.tolist())]
        return "\n".join(rows) + "\n"

    def tags(self) -> list[tuple[Any, ...]]:
        """The tag of a GeoTIFF that holds them (RPCCoefficientTag): errors, -1 where nobody states them, offsets,
        scales and coefficients, in the order of RPC00B.
        """
        parts = (self.line_numerator, self.line_denominator, self.sample_numerator, self.sample_denominator)
        errors = (_UNSTATED if error is None else error for error in (self.bias_m, self.random_m))
        values = (*errors, *self.offset.tolist(), *self.scale.tolist(), *np.concatenate(parts).tolist())
        return [(_COEFFICIENTS, "d", len(values), values, True)]


def axis_sigma(covariance: Array) -> float:
    """Return the root mean square error of a horizontal axis, metres, as ERR_BIAS and ERR_RAND state it.

    Parameters
    ----------
    covariance : Array
        (N, 2, 2) to the east and to the north over an image, m^2.
    """
    return float(np.sqrt(0.5 * np.mean(np.trace(covariance, axis1=-2, axis2=-1))))


_STEP = 1e-6
_ARRIVED = 1e-9
_MOST_STEPS = 30
"""Of the ground's size: of a derivative, of the last step to the ground; and how many."""
_COEFFICIENTS = 50844
_UNSTATED = -1.0
"""Of an error, metres."""
_WIDEST = 90.0
"""Degrees of longitude."""


def _seen(
    sensor: Sensor,
    first_pixel: int,
    pixels: int,
    heights: tuple[float, float],
    counts: tuple[int, ...],
    *,
    at_ends: bool,
) -> Array:
    """Line, sample, latitude, longitude (degrees) and height (metres) over an image, (N, 5); image coordinates from the
    window's first pixel.
    """
    low, high = np.array([(-0.5, sensor.lines - 0.5), (-0.5, pixels - 0.5), heights]).T
    line, sample, height = _places(0.5 * (low + high), 0.5 * (high - low), counts, at_ends)
    ground = sensor.ground(line, first_pixel + sample, height)
    if not np.all(np.isfinite(ground)):
        raise ValueError("a look misses the Earth")
    longitude, latitude, _ = sensor.earth.geodetic(ground)
    return np.stack([line, sample, np.degrees(latitude), np.degrees(longitude), height], axis=-1)


def _places(middle: Array, half: Array, counts: tuple[int, ...], at_ends: bool) -> list[Array]:
    """Lines, samples and heights of a grid of Chebyshev points, with the ends or between those that have them."""
    angles = (np.linspace(0.0, np.pi, n) if at_ends else (np.arange(n) + 0.5) * np.pi / n for n in counts)
    axes = (m - h * np.cos(angle) for m, h, angle in zip(middle, half, angles, strict=True))
    return [v.ravel() for v in np.meshgrid(*axes, indexing="ij")]


def _monomials(unit: Array) -> Array:
    """(N, 20) terms of latitude, longitude and height (N, 3), scaled."""
    powers = [np.stack([np.ones_like(one), one, one**2, one**3]) for one in (unit[:, 1], unit[:, 0], unit[:, 2])]
    return np.stack([powers[0][a] * powers[1][b] * powers[2][c] for a, b, c in _POWERS], axis=-1)


def _best(
    sides: list[tuple[Array, Array]], k: int, offset: float, scale: float
) -> tuple[tuple[Array, Array], float, float]:
    """Numerator and denominator of one image coordinate, largest and root mean square error where it was not fitted.

    Attitudes that jitter are no cubics: coefficients that follow the jitter at the fitted places go astray between
    them. Of several degrees of smoothness the one with the least error there is taken.
    """
    (basis, fitted), (others, checked) = sides
    found: list[tuple[float, float, tuple[Array, Array]]] = []
    for damping in _DAMPING:
        ratio = _ratio(basis, (fitted[:, k] - offset) / scale, damping)
        below = others @ ratio[1]
        if not np.all(below > 0.0):  # a pole on the ground
            continue
        away = offset + scale * (others @ ratio[0]) / below - checked[:, k]
        found.append((float(np.sqrt(np.mean(away**2))), float(np.max(np.abs(away))), ratio))
    rms, most, ratio = min(found, key=lambda one: one[0])
    return ratio, most, rms


@one_blas_thread()
def _ratio(basis: Array, value: Array, damping: float) -> tuple[Array, Array]:
    """Coefficients (20,) and (20,), the second's first being 1, whose ratio is a value (N,): least squares of the
    ratio itself, by weights from the denominator of the round before; ``damping`` of the denominator's coefficients.
    """
    weight = np.ones(len(value))
    held = np.concatenate([np.zeros(TERMS), np.full(TERMS - 1, damping * np.sqrt(len(value)))])
    found = np.zeros(2 * TERMS - 1)
    for _ in range(_ROUNDS):
        rows = np.concatenate([basis, -value[:, None] * basis[:, 1:]], axis=1) * weight[:, None]
        rows, right = np.concatenate([rows, np.diag(held)]), np.concatenate([value * weight, np.zeros(len(held))])
        found = np.linalg.lstsq(rows, right, rcond=_RANK)[0]
        weight = 1.0 / (1.0 + basis[:, 1:] @ found[TERMS:])
        if not np.all(np.isfinite(weight) & (weight > 0.0)):
            break
    return found[:TERMS], np.concatenate([[1.0], found[TERMS:]])


_AXES = ("LINE", "SAMP", "LAT", "LONG", "HEIGHT")
_PARTS = ("LINE_NUM", "LINE_DEN", "SAMP_NUM", "SAMP_DEN")
_WHAT = "rational polynomials: NAME_RPC.TXT, a GeoTIFF with them, or RPC_NAME.XML of DIMAP"
_GROUND_MODELS = {"2": "Inverse_Model", "3": "GroundtoImage_Values"}
_FIRST_PIXEL = {"2": 1.0, "3": 0.0}
_TIFF = (".tif", ".tiff")
_ROW = re.compile(r"\s*([A-Z_0-9]+)\s*[:=]\s*(\S+)\s*(?:[A-Za-z]+\s*)?$")
_LEAST_SCALE = 1e-9


def read_rpc(path: str | Path) -> RationalPolynomial:
    """The polynomials of a file; its contents or ending decide on the format.

    Parameters
    ----------
    path : str | Path
        Of it.

    Raises
    ------
    InputError
        It cannot be read, or is not whole; with file, line and key.
    """
    if Path(path).suffix.lower() in _TIFF:
        return _from_tiff(Path(path))
    if any(line.lstrip("\ufeff \t").startswith("<") for line in first_lines(path, _WHAT, 1)):
        return _from_dimap(read_xml(path, _WHAT))
    return _from_text(Path(path))


def is_rpc(path: Path) -> bool:
    """Whether a file holds rational polynomials alone: NAME_RPC.TXT, a GeoTIFF, or the RPC file of DIMAP.

    Raises
    ------
    InputError
        It is XML that cannot be read.
    """
    match path.suffix.lower():
        case ".tif" | ".tiff" | ".txt":
            return True
        case ".xml":
            return bool(read_xml(path, _WHAT).all("Rational_Function_Model"))
    return False


def _made(
    file: str, offset: list[float], scale: list[float], parts: list[np.ndarray], errors: list[float | None]
) -> RationalPolynomial:
    small = [name for name, value in zip(_AXES, scale, strict=True) if not value > _LEAST_SCALE]
    if small:
        raise InputError(Issue("a scale that is not above zero", file, None, (f"{small[0]}_SCALE",)))
    if not (-90.0 <= offset[2] <= 90.0 and -180.0 <= offset[3] <= 360.0):
        found = f"{offset[2]:g}, {offset[3]:g}"
        raise InputError(Issue("no latitude and longitude, degrees", file, None, ("LAT_OFF", "LONG_OFF"), found))
    for name, part in zip(_PARTS, parts, strict=True):
        if name.endswith("DEN") and not np.any(part):
            raise InputError(Issue("a denominator of zeros", file, None, (f"{name}_COEFF",)))
    stated = [None if one is None or one < 0.0 else one for one in errors]  # -1 where nobody states one
    line, below, sample, under = parts
    return RationalPolynomial(
        np.array(offset), np.array(scale), line, below, sample, under, bias_m=stated[0], random_m=stated[1]
    )


def _from_text(path: Path) -> RationalPolynomial:
    file, found = str(path), {}
    for k, line in enumerate(text_lines(path, _WHAT)):
        if not line.strip():
            continue
        match = _ROW.match(line)
        if match is None:
            raise InputError(Issue("not NAME: value", file, k + 1, (), shown(line), "LINE_OFF: 5120.5 pixels"))
        name, text = match.groups()
        if name in found:
            raise InputError(Issue("a key that stands twice", file, k + 1, (name,)))
        found[name] = float(numbers(file, [[text]], [k + 1], [name])[0, 0])
    names = [f"{axis}_{what}" for what in ("OFF", "SCALE") for axis in _AXES]
    names += [f"{part}_COEFF_{k + 1}" for part in _PARTS for k in range(TERMS)]
    for name in names:
        if name not in found:
            raise InputError(Issue(f"no {name}", file, None, (name,), None, _WHAT, nearest(name, found)))
    values = [found[name] for name in names]
    parts = [np.array(values[10 + TERMS * k : 10 + TERMS * (k + 1)]) for k in range(4)]
    return _made(file, values[:5], values[5:10], parts, [found.get("ERR_BIAS"), found.get("ERR_RAND")])


def _from_dimap(root: Element) -> RationalPolynomial:
    if root.tag != "Dimap_Document":
        root.wrong("not a DIMAP file", f"<{root.tag}>", "<Dimap_Document>")
    form = root.one("Metadata_Identification", "METADATA_FORMAT")
    version = form.attributes.get("version", "").partition(".")[0]
    if version not in _GROUND_MODELS:
        form.wrong("not this format", shown(form.attributes.get("version")), "DIMAP of version 2 or 3")
    model = root.one("Rational_Function_Model", "Global_RFM")
    values, validity = model.one(_GROUND_MODELS[version]), model.one("RFM_Validity")
    offset, scale = ([validity.number(f"{axis}_{what}") for axis in _AXES] for what in ("OFF", "SCALE"))
    offset[0] -= _FIRST_PIXEL[version]
    offset[1] -= _FIRST_PIXEL[version]
    parts = [np.array([values.number(f"{part}_COEFF_{k + 1}") for k in range(TERMS)]) for part in _PARTS]
    return _made(root.file, offset, scale, parts, [None, None])


def _from_tiff(path: Path) -> RationalPolynomial:
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    file = str(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path, driver="GTiff") as image:
                rpc = image.rpcs
    # the library's errors are many
    except Exception as error:
        raise InputError(Issue(f"cannot be read: {why_unreadable(error)}", file, allowed=_WHAT)) from None
    if rpc is None:
        raise InputError(Issue("a TIFF without rational polynomials", file, allowed=names_text(["RPCCoefficientTag"])))
    offset = [rpc.line_off, rpc.samp_off, rpc.lat_off, rpc.long_off, rpc.height_off]
    scale = [rpc.line_scale, rpc.samp_scale, rpc.lat_scale, rpc.long_scale, rpc.height_scale]
    parts = [rpc.line_num_coeff, rpc.line_den_coeff, rpc.samp_num_coeff, rpc.samp_den_coeff]
    return _made(file, offset, scale, [np.array(part, np.float64) for part in parts], [rpc.err_bias, rpc.err_rand])


_SLOPE_STEP = 10.0
"""Metres on the ground of a derivative: polynomials are straight to 1e-9 over it."""
_CORRECTED_GRID = (21, 21, 7)
"""Lines, samples and heights through which corrected polynomials go."""
_GROUND_GRID = 5
_UNLIKELY = 0.05
"""Chance of a chi-square from which residuals scatter beyond their covariances."""


def polynomial_correction(
    polynomial: RationalPolynomial,
    itrs: Array,
    ground_covariance: Array,
    measured: Array,
    image_covariance: Array,
    kind: Kind,
    screened: bool = True,
) -> ImageCorrection:
    """By how much polynomials are off in the image.

    Parameters
    ----------
    polynomial : RationalPolynomial
        Of the image.
    itrs : Array
        (N, 3) of the points, metres.
    ground_covariance : Array
        (N, 3, 3) in its axes, m^2.
    measured : Array
        (N, 2) line and sample, the centre of the first pixel being 0, 0.
    image_covariance : Array
        (N, 2, 2), pixels^2.
    kind : Kind
        Of the correction, shift or affine.
    screened : bool
        Whether points far beyond their covariances are left out.

    Raises
    ------
    ValueError
        As `analysis.orbit.image_correction.image_correction`.
    """
    longitude, latitude, height = Earth().geodetic(itrs)
    slope = image_slope(polynomial, latitude, longitude, height) @ east_north_up(longitude, latitude)
    spread = image_covariance + slope @ ground_covariance @ np.swapaxes(slope, 1, 2)
    predicted = np.stack(polynomial.image(np.degrees(latitude), np.degrees(longitude), height), axis=-1)
    return image_correction(predicted, measured, spread, kind, screened)


def image_slope(polynomial: RationalPolynomial, latitude: Array, longitude: Array, height: Array) -> Array:
    """Derivatives of line and sample by metres east, north and up, (N, 2, 3), at places (N,) in radians and metres."""
    meridian, normal = curvature_radii(latitude)
    moves = (
        (0.0, _SLOPE_STEP / ((normal + height) * np.cos(latitude)), 0.0),
        (_SLOPE_STEP / (meridian + height), 0.0, 0.0),
        (0.0, 0.0, _SLOPE_STEP),
    )
    columns = []
    for north, east, up in moves:
        ends = [
            np.stack(
                polynomial.image(
                    np.degrees(latitude + sign * north), np.degrees(longitude + sign * east), height + sign * up
                ),
                axis=-1,
            )
            for sign in (0.5, -0.5)
        ]
        columns.append((ends[0] - ends[1]) / _SLOPE_STEP)
    return np.stack(columns, axis=-1)


def controlled(polynomial: RationalPolynomial, correction: ImageCorrection) -> RationalPolynomial:
    """Return the polynomials with a correction inside, and what is uncertain of them on the ground.

    Parameters
    ----------
    polynomial : RationalPolynomial
        Of the image.
    correction : ImageCorrection
        That was found for it.

    Raises
    ------
    ValueError
        Polynomials that do not lead back to the ground, ground at a pole or the 180th meridian.
    """
    grids, kept = [], [0, 1, 4]
    for at_ends in (True, False):
        counts = _CORRECTED_GRID if at_ends else tuple(count - 1 for count in _CORRECTED_GRID)
        line, sample, height = _places(polynomial.offset[kept], polynomial.scale[kept], counts, at_ends)
        latitude, longitude = polynomial.ground(line, sample, height)
        moved = np.stack([line, sample], axis=-1) + correction.at(line, sample)
        grids.append(np.stack([*moved.T, latitude, longitude, height], axis=-1)[np.isfinite(latitude)])
    if min(map(len, grids)) < np.prod(_CORRECTED_GRID) // 2:
        raise ValueError("the polynomials do not lead back to the ground over the image that they state")
    bias, random = _on_the_ground(polynomial, correction)
    return replace(RationalPolynomial.through(*grids), bias_m=bias, random_m=random)


def _on_the_ground(polynomial: RationalPolynomial, correction: ImageCorrection) -> tuple[float, float]:
    """Root mean square errors of a horizontal axis over the image, metres: of the correction, and of what scatters at
    the control points beyond their own covariances.
    """
    steps = np.linspace(-1.0, 1.0, _GROUND_GRID)
    line, sample = (
        v.ravel()
        for v in np.meshgrid(*(polynomial.offset[k] + polynomial.scale[k] * steps for k in (0, 1)), indexing="ij")
    )
    height = np.full_like(line, polynomial.offset[4])
    latitude, longitude = (np.radians(v) for v in polynomial.ground(line, sample, height))
    seen = np.isfinite(latitude)
    slope = image_slope(polynomial, latitude[seen], longitude[seen], height[seen])[:, :, :2]
    to_ground = np.linalg.inv(slope)
    used = correction.used
    own = np.einsum("nii->ni", correction.variance)[used]
    beyond = np.zeros(2)
    if correction.probability < _UNLIKELY:
        beyond = np.maximum(np.mean(correction.residual[used] ** 2 - own, axis=0), 0.0)
    known = correction.covariance_at(line[seen], sample[seen])
    found = []
    for variance in (known, np.broadcast_to(np.diag(beyond), known.shape)):
        found.append(axis_sigma(to_ground @ variance @ np.swapaxes(to_ground, 1, 2)))
    return found[0], found[1]


def residual_sigma(correction: ImageCorrection) -> Array:
    """(N, 2) standard deviations of the residuals of line and sample, pixels."""
    return np.sqrt(np.maximum(np.einsum("nii->ni", correction.variance), 0.0))
