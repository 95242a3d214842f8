"""Modulation transfer function (MTF) from one slanted edge, after ISO 12233, with standard deviations.

Steps: the edge's line from row centroids (`edge_location`); all pixels projected on the edge's *normal* and a
least-squares edge-spread function through them (`edge_fit`); angle, position and a test for curvature by one
Gauss-Newton step on all pixels, twice; the transform of the line-spread function in closed form over the contrast.

ISO 12233 projects along the rows, and its frequencies are counted along the row. Here they are counted along the
normal: the result is the cut through the two-dimensional MTF at f (cos angle, sin angle) for axis "x". Along the row
(axis "x") or column (axis "y") the frequency is lower by cos(angle).

The processing of noise is linear but for the division by the contrast, so its covariance is exact to first order: pixel
variances -> coefficients -> transfer function with its normalisation -> modulus. Noise lengthens the modulus on average
(Rice); `noise_bias` gives the amount, and `mtf` is not corrected for it.

Without noise the error is below 0.0005 up to Nyquist for F/9.2 at 650 nm with pixels of 7 um and of 28 um, at 2 to 10
deg for 64 x 64 px and more (tests/analysis/test_slanted_edge.py). `sigma` does not contain it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from analysis.arrays import Array
from analysis.mtf.edge_fit import OVERSAMPLING, EdgeDesign, EdgeSpread, FittedEdge, fit_edge, path_parts
from analysis.mtf.edge_location import Axis, EdgeError, EdgeLine, checked_region, locate_edge, pixel_noise
from analysis.spots.noise import NoiseModel
from analysis.statistics import measured_bias, p_value_of, rice_sigma, signal_modulus
from optics.numerics.arguments import checked, finite

# Fraction of the contrast by which means of blocks of 4 x 4 px may differ from the fitted edge.
_OTHER_STRUCTURE = 0.1
# Blocks and strips of pixels whose means are tested for structure, px.
_BLOCK, _STRIP = 8, 4
FALSE_ALARM = 1e-4
"""Probability that independent noise of the pixels is reported as structure."""
_LEAST_STRUCTURE = 5e-5
FREQUENCY = np.linspace(0.0, 1.0, 65)
FREQUENCY.setflags(write=False)
"""Frequencies at which an MTF is given by default, cycles/pixel."""
# Samples of the returned spread functions.
_SHOWN_PER_PIXEL = 16


def slanted_edge_mtf(
    region: ArrayLike,
    *,
    noise: NoiseModel | None = None,
    frames: int = 1,
    saturation: float | None = None,
    frequency: ArrayLike | None = None,
    rounding: tuple[float, float] = (0.0, 0.0),
    uniform_light: bool = False,
) -> EdgeMtf:
    """Measure the modulation transfer function from a slanted edge, with the standard deviation at every frequency.

    Frequencies are counted along the normal of the edge, not along the rows as in ISO 12233. The region may be one
    frame or the mean of several; `edge_pages.measure_pages` aligns frames between which the edge moves.

    Dimensions: H rows, W columns, F frequencies.

    Parameters
    ----------
    region : (H, W) array_like
        Grey values, linear in light, of a region with one edge. The edge should be 2 to 10 deg off the pixel grid.
    noise : NoiseModel, optional
        Noise of the detector; its fixed pattern counts as independent from pixel to pixel. By default the variance is
        estimated from the residuals on both sides of the edge and taken as linear in the grey value.
    frames : int
        Number of frames averaged into the region; used with `noise` only.
    saturation : float, optional
        Grey value of saturation. By default that of `noise`; without it, plateaus of equal values count as saturated.
    frequency : (F,) array_like, optional
        Increasing frequencies, in cycles per pixel. The default is 0 to 1 in steps of 1/64.
    rounding : tuple of float
        Rms of the rounding error that remains in the dark and in the bright level, in grey values.
    uniform_light : bool
        True if the light is known to be uniform, as in a simulated image; otherwise both levels are fitted as planes.

    Returns
    -------
    EdgeMtf
        `frequency`, `mtf` and `sigma` (F,), the edge-spread function and the fitted line; `at` interpolates.

    Raises
    ------
    ValueError
        The region does not show one straight edge that can be measured, or the frequencies are not increasing, are
        negative or exceed 2 cycles per pixel.

    Notes
    -----
    After ISO 12233, with a least-squares edge-spread function and exact propagation of the noise (module docstring).

    Examples
    --------
    An edge at 5 deg, blurred by a Gaussian of 0.6 px, whose MTF is exp(-2 pi^2 0.6^2 f^2):

    >>> import numpy as np
    >>> from scipy.special import erf
    >>> import analysis
    >>> row, column = np.mgrid[:80, :80]
    >>> angle = np.radians(5.0)
    >>> distance = (column - 39.2) * np.cos(angle) - (row - 39.5) * np.sin(angle)
    >>> image = 500 + 400 * erf(distance / (0.6 * np.sqrt(2)))
    >>> edge = analysis.slanted_edge_mtf(image, frequency=[0.0, 0.25, 0.5], saturation=1000)
    >>> np.round(edge.mtf, 3)
    array([1.   , 0.641, 0.169])
    >>> np.round(np.exp(-2 * np.pi**2 * 0.6**2 * edge.frequency**2), 3)
    array([1.   , 0.641, 0.169])
    >>> edge.axis, round(float(np.degrees(abs(edge.angle))), 2)
    ('x', 5.0)

    With 1 % of noise; `at` interpolates the value and its standard deviation:

    >>> rng = np.random.default_rng(3)
    >>> value, sigma = analysis.slanted_edge_mtf(image + 4 * rng.standard_normal(image.shape)).at(0.25)
    >>> round(value, 2), round(sigma, 3)
    (0.64, 0.003)
    """
    frequencies = FREQUENCY if frequency is None else _checked_frequency(frequency)
    if saturation is None and noise is not None:
        saturation = noise.saturation_dn
    grey = checked_region(region, saturation)
    line = locate_edge(grey)
    upright = rising(grey, line)
    fitted = fit_edge(upright, *rising_line(line, upright.shape[1]), uniform_light)
    return edge_result(
        upright[None] - fitted.light.reshape(upright.shape), line, fitted, noise, frames, frequencies, rounding
    )


def _checked_frequency(frequency: ArrayLike) -> Array:
    """Return frequencies, (F,) cycles/pixel, if they suit `slanted_edge_mtf`; raise ValueError otherwise.

    Dimensions: F frequencies.
    """
    wanted = np.array(frequency, dtype=np.float64)
    if wanted.ndim != 1 or wanted.size < 2 or not np.all(np.diff(wanted) > 0) or wanted[0] < 0:
        raise ValueError("frequency must be at least two increasing values >= 0, in cycles/pixel")
    if wanted[-1] > OVERSAMPLING / 2:
        raise ValueError(f"frequency must be at most {OVERSAMPLING / 2:g} cycles/pixel, found {wanted[-1]:g}")
    return wanted


def rising(grey: Array, line: EdgeLine) -> Array:
    """Return regions (..., H, W) transposed or mirrored so that the edge is near-vertical and rises to the right.

    Dimensions: H rows, W columns.
    """
    upright = grey if line.axis == "x" else np.swapaxes(grey, -1, -2)
    return upright if line.sign > 0 else upright[..., ::-1]


def rising_line(line: EdgeLine, columns: int) -> tuple[float, float]:
    """Return the column in the middle row and the slope of the line in a region oriented by `rising`."""
    return line.position if line.sign > 0 else columns - 1 - line.position, math.tan(line.sign * line.angle)


def edge_result(
    pages: Array,
    line: EdgeLine,
    fitted: FittedEdge,
    noise: NoiseModel | None,
    frames: int,
    frequency: Array,
    rounding: tuple[float, float],
) -> EdgeMtf:
    """Return the MTF of a fitted edge, with its sigmas.

    Dimensions: P pages, H rows, W columns, F frequencies.

    Parameters
    ----------
    pages : (P, H, W) ndarray
        Regions from `rising`, with equal levels; P is 1 unless pages are aligned.
    line : EdgeLine
        Line as located, for its axis and sign.
    fitted : FittedEdge
        Line and edge-spread function of all pages together.
    noise : NoiseModel or None
        Noise model of the detector; None to estimate the noise from the residuals.
    frames : int
        Number of frames averaged into each page.
    frequency : (F,) ndarray
        Frequencies, cycles/pixel.
    rounding : tuple of float
        Rms of the rounding error that remains in the dark and in the bright level, grey values.

    Raises
    ------
    EdgeError
        There is more than one straight edge.
    """
    spread, design = fitted.spread, fitted.design
    grey, columns = pages.ravel(), pages.shape[2]
    model = spread.value(design)
    _check_single_edge((pages - model.reshape(pages.shape)).mean(axis=0), spread.contrast, line)
    levels = _Levels(pages.shape, grey, model, design, spread)
    variance, dark_variance, bright_variance = levels.variances(noise, frames, rounding)
    covariance = spread.covariance(design, variance)
    transfer, gradient = spread.transform(frequency)
    modulus = np.abs(transfer)
    rotated = gradient * np.exp(-1j * np.angle(transfer))
    along, across = (np.sqrt(np.sum(part * (covariance @ part), axis=0)) for part in (rotated.real, rotated.imag))
    signal = signal_modulus(modulus, along, across)

    slope_sigma, curvature, curvature_sigma, squares = _path_errors(fitted, grey - model, variance)
    cosine = math.cos(math.atan(float(fitted.rows.slope.mean())))
    # A path that is off by e(v) blurs: 1 - mean cos(2 pi f e cosine) is a sum of k chi^2, its mean square as below.
    blurs = 0.5 * squares * (2.0 * np.pi * frequency[:, None] * cosine) ** 2
    blur = np.sqrt(blurs.sum(axis=1) ** 2 + 2.0 * np.sum(blurs**2, axis=1))
    # noise of the positions of aligned pages: an error of one sign, counted as a symmetric one of that size
    jitter = 0.5 * (2.0 * np.pi * frequency) ** 2 * fitted.jitter
    # one relative error of the contrast, except at frequency 0, where the MTF is 1
    level = np.where(frequency > 0.0, math.hypot(*rounding) / spread.contrast, 0.0)
    centre = spread.design(np.zeros(1))
    steep = float(spread.slope(centre)[0])
    shift = (spread.dark + 0.5 * spread.contrast - float(spread.value(centre)[0])) / steep
    # derivatives of the edge's height in the middle above half height by the coefficients
    lift = np.insert(centre.project(np.ones(1)), spread.spline_count, np.zeros(fitted.change.size))
    lift[-3:] -= (1.0, 0.5, 0.0)
    offset = fitted.rows.middle + shift / cosine
    if line.sign < 0:
        offset = columns - 1 - offset
    samples = math.floor(min(-design.x.min(), design.x.max()) * _SHOWN_PER_PIXEL)
    distance = np.arange(-samples, samples + 1) / _SHOWN_PER_PIXEL
    shown = spread.design(distance)
    return EdgeMtf(
        axis=line.axis,
        frequency=frequency,
        mtf=modulus,
        transfer=transfer * np.exp(2j * np.pi * frequency * shift),
        sigma_along=along,
        sigma_across=across,
        sigma=np.sqrt(
            rice_sigma(signal, along, across) ** 2 + (blur * modulus) ** 2 + (np.hypot(jitter, level) * modulus) ** 2
        ),
        noise_bias=measured_bias(modulus, across),
        angle=line.sign * math.atan(float(fitted.rows.slope.mean())),
        angle_sigma=slope_sigma * cosine**2,
        position=offset,
        position_sigma=math.sqrt(float(lift @ covariance @ lift)) / steep / cosine,
        curvature=line.sign * curvature,
        curvature_sigma=curvature_sigma,
        order=fitted.order,
        light=fitted.change,
        light_sigma=np.sqrt(np.diag(covariance)[spread.spline_count : -3]),
        structure=_structure(fitted, grey - model, variance),
        distance=distance,
        esf=spread.value(shown),
        lsf=spread.slope(shown) / spread.contrast,
        pixel_distance=design.x,
        pixel_grey=grey,
        dark=spread.dark,
        bright=spread.dark + spread.contrast,
        noise_dark=math.sqrt(dark_variance),
        noise_bright=math.sqrt(bright_variance),
        core=spread.core,
    )


def _check_single_edge(residual: Array, contrast: float, line: EdgeLine) -> None:
    rows, columns = residual.shape[0] // 4, residual.shape[1] // 4
    blocks = np.abs(residual[: 4 * rows, : 4 * columns].reshape(rows, 4, columns, 4).mean(axis=(1, 3)))
    # six sigma: by chance once in 1e6 regions of 64 x 64 px
    noise = max(pixel_noise(part) for part in (residual, residual[:, :8], residual[:, -8:]))
    limit = max(_OTHER_STRUCTURE * contrast, 6.0 * noise / 4.0)
    if blocks.max() > limit:
        along, across = (4 * int(k) + 2 for k in np.unravel_index(int(blocks.argmax()), blocks.shape))
        across = across if line.sign > 0 else residual.shape[1] - 1 - across
        row, column = (along, across) if line.axis == "x" else (across, along)
        raise EdgeError(
            f"the region contains more than one straight edge: near its row {row}, column {column} grey values differ "
            f"from such an edge by {blocks.max() / contrast:.0%} of its contrast (second edge, corner, bend, speck, "
            "uneven light); choose a region with one edge between two even areas"
        )


@dataclass(frozen=True)
class Structure:
    """Structure in the residuals of the fit: differences between the means of blocks of pixels and the fit.

    Attributes
    ----------
    rms : float
        Rms of the differences beyond the noise, grey values.
    p_value : float
        Probability of such differences by independent noise of the pixels (p-value).
    """

    rms: float
    p_value: float


def _structure(fitted: FittedEdge, residual: Array, variance: Array) -> Structure:
    """Return the structure in the residuals of independent pixels (N,) with their variances (N,).

    It is tested in the means of blocks of 8 x 8 px, of strips of 4 px along the edge, and of strips across it on either
    side.

    Dimensions: N pixels.
    """
    along = np.repeat(fitted.rows.along + fitted.rows.half, fitted.rows.columns).astype(np.intp)
    across = np.tile(np.arange(fitted.rows.columns), len(fitted.rows.along))
    x = fitted.design.x
    strip = np.floor(x / _STRIP).astype(np.intp)
    out = []
    for label in (along // _BLOCK * 10_000 + across // _BLOCK, strip - strip.min(), 2 * (along // _STRIP) + (x > 0.0)):
        label = np.unique(label, return_inverse=True)[1].ravel()
        count, total, noise = (np.bincount(label, weight) for weight in (None, residual, variance))
        p_value = float(p_value_of(float(np.sum(total**2 / noise)), len(count)))
        excess = float(np.mean((total**2 - noise) / count**2, where=count >= _STRIP**2))
        out.append(Structure(math.sqrt(max(excess, 0.0)), min(3.0 * p_value, 1.0)))
    return min(out, key=lambda structure: structure.p_value)


def _path_errors(fitted: FittedEdge, residual: Array, variance: Array) -> tuple[float, float, float, Array]:
    """Return the errors of the edge's fitted path: of its slope, of its curvature, and of its position by order.

    The result holds the sigma of the slope, the curvature (mean second derivative, 1/px) and its sigma, and the mean
    squares of the position's error. The mean squares along the rows, (order,) px^2, are those due to the errors of the
    coefficients of order 1 and up. Residuals and variances have the shape (N,).

    Dimensions: N pixels.
    """
    rows, order = fitted.rows, fitted.order
    parts, near = path_parts(fitted, max(order, 2))
    scatter, normal = (parts * variance[near]) @ parts.T, parts @ parts.T
    inverse = np.linalg.inv(normal)
    bend = float((inverse @ (parts @ residual[near]))[2]) + float(rows.bend[:1].sum())
    # the second derivative of the second Legendre polynomial is 3
    scale = 3.0 / rows.half**2
    # covariance of the fitted coefficients alone
    inverse_fitted = np.linalg.inv(normal[: order + 1, : order + 1])
    square = np.diag(inverse_fitted @ scatter[: order + 1, : order + 1] @ inverse_fitted)[1:]
    bend_sigma = math.sqrt(float((inverse @ scatter @ inverse)[2, 2]))
    blur = square * np.mean(rows.polynomials(order)[1:] ** 2, axis=1)
    return math.sqrt(square[0]) / rows.half, scale * bend, scale * bend_sigma, blur


@dataclass(frozen=True, eq=False)
class _Levels:
    """Grey values (N,) of all pixels and their fitted model, from which the noise on both sides of the edge follows.

    Dimensions: N pixels.
    """

    shape: tuple[int, ...]
    grey: Array
    model: Array
    design: EdgeDesign
    spread: EdgeSpread

    def variances(
        self, noise: NoiseModel | None, frames: int, rounding: tuple[float, float]
    ) -> tuple[Array, float, float]:
        """Return the variance of every pixel (N,), and that of a dark and of a bright pixel.

        Errors that a pixel has in all pages alike do not average down. A pixel of P pages therefore counts with P times
        the variance of its mean, as if it had fallen on the same position of the edge in all of them, which is so where
        pages hardly move; where they do move, sigma is rather too large.

        Dimensions: N pixels.
        """
        count, spread = self.shape[0], self.spread
        ends = np.array([spread.dark, spread.dark + spread.contrast])
        if noise is not None:
            dark, bright = (noise.temporal_variance_dn2(ends, frames * count) + noise.fixed_variance_dn2(ends)) * count
            variance = noise.temporal_variance_dn2(self.model, frames * count) + noise.fixed_variance_dn2(self.model)
            return variance * count, float(dark), float(bright)
        # two levels and a tail are fitted outside of the core, so that each side loses 1.5 degrees of freedom
        square = np.mean((self.grey - self.model).reshape(count, -1), axis=0) ** 2
        x, levels = self.design.x.reshape(count, -1), self.model.reshape(count, -1)
        sides = np.all(x < -spread.core, axis=0), np.all(x > spread.core, axis=0)
        dark, bright = (
            max(float(square[side].sum()) / max(np.count_nonzero(side) - 1.5, 1.0), least**2) * count
            for side, least in zip(sides, rounding, strict=True)
        )
        # the tails of diffraction lie between the levels
        low, high = (float(levels[:, side].mean()) for side in sides)
        slope = (bright - dark) / (high - low)
        floor = 0.1 * min(dark, bright)
        variance = np.maximum(dark + slope * (self.model - low), floor)
        dark, bright = (max(dark + slope * (level - low), floor) for level in ends)
        return variance, float(dark), float(bright)


@dataclass(frozen=True, eq=False)
class PagePositions:
    """Position of the edge in each of P pages, frames of one image.

    Attributes
    ----------
    position, position_sigma : (P,) ndarray
        Position in the region's middle, px, as `EdgeMtf.position`; sigma due to the noise that is new in each page.
    angle, angle_sigma : (P,) ndarray
        Angle, rad, as `EdgeMtf.angle`; all equal where pages do not rotate.
    chi_square, degrees_of_freedom : float, int
        Test of positions and angles of all pages being the same.
    aligned : bool
        True if they are not the same, so that the pages were aligned before they were measured together.
    same : int
        Number of pages that are identical copies of another one and do not count.
    noise : tuple of float
        Rms noise of one pixel in one page on the dark and on the bright side, grey values.
    rounded : tuple of float
        Rms of the rounding error that remains in these levels, however many pixels and pages there are, grey values.
    """

    position: Array
    position_sigma: Array
    angle: Array
    angle_sigma: Array
    chi_square: float
    degrees_of_freedom: int
    aligned: bool
    same: int
    noise: tuple[float, float]
    rounded: tuple[float, float]

    @property
    def drift(self) -> float:
        """Rms of the edge's positions in the pages about their mean, px."""
        return float(np.std(self.position))


@dataclass(frozen=True, eq=False)
class EdgeMtf:
    """MTF along the normal of one edge.

    Dimensions: F frequencies, S samples, N pixels.

    Attributes
    ----------
    axis : {"x", "y"}
        "x" for a near-vertical edge (MTF along rows), "y" for a near-horizontal one (MTF along columns).
    frequency : (F,) ndarray
        Frequency along the normal, cycles/pixel.
    mtf : (F,) ndarray
        Modulus of the transfer function, 1 at frequency 0, not corrected for `noise_bias`.
    transfer : (F,) ndarray of complex
        Transfer function, phase counted from the edge's position.
    sigma_along, sigma_across : (F,) ndarray
        Standard deviation of `transfer` along itself, and perpendicular to that.
    sigma : (F,) ndarray
        Standard deviation of `mtf` from noise, including the uncertainty of the angle.
    noise_bias : (F,) ndarray
        Mean amount by which noise lengthens `mtf`, >= 0, from the measured mtf (`statistics.measured_bias`). Its mean
        over repeats is right to 0.03 sigma_across where the true MTF is three of them, to 0.09 down to 0.6, and too
        small where there is hardly a signal, by up to half of one.
    angle, angle_sigma : float
        Angle to the grid, rad: column (row) = position + tan(angle) (row (column) - middle).
    position, position_sigma : float
        Column (axis "x") or row (axis "y") of the edge's half height in the region's middle, px.
    curvature, curvature_sigma : float
        Mean second derivative of the edge's column (row) by its row (column), 1/px.
    order : int
        Order of the polynomial of the edge's path, 1 where it is straight within the noise.
    light, light_sigma : (4,) ndarray
        Change of the bright level over the region's length along the edge and over its width from the dark side to the
        bright, and the same of the dark level, grey values; (0,) where light was taken as even.
    structure : Structure
        Structure that the fit leaves in the region.
    distance, esf, lsf : (S,) ndarray
        Distance along the normal from the dark side to the bright, px, 16 to a pixel, as far as there are pixels on
        both sides; edge-spread function, grey values; line-spread function, 1/px, integral 1.
    pixel_distance, pixel_grey : (N,) ndarray
        Projected distance, px, and grey value of all pixels, as used.
    dark, bright : float
        Grey values far from the edge, tails accounted for.
    noise_dark, noise_bright : float
        Rms noise of one pixel there, grey values.
    core : float
        Half width of the spline, px; beyond it the edge-spread function is level + tail / x.
    pages : PagePositions or None
        Positions in the frames, if several were measured by `edge_pages.measure_pages`.
    """

    axis: Axis
    frequency: Array
    mtf: Array
    transfer: NDArray[np.complex128]
    sigma_along: Array
    sigma_across: Array
    sigma: Array
    noise_bias: Array
    angle: float
    angle_sigma: float
    position: float
    position_sigma: float
    curvature: float
    curvature_sigma: float
    distance: Array
    esf: Array
    lsf: Array
    pixel_distance: Array
    pixel_grey: Array
    dark: float
    bright: float
    noise_dark: float
    noise_bright: float
    core: float
    order: int
    light: Array
    light_sigma: Array
    structure: Structure
    pages: PagePositions | None = None

    @property
    def doubt(self) -> str:
        """Warning that sigma does not cover an error of the MTF; empty if the region shows no structure.

        Noise-free images of diffraction at an F/9 pupil leave a structure of 2.5e-5 of the contrast.
        """
        share = self.structure.rms / (self.bright - self.dark)
        if self.structure.p_value >= FALSE_ALARM or share < _LEAST_STRUCTURE:
            return ""
        form = "curved" if self.order > 1 else "straight"
        return (
            f"the region contains structure of {share:.2g} of the contrast (rms of means over blocks and strips, p ="
            f" {self.structure.p_value:.1g}) that a {form} edge between two planes does not explain:"
            " uneven light, a rough edge, specks, or noise correlated between pixels. sigma does not"
            " include its effect on the MTF: use even light or a smaller region"
        )

    @checked
    def at(self, frequency: float) -> tuple[float, float]:
        """Return the MTF and its sigma at one frequency along the edge's normal, cycles/pixel, by cubic interpolation.

        Raises
        ------
        ValueError
            The frequency is outside of the measured ones.
        """
        if not self.frequency[0] <= frequency <= self.frequency[-1]:
            raise ValueError(
                f"frequency {frequency} lies outside of {self.frequency[0]:g} to {self.frequency[-1]:g} cycles/pixel"
            )
        value = CubicSpline(self.frequency, self.mtf)(frequency)
        return float(value), float(np.interp(frequency, self.frequency, self.sigma))

    @checked
    def frequency_at(self, value: float) -> tuple[float, float]:
        """Return the lowest frequency at which the MTF falls below a value, and its sigma, both in cycles/pixel.

        Both are NaN if there is none, as for a value above 1.

        Raises
        ------
        ValueError
            The value is NaN or infinite.
        """
        value = float(finite("value", value, "an MTF such as 0.5"))
        below = np.flatnonzero((self.mtf[1:] < value) & (self.mtf[:-1] >= value))
        if below.size == 0:
            return math.nan, math.nan
        curve = CubicSpline(self.frequency, self.mtf)
        low, high = self.frequency[below[0]], self.frequency[below[0] + 1]
        roots = curve.solve(value, extrapolate=False)
        root = float(roots[(roots >= low) & (roots <= high)][0])
        return root, float(np.interp(root, self.frequency, self.sigma) / abs(curve(root, 1)))
