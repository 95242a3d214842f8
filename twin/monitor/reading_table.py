"""Table of the changes that every estimator reports in each state: value, standard deviations and true change.

A change as reported by an estimator is called its reading. The table is made once for a state or a time series; JSON
files, the terminal, reports, CSV tables, scripts, studies and the live page present parts of it. The parameters are
declared in `analysis.monitor.parameters`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor import parameters
from analysis.monitor.disturbances import Disturbances
from analysis.monitor.estimators import ESTIMATORS
from analysis.monitor.limits import unchanged_quantities
from analysis.monitor.monitor_formulas import GroundGeometry
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP, CameraCalibration, Parameter
from analysis.monitor.recovery import Estimates, Recovery
from twin.framework.artefact import FAR, SAME, decimals_for, fixed
from twin.monitor.truth import Truth


@dataclass(frozen=True, eq=False)
class Reading:
    """One change as estimated by one estimator: a row of the table, in the unit of the parameter.

    Numbers are arrays over S states, (S,), or floats of one state. For a whole time series they are root mean squares.

    Attributes
    ----------
    group : str
        Name of the camera; ``intersection_angle`` or ``ground`` for quantities of two cameras together.
    parameter : Parameter
        Parameter that changes.
    estimator : str
        Name of the estimator.
    true : float or (S,) ndarray
        True change from the exact trace; NaN for a real measurement, whose true change is unknown.
    value : float or (S,) ndarray
        Estimated change.
    error : float or (S,) ndarray
        Value minus true change.
    sigma : float or (S,) ndarray
        Total standard deviation of the error.
    noise : float or (S,) ndarray
        Standard deviation due to the noise of the images alone.
    """

    group: str
    parameter: Parameter
    estimator: str
    true: Any
    value: Any
    error: Any
    sigma: Any
    noise: Any

    @property
    def camera(self) -> str:
        """Name of the camera that changes; empty for quantities of two cameras together."""
        return "" if self.group in (ANGLE_GROUP, GROUND_GROUP) else self.group

    @property
    def where(self) -> str:
        """Name of the camera; ``both`` for the angle between two cameras, ``ground`` for errors on the ground."""
        return {ANGLE_GROUP: "both"}.get(self.group, self.group)

    @property
    def name(self) -> str:
        """Name of the change in sentences, such as ``Δα of forward``."""
        if self.group == GROUND_GROUP:
            return f"{self.parameter.symbol} on the ground"
        return f"{self.parameter.symbol} of {self.camera}" if self.camera else self.parameter.symbol

    @property
    def ratio(self) -> float:
        """Error divided by its standard deviation; NaN for a missing estimate.

        With a standard deviation of zero it is infinite, unless the error is only rounding.
        """
        if self.sigma > 0.0 or math.isnan(self.sigma):
            return float(self.error / self.sigma)
        return 0.0 if abs(self.error) < SAME else math.copysign(math.inf, self.error)

    @property
    def size(self) -> float:
        """Estimated change divided by its standard deviation."""
        return float(self.value / self.sigma) if self.sigma > 0.0 else 0.0

    @property
    def far(self) -> bool:
        """True if the error, in standard deviations, exceeds the limit above which reports mark it."""
        return abs(self.ratio) > FAR

    def shown(self, value: float, sign: bool = False) -> str:
        """Format a number of this estimate with the digits that its standard deviation justifies.

        Parameters
        ----------
        value : float
            Number in the parameter's unit.
        sign : bool
            True to write a plus sign.
        """
        return fixed(value, decimals_for(self.sigma), sign)

    @property
    def read(self) -> str:
        """Text of the estimated change with its standard deviation and unit."""
        return f"{self.shown(self.value)} ± {self.shown(self.sigma)} {self.parameter.unit}"

    def group_in(self, nested: dict[str, Any]) -> dict[str, Any]:
        """Return the part of nested results that this estimate belongs to; it is added if missing.

        Parameters
        ----------
        nested : dict
            Results by group: ``cameras``, ``intersection_angle`` and ``ground``, each by estimator.
        """
        return nested["cameras"].setdefault(self.camera, {}) if self.camera else nested.setdefault(self.group, {})

    def each(self, of: Callable[[Any], Any]) -> Reading:
        """Return a copy with a function applied to each of its numbers (true change, value, error, sigmas).

        Parameters
        ----------
        of : callable
            Function of a number's array over the states.
        """
        numbers = of(self.true), of(self.value), of(self.error), of(self.sigma), of(self.noise)
        return Reading(self.group, self.parameter, self.estimator, *numbers)


@dataclass(frozen=True, eq=False)
class ReadingTable:
    """Table of the changes that all estimators report in S states.

    Attributes
    ----------
    rows : tuple of Reading
        One row for each change and estimator, ordered by group, change and estimator.
    ground_residuals : mapping
        Estimator -> ground errors, (S,), that remain after a correction with its estimates, RMS over the line. In files
        they are further keys of the group ``ground``.
    """

    rows: tuple[Reading, ...]
    ground_residuals: Mapping[str, Mapping[str, Any]]

    def __iter__(self) -> Iterator[Reading]:
        """Iterate over the rows of the table, one for each change and estimator."""
        return iter(self.rows)

    def at(self, state: int) -> ReadingTable:
        """Return the table of one state, whose numbers are floats.

        Parameters
        ----------
        state : int
            Number of the state.
        """
        residuals = {
            e: {key: float(value[state]) for key, value in errors.items()}
            for e, errors in self.ground_residuals.items()
        }
        return ReadingTable(tuple(row.each(lambda number: float(number[state])) for row in self.rows), residuals)

    @property
    def rms(self) -> ReadingTable:
        """Table of root mean squares over the states, for the cameras' changes and the angle between two cameras."""
        rows = (row.each(lambda number: float(np.sqrt(np.mean(np.square(number))))) for row in self.rows)
        return ReadingTable(tuple(row for row in rows if row.group != GROUND_GROUP), {})

    def of(self, estimator: str) -> tuple[Reading, ...]:
        """Return the rows of the table that belong to one estimator.

        Parameters
        ----------
        estimator : str
            Name of the estimator.
        """
        return tuple(row for row in self.rows if row.estimator == estimator and not np.all(np.isnan(row.sigma)))

    def by_change(self) -> list[list[Reading]]:
        """Return for each change the rows of all estimators that report it."""
        out: dict[tuple[str, str], list[Reading]] = {}
        for row in self.rows:
            out.setdefault((row.group, row.parameter.key), []).append(row)
        return list(out.values())

    def row(self, group: str, key: str, estimator: str) -> Reading:
        """Return the row of one change by one estimator.

        Parameters
        ----------
        group : str
            Camera, ``intersection_angle`` or ``ground``.
        key : str
            Name of the change in files, such as ``d_f_um``.
        estimator : str
            Name of the estimator.
        """
        wanted = (group, key, estimator)
        return next(row for row in self.rows if (row.group, row.parameter.key, row.estimator) == wanted)

    def groups(self, truth: str = "") -> dict[str, Any]:
        """Return the table as nested plain data for JSON files.

        The groups are ``cameras`` by name, ``intersection_angle`` and ``ground``, each by estimator.

        Parameters
        ----------
        truth : str
            Key of the true changes beside the estimators; empty to omit them.
        """
        out: dict[str, Any] = {"cameras": {}}
        for row in self.rows:
            key, group = row.parameter.key, row.group_in(out)
            if truth:
                group.setdefault(truth, {}).setdefault(key, plain(row.true))
            read = group.setdefault(row.estimator, {})
            read[key] = plain(row.value)
            read[f"{key}_sigma"], read[f"{key}_sigma_noise"] = plain(row.sigma), plain(row.noise)
        for estimator, residuals in self.ground_residuals.items():
            out[GROUND_GROUP][estimator] |= {key: plain(value) for key, value in residuals.items()}
        return out

    def true(self) -> dict[str, Any]:
        """Return the true changes as plain data, nested by group as in JSON files."""
        out: dict[str, Any] = {"cameras": {}}
        for row in self.rows:
            group = row.group_in(out)
            if row.parameter.key not in group:
                group[row.parameter.key] = plain(row.true)
        return out

    @staticmethod
    def joined(parts: Sequence[ReadingTable]) -> ReadingTable:
        """Return one table whose states are those of several tables, one table after the other.

        Parameters
        ----------
        parts : sequence of ReadingTable
            Tables with the same rows (changes and estimators).
        """
        names = ("true", "value", "error", "sigma", "noise")
        rows = tuple(
            replace(same[0], **{name: np.concatenate([getattr(row, name) for row in same]) for name in names})
            for same in zip(*(part.rows for part in parts), strict=True)
        )
        residuals = {
            estimator: {
                key: np.concatenate([part.ground_residuals[estimator][key] for part in parts]) for key in errors
            }
            for estimator, errors in parts[0].ground_residuals.items()
        }
        return ReadingTable(rows, residuals)


def plain(number: Any) -> Any:
    """Return a number or array as a float or nested lists for JSON: negative zero becomes zero, NaN becomes None."""
    if isinstance(number, float):
        return None if math.isnan(number) else number + 0.0
    return [plain(item) for item in np.asarray(number).tolist()]


def reading_table(
    estimates: Estimates | Recovery,
    cameras: Mapping[str, CameraCalibration],
    truth: Truth | None = None,
    ground: GroundGeometry | None = None,
    prior: Disturbances | None = None,
) -> ReadingTable:
    """Return the table of all changes that the estimators report, from their results.

    For a change that no motion of the prior causes, the value of an estimator that needs a prior is NaN.

    Parameters
    ----------
    estimates : Estimates | Recovery
        Estimates of all estimators.
    cameras : mapping of str to CameraCalibration
        Calibration of each camera.
    truth : Truth | None
        True changes of the same states; None for a real measurement.
    ground : GroundGeometry | None
        Ground geometry of a stereo pair of known altitude, for the true ground errors.
    prior : Disturbances | None
        Prior of the estimators that need one; None if there is none.
    """
    rows: list[Reading] = []
    fixed_changes = frozenset() if prior is None else unchanged_quantities(prior, cameras, ground)

    def add(
        group: str, which: Iterable[Parameter], true: np.ndarray | None, read: Mapping[str, Sequence[np.ndarray]]
    ) -> None:
        """Append the rows of a group of changes from arrays of their numbers, (S, P) for S states and P changes."""
        for k, parameter in enumerate(which):
            for estimator, (values, sigmas, noises) in read.items():
                value = values[:, k]
                true_value = np.full_like(value, np.nan) if true is None else true[:, k]
                sigma, noise = sigmas[:, k], noises[:, k]
                if (group, parameter.key) in fixed_changes and (
                    estimator not in ESTIMATORS or ESTIMATORS[estimator].needs_prior
                ):
                    value = sigma = noise = np.full_like(value, np.nan)
                rows.append(Reading(group, parameter, estimator, true_value, value, value - true_value, sigma, noise))

    units = np.array([estimate.per_si for estimate in parameters.CAMERA_PARAMETERS.values()])
    for name, estimators in estimates.parameters.items():
        rows_in_si = parameters.rows_of(cameras[name]) / units[:, None]
        readings: dict[str, Sequence[np.ndarray]] = {
            estimator: [
                units * number
                for number in (
                    estimate.vector @ rows_in_si.T,
                    _sigma(rows_in_si, estimate.error_covariance),
                    _sigma(rows_in_si, estimate.covariance),
                )
            ]
            for estimator, estimate in estimators.items()
        }
        true = None if truth is None else units * (truth.vector(name) @ rows_in_si.T)
        add(name, parameters.CAMERA_PARAMETERS.values(), true, readings)
    if estimates.angle:
        readings = {
            e: tuple(v[:, None] / ARCSEC for v in (a.change_rad, a.sigma_rad, a.noise_rad))
            for e, a in estimates.angle.items()
        }
        add(ANGLE_GROUP, (parameters.ANGLE,), None if truth is None else truth.angle_change[:, None] / ARCSEC, readings)
    if estimates.ground:
        readings = {e: (g.error_m, g.sigma_m, g.sigma_noise_m) for e, g in estimates.ground.items()}
        error = None if truth is None or ground is None else truth.ground_error(ground)
        add(GROUND_GROUP, parameters.GROUND, error, readings)
    residuals = {
        e: {"left_plan_rms_m": g.plan_rms_m, "left_height_rms_m": g.height_rms_m} for e, g in estimates.ground.items()
    }
    return ReadingTable(tuple(rows), residuals)


def _sigma(combination: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the standard deviations of P linear combinations of a camera's four parameters, (S, P) for S states.

    ``combination`` holds the coefficients (P, 4), ``covariance`` the covariances of the parameters (S, 4, 4).
    """
    return np.asarray(np.sqrt(np.einsum("pi,sij,pj->sp", combination, covariance, combination)))
