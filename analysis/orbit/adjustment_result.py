"""Solution of a three-line in-orbit calibration: values, covariance, what closed it, how it fits."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from analysis.orbit.calibration_parameters import CalibrationField, index
from analysis.orbit.hidden_terms import Courses, HiddenTerms, Rates, Unseen
from analysis.orbit.null_space import Combination, Gauge
from analysis.orbit.three_line_model import DRIFT, LineModel

__all__ = ["Adjustment"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Solution of a calibration.

    Attributes:
        names: of the unknowns. values: (P,) metres and radians. covariance: (P, P) from the sigmas as given times
            `factors`, and of the start values where these close what is open. Held unknowns count as exact: zero rows.
        gauge: what was fixed. open: combinations that the gauge closed. weak: combinations of low strength that were
            solved for all the same.
        from_start: (P,) share of each variance that comes from the start values and not from the points, 0 to 1.
        follow: (P, H) change of the values with the start values of the H held unknowns.
        cameras: with the adjusted interior, in the reference state.
        ground: field -> (m, 3) adjusted points; NaN for those that robust weights gave up. ground_covariance:
            field -> (m, 3, 3), likewise.
        residual: field -> line -> (n, 2) standardised residuals of image points. weight: field -> line -> (n,) robust.
        chi_square, degrees_of_freedom: weighted, points left out do not count.
        factors: variance group -> estimated factor (1 where not estimated). redundancy: of each group. Noise that image
            points share is a group of its own.
        iterations: Gauss-Newton steps in all.
        fields: that were adjusted.
        unseen: what the residuals say of terms that are left out.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array
    gauge: Gauge
    open: tuple[Combination, ...]
    weak: tuple[Combination, ...]
    from_start: Array
    follow: Array
    cameras: Mapping[str, LineModel]
    ground: Mapping[str, Array]
    ground_covariance: Mapping[str, Array]
    residual: Mapping[str, Mapping[str, Array]]
    weight: Mapping[str, Mapping[str, Array]]
    chi_square: float
    degrees_of_freedom: int
    factors: Mapping[str, float]
    redundancy: Mapping[str, float]
    iterations: int
    fields: Sequence[CalibrationField] = field(repr=False)
    unseen: Callable[[HiddenTerms], Unseen] = field(repr=False)

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviation of each unknown; 0 where held."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @cached_property
    def rates(self) -> Unseen | None:
        """What the residuals say of a drift of the attitude during each field; None where a rate is an unknown."""
        return None if any(n.endswith("rate") for n in self.names) else self.unseen(Rates.of(self.fields))

    @cached_property
    def courses(self) -> Unseen:
        """What they say of errors that change slowly along the lines."""
        return self.unseen(Courses.of(self.fields))

    def sigma_with(self, start: Mapping[str, float]) -> dict[str, float]:
        """Standard deviation of each unknown where held unknowns are not exact: name -> sigma of its start value.

        Raises CalibrationError for a name that is not held.
        """
        given = np.zeros(len(self.gauge.held))
        for name, sigma in start.items():
            given[index(self.gauge.held, name)] = sigma
        hidden = np.sum((self.follow * given) ** 2, axis=1)
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance) + hidden).tolist(), strict=True))

    @property
    def correlation(self) -> Array:
        """(P, P); rows of held unknowns are NaN."""
        sigma = np.sqrt(np.diag(self.covariance))
        with np.errstate(invalid="ignore"):
            return np.asarray(self.covariance / sigma / sigma[:, None])

    @property
    def p_value(self) -> float:
        """Chance of such a chi-square or a larger one, if the sigmas are right and no robust weights are on."""
        return float(chi2.sf(self.chi_square, self.degrees_of_freedom))

    def value(self, name: str) -> float:
        """One unknown. Raises CalibrationError when there is none of that name."""
        return float(self.values[index(self.names, name)])

    def bias(self, field: str) -> Array:
        """(3,) roll, pitch, yaw of a field, radians; zero where not solved for."""
        found = [n if n in self.names else f"{field} {n}" for n in ("roll", "pitch", "yaw")]
        return np.array([self.value(n) if n in self.names else 0.0 for n in found])

    def cameras_of(self, field: str) -> dict[str, LineModel]:
        """Cameras in their state during one field: adjusted interior and, where solved for, drift."""
        found = {}
        for line, camera in self.cameras.items():
            names = [f"{field} {line} {n}" for n in DRIFT]
            drift = names[0] in self.names
            found[line] = camera.drifted([self.value(n) for n in names]) if drift else camera
        return found
