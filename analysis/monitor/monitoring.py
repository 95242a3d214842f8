"""From spot shifts to camera parameters: the formulas of paper 001 (Wang et al., Acta Photonica Sinica 47(10) 1012001,
2018).

Axes: the column direction of an area CCD is the paper's x (flight direction), the row direction its y (along the line
CCD). Sides: index 0 = left CCD (at the +Y end of the line, index 1 of the paper), 1 = right CCD (index 2 of the
paper). A shift is after - before; the paper's X_L = x01 - x11 and Y_L = y01 - y11 are before - after.
Vector of pixel coordinates: [left row, left column, right row, right column]. Vector of parameters: [d_alpha, d_beta,
d_gamma (rad), d_f (m)].

Three sets of formulas, which differ only where the paper does:

- `paper_single`: eq. (2), (3), (5), (7) as printed, with the arctangent.
- `paper_joint`: Table 1, "expression of uncertain changes", as printed. The table does not say how Y_L is signed, and
  uses it in both d_beta and d_f; each row here takes the sign that agrees with the single-change formula beside it:
  Y_L = y01 - y11 for d_beta, Y_L = y11 - y01 for d_f. Its d_f is then +1/2 of eq. (7), and its d_gamma equals eq. (5).
- `derived`: what a plane-mirror return gives to first order. A shift s of the focal plane moves the spot by 2 s
  against it, so d_alpha and d_beta are shift/(2f) without the cos^2 (which is a field-angle factor of the line of
  sight, not of the spot); d_gamma = (X_L - X_R) delta / (2 L), half of the printed (5); d_f by (7). A field-biased
  camera adds three calibrated numbers: its plate scale across the line f_x (d_alpha divides by it, d_gamma carries
  f/f_x) and the gradients of principal distance and of line tilt over the field, which enter d_f by d_alpha and
  d_gamma by d_beta. With f_x = f and no gradients the formulas are those of a distortion-free camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from analysis.arrays import Array, OfStates, shows
from analysis.units import ARCSEC, UM_PER_M

FORMULAS = ("paper_single", "paper_joint", "derived")
PARAMETERS = ("d_alpha_arcsec", "d_beta_arcsec", "d_gamma_arcsec", "d_f_um")
"""Keys of the parameters in results, which end in their unit."""
PER_SI = np.array([1 / ARCSEC, 1 / ARCSEC, 1 / ARCSEC, UM_PER_M])
"""How many of these units make one SI unit (rad, m)."""


@shows("principal_distance_m [m]", "separation_m [mm]", "pitch_m [um]", "field_alpha_rad [deg]", "field_beta_rad [deg]")
@dataclass(frozen=True)
class MonitorGeometry:
    """What the formulas need to know of one camera's monitor. Raises ValueError, naming the field.

    principal_distance_m: f, m. separation_m: L, distance of the two area CCDs, m. pitch_m: delta, m.
    field_alpha_rad, field_beta_rad: alpha and beta in the cos^2 of (2), (3) and Table 1, rad.
    principal_distance_across_m: plate scale across the line, m, where calibration finds it different from f
        (anamorphism); default principal_distance_m. Only `derived` uses it.
    d_f_per_alpha_m: change of the principal distance per rad of d_alpha, m, from the calibrated distortion: turning
        the line of sight brings the line to a field where the plate scale differs. Only `derived` uses it.
    d_gamma_per_beta: likewise the turn of the imaged line per rad of d_beta. Only `derived` uses it.
    """

    principal_distance_m: float
    separation_m: float
    pitch_m: float
    field_alpha_rad: float = 0.0
    field_beta_rad: float = 0.0
    principal_distance_across_m: float | None = None
    d_f_per_alpha_m: float = 0.0
    d_gamma_per_beta: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None:
                continue
            angle = field.name.endswith("_rad")
            if "_per_" in field.name:
                if not math.isfinite(value):
                    raise ValueError(f"monitor geometry: {field.name} must be finite, found {value!r}")
                continue
            if not math.isfinite(value) or (abs(value) >= math.pi / 2 if angle else value <= 0):
                allowed = "within +-pi/2" if angle else "finite and > 0"
                raise ValueError(f"monitor geometry: {field.name} must be {allowed}, found {value!r}")


@shows("d_alpha_rad [arcsec]", "d_beta_rad [arcsec]", "d_gamma_rad [arcsec]", "d_f_m [um]")
@dataclass(frozen=True, eq=False)
class CameraParameters(OfStates):
    """Changes of one camera, scalars or arrays of one shape (...).

    d_alpha_rad, d_beta_rad, d_gamma_rad: rotations of the camera about Y, X, Z. d_f_m: change of the principal
        distance.
    covariance: (..., 4, 4) in order d_alpha, d_beta, d_gamma (rad), d_f (m): of the noise of the images.
    total: likewise, of the noise and of what the estimator makes wrong of stated disturbances; None where none are
        stated.
    """

    d_alpha_rad: Array
    d_beta_rad: Array
    d_gamma_rad: Array
    d_f_m: Array
    covariance: Array
    total: Array | None = None

    @classmethod
    def from_vector(cls, values: ArrayLike, covariance: ArrayLike, total: ArrayLike | None = None) -> CameraParameters:
        """From plain arrays.

        Args:
            values: (..., 4) d_alpha, d_beta, d_gamma (rad), d_f (m).
            covariance: (..., 4, 4) of the noise.
            total: (..., 4, 4) of noise and misfit; None where no disturbances are stated.
        """
        vector, spread = np.asarray(values, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
        if vector.shape[-1:] != (4,) or spread.shape[-2:] != (4, 4):
            raise ValueError(f"camera parameters: need (..., 4) and (..., 4, 4), found {vector.shape}, {spread.shape}")
        spread = np.broadcast_to(spread, (*vector.shape, 4))
        whole = None if total is None else np.broadcast_to(np.asarray(total, np.float64), spread.shape)
        return cls(vector[..., 0], vector[..., 1], vector[..., 2], vector[..., 3], spread, whole)

    @property
    def vector(self) -> Array:
        """(..., 4): [d_alpha, d_beta, d_gamma (rad), d_f (m)]."""
        return np.stack([self.d_alpha_rad, self.d_beta_rad, self.d_gamma_rad, self.d_f_m], axis=-1)

    @property
    def error_covariance(self) -> Array:
        """(..., 4, 4): the total one; where no disturbances are stated, that of the noise."""
        return self.covariance if self.total is None else self.total

    @property
    def sigma(self) -> Array:
        """(..., 4): standard deviations of the error, in the order and units of `vector`; see `error_covariance`."""
        return np.sqrt(np.diagonal(self.error_covariance, axis1=-2, axis2=-1))

    @property
    def sigma_noise(self) -> Array:
        """(..., 4): standard deviations by the noise of the images alone."""
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))

    def to_dict(self) -> dict[str, Any]:
        """d_alpha_arcsec, d_beta_arcsec, d_gamma_arcsec, d_f_um, <key>_sigma and <key>_sigma_noise: floats, or nested
        lists for arrays.
        """
        values, sigma, noise = self.vector, self.sigma, self.sigma_noise
        out: dict[str, Any] = {}
        for k, (key, scale) in enumerate(zip(PARAMETERS, PER_SI, strict=True)):
            out[key] = (values[..., k] * scale).tolist()
            out[f"{key}_sigma"] = (sigma[..., k] * scale).tolist()
            out[f"{key}_sigma_noise"] = (noise[..., k] * scale).tolist()
        return out


def coefficients(name: str, geometry: MonitorGeometry) -> Array:
    """(4, 4) matrix, parameter [d_alpha, d_beta, d_gamma, d_f] (rad, m) per pixel of shift [left row, left column,
    right row, right column], after - before, of an estimator in FORMULAS. For `paper_single` it is the argument of
    the arctangents.

    Multiplied with the Jacobian (4, M) of spot shifts per motion it gives a crosstalk table.
    """
    if name not in FORMULAS:
        raise ValueError(f"monitoring: no estimator {name!r}; there are {', '.join(FORMULAS)}")
    delta, f, length = geometry.pitch_m, geometry.principal_distance_m, geometry.separation_m
    paper = name != "derived"
    f_x = f if paper or geometry.principal_distance_across_m is None else geometry.principal_distance_across_m
    beta = delta * (math.cos(geometry.field_beta_rad) ** 2 if paper else 1.0) / (2 * f) / 2
    alpha = delta * (math.cos(geometry.field_alpha_rad) ** 2 if paper else 1.0) / (2 * f_x) / 2
    gamma = delta / length if paper else delta / (2 * length) * f / f_x
    scale = delta * f / (length * {"paper_single": 2, "paper_joint": 4, "derived": 2}[name])
    matrix = np.array(
        [[0.0, -alpha, 0.0, -alpha], [-beta, 0.0, -beta, 0.0], [0.0, -gamma, 0.0, gamma], [scale, 0.0, -scale, 0.0]]
    )
    if not paper:
        matrix[2] += geometry.d_gamma_per_beta * matrix[1]
        matrix[3] += geometry.d_f_per_alpha_m * matrix[0]
    return matrix


def paper_single(
    before: ArrayLike, after: ArrayLike, covariance: ArrayLike, geometry: MonitorGeometry
) -> CameraParameters:
    """Eq. (2), (3), (5), (7) of paper 001 as printed, with the arctangent.

    Args:
        before: (..., 2 channels, 2) spot positions (row, column) of the nominal state, px.
        after: of the changed state, likewise.
        covariance: (..., 4, 4) of after - before, px^2, in order [left row, left column, right row, right column];
            zeros where there is no noise.
        geometry: of the camera.
    """
    argument, spread = linear(coefficients("paper_single", geometry), before, after, covariance)
    values = argument.copy()
    values[..., :3] = np.arctan(argument[..., :3])
    slope = np.ones_like(argument)
    slope[..., :3] = 1 / (1 + argument[..., :3] ** 2)
    return CameraParameters.from_vector(values, slope[..., :, None] * spread * slope[..., None, :])


def paper_joint(
    before: ArrayLike, after: ArrayLike, covariance: ArrayLike, geometry: MonitorGeometry
) -> CameraParameters:
    """Table 1 of paper 001, last column, as printed; arguments as `paper_single`, sign of Y_L: see the module.

    Args:
        before: spot positions of the nominal state, (..., 2 channels, 2), row and column, px.
        after: of the changed state, likewise.
        covariance: of after - before, (..., 4, 4), px^2, in the order left row, left column, right row, right column;
            zeros where there is no noise.
        geometry: of the camera.
    """
    return CameraParameters.from_vector(*linear(coefficients("paper_joint", geometry), before, after, covariance))


def derived(before: ArrayLike, after: ArrayLike, covariance: ArrayLike, geometry: MonitorGeometry) -> CameraParameters:
    """The corrected factors (see the module's text); arguments as `paper_single`.

    Args:
        before: spot positions of the nominal state, (..., 2 channels, 2), row and column, px.
        after: of the changed state, likewise.
        covariance: of after - before, (..., 4, 4), px^2, in the order left row, left column, right row, right column;
            zeros where there is no noise.
        geometry: of the camera.
    """
    return CameraParameters.from_vector(*linear(coefficients("derived", geometry), before, after, covariance))


def linear(matrix: Array, before: ArrayLike, after: ArrayLike, covariance: ArrayLike) -> tuple[Array, Array]:
    """What a matrix (4, 4) as of `coefficients` makes of the shifts, (..., 4), and its covariance (..., 4, 4); the
    other arguments as `paper_single`.

    Args:
        matrix: as of `coefficients`, (4, 4).
        before: spot positions of the nominal state, (..., 2 channels, 2), row and column, px.
        after: of the changed state, likewise.
        covariance: of after - before, (..., 4, 4), px^2, in the order left row, left column, right row, right column;
            zeros where there is no noise.
    """
    start, end = np.asarray(before, dtype=np.float64), np.asarray(after, dtype=np.float64)
    spread = np.asarray(covariance, dtype=np.float64)
    if start.shape[-2:] != (2, 2) or end.shape[-2:] != (2, 2) or spread.shape[-2:] != (4, 4):
        raise ValueError(
            "monitoring: before and after must be (..., 2 channels, 2 (row, column)) and covariance (..., 4, 4),"
            f" found {start.shape}, {end.shape}, {spread.shape}"
        )
    shift = end - start
    shift = shift.reshape(*shift.shape[:-2], 4)
    if not (np.all(np.isfinite(shift)) and np.all(np.isfinite(spread))):
        raise ValueError("monitoring: positions and covariance must be finite")
    return shift @ matrix.T, matrix @ spread @ matrix.T
