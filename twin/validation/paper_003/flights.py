"""Campaigns over the seven fields with everything drawn anew, calibrated and tested as paper 003 does it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from analysis.orbit.three_line_model import BIAS
from scenes.specs.orbit.angle import LINES
from scenes.specs.orbit.setup import CalibrationSetup
from twin.orbit.calibration.campaign import Campaign, FieldPass
from twin.orbit.calibration.campaign_adjustment import calibrated_alone
from twin.orbit.calibration.flown_campaign import fly_fields
from twin.orbit.calibration.influences import INNER
from twin.orbit.calibration.latitude import LatitudeFit, fitted
from twin.orbit.calibration.schemes import schemes_tested, tested, tested_before, values_of

MEDIAN = float(np.sqrt(np.pi / 2.0))
"""Standard deviation of a median over that of a mean, for normal noise and many draws."""


@dataclass(frozen=True, eq=False)
class Flights:
    """N campaigns over K fields, S schemes; the last scheme lets each field use its own parameters.

    Attributes:
        fields: names. latitude: (K,) radians. scheme_fields: of the averaged schemes.
        bias, bias_sigma, true_bias: (N, K, 3) of each field calibrated by itself, radians; roll, pitch, yaw.
        interior, interior_sigma: (N, K, 9) in the order of INNER, metres; sigma 0 where held.
        plan, height: (N, S, K) RMS at check points without ground control, metres.
        plan_before, height_before: (N, K) with the laboratory's camera.
        plan_floor, height_floor: (N, K) with the true camera and the true bias: the check points' own noise.
        expected: (N, S, K) RMS in plan that the true biases of fields and scheme imply.
        fits: campaign -> roll, pitch, yaw against latitude, from the estimated biases.
        true_amplitude, true_significance: (N, 3) amplitude from the true biases, by unweighted least squares, and how
            many of its standard deviations it is.
    """

    fields: tuple[str, ...]
    latitude: np.ndarray
    scheme_fields: tuple[tuple[str, ...], ...]
    bias: np.ndarray
    bias_sigma: np.ndarray
    true_bias: np.ndarray
    interior: np.ndarray
    interior_sigma: np.ndarray
    plan: np.ndarray
    height: np.ndarray
    plan_before: np.ndarray
    height_before: np.ndarray
    plan_floor: np.ndarray
    height_floor: np.ndarray
    expected: np.ndarray
    fits: tuple[tuple[LatitudeFit, ...], ...]
    true_amplitude: np.ndarray
    true_significance: np.ndarray

    @property
    def count(self) -> int:
        """Campaigns."""
        return len(self.plan)


def flown(
    setup: CalibrationSetup, seeds: Sequence[np.random.SeedSequence], step: Callable[[int], None]
) -> list[Campaign]:
    """Campaigns whose noise the adjustment takes as each exposure's own, which hardly changes what it estimates."""
    out = []
    for k, seed in enumerate(seeds):
        step(k)
        out.append(fly_fields(setup, seed).independent)
    return out


def flights_of(campaigns: Sequence[Campaign]) -> Flights:
    """Calibrate and test all of them."""
    first = campaigns[0]
    names = tuple(p.name for p in first.passes)
    latitude = np.array([p.latitude for p in first.passes])
    rows: dict[str, list[np.ndarray]] = {}
    fits = []
    for one in campaigns:
        alone = {p.name: calibrated_alone(one, p) for p in one.passes}
        schemes, before = schemes_tested(one, alone), tested_before(one)
        floor = {p.name: tested(one, p, one.truth, p.bias) for p in one.passes}
        true = np.array([p.bias for p in one.passes])
        bias = np.array([alone[n].bias(n) for n in names])
        sigma = np.array([[alone[n].sigma[f"{n} {axis}"] for axis in BIAS] for n in names])
        new = {
            "bias": bias,
            "bias_sigma": sigma,
            "true_bias": true,
            "interior": np.array([[alone[n].value(i) for i in INNER] for n in names]),
            "interior_sigma": np.array([[alone[n].sigma[i] for i in INNER] for n in names]),
            "plan": np.array([values_of(e, "plan_rms") for e in schemes.values()]),
            "height": np.array([values_of(e, "height_rms") for e in schemes.values()]),
            "plan_before": values_of(before, "plan_rms"),
            "height_before": values_of(before, "height_rms"),
            "plan_floor": values_of(floor, "plan_rms"),
            "height_floor": values_of(floor, "height_rms"),
        }
        new["expected"] = _expected(one, names, new["plan_floor"])
        new["true_amplitude"], new["true_significance"] = _slopes(latitude, true)
        for key, value in new.items():
            rows.setdefault(key, []).append(value)
        fits.append(tuple(fitted(a, latitude, bias[:, k], np.diag(sigma[:, k] ** 2)) for k, a in enumerate(BIAS)))
    return Flights(
        fields=names,
        latitude=latitude,
        scheme_fields=first.spec.schemes,
        fits=tuple(fits),
        **{key: np.array(value) for key, value in rows.items()},
    )


def _expected(campaign: Campaign, names: tuple[str, ...], floor: np.ndarray) -> np.ndarray:
    """(S, K) RMS in plan from the true biases: a field's roll and pitch less the scheme's mean, times the height of
    flight, beside the noise of the check points themselves. Yaw moves the swath's ends by 0.2 m for 1 arcsec.
    """
    true = {p.name: p.bias for p in campaign.passes}
    above = np.array([_height(p) for p in campaign.passes])
    rows = []
    for scheme in (*campaign.spec.schemes, None):
        mean = {n: np.mean([true[k] for k in (scheme or (n,))], axis=0) for n in names}
        turn = np.array([np.hypot(*(mean[n] - true[n])[:2]) for n in names])
        rows.append(np.hypot(above * turn, floor))
    return np.array(rows)


def _slopes(latitude: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(3,) amplitudes of sin(latitude - middle) in true biases (K, 3), and over their standard deviations."""
    reference = 0.5 * (latitude.min() + latitude.max())
    design = np.column_stack([np.sin(latitude - reference), np.ones_like(latitude)])
    best, square, _, _ = np.linalg.lstsq(design, true, rcond=None)
    sigma = np.sqrt(square / (len(latitude) - 2) * np.linalg.inv(design.T @ design)[0, 0])
    return best[0], np.abs(best[0]) / sigma


def _height(one: FieldPass) -> float:
    """Of the flight above the check points, metres."""
    earth = one.data.earth
    flight = float(earth.geodetic(one.trajectory.position(0.0))[2])
    return flight - float(np.mean(earth.geodetic(one.check_ground)[2]))


def median(values: np.ndarray) -> tuple[float, float]:
    """Median of (N,) values and its standard deviation."""
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
    return float(np.median(values)), MEDIAN * spread / float(np.sqrt(len(values)))


def lines_of(part: str) -> list[int]:
    """Places in INNER of an element, ``f``, ``x`` or ``y``, of all lines."""
    return [INNER.index(f"{line} {part}") for line in LINES]
