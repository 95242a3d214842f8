"""Changes of the cameras estimated from a monitor's images, and their JSON form (recovered.json)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from analysis.arrays import shows
from analysis.monitor.disturbances import FALSE_ALARM, Consistency, Disturbances, chi_squares, consistency
from analysis.monitor.estimators import Estimator, applicable, preferred_estimator
from analysis.monitor.limits import Quantity, posterior_sigma, quantities, split, unchanged_quantities
from analysis.monitor.monitor_formulas import GroundGeometry
from analysis.monitor.parameters import CameraCalibration
from analysis.monitor.recovery import NONLINEAR_SIGMAS, Recovery
from analysis.spots.likelihood import FALSE_ALARM as SPOT_ALARM
from analysis.spots.likelihood import FitStates
from twin.framework.artefact import significant
from twin.framework.provenance import SelfCheck
from twin.monitor.crosstalk import CameraCrosstalk, estimator_gains
from twin.monitor.reading_table import ReadingTable, reading_table
from twin.monitor.truth import Truth
from twin.uncertainty.monitor_limits import short_text, unobserved_texts


@shows("cameras", "frames", "centroid", "recovery")
@dataclass(frozen=True, eq=False)
class MonitorReading:
    """Changes of the cameras estimated from a monitor's images of one state, with covariance and checks.

    Attributes
    ----------
    channels : tuple of (str, str)
        Camera and channel name of every spot, in the order of the spots.
    cameras : Mapping[str, CameraCalibration]
        Calibration of each camera's monitor.
    ground : GroundGeometry or None
        Viewing geometry of a pair of cameras at a known altitude.
    disturbances : Disturbances or None
        Prior on the disturbances, None if there is none.
    recovery : Recovery
        Spot positions and estimates from the images (one state).
    crosstalk : Mapping[str, CameraCrosstalk]
        Response of each camera to elementary motions, used to explain a contradiction of the prior; empty without a
        model of the instrument.
    frames : int
        Number of frames of each spot after the change.
    centroid : str
        Method that locates the spots.
    earlier_doubts : tuple of str
        Reasons why sigma does not hold that were known before the spots were measured.
    truth : Truth or None
        True changes, for simulated states.
    together : int
        Number of measurements, this one included, that share one false-alarm rate.
    """

    channels: tuple[tuple[str, str], ...]
    cameras: Mapping[str, CameraCalibration]
    ground: GroundGeometry | None
    disturbances: Disturbances | None
    recovery: Recovery
    crosstalk: Mapping[str, CameraCrosstalk]
    frames: int
    centroid: str
    earlier_doubts: tuple[str, ...] = ()
    truth: Truth | None = None
    together: int = 1

    @property
    def estimators(self) -> dict[str, Estimator]:
        """Name -> estimator in the results, for all whose requirements (a prior, for instance) are met."""
        return applicable(self.cameras, self.disturbances)

    @property
    def judged(self) -> str:
        """Name of the estimator that the verdict uses: `posterior` if the prior changes any estimate, else `model`."""
        return preferred_estimator(name for name in self.estimators if self.table.of(name))

    @cached_property
    def table(self) -> ReadingTable:
        """Table of the changes estimated by all estimators, with the true changes where these are known."""
        return reading_table(self.recovery, self.cameras, self.truth, self.ground, self.disturbances).at(0)

    @cached_property
    def gains(self) -> dict[str, np.ndarray]:
        """Estimator -> its linear map from spot shifts (px) to camera parameters (rad or m).

        Each is a (4 x cameras, 2 x spots) array.
        """
        return estimator_gains(self.cameras, self.disturbances, self.recovery.shift_covariance[0])

    @cached_property
    def doubts(self) -> tuple[str, ...]:
        """Reasons why sigma is not valid for this measurement, as sentences without full stops.

        They are spots whose shape differs from their calibration, estimates that are not linear in the motions and
        cannot be linearised again, and spot shifts that contradict the prior.
        """
        texts = list(self.earlier_doubts)
        evidence = self.recovery.evidence
        doubt = None if evidence is None else evidence.doubt(0, ["/".join(channel) for channel in self.channels])
        if doubt is not None and not texts:
            texts.append(doubt.text)
        for name, curvature in self.recovery.curvature.items():
            if not curvature.valid[0]:
                texts.append(
                    f"σ does not hold: the motions read by the {self.estimators[name].title} are too large for a "
                    f"linear estimate, and the estimated state cannot be retraced ({self._error_text(name)}); "
                    "readings are linear"
                )
        return (*texts, *self.contradiction)

    @property
    def contradiction(self) -> tuple[str, ...]:
        """Sentence that the spot shifts contradict the prior; empty if they agree with it."""
        return contradicted(self.disturbances, self.consistency)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on estimates that were linearised again about the estimated state, as sentences without full stops."""
        return tuple(
            f"the motions read by the {self.estimators[name].title} are too large for a linear estimate "
            f"({self._error_text(name)} against the retraced state): its readings are Gauss-Newton iterates"
            for name, curvature in self.recovery.curvature.items()
            if curvature.beyond[0] and curvature.valid[0]
        )

    @cached_property
    def unobserved(self) -> tuple[str, ...]:
        """Warnings about bodies whose motions hardly move the spots but contribute to sigma, without full stops."""
        prior, noise = self.disturbances, self.recovery.shift_covariance[0]
        if prior is None or not np.any(noise):
            return ()
        return unobserved_texts(prior, noise, self._quantities, self.gains[self.judged])

    def _error_text(self, name: str) -> str:
        """Return the parameter whose linear estimate differs most from a ray trace of the estimated state, as text.

        The text also gives the size of the difference.
        """
        index, size = self.recovery.curvature[name].worst()
        if not math.isfinite(size):
            return "light is lost"
        return f"the linear {short_text(self._quantities[index])} is off by {size:.3g} σ"

    @cached_property
    def _quantities(self) -> tuple[Quantity, ...]:
        return quantities(self.cameras, self.ground)

    @property
    def sigma_holds(self) -> bool:
        """True if there is no reason to doubt the sigmas, i.e. ``doubts`` is empty."""
        return not self.doubts

    @cached_property
    def from_statement(self) -> dict[str, dict[str, float | None]]:
        """Group -> key -> fraction of the posterior variance due to the prior alone, which remains without image noise.

        The fraction is None for a quantity that no motion of the prior changes. The mapping is empty if there is no
        prior or if the images have no noise.
        """
        prior, noise = self.disturbances, self.recovery.shift_covariance[0]
        if prior is None or not np.any(noise):
            return {}
        rows = np.stack([quantity.row for quantity in self._quantities])
        with_noise, without_noise = (posterior_sigma(rows, prior, spread) for spread in (noise, 0.0 * noise))
        out: dict[str, dict[str, float | None]] = {}
        unchanged = unchanged_quantities(prior, self.cameras, self.ground)
        for quantity, sigma, noise_free in zip(self._quantities, with_noise, without_noise, strict=True):
            share = round(min(float(noise_free / sigma) ** 2, 1.0) if sigma > 0.0 else 0.0, SHARE_DECIMALS)
            missing = (quantity.group, quantity.key) in unchanged
            out.setdefault(quantity.group, {})[quantity.key] = None if missing else share
        return out

    @cached_property
    def repeats_prior(self) -> tuple[str, ...]:
        """Names of the quantities whose standard deviation the spots reduce by less than 5 %.

        Empty without a prior and without noise.
        """
        prior, noise = self.disturbances, self.recovery.shift_covariance[0]
        if prior is None or not np.any(noise):
            return ()
        parts = split(np.stack([quantity.row for quantity in self._quantities]), prior, noise, prior.best_gain(noise))
        unmeasured = (parts.sigma_before > 0.0) & (parts.sigma > UNMEASURED * parts.sigma_before)
        repeated = zip(self._quantities, unmeasured, strict=True)
        return tuple(short_text(quantity) for quantity, repeats in repeated if repeats)

    @cached_property
    def consistency(self) -> Consistency | None:
        """Chi-square test of the shifts against the prior on disturbances.

        It is None without a prior, and where shifts have no noise: rounding would then contradict a prior that holds a
        body fixed.
        """
        if self.disturbances is None or not np.any(self.recovery.shift_covariance):
            return None
        recovery, candidates = self.recovery, self.any_motions(self.disturbances)
        rate = FALSE_ALARM / self.together
        return consistency(recovery.shift[0], recovery.shift_covariance[0], self.disturbances, candidates, rate)

    def any_motions(self, prior: Disturbances) -> dict[str, np.ndarray]:
        """Return the spot shifts due to the motions of each body, including bodies that the prior holds fixed.

        Parameters
        ----------
        prior : Disturbances
            Prior, which gives the number of spot coordinates.

        Returns
        -------
        dict of str to (2 C, M) ndarray
            Body -> shifts of C spots (row and column of each), in pixels per table unit (arcsec, um, ppm) of each of
            the body's M motions.
        """
        columns: dict[tuple[str, str, int], np.ndarray] = {}
        for name, table in self.crosstalk.items():
            rows = [2 * i + axis for i, (camera, _) in enumerate(self.channels) if camera == name for axis in (0, 1)]
            for motion, shifts in zip(table.motions, table.spot_shift.T, strict=True):
                # a body that both cameras see is in both tables
                key = (motion.body, motion.kind, motion.axis)
                columns.setdefault(key, np.zeros(len(prior.spots)))[rows] = shifts
        bodies = dict.fromkeys(body for body, _, _ in columns)
        return {b: np.stack([c for (body, _, _), c in columns.items() if body == b], axis=1) for b in bodies}

    def worst_of(self, shifts: np.ndarray, covariance: np.ndarray) -> tuple[int, Consistency] | None:
        """Return the time of a series at which the spot shifts agree least with the prior, and its chi-square test.

        The limit of the test is that of the largest value of all times, at the same false-alarm rate. The result is
        None without a prior.

        Parameters
        ----------
        shifts : (T, 2 C) ndarray
            Shifts of C spots (row and column of each) at T times, in pixels.
        covariance : (T, 2 C, 2 C) ndarray
            Covariance of the shifts at each time, in px^2.
        """
        prior, false_alarm = self.disturbances, FALSE_ALARM / len(shifts)
        if prior is None:
            return None
        worst = int(np.argmax(chi_squares(shifts, covariance, prior)))
        candidates = self.any_motions(prior)
        return worst, consistency(shifts[worst], covariance[worst], prior, candidates, false_alarm=false_alarm)

    @property
    def checks(self) -> Iterator[SelfCheck]:
        """Checks of the spot fits, of the spot shifts against the prior, and of the linearity of the estimates."""
        evidence = self.recovery.evidence
        if evidence is not None:
            yield from _fits("spots before", evidence.before)
            yield from _fits("spots after", evidence.after)
        if self.consistency is not None:
            yield prior_check("shifts against the prior on disturbances", self.consistency)
        for name, curvature in self.recovery.curvature.items():
            size = curvature.worst()[1]
            if math.isfinite(size):
                state = "relinearised" if curvature.beyond[0] and curvature.valid[0] else "linear"
                limit = f"above {NONLINEAR_SIGMAS:g} sigma relinearised, else sigma does not hold"
                meaning = f"readings are {state}; {limit}"
                yield SelfCheck(f"linear readings of {name} against the retraced state", size, None, "sigma", meaning)

    def recovered_dict(self) -> dict[str, Any]:
        """Return the contents of recovered.json: estimated changes, sigmas, spots and tests."""
        groups = self.table.groups()
        spots: dict[str, Any] = {}
        r = self.recovery
        fits = (None, None) if r.evidence is None else (r.evidence.before, r.evidence.after)
        for i, (camera, channel) in enumerate(self.channels):
            spots.setdefault(camera, {})[channel] = {
                "before": {**_spot(r.before[0, i], r.sigma_before[0, i]), **_fit(fits[0], i)},
                "after": {**_spot(r.after[0, i], r.sigma_after[0, i]), **_fit(fits[1], i)},
            }
        share, retraced = self.from_statement, {name: self._retraced(name) for name in r.curvature}
        out = {"cameras": groups.pop("cameras"), "spots": spots, **groups}
        out["disturbances"] = self._consistency_plain(self.consistency)
        out |= ({"from_statement": share} if share else {}) | ({"retraced": retraced} if retraced else {})
        out |= {"sigma_holds": self.sigma_holds, "doubts": list(self.doubts)}
        return out | {"centroid": self.centroid, "frames": self.frames}

    def _retraced(self, name: str) -> dict[str, Any]:
        """Return the comparison of an estimator's linear estimates with a ray trace of the estimated state."""
        curvature = self.recovery.curvature[name]
        worst, size = curvature.worst()
        quantity = self._quantities[worst]
        return {
            "off_in_sigma": round(size, OFF_DECIMALS) if math.isfinite(size) else None,
            "of": quantity.name if size >= 1.0 else "",
            "relinearised": bool(curvature.beyond[0] and curvature.valid[0]),
            "holds": bool(curvature.valid[0]),
        }

    def _consistency_plain(self, test: Consistency | None) -> dict[str, Any]:
        """Return the prior's name and the test of the shifts against it, as plain data; None without prior or noise."""
        name = None if self.disturbances is None else self.disturbances.name
        numbers = {key: None if test is None else number(test) for key, number in _TEST_KEYS.items()}
        suspects = [
            {"body": s.body, "times_stated": _to_digits(s.times), "log_likelihood_gain": _to_digits(s.gain)}
            for s in (test.suspects if test is not None else ())
        ]
        return {"name": name, **numbers, "suspects": suspects}


def contradicted(
    prior: Disturbances | None, test: Consistency | None, when: str = "", rate: str = f"{FALSE_ALARM:g}"
) -> tuple[str, ...]:
    """Return a warning if the shifts of a measurement contradict the prior.

    Parameters
    ----------
    prior : Disturbances or None
        Prior on the disturbances.
    test : Consistency or None
        Test of the shifts against the prior.
    when : str
        Text that names the measurement, where there are several.
    rate : str
        False-alarm rate, as text.
    """
    if prior is None or test is None or test.agrees:
        return ()
    return (
        f"the shifts of the spots contradict the prior {prior.name}{when}: chi-square "
        f"{significant(test.chi_square)} for {test.degrees} degrees of freedom, limit {test.limit:.1f} at a "
        f"false-alarm rate of {rate}{_suspect_text(test, prior.bodies)}; σ does not hold for this measurement",
    )


def _suspect_text(test: Consistency, prior_bodies: Sequence[str]) -> str:
    if not test.suspects:
        return ""
    first = test.suspects[0]
    times = significant(first.times, 2)
    if first.body in prior_bodies:
        return (
            f"; motions of {first.body} would explain them best, with {times} times the standard deviations of the "
            "prior"
        )
    return (
        f"; motions of {first.body}, which the prior does not contain, would explain them best, with standard "
        f"deviations of about {times} µm, arcsec, ppm and nm"
    )


def _fits(what: str, fits: FitStates) -> Iterator[SelfCheck]:
    """Yield the check of the worst fit among some spots: its chi-square divided by the limit."""
    ratio = np.fmax(fits.whole / fits.whole_limit, fits.core / fits.core_limit)
    if np.any(np.isfinite(ratio) & (ratio > 0.0)):
        meaning = (
            f"reduced chi-square over its limit; false-alarm rate {SPOT_ALARM:g} per fit; above 1, sigma is widened"
        )
        yield SelfCheck(f"fit of the {what}", float(np.nanmax(ratio)), 1.0, "of the limit", meaning)


def prior_check(name: str, test: Consistency) -> SelfCheck:
    """Return the check of spot shifts against the prior on disturbances.

    Parameters
    ----------
    name : str
        Name of the check.
    test : Consistency
        Test of the shifts against the prior.
    """
    meaning = (
        f"chi-square for {test.degrees} degrees of freedom; false-alarm rate {test.false_alarm:.2g}; else a warning"
    )
    return SelfCheck(name, test.chi_square, test.limit, "", meaning)


def worst_checks(readings: Iterable[MonitorReading]) -> tuple[SelfCheck, ...]:
    """Return for each kind of check, by its name, the one with the worst result among several measurements.

    Parameters
    ----------
    readings : Iterable[MonitorReading]
        Measurements of several states or times.
    """
    out: dict[str, SelfCheck] = {}
    for check in (check for reading in readings for check in reading.checks):
        if check.name not in out or check.value > out[check.name].value:
            out[check.name] = check
    return tuple(out.values())


UNMEASURED = 0.95
"""Ratio of posterior to prior sigma above which the spots count as not measuring a quantity."""
SHARE_DECIMALS, OFF_DECIMALS = 3, 1
"""Decimals to which fractions of variances, and linearity errors in sigmas, are rounded in results.

Rounding errors of the computation then rarely change a number.
"""
READING_DECIMALS = 6
"""Number of decimals to which files give an estimated change divided by its sigma."""
_TEST_KEYS: Mapping[str, Callable[[Consistency], Any]] = {
    "chi_square": lambda test: _to_digits(test.chi_square),
    "chi_square_sigma_noise": lambda test: test.sigma_noise,
    "degrees_of_freedom": lambda test: test.degrees,
    "limit": lambda test: _to_digits(test.limit),
    "false_alarm": lambda test: test.false_alarm,
    "chance": lambda test: _to_digits(test.p_value),
    "chance_sigma_noise": lambda test: test.p_value_sigma_noise,
    "agrees": lambda test: test.agrees,
}
"""Key in files -> function that takes its number from the chi-square test against the prior."""
_SIGMA_DIGITS = 8
"""Number of significant digits of a sigma and of a chi-square in files."""
_SIGMAS = ("_sigma", "_sigma_noise", "_rms_m")
"""Endings of the keys in files whose values are standard deviations."""


def _to_digits(value: float) -> float:
    return float(f"{value:.{_SIGMA_DIGITS - 1}e}")


def rounded(readings: Mapping[str, Any]) -> dict[str, Any]:
    """Round estimated changes for files: each to a millionth of its sigma, the sigmas to eight digits.

    Further digits carry no information and differ between processors, with the order in which linear algebra sums.

    Parameters
    ----------
    readings : Mapping[str, Any]
        Nested estimates; the sigma of ``x`` is ``x_sigma_noise`` or ``x_sigma`` beside it, the first that exists. Other
        numbers are not rounded.
    """
    out: dict[str, Any] = {}
    for key, value in readings.items():
        names = (f"{key}_sigma_noise", f"{key}_sigma")
        sigma = next((readings[name] for name in names if name in readings), None)
        if isinstance(value, Mapping):
            out[key] = rounded(value)
        elif isinstance(value, float) and key.endswith(_SIGMAS):
            out[key] = _to_digits(value)
        elif isinstance(value, float) and isinstance(sigma, float) and 0.0 < sigma < math.inf:
            # adding 0.0 turns a negative zero into a positive one
            out[key] = round(value, READING_DECIMALS - math.floor(math.log10(sigma))) + 0.0
        else:
            out[key] = value
    return out


def _fit(fits: FitStates | None, spot: int) -> dict[str, float | None]:
    """Return the goodness of fit of a spot; its numbers are None where no shape was fitted or no fit was tested."""
    tested = fits is not None and math.isfinite(fits.whole[0, spot])
    return {
        key: _to_digits(float(getattr(fits, attribute)[0, spot])) if tested else None for key, attribute in _FIT.items()
    }


_FIT = {
    "reduced_chi_square": "whole",
    "reduced_chi_square_sigma_noise": "whole_sigma",
    "core_chi_square": "core",
    "core_chi_square_sigma_noise": "core_sigma",
    "sigma_widened": "widening",
}
"""Key of a spot's goodness of fit in files -> attribute of its fit."""


def _spot(position: np.ndarray, sigma: np.ndarray) -> dict[str, float]:
    return dict(zip(("row", "column", "row_sigma", "column_sigma"), map(float, (*position, *sigma)), strict=True))
