"""Rational polynomials of an image (RPC): line and sample as ratios of cubics in latitude, longitude and height.

The coefficients are in the order of RPC00B (NIMA STDI-0002), which all photogrammetric software reads. Coordinates are
scaled to -1 .. 1 over the ground that the fit covers; the polynomials must not be used beyond it. Image coordinates
count from the centre of the first pixel, and heights are above the ellipsoid (WGS84).

Reference: Tao and Hu, Photogramm. Eng. Remote Sens. 67, 1347 (2001).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from analysis.arrays import Array, UndeterminedError
from optics.numerics.backend import one_blas_thread

TERMS = 20
_POWERS = np.array(
    [
        *((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2)),
        *((1, 1, 1), (3, 0, 0), (1, 2, 0), (1, 0, 2), (2, 1, 0), (0, 3, 0), (0, 1, 2), (2, 0, 1), (0, 2, 1), (0, 0, 3)),
    ]
)
"""Powers of longitude, latitude and height in the order of RPC00B."""
_ROUNDS = 6
_RANK = 1e-11
"""Smallest singular value that counts, relative to the largest. A cubic ratio has more coefficients than an image has
shape, and the rest stay small."""
_DAMPING = (0.0, 1e-8, 1e-6, 1e-4, 1e-2, 1.0)
"""Damping of the denominators that is tried; the last leaves polynomials."""


_STEP = 1e-6
_ARRIVED = 1e-9
_MOST_STEPS = 30
"""Of the ground's size: of a derivative, of the last step to the ground; and how many."""
_COEFFICIENTS = 50844
_UNSTATED = -1.0
"""Of an error, metres."""
_WIDEST = 90.0
"""Degrees of longitude."""


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


def fit_rpc(
    image: ArrayLike, ground: ArrayLike, *, check: tuple[ArrayLike, ArrayLike] | None = None
) -> RationalPolynomial:
    """Fit rational polynomials to places of an image and of the ground.

    Both denominators are fitted. Of several strengths of regularisation, the one with the smallest error at the check
    places is chosen.

    Parameters
    ----------
    image : (N, 2) array_like
        Line and sample, in pixels; the centre of the first pixel is (0, 0).
    ground : (N, 3) array_like
        Latitude and longitude (degrees) and height above the ellipsoid (metres) that these places see. They must cover
        several heights.
    check : tuple of (M, 2) and (M, 3) array_like, optional
        Image and ground of places between the others that are not fitted. By default every fourth place is held out.

    Returns
    -------
    RationalPolynomial
        The polynomials; `error_px` and `rms_px` are their largest and their rms error at the check places.

    Raises
    ------
    ValueError
        Arrays of other shapes, values that are not finite, a coordinate that is constant, fewer than 39 places to fit,
        or ground on a pole or the 180th meridian.

    Examples
    --------
    A frame camera above 48 deg north, 11 deg east, whose perspective images are ratios of polynomials:

    >>> import numpy as np
    >>> import analysis
    >>> rng = np.random.default_rng(8)
    >>> ground = rng.uniform([47.9, 10.9, 0.0], [48.1, 11.1, 2000.0], (400, 3))  # latitude, longitude, height
    >>> north, east = 111e3 * (ground[:, 0] - 48), 74e3 * (ground[:, 1] - 11)
    >>> image = 5000 + 5e5 * np.column_stack([-north, east]) / (600e3 - ground[:, 2])[:, None]
    >>> rpc = analysis.fit_rpc(image, ground)
    >>> max(rpc.error_px) < 1e-6
    True
    >>> line, sample = rpc.image([48.0], [11.0], [500.0])
    >>> np.round(line, 3), np.round(sample, 3)
    (array([5000.]), array([5000.]))
    >>> latitude, longitude = rpc.ground(line, sample, [500.0])
    >>> np.round(latitude, 6), np.round(longitude, 6)
    (array([48.]), array([11.]))
    >>> print(rpc.text()[:9])
    LINE_OFF:
    """
    places = _places_of(image, ground)
    if check is None:
        held = np.arange(len(places)) % 4 == 3
        places, others = places[~held], places[held]
    else:
        others = _places_of(*check)
    ends = np.stack([np.min(places, axis=0), np.max(places, axis=0)])
    if ends[1, 3] - ends[0, 3] > _WIDEST:
        raise ValueError("the ground lies on the 180th meridian or a pole, where longitudes jump")
    offset, scale = np.mean(ends, axis=0), 0.5 * (ends[1] - ends[0])
    if len(places) < 2 * TERMS - 1 or not len(others):
        raise UndeterminedError(
            f"rational polynomials: {len(places)} places to fit and {len(others)} to check; need at least"
            f" {2 * TERMS - 1} and 1"
        )
    if not np.all(scale > 0.0):
        constant = ("line", "sample", "latitude", "longitude", "height")[int(np.argmin(scale))]
        raise UndeterminedError(
            f"rational polynomials: {constant} is constant; spread the places over every coordinate"
        )
    sides = [(_monomials((seen[:, 2:] - offset[2:]) / scale[2:]), seen) for seen in (places, others)]
    best = [_best(sides, k, offset[k], scale[k]) for k in range(2)]
    (line, line_most, line_rms), (sample, sample_most, sample_rms) = best
    return RationalPolynomial(offset, scale, *line, *sample, (line_most, sample_most), (line_rms, sample_rms))


def _places_of(image: ArrayLike, ground: ArrayLike) -> Array:
    """Return image and ground side by side, (N, 5), checked."""
    left, right = np.asarray(image, np.float64), np.asarray(ground, np.float64)
    if left.ndim != 2 or left.shape[1] != 2 or right.shape != (len(left), 3):
        raise ValueError(
            f"rational polynomials: need image (N, 2) and ground (N, 3), found {left.shape}, {right.shape}"
        )
    both = np.concatenate([left, right], axis=1)
    if not np.all(np.isfinite(both)):
        raise ValueError("rational polynomials: places must be finite; leave out those that see no ground")
    return both


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
    if not found:
        raise UndeterminedError("rational polynomials: every fit has a pole on the ground; use more places")
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
