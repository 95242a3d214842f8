"""Numbers of an in-orbit calibration, as calibration.json has them: metres and radians."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from analysis.orbit.calibration_parameters import OFFSET, RATE
from analysis.orbit.null_space import Combination
from analysis.orbit.three_line_model import BIAS
from twin.orbit.calibration.attitude_drift import DriftNumbers
from twin.orbit.calibration.calibration_run import CalibrationRun, FieldResult
from twin.orbit.calibration.campaign import FieldPass, Rejected, interior_names
from twin.orbit.calibration.chip_steps import StepNumbers
from twin.orbit.calibration.image_numbers import ImageNumbers
from twin.orbit.calibration.influences import DatumRow, LightRow, Surprise
from twin.orbit.calibration.latitude import LatitudeFit
from twin.orbit.calibration.measured_quality import Meeting, ground_sample, meeting_of
from twin.orbit.calibration.repeatability import Repeatability, repeatability
from twin.orbit.calibration.scheme_numbers import (
    CampaignNumbers,
    ErrorNumbers,
    MeanNumbers,
    MonitoringNumbers,
    StripNumbers,
    VerdictNumbers,
)
from twin.run.plain_data import plain_data

Array = NDArray[np.float64]


def unit(name: str) -> str:
    """SI unit of an unknown."""
    if name.endswith(RATE):
        return "rad/s"
    return "rad" if name.split()[-1] in BIAS else "m"


@dataclass(frozen=True)
class ParameterNumbers:
    """An unknown of the adjustment of all fields; held: by the gauge. share_from_launch: of its variance, what comes
    from the sigmas of launch and season and not from the points, 0 to 1.
    """

    value: float
    sigma: float
    sigma_with_gauge: float
    share_from_launch: float
    held: bool
    truth: float | None
    unit: str

    @classmethod
    def of(cls, run: CalibrationRun) -> dict[str, Self]:
        """Name -> numbers."""
        found = run.together
        sigma, held = found.sigma, found.gauge.held
        whole = found.sigma_with(dict.fromkeys(held, run.campaign.spec.launch.interior))
        truth = [None] * len(found.names) if run.truth is None else run.truth.tolist()
        return {
            name: cls(float(value), sigma[name], whole[name], float(share), name in held, true, unit(name))
            for name, value, share, true in zip(found.names, found.values, found.from_start, truth, strict=True)
        }


@dataclass(frozen=True)
class SigmaNotes:
    """What the sigmas hold."""

    sigma: str
    sigma_with_gauge: str
    held_start_sigma_m: float
    fields: str

    @classmethod
    def of(cls, run: CalibrationRun) -> Self:
        """Of a run."""
        rates = any(name in RATE for name in run.together.names)
        own = any(name.endswith(RATE) for name in run.together.names) and not rates
        return cls(
            sigma="with the gauge's held unknowns exact"
            + (", and with the drift of the biases during the passes as the latitude fit tells it" if rates else "")
            + (", and with a drift of the attitude in each pass as it is stated or was found" if own else ""),
            sigma_with_gauge="with what launch leaves to expect of the held unknowns, and all that follows them",
            held_start_sigma_m=run.campaign.spec.launch.interior,
            fields="of each field by itself: without the drift of the biases during the pass",
        )


@dataclass(frozen=True)
class CorrelationNumbers:
    """Of the unknowns that are not held."""

    names: Sequence[str]
    matrix: Array

    @classmethod
    def of(cls, run: CalibrationRun) -> Self:
        """Of a run."""
        found = run.together
        free = [k for k, name in enumerate(found.names) if found.sigma[name] > 0.0]
        return cls([found.names[k] for k in free], np.round(found.correlation[np.ix_(free, free)], 6))


@dataclass(frozen=True)
class CombinationNumbers:
    """A change of unknowns together that the measurements do not see, or hardly."""

    change: Mapping[str, float]
    strength: float
    sigma_m: float | None

    @classmethod
    def of(cls, combinations: Iterable[Combination]) -> tuple[Self, ...]:
        """Of all."""
        return tuple(
            cls({name: float(v) for name, v in zip(one.names, one.change, strict=True)}, one.strength, one.sigma)
            for one in combinations
        )


@dataclass(frozen=True)
class FitNumbers:
    """How the adjustment of all fields fits."""

    chi_square: float
    degrees_of_freedom: int
    p_value: float
    iterations: int
    attitude_drift: DriftNumbers


@dataclass(frozen=True)
class StepwiseNumbers:
    """One field by turns of interior orientation and biases; rate: what a round leaves of the error."""

    field: str
    rounds: int
    rate: float
    converged: bool


@dataclass(frozen=True)
class BiasNumbers:
    """A bias of a field by itself."""

    value: float
    sigma: float
    truth: float | None
    unit: str


@dataclass(frozen=True)
class InteriorNumbers:
    """A parameter of the interior orientation by one field."""

    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class FieldNumbers:
    """A field calibrated by itself."""

    latitude_rad: float
    bias: Mapping[str, BiasNumbers]
    interior: Mapping[str, InteriorNumbers]
    p_value: float
    orbit_third_difference_rms_m: Array
    attitude_third_difference_rms_rad: Array

    @classmethod
    def of(cls, one: FieldPass, result: FieldResult) -> Self:
        """Of one field."""
        alone = result.adjustment
        sigma = alone.sigma
        interior = interior_names(tuple(alone.cameras))
        truth = [None] * len(BIAS) if one.known_truth is None else one.bias.tolist()
        return cls(
            latitude_rad=one.latitude,
            bias={
                name: BiasNumbers(float(v), sigma[f"{one.name} {name}"], t, "rad")
                for name, v, t in zip(BIAS, alone.bias(one.name), truth, strict=True)
            },
            interior={
                name: InteriorNumbers(alone.value(name), sigma[name], "m") for name in alone.names if name in interior
            },
            p_value=alone.p_value,
            orbit_third_difference_rms_m=result.orbit.rms,
            attitude_third_difference_rms_rad=result.attitude.rms,
        )


@dataclass(frozen=True)
class LatitudeNumbers:
    """Amplitude x sin(latitude - reference) + constant, of one axis of the biases."""

    amplitude_rad: float
    amplitude_sigma_rad: float
    constant_rad: float
    constant_sigma_rad: float
    reference_rad: float
    remainder_rad: float
    chi_square: float
    degrees_of_freedom: int
    p_value: float

    @classmethod
    def of(cls, fit: LatitudeFit) -> Self:
        """Of one axis."""
        return cls(
            fit.amplitude,
            fit.amplitude_sigma,
            fit.constant,
            fit.constant_sigma,
            fit.reference,
            fit.remainder,
            fit.chi_square,
            fit.degrees_of_freedom,
            fit.p_value,
        )


@dataclass(frozen=True)
class RepeatabilityNumbers:
    """Scatter of a parameter from field to field."""

    name: str
    unit: str
    scatter: float
    sigma: float
    p_value: float | None

    @classmethod
    def of(cls, one: Repeatability) -> Self:
        """Of one parameter."""
        return cls(one.name, unit(one.name), one.scatter, one.sigma, one.p_value)


@dataclass(frozen=True)
class QuantityNumbers:
    """A number and its unit."""

    value: float
    unit: str


@dataclass(frozen=True)
class LightNumbers:
    """What effects on the light do where they are left in."""

    left_in: Sequence[str]
    moved_rms_m: Mapping[str, Array]
    before: ErrorNumbers
    after: ErrorNumbers
    parameter_change: Mapping[str, QuantityNumbers]
    parameter_change_sigmas: Mapping[str, float]
    p_value: float

    @classmethod
    def of(cls, row: LightRow) -> Self:
        """Of one choice of effects."""
        return cls(
            left_in=row.left,
            moved_rms_m=row.moved,
            before=ErrorNumbers(*row.before),
            after=ErrorNumbers(*row.after),
            parameter_change={name: QuantityNumbers(v, unit(name)) for name, v in row.shift.items()},
            parameter_change_sigmas={n: v / row.sigma[n] for n, v in row.shift.items() if row.sigma[n] > 0.0},
            p_value=row.p_value,
        )


@dataclass(frozen=True)
class DatumNumbers:
    """What a datum does that is off by a shift, or a clock of the lines that is late.

    Attributes:
        shift_east_north_up_m, late_s: the shift, or by how much the clock is late.
        bias_change_rad, interior_change_m, offset_change_m: of the parameters.
        most: the element of the interior that moves by the most of its sigmas.
        most_sigmas: by how many.
        one_sigma_at: shift or time that moves it by one sigma, metres or seconds.
        warned_from: from which on an unknown is beyond what is expected, metres or seconds; None for never.
        chi_square_change, p_value: of the fit.
        after: errors at check points.
    """

    shift_east_north_up_m: Sequence[float]
    late_s: float
    bias_change_rad: Mapping[str, float]
    interior_change_m: Mapping[str, float]
    offset_change_m: Mapping[str, float]
    most: str
    most_sigmas: float
    one_sigma_at: float | None
    warned_from: float | None
    chi_square_change: float
    p_value: float
    after: ErrorNumbers

    @classmethod
    def of(cls, row: DatumRow) -> Self:
        """Of one shift."""
        return cls(
            shift_east_north_up_m=row.shift,
            late_s=row.late,
            bias_change_rad=dict(zip(BIAS, row.bias.tolist(), strict=True)),
            interior_change_m=row.interior,
            offset_change_m=dict(zip(OFFSET, row.offset.tolist(), strict=True)),
            most=row.most_sigmas[0],
            most_sigmas=row.most_sigmas[1],
            one_sigma_at=row.size / row.most_sigmas[1] if row.most_sigmas[1] else None,
            warned_from=row.warned,
            chi_square_change=row.fit,
            p_value=row.p_value,
            after=ErrorNumbers(*row.after),
        )


@dataclass(frozen=True)
class SurpriseNumbers:
    """An estimate beyond what is expected of it."""

    name: str
    change: float
    expected_sigma: float
    ratio: float
    unit: str

    @classmethod
    def of(cls, one: Surprise) -> Self:
        """Of one unknown."""
        return cls(one.name, one.change, one.expected, one.ratio, unit(one.name))


@dataclass(frozen=True)
class MeasuredNumbers:
    """A measured pass: its points, what screening left out, ground sample distance.

    sigma_factor: line -> on the sigmas of its image points, by the residuals. check_chi_square: of the check points'
    rays by the pass's own parameters, with check_degrees_of_freedom.
    """

    control_points: int
    tie_points: int
    check_points: int
    image_points: Mapping[str, int]
    gsd_m: Mapping[str, Sequence[float]]
    rejected: Sequence[Sequence[str]]
    rejected_check_points: Sequence[str]
    sigma_factor: Mapping[str, float] | None
    check_chi_square: float
    check_degrees_of_freedom: int

    @classmethod
    def of(cls, one: FieldPass, rejected: Rejected | None, meeting: Meeting) -> Self:
        """Of one pass."""
        ties = len(next(iter(one.tie_images.values())).point) if one.tie_images else 0
        return cls(
            control_points=int(one.is_control.sum()),
            tie_points=int((~one.is_control).sum()) + ties,
            check_points=len(one.check_ground),
            image_points={name: len(row.point) for name, row in one.measurements.images.items()},
            gsd_m={name: ground_sample(one, name) for name in one.data.sensors},
            rejected=[] if rejected is None else rejected.points,
            rejected_check_points=[] if rejected is None else rejected.check_points,
            sigma_factor=None if rejected is None else rejected.factors,
            check_chi_square=meeting.chi_square,
            check_degrees_of_freedom=meeting.degrees_of_freedom,
        )


@dataclass(frozen=True)
class CalibrationNumbers:
    """calibration.json."""

    seed: int
    parameters: Mapping[str, ParameterNumbers]
    sigmas: SigmaNotes
    correlations: CorrelationNumbers
    null_vectors: Sequence[CombinationNumbers]
    weak_vectors: Sequence[CombinationNumbers]
    gauge: str
    images: ImageNumbers | None
    measured: Mapping[str, MeasuredNumbers] | None
    fit: FitNumbers
    chip_steps: Sequence[StepNumbers]
    stepwise: StepwiseNumbers
    fields: Mapping[str, FieldNumbers]
    schemes: Mapping[str, Mapping[str, ErrorNumbers]]
    scheme_fields: Mapping[str, Sequence[str] | str]
    before: Mapping[str, ErrorNumbers]
    finding: MeanNumbers | None
    bias_latitude: Mapping[str, LatitudeNumbers]
    repeatability: Sequence[RepeatabilityNumbers]
    light: Sequence[LightNumbers]
    light_corrected: bool
    datum: Sequence[DatumNumbers]
    surprises: Sequence[SurpriseNumbers]
    campaigns: CampaignNumbers | None
    monitoring: MonitoringNumbers | None
    strips: StripNumbers | None
    verdict: VerdictNumbers

    @classmethod
    def of(cls, run: CalibrationRun) -> Self:
        """Of a run."""
        found, campaign, spec, way = run.together, run.campaign, run.campaign.spec, run.stepwise
        limits = spec.limits
        return cls(
            seed=run.seed,
            parameters=ParameterNumbers.of(run),
            sigmas=SigmaNotes.of(run),
            correlations=CorrelationNumbers.of(run),
            null_vectors=CombinationNumbers.of(found.open),
            weak_vectors=CombinationNumbers.of(found.weak),
            gauge=str(found.gauge),
            images=None if campaign.images is None else ImageNumbers.of(campaign.images),
            measured=None
            if run.truth is not None
            else {
                p.name: MeasuredNumbers.of(
                    p, campaign.rejected.get(p.name), meeting_of(campaign, p, run.fields[p.name].adjustment)
                )
                for p in campaign.passes
            },
            fit=FitNumbers(
                found.chi_square,
                found.degrees_of_freedom,
                found.p_value,
                found.iterations,
                DriftNumbers.of(campaign, found),
            ),
            chip_steps=StepNumbers.of(campaign, found),
            stepwise=StepwiseNumbers(spec.schemes[0][0], way.rounds, way.rate, way.converged),
            fields={p.name: FieldNumbers.of(p, run.fields[p.name]) for p in campaign.passes},
            schemes={scheme: ErrorNumbers.by_field(errors) for scheme, errors in run.schemes.items()},
            scheme_fields={
                scheme: spec.schemes[k] if k < len(spec.schemes) else "each its own"
                for k, scheme in enumerate(run.schemes)
            },
            before=ErrorNumbers.by_field(run.before),
            finding=None if run.scheme_means is None else MeanNumbers.of(run.scheme_means),
            bias_latitude={f.axis: LatitudeNumbers.of(f) for f in run.latitude},
            repeatability=[RepeatabilityNumbers.of(r) for r in repeatability(run)],
            light=[LightNumbers.of(row) for row in run.light],
            light_corrected=bool(spec.effects.corrected),
            datum=[DatumNumbers.of(row) for row in run.datum],
            surprises=[SurpriseNumbers.of(s) for s in run.surprises],
            campaigns=None if run.repeats is None else CampaignNumbers.of(run.repeats, limits.plan, limits.height),
            monitoring=None if run.monitoring is None else MonitoringNumbers.of(run.monitoring),
            strips=None if run.strips is None else StripNumbers.of(run.strips, run.schemes),
            verdict=VerdictNumbers.of(run),
        )


def calibration_numbers(run: CalibrationRun) -> dict[str, Any]:
    """Contents of calibration.json without its frames; what is not defined is None."""
    return dict(plain_data(CalibrationNumbers.of(run)))
