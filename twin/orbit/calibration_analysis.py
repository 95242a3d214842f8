"""Calibration over fields by simultaneous adjustment, and each field by itself as in paper 003; schemes of averaged
parameters, tested on all fields by forward intersection without ground control.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.orbit.adjustment import Adjustment, adjust
from analysis.orbit.calibration_parameters import Prior, Unknowns
from analysis.orbit.forward_intersection import CheckErrors, check_errors, intersect
from analysis.orbit.null_space import Gauge, RankError
from analysis.orbit.stepwise import Stepwise, stepwise
from analysis.orbit.third_difference import ThirdDifference, third_difference
from analysis.orbit.three_line_model import BIAS, INTERIOR, LineModel
from optics.frozen_map import FrozenMap
from scenes.orbit_angle import LINES
from twin.orbit.calibration_test import Campaign, FieldPass, fly_fields
from twin.trial.bench_error import BenchError
from twin.trial.result import Advance

if TYPE_CHECKING:
    from scenes.orbit_setup import CalibrationSetup

GAUGE = Gauge(held=("nadir x", "nadir y"))
"""The nadir line's principal point stays as the laboratory has it: x is not observable against pitch, y against roll so
weakly that a field would not know it to a pixel."""
INNER = tuple(f"{line} {name}" for line in LINES for name in INTERIOR)
OFFSET = ("along", "across", "down")
_LEAST_OFFSET = 1e-3
"""Metres; sigma of an orbit without a drift along one axis."""
STEPWISE_TOLERANCE = 1e-3
"""Of the sigmas; the last step of a round of the stepwise solution."""


@dataclass(frozen=True, eq=False)
class FieldResult:
    """A field calibrated by itself, with paper 003's twelve unknowns.

    Attributes:
        adjustment: simultaneous.
        orbit: third differences of the measured positions, ITRS.
        attitude: third differences of the measured attitude against the orbital frame, roll, pitch, yaw.
    """

    adjustment: Adjustment
    orbit: ThirdDifference
    attitude: ThirdDifference


@dataclass(frozen=True, eq=False)
class Finding:
    """The paper's finding, from the schemes of averaged parameters, fewest fields against most fields.

    Attributes:
        plan: mean over the fields of the RMS in plan, metres, each scheme.
        plan_spread: standard deviation over the fields.
        height, height_spread: likewise.
    """

    plan: np.ndarray
    plan_spread: np.ndarray
    height: np.ndarray
    height_spread: np.ndarray

    @property
    def plan_improves(self) -> bool:
        """The mean falls from the first scheme to the last."""
        return bool(self.plan[-1] < self.plan[0])

    @property
    def plan_evens_out(self) -> bool:
        """The spread over the fields falls from the first scheme to the last."""
        return bool(self.plan_spread[-1] < self.plan_spread[0])

    @property
    def height_change(self) -> float:
        """Largest change of the mean height error between schemes, relative to the first."""
        return float(np.ptp(self.height) / self.height[0])

    @property
    def height_stays(self) -> bool:
        """It changes by less than a fifth, three times the scatter of an RMS over 100 points (7%)."""
        return self.height_change < 0.2

    @property
    def holds(self) -> bool:
        """All three parts."""
        return self.plan_improves and self.plan_evens_out and self.height_stays


@dataclass(frozen=True, eq=False)
class CalibrationRun:
    """All that was computed.

    Attributes:
        campaign: truth and measurements.
        together: simultaneous adjustment of all fields, with the orbit's offsets.
        truth: (P,) true values of its unknowns.
        fields: name -> that field by itself.
        paper_way: the first scheme's first field by the paper's stepwise solution.
        before: field -> errors with the laboratory's camera.
        schemes: scheme, "1" on -> field -> errors; the last lets each field use its own parameters.
        finding: of the paper, judged.
    """

    campaign: Campaign
    together: Adjustment
    truth: np.ndarray
    fields: Mapping[str, FieldResult]
    paper_way: Stepwise
    before: Mapping[str, CheckErrors]
    schemes: Mapping[str, Mapping[str, CheckErrors]]
    finding: Finding


def run_calibration_passes(setup: CalibrationSetup, seed: int, advance: Advance) -> CalibrationRun:
    """Fly, calibrate, test.

    Raises:
        BenchError: the orbit, the points or the adjustment do not allow it.
    """
    parts = 4 + len(setup.test.fields)
    advance("calibration", 0, parts)
    campaign = fly_fields(setup, np.random.SeedSequence(seed))
    advance("calibration", 1, parts)
    try:
        together = simultaneous(campaign)
        advance("calibration", 2, parts)
        fields = {}
        for k, one in enumerate(campaign.passes):
            alone = adjust([one.control], campaign.laboratory, campaign.noise, gauge=GAUGE)
            fields[one.name] = FieldResult(alone, *_third_differences(campaign, one))
            advance("calibration", 3 + k, parts)
        first = campaign.spec.schemes[0][0]
        control = next(p.control for p in campaign.passes if p.name == first)
        paper_way = stepwise(
            [control], campaign.laboratory, campaign.noise, held=GAUGE.held, tolerance=STEPWISE_TOLERANCE
        )
        before = {p.name: _tested(campaign, p, campaign.laboratory, np.zeros(3)) for p in campaign.passes}
        schemes = _schemes(campaign, fields)
    except RankError as error:
        remedy = "a field with width and length, and more points"
        raise BenchError(str(error), ("points",), remedy) from error
    except ValueError as error:  # a CalibrationError, or too few readings for third differences
        raise BenchError(str(error), ("errors",), "errors that an adjustment can take, and more points") from error
    advance("calibration", parts, parts)
    averaged = list(schemes)[:-1]
    plan, height = (
        np.array([[getattr(e, what) for e in schemes[k].values()] for k in averaged])
        for what in ("plan_rms", "height_rms")
    )
    finding = Finding(plan.mean(axis=1), plan.std(axis=1), height.mean(axis=1), height.std(axis=1))
    return CalibrationRun(
        campaign,
        together,
        true_values(campaign, together.names),
        FrozenMap(fields),
        paper_way,
        FrozenMap(before),
        FrozenMap(schemes),
        finding,
    )


def simultaneous(campaign: Campaign) -> Adjustment:
    """All fields at once: one interior, a bias and, where the orbit drifts, an offset with its prior for each field.

    Raises:
        CalibrationError: it cannot be solved.
    """
    errors = campaign.spec.errors
    offsets = errors.switched_on and any(errors.gps.drift)
    priors = [
        Prior({f"{p.name} offset {axis}": 1.0}, 0.0, max(sigma, _LEAST_OFFSET), "orbit")
        for p in campaign.passes
        for axis, sigma in zip(OFFSET, errors.gps.drift, strict=True)
    ]
    return adjust(
        [p.control for p in campaign.passes],
        campaign.laboratory,
        campaign.noise,
        unknowns=Unknowns(offset="field" if offsets else "none"),
        priors=priors if offsets else (),
        gauge=GAUGE,
    )


def true_values(campaign: Campaign, names: tuple[str, ...]) -> np.ndarray:
    """True values of unknowns (P,) by name, metres and radians; of biases and offsets, those at the field's middle."""
    known = {
        f"{line} {name}": value
        for line, camera in campaign.truth.items()
        for name, value in zip(INTERIOR, camera.interior, strict=True)
    }
    for one in campaign.passes:
        known |= {f"{one.name} {name}": v for name, v in zip(BIAS, one.bias, strict=True)}
        known |= {f"{one.name} offset {name}": v for name, v in zip(OFFSET, one.offset, strict=True)}
    return np.array([known[name] for name in names])


def _schemes(campaign: Campaign, fields: Mapping[str, FieldResult]) -> dict[str, Mapping[str, CheckErrors]]:
    """Scheme -> field -> errors at its check points."""
    found: dict[str, Mapping[str, CheckErrors]] = {}
    for k, names in enumerate(campaign.spec.schemes):
        cameras, bias = _averaged(campaign, fields, names)
        found[str(k + 1)] = FrozenMap({p.name: _tested(campaign, p, cameras, bias) for p in campaign.passes})
    own = {p.name: _tested(campaign, p, *_averaged(campaign, fields, (p.name,))) for p in campaign.passes}
    found[str(len(campaign.spec.schemes) + 1)] = FrozenMap(own)
    return found


def _averaged(
    campaign: Campaign, fields: Mapping[str, FieldResult], names: tuple[str, ...]
) -> tuple[dict[str, LineModel], np.ndarray]:
    """Cameras and bias (3,): means of the parameters of these fields, each calibrated by itself."""
    results = {name: fields[name].adjustment for name in names}
    cameras = {
        line: camera.with_interior(np.mean([r.cameras[line].interior for r in results.values()], axis=0))
        for line, camera in campaign.laboratory.items()
    }
    return cameras, np.mean([r.bias(name) for name, r in results.items()], axis=0)


def _tested(campaign: Campaign, one: FieldPass, cameras: Mapping[str, LineModel], bias: np.ndarray) -> CheckErrors:
    return check_errors(intersect(one.check, cameras, campaign.noise, bias=bias).ground, one.check_ground)


def _third_differences(campaign: Campaign, one: FieldPass) -> tuple[ThirdDifference, ThirdDifference]:
    errors, measured = campaign.spec.errors, one.measured
    fixes = _readings(measured.first, measured.last, errors.gps.interval)
    looks = _readings(measured.first, measured.last, errors.star_tracker.interval)
    turned = np.swapaxes(measured.orbital_to_itrs(looks), 1, 2) @ measured.body_to_itrs(looks)
    # small angles: the skew part of the rotation
    skew = 0.5 * (turned - np.swapaxes(turned, 1, 2))
    angles = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=-1)
    return third_difference(fixes, measured.position(fixes)), third_difference(looks, angles)


def _readings(first: float, last: float, interval: float) -> np.ndarray:
    """Times of the readings inside the span, seconds; five at least, or the analysis says so."""
    return interval * np.arange(np.ceil(first / interval), np.floor(last / interval) + 1.0)
