"""Rational polynomials (RPC00B, NIMA STDI-0002) of a line sensor: fit, files, and correction by control points.

Line and sample are ratios of cubics in latitude, longitude and height, the one model that all photogrammetric software
reads. Coordinates are scaled to -1 .. 1 over the ground that the fit covers; beyond it the polynomials are not valid.
Image coordinates count from the centre of the first pixel, heights are above the ellipsoid (WGS84).

Files that are read: RPC00B as text beside an image (NAME_RPC.TXT, NAME.RPB) or inside a GeoTIFF, and the RPC files of
DIMAP 2 and 3, of which the model from the ground to the image is used. DIMAP 2 counts lines and samples from 1, which
becomes 0 here; DIMAP 3 counts them from 0, as a scene of Pléiades Neo shows, whose RPC file has the first pixel at
0.0005, -0.0006.

Control points determine a correction in the image, with its covariance and residuals, and polynomials of the same form
that include it.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from analysis.arrays import Array
from analysis.orbit.rational_polynomial import (
    TERMS,
    ImageCorrection,
    Kind,
    RationalPolynomial,
    fit_rpc,
    image_correction,
)
from scenes.yaml.errors import InputError, Issue, names_text, nearest, shown
from scenes.yaml.input_file import why_unreadable
from twin.orbit.flight.earth import Earth, curvature_radii, east_north_up
from twin.orbit.flight.sensor import Sensor
from twin.orbit.measured.xml_file import Element, first_lines, numbers, read_xml, text_lines

_GRID = (24, 24, 9)
"""Number of lines, pixels and heights of the grid of the fit; the points at which it is checked lie between."""


def sensor_polynomial(
    sensor: Sensor, first_pixel: int, pixels: int, heights: tuple[float, float]
) -> RationalPolynomial:
    """Fit rational polynomials to the image of a sensor, or to a window of it.

    Parameters
    ----------
    sensor : Sensor
        The line on its trajectory; its lines are those of the window.
    first_pixel : int
        First pixel of the window on the line.
    pixels : int
        Number of pixels of the window.
    heights : tuple[float, float]
        Lowest and highest ground above the ellipsoid, metres.

    Raises
    ------
    ValueError
        A line of sight misses the Earth, or the ground crosses a pole or the 180th meridian.
    """
    low, high = np.array([(-0.5, sensor.lines - 0.5), (-0.5, pixels - 0.5), heights]).T
    grids = []
    for at_ends in (True, False):
        counts = _GRID if at_ends else tuple(count - 1 for count in _GRID)
        line, sample, height = _chebyshev_grid(0.5 * (low + high), 0.5 * (high - low), counts, at_ends)
        ground = sensor.ground(line, first_pixel + sample, height)
        if not np.all(np.isfinite(ground)):
            raise ValueError("a line of sight misses the Earth")
        longitude, latitude, _ = (np.degrees(v) for v in sensor.earth.geodetic(ground))
        grids.append((np.stack([line, sample], axis=-1), np.stack([latitude, longitude, height], axis=-1)))
    return fit_rpc(*grids[0], check=grids[1])


def axis_sigma(covariance: Array) -> float:
    """Return the root mean square error of a horizontal axis, metres, as ERR_BIAS and ERR_RAND define it.

    Parameters
    ----------
    covariance : (N, 2, 2) ndarray
        Covariances of errors to the east and to the north at N points of an image, m^2.
    """
    return float(np.sqrt(0.5 * np.mean(np.trace(covariance, axis1=-2, axis2=-1))))


def _chebyshev_grid(middle: Array, half: Array, counts: tuple[int, ...], at_ends: bool) -> list[Array]:
    """Return lines, samples and heights of a grid of Chebyshev points.

    Parameters
    ----------
    middle, half : (3,) ndarray
        Middle and half width of the ranges of line, sample and height.
    counts : tuple of int
        Number of points of each.
    at_ends : bool
        True for points that include the ends of the ranges, False for points between these.
    """
    angles = (np.linspace(0.0, np.pi, n) if at_ends else (np.arange(n) + 0.5) * np.pi / n for n in counts)
    axes = (m - h * np.cos(angle) for m, h, angle in zip(middle, half, angles, strict=True))
    return [v.ravel() for v in np.meshgrid(*axes, indexing="ij")]


_AXES = ("LINE", "SAMP", "LAT", "LONG", "HEIGHT")
_PARTS = ("LINE_NUM", "LINE_DEN", "SAMP_NUM", "SAMP_DEN")
_WHAT = "rational polynomials: NAME_RPC.TXT, NAME.RPB, a GeoTIFF with them, or RPC_NAME.XML of DIMAP"
_GROUND_MODELS = {"2": "Inverse_Model", "3": "GroundtoImage_Values"}
_FIRST_PIXEL = {"2": 1.0, "3": 0.0}
_TIFF = (".tif", ".tiff")
_ROW = re.compile(r"\s*([A-Z_0-9]+)\s*[:=]\s*(\S+)\s*(?:[A-Za-z]+\s*)?$")
_RPB_ROW = re.compile(r"\b(\w+)\s*=\s*(\([^)]*\)|[^;\n]*);", re.S)
_RPB_AXES = ("line", "samp", "lat", "long", "height")
_LEAST_SCALE = 1e-9


def read_rpc(path: str | Path) -> RationalPolynomial:
    """Read rational polynomials from a file, whose format is recognised by its content or ending.

    Parameters
    ----------
    path : str or Path
        Path of the file.

    Raises
    ------
    InputError
        The file cannot be read or is incomplete; with file, line and key.
    """
    if Path(path).suffix.lower() in _TIFF:
        return _from_tiff(Path(path))
    if Path(path).suffix.lower() == ".rpb":
        return _from_rpb(Path(path))
    if any(line.lstrip("\ufeff \t").startswith("<") for line in first_lines(path, _WHAT, 1)):
        return _from_dimap(read_xml(path, _WHAT))
    return _from_text(Path(path))


def is_rpc(path: Path) -> bool:
    """Return True if a file holds rational polynomials alone: NAME_RPC.TXT, NAME.RPB, GeoTIFF, RPC file of DIMAP.

    Raises
    ------
    InputError
        The file is XML that cannot be read.
    """
    match path.suffix.lower():
        case ".tif" | ".tiff" | ".txt" | ".rpb":
            return True
        case ".xml":
            return bool(read_xml(path, _WHAT).all("Rational_Function_Model"))
    return False


def _polynomial_of(
    file: str, offset: list[float], scale: list[float], parts: list[np.ndarray], errors: list[float | None]
) -> RationalPolynomial:
    small = [name for name, value in zip(_AXES, scale, strict=True) if not value > _LEAST_SCALE]
    if small:
        raise InputError(Issue("the scale is not above zero", file, None, (f"{small[0]}_SCALE",)))
    if not (-90.0 <= offset[2] <= 90.0 and -180.0 <= offset[3] <= 360.0):
        value = f"{offset[2]:g}, {offset[3]:g}"
        raise InputError(Issue("not a latitude and longitude in degrees", file, None, ("LAT_OFF", "LONG_OFF"), value))
    for name, part in zip(_PARTS, parts, strict=True):
        if name.endswith("DEN") and not np.any(part):
            raise InputError(Issue("all coefficients of the denominator are zero", file, None, (f"{name}_COEFF",)))
    error_terms = [None if error is None or error < 0.0 else error for error in errors]  # -1 if not stated
    line, below, sample, under = parts
    return RationalPolynomial(
        np.array(offset), np.array(scale), line, below, sample, under, bias_m=error_terms[0], random_m=error_terms[1]
    )


def _from_text(path: Path) -> RationalPolynomial:
    file, values_by_name = str(path), {}
    for k, line in enumerate(text_lines(path, _WHAT)):
        if not line.strip():
            continue
        match = _ROW.match(line)
        if match is None:
            raise InputError(Issue("not NAME: value", file, k + 1, (), shown(line), "LINE_OFF: 5120.5 pixels"))
        name, text = match.groups()
        if name in values_by_name:
            raise InputError(Issue("this key occurs twice", file, k + 1, (name,)))
        values_by_name[name] = float(numbers(file, [[text]], [k + 1], [name])[0, 0])
    names = [f"{axis}_{what}" for what in ("OFF", "SCALE") for axis in _AXES]
    names += [f"{part}_COEFF_{k + 1}" for part in _PARTS for k in range(TERMS)]
    for name in names:
        if name not in values_by_name:
            raise InputError(Issue(f"no {name}", file, None, (name,), None, _WHAT, nearest(name, values_by_name)))
    values = [values_by_name[name] for name in names]
    parts = [np.array(values[10 + TERMS * k : 10 + TERMS * (k + 1)]) for k in range(4)]
    return _polynomial_of(
        file, values[:5], values[5:10], parts, [values_by_name.get("ERR_BIAS"), values_by_name.get("ERR_RAND")]
    )


def _from_rpb(path: Path) -> RationalPolynomial:
    """Read a file NAME.RPB of DigitalGlobe: `key = value;`, with lists of coefficients in parentheses."""
    file, content = str(path), "\n".join(text_lines(path, _WHAT))
    rows = {row[1]: (row[2], content.count("\n", 0, row.start()) + 1) for row in _RPB_ROW.finditer(content)}

    def values(name: str, count: int) -> list[float]:
        if name not in rows:
            raise InputError(Issue(f"no {name}", file, None, (name,), None, _WHAT, nearest(name, rows)))
        text, line = rows[name]
        words = text.strip("() \n\t").replace(",", " ").split()
        if len(words) != count:
            raise InputError(Issue("another number of values", file, line, (name,), f"{len(words)}", f"{count}"))
        return numbers(file, [words], [line], [name] * count)[0].tolist()

    offset, scale = ([values(f"{axis}{what}", 1)[0] for axis in _RPB_AXES] for what in ("Offset", "Scale"))
    names = ("lineNumCoef", "lineDenCoef", "sampNumCoef", "sampDenCoef")
    errors = [values(name, 1)[0] if name in rows else None for name in ("errBias", "errRand")]
    return _polynomial_of(file, offset, scale, [np.array(values(name, TERMS)) for name in names], errors)


def _from_dimap(root: Element) -> RationalPolynomial:
    if root.tag != "Dimap_Document":
        root.wrong("not a DIMAP file", f"<{root.tag}>", "<Dimap_Document>")
    form = root.single("Metadata_Identification", "METADATA_FORMAT")
    version = form.attributes.get("version", "").partition(".")[0]
    if version not in _GROUND_MODELS:
        form.wrong("not this format", shown(form.attributes.get("version")), "DIMAP of version 2 or 3")
    model = root.single("Rational_Function_Model", "Global_RFM")
    values, validity = model.single(_GROUND_MODELS[version]), model.single("RFM_Validity")
    offset, scale = ([validity.number(f"{axis}_{what}") for axis in _AXES] for what in ("OFF", "SCALE"))
    offset[0] -= _FIRST_PIXEL[version]
    offset[1] -= _FIRST_PIXEL[version]
    parts = [np.array([values.number(f"{part}_COEFF_{k + 1}") for k in range(TERMS)]) for part in _PARTS]
    return _polynomial_of(root.file, offset, scale, parts, [None, None])


def _from_tiff(path: Path) -> RationalPolynomial:
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    file = str(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path, driver="GTiff") as image:
                rpc = image.rpcs
    # the library raises many kinds of errors
    except Exception as error:
        raise InputError(Issue(f"cannot be read: {why_unreadable(error)}", file, allowed=_WHAT)) from None
    if rpc is None:
        raise InputError(Issue("a TIFF without rational polynomials", file, allowed=names_text(["RPCCoefficientTag"])))
    offset = [rpc.line_off, rpc.samp_off, rpc.lat_off, rpc.long_off, rpc.height_off]
    scale = [rpc.line_scale, rpc.samp_scale, rpc.lat_scale, rpc.long_scale, rpc.height_scale]
    parts = [rpc.line_num_coeff, rpc.line_den_coeff, rpc.samp_num_coeff, rpc.samp_den_coeff]
    return _polynomial_of(
        file, offset, scale, [np.array(part, np.float64) for part in parts], [rpc.err_bias, rpc.err_rand]
    )


_CORRECTED_GRID = (21, 21, 7)
"""Number of lines, samples and heights of the grid to which corrected polynomials are fitted."""
_RATIONAL_GRID = (11, 11, 5)
"""Number of lines, samples and heights of the grid for an affine correction, with which polynomials keep their form."""
_GROUND_GRID = 5
"""Number of lines and of samples at which errors on the ground are computed."""
_UNLIKELY = 0.05
"""p-value of chi-square below which residuals are treated as larger than their covariances predict."""


def polynomial_correction(
    polynomial: RationalPolynomial,
    itrs: Array,
    ground_covariance: Array,
    measured: Array,
    image_covariance: Array,
    kind: Kind,
    screened: bool = True,
) -> ImageCorrection:
    """Estimate a correction of line and sample of rational polynomials from control points.

    Parameters
    ----------
    polynomial : RationalPolynomial
        Polynomials of the image.
    itrs : (N, 3) ndarray for N points
        Ground points, in metres.
    ground_covariance : (N, 3, 3) ndarray
        Covariances of the ground points in ITRS axes, in m^2.
    measured : (N, 2) ndarray
        Measured line and sample; the centre of the first pixel is 0, 0.
    image_covariance : (N, 2, 2) ndarray
        Covariances of the measured positions, in pixels^2.
    kind : Kind
        Kind of the correction, shift or affine.
    screened : bool
        True to reject points far beyond their covariances.

    Raises
    ------
    ValueError
        The points do not determine the correction.
    """
    longitude, latitude, height = Earth().geodetic(itrs)
    slope = image_slope(polynomial, latitude, longitude, height) @ east_north_up(longitude, latitude)
    spread = image_covariance + slope @ ground_covariance @ np.swapaxes(slope, 1, 2)
    predicted = np.stack(polynomial.image(np.degrees(latitude), np.degrees(longitude), height), axis=-1)
    return image_correction(predicted, measured, spread, kind, screened)


def image_slope(polynomial: RationalPolynomial, latitude: Array, longitude: Array, height: Array) -> Array:
    """Return the derivatives of line and sample, in pixels per metre of a step east, north and up, (N, 2, 3).

    They are computed at N positions; latitudes and longitudes are in radians, heights in metres.
    """
    by_geodetic = polynomial.linearised(np.degrees(latitude), np.degrees(longitude), height)[1]
    return _level_slope(by_geodetic, latitude, height)


def _level_slope(by_geodetic: Array, latitude: Array, height: Array) -> Array:
    """Return derivatives (..., 2, 3) by metres east, north and up from those by latitude, longitude and height.

    The latter are per degree and metre; latitudes are in radians, heights in metres.
    """
    meridian, normal = curvature_radii(latitude)
    east, north = np.degrees(1.0 / ((normal + height) * np.cos(latitude))), np.degrees(1.0 / (meridian + height))
    degrees_per_metre = np.stack([east, north, np.ones_like(east)], axis=-1)
    return np.asarray(by_geodetic[..., [1, 0, 2]] * degrees_per_metre[..., None, :])


@dataclass(frozen=True, eq=False)
class PolynomialImage:
    """Image with rational polynomials, as a function of ground points in the ITRS.

    Attributes
    ----------
    polynomial : RationalPolynomial
        Rational polynomials.
    middle, size : (2,) ndarray
        Middle and half extent of the image in lines and samples, in pixels.
    """

    polynomial: RationalPolynomial
    middle: Array
    size: Array

    def seen(self, ground: Array) -> tuple[Array, Array]:
        """Return line and sample (n, 2) of n ground points (n, 3), ITRS, in metres, and derivatives (n, 2, 3)."""
        longitude, latitude, height = Earth().geodetic(ground)
        position, slope = self.polynomial.linearised(np.degrees(latitude), np.degrees(longitude), height)
        return position, _level_slope(slope, latitude, height) @ east_north_up(longitude, latitude)

    @classmethod
    def of(cls, polynomial: RationalPolynomial, shape: tuple[int, int] | None = None) -> PolynomialImage:
        """Return an image of known numbers of lines and samples, or of the extent that the polynomials state."""
        if shape is None:
            return cls(polynomial, polynomial.offset[:2], polynomial.scale[:2])
        half = 0.5 * (np.array(shape) - 1.0)
        return cls(polynomial, half, np.maximum(half, 1.0))

    def ground(self, position: Array, height: Array | float) -> Array:
        """Return the ground points (n, 3), ITRS, in metres, that positions (n, 2) see at heights; NaN for none."""
        latitude, longitude = self.polynomial.ground(position[:, 0], position[:, 1], height)
        return np.asarray(Earth().ecef(np.radians(longitude), np.radians(latitude), height))


def corrected_polynomial(polynomial: RationalPolynomial, correction: ImageCorrection) -> RationalPolynomial:
    """Return polynomials that include a correction, with its remaining ground errors as ERR_BIAS and ERR_RAND.

    They are fitted over the image and the heights that the scales of the polynomials state.

    Parameters
    ----------
    polynomial : RationalPolynomial
        Polynomials of the image.
    correction : ImageCorrection
        Estimated correction.

    Raises
    ------
    ValueError
        The polynomials cannot be inverted to the ground, or the ground lies at a pole or the 180th meridian.
    """
    corrected = refitted(PolynomialImage.of(polynomial), correction.at, _CORRECTED_GRID)
    bias, random = _on_the_ground(polynomial, correction)
    return replace(corrected, bias_m=bias, random_m=random)


def refitted(
    image: PolynomialImage, correction: Callable[[Array, Array], Array], grid: tuple[int, int, int] = _RATIONAL_GRID
) -> RationalPolynomial:
    """Return polynomials that include a correction of line and sample, fitted over an image and its heights.

    Parameters
    ----------
    image : PolynomialImage
        Polynomials without the correction, and the extent of the image.
    correction : callable
        Function from lines and samples (N,) by the polynomials to their correction (N, 2), in pixels.
    grid : tuple of int
        Number of lines, samples and heights of the grid.

    Raises
    ------
    ValueError
        The polynomials cannot be inverted to the ground, or the ground lies at a pole or the 180th meridian.
    """
    grids, polynomial = [], image.polynomial
    middle, half = np.append(image.middle, polynomial.offset[4]), np.append(image.size, polynomial.scale[4])
    for at_ends in (True, False):
        counts = grid if at_ends else tuple(count - 1 for count in grid)
        line, sample, height = _chebyshev_grid(middle, half, counts, at_ends)
        latitude, longitude = polynomial.ground(line, sample, height)
        moved = np.stack([line, sample], axis=-1) + correction(line, sample)
        ground = np.stack([latitude, longitude, height], axis=-1)
        grids.append((moved[np.isfinite(latitude)], ground[np.isfinite(latitude)]))
    if min(len(moved) for moved, _ in grids) < np.prod(grid) // 2:
        raise ValueError("the polynomials cannot be inverted to the ground over their image")
    return fit_rpc(*grids[0], check=grids[1])


def _on_the_ground(polynomial: RationalPolynomial, correction: ImageCorrection) -> tuple[float, float]:
    """Return the RMS errors per horizontal axis over the image, in metres, as ERR_BIAS and ERR_RAND.

    They are the error of the correction, and the scatter of the control points beyond their own covariances.
    """
    position, to_ground = level_slopes(PolynomialImage.of(polynomial))
    used = correction.used
    predicted = np.einsum("nii->ni", correction.variance)[used]
    beyond = np.zeros(2)
    if correction.probability < _UNLIKELY:
        beyond = np.maximum(np.mean(correction.residual[used] ** 2 - predicted, axis=0), 0.0)
    covariance = correction.covariance_at(*position.T)
    sigmas = []
    for variance in (covariance, np.broadcast_to(np.diag(beyond), covariance.shape)):
        sigmas.append(axis_sigma(to_ground @ variance @ np.swapaxes(to_ground, 1, 2)))
    return sigmas[0], sigmas[1]


def level_slopes(image: PolynomialImage) -> tuple[Array, Array]:
    """Return line and sample (N, 2) of a grid over an image, and metres east and north per pixel there, (N, 2, 2).

    The ground has the middle height of the polynomials.
    """
    steps = np.linspace(-1.0, 1.0, _GROUND_GRID)
    ends = (middle + size * steps for middle, size in zip(image.middle, image.size, strict=True))
    position = np.stack([v.ravel() for v in np.meshgrid(*ends, indexing="ij")], axis=-1)
    height = np.full(len(position), image.polynomial.offset[4])
    line, sample = position.T
    latitude, longitude = (np.radians(v) for v in image.polynomial.ground(line, sample, height))
    seen = np.isfinite(latitude)
    slope = image_slope(image.polynomial, latitude[seen], longitude[seen], height[seen])
    return position[seen], np.asarray(np.linalg.inv(slope[:, :, :2]))


def residual_sigma(correction: ImageCorrection) -> Array:
    """Return the standard deviations of the residuals of line and sample at N points, (N, 2), in pixels."""
    return np.sqrt(np.maximum(np.einsum("nii->ni", correction.variance), 0.0))
