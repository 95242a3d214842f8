"""Calibration of a camera in orbit over fields of points (paper 003, Mo et al. 2015).

All fields are calibrated in one simultaneous adjustment, and each field by itself as in paper 003, from the
measurements alone; the simulated truth is used only to compare estimates with it. `exported` writes the measurements as
a folder of tables with a test file that reads them back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.calibration.adjustment import Adjustment, FarPointsError, NoiseError
from analysis.calibration.strip_adjustment import Stepwise, stepwise
from analysis.orbit.calibration_parameters import OFFSET, RATE, RankError
from analysis.orbit.forward_intersection import CheckErrors, ThirdDifference, third_difference
from analysis.orbit.three_line_model import BIAS, INTERIOR
from optics.numerics.backend import one_blas_thread
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.calibration import LEAST_TIES
from scenes.specs.orbit.setup import MeasuredCalibrationSetup
from scenes.yaml.yaml_file import dump_yaml
from twin.framework.memory import Lowered, require_memory
from twin.framework.procedure import Advance, BenchError, silent
from twin.orbit.calibration import campaign_adjustment, influences
from twin.orbit.calibration import schemes as scheme_tests
from twin.orbit.calibration.campaign import Campaign, FieldPass, campaign_of
from twin.orbit.calibration.flown_campaign import fly_fields
from twin.orbit.measured import measurement_tables

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.setup import AnyCalibration, CalibrationSetup

_EVEN = 1e-3
"""Largest relative deviation of an interval between readings from their median interval for which the readings count as
evenly spaced.
"""
_LEAST_EVEN = 5
"""Smallest number of evenly spaced readings from which third differences are computed."""
STEPWISE_TOLERANCE = 1e-3
"""Largest change of an unknown in the last round of the stepwise solution, in sigmas, at which it counts as converged.
"""
_TIE = 1.7e5
"""Memory that the adjustment of a strip needs per tie point, line and field, in bytes, including the spline
coefficients of the attitude that the point determines.
"""


@dataclass(frozen=True, eq=False)
class FieldResult:
    """Calibration of a single field, with the twelve unknowns of paper 003 (Mo et al. 2015).

    The unknowns are principal distance f and principal point x, y of three lines, and the attitude biases roll, pitch,
    yaw.

    Attributes
    ----------
    adjustment : Adjustment
        Adjustment of this field alone.
    orbit : ThirdDifference or None
        Third differences of the measured positions, in ITRS; None for fewer than five evenly spaced readings.
    attitude : ThirdDifference or None
        Third differences of the measured attitude against the orbital frame (roll, pitch, yaw), from readings within
        those of the orbit; None for fewer than five evenly spaced readings.
    """

    adjustment: Adjustment
    orbit: ThirdDifference | None
    attitude: ThirdDifference | None


@dataclass(frozen=True, eq=False)
class CalibrationRun:
    """All results of a calibration in orbit.

    Attributes
    ----------
    setup : AnyCalibration
        Resolved test file and camera.
    seed : int
        Seed of all random numbers.
    campaign : Campaign
        Measurements of all passes, and their truth where it is known.
    together : Adjustment
        Simultaneous adjustment of all fields, with the offsets of the orbit and, where the fit against latitude
        determines it, the drift of the biases during the passes.
    truth : (P,) ndarray for P unknowns, or None
        True values of the unknowns of `together`, in metres and radians; None for measured passes.
    fields : Mapping[str, FieldResult]
        Calibration of each field by itself, by name of the field.
    stepwise : Stepwise
        Stepwise solution of the first field of the first scheme, bias and interior orientation in turn.
    before : Mapping[str, CheckErrors]
        Errors at the check points with the laboratory's camera, by field.
    schemes : Mapping[str, Mapping[str, CheckErrors]]
        Scheme (set of fields whose parameters are averaged), counted from "1" -> field -> errors at its check points;
        in the last scheme each field uses its own parameters.
    scheme_means : SchemeMeans or None
        Means of the errors over the fields; None where there is only one scheme of averaged parameters.
    latitude : tuple of LatitudeFit
        Fits of the biases against latitude: roll, pitch, yaw; empty for too few fields.
    repeatability : tuple of Repeatability
        Scatter of the parameters from field to field; empty for a single field.
    unexpected_changes : tuple of UnexpectedChange
        Estimates that differ from their expected values by more than `UNEXPECTED_SIGMAS` sigmas.
    drift : AttitudeDrift
        Drift of the attitude within the passes, tested on the residuals.
    chip_steps : tuple of ChipStep
        Steps between the chips of a line, tested on the residuals.
    monitoring : Monitoring or None
        Comparison of calibrations with and without the on-board monitor; None for cameras without a monitor.
    strips : Strips or None
        Passes adjusted on tie points; None where the file asks for none.
    """

    setup: AnyCalibration
    seed: int
    campaign: Campaign
    together: Adjustment
    truth: np.ndarray | None
    fields: Mapping[str, FieldResult]
    stepwise: Stepwise
    before: Mapping[str, CheckErrors]
    schemes: Mapping[str, Mapping[str, CheckErrors]]
    scheme_means: scheme_tests.SchemeMeans | None
    latitude: tuple[campaign_adjustment.LatitudeFit, ...]
    repeatability: tuple[scheme_tests.Repeatability, ...]
    unexpected_changes: tuple[influences.UnexpectedChange, ...]
    drift: influences.AttitudeDrift
    chip_steps: tuple[influences.ChipStep, ...]
    monitoring: scheme_tests.Monitoring | None
    strips: scheme_tests.Strips | None

    @property
    def within_limits(self) -> list[str]:
        """Names of the schemes with which every field meets the limits of the test's file."""
        return [name for name, errors in self.schemes.items() if scheme_tests.meets(errors, self.setup.test.limits)]


def unit(name: str) -> str:
    """Return the SI unit of an unknown by its name."""
    if name.endswith(RATE):
        return "rad/s"
    return "rad" if name.split()[-1] in BIAS else "m"


@dataclass(frozen=True)
class Unknown:
    """Unknown of the adjustment of all fields, in SI units.

    Attributes
    ----------
    name : str
        Name of the unknown.
    value : float
        Estimated value.
    sigma : float
        Standard deviation if the unknowns that the gauge fixes are exact; 0 for the fixed ones.
    sigma_with_gauge : float
        Standard deviation that includes the uncertainty, after launch, of the unknowns that the gauge fixes.
    prior_share : float
        Share of the variance, 0 to 1, that comes from the prior sigmas (changes at launch and with the season) and not
        from the points.
    held : bool
        True where the gauge fixes the unknown at its laboratory value.
    truth : float or None
        True value; None for measured passes.
    """

    name: str
    value: float
    sigma: float
    sigma_with_gauge: float
    prior_share: float
    held: bool
    truth: float | None

    @property
    def unit(self) -> str:
        """SI unit of value, sigmas and truth."""
        return unit(self.name)


def unknowns(run: CalibrationRun) -> dict[str, Unknown]:
    """Return the unknowns of the adjustment of all fields, by name."""
    adjustment = run.together
    sigma, held = adjustment.sigma, adjustment.gauge.held
    whole = adjustment.sigma_with(dict.fromkeys(held, run.campaign.spec.launch.interior))
    truth = [None] * len(adjustment.names) if run.truth is None else run.truth.tolist()
    values, shares = adjustment.values.tolist(), adjustment.prior_share.tolist()
    rows = zip(adjustment.names, values, shares, truth, strict=True)
    return {n: Unknown(n, value, sigma[n], whole[n], share, n in held, true) for n, value, share, true in rows}


@one_blas_thread()  # of small matrices: threads would only wait for each other
def run_calibration(
    setup: AnyCalibration, backend: Backend | None, seed: int, advance: Advance = silent
) -> CalibrationRun:
    """Simulate or read the passes, calibrate, and test on the check points: ``python -m twin.orbit calibrate``.

    Nothing is ray-traced: the backend is not used.

    Raises
    ------
    BenchError
        The orbit, the points or the adjustment do not allow a calibration.
    """
    try:
        return _run(setup, seed, advance)
    except ValueError as error:
        key, remedy = _key_and_remedy(error, isinstance(setup, MeasuredCalibrationSetup))
        raise BenchError(str(error), key, remedy) from error


_NOISE_KEYS = {
    "attitude": ("errors", "star_tracker", "noise"),
    "slow attitude": ("errors", "star_tracker", "slow"),
    "station": ("errors", "gps", "noise"),
}
"""Source of noise -> its key in the file. Image and control points are not included: they have separate keys in a
simulation, and sigmas in tables of measurements.
"""


def _key_and_remedy(error: ValueError, measured: bool) -> tuple[tuple[str, ...], str]:
    """Return the key of the file to change and the remedy, for an error of the adjustment."""
    if isinstance(error, RankError):
        return ("data" if measured else "points",), "a field with width and length, and more points"
    if isinstance(error, NoiseError):
        tables = {"image": "image_points", "control": "ground"}
        key = ("data",) if measured else ("errors", error.largest)
        table = f"in the table {tables[error.largest]}" if measured and error.largest in tables else "there"
        return _NOISE_KEYS.get(error.largest, key), f"smaller sigmas {table}; are their units right?"
    if isinstance(error, FarPointsError):
        if measured:
            remedy = "check the points' names and datum, the epoch, the conventions (`twin.orbit check`)"
            return ("data",), f"{remedy}, state a larger launch.bias, or reject points (`screening: robust`)"
        return ("errors",), "a datum and biases within the range that launch.bias allows"
    if measured:
        return ("data",), measurement_tables.LINES_SEE_POINTS
    return ("errors",), "errors that an adjustment can take, and more points"


def _require_memory(setup: CalibrationSetup) -> None:
    """Raise an error if the adjustments of all strips, which need the most memory, do not fit into the memory."""
    test, strip = setup.test, setup.test.strip
    if strip is not None:
        each = len(setup.camera.lines) * len(test.fields) * _TIE
        require_memory(Lowered(test, ("strip", "ties"), strip.ties, "tie points", lambda ties: ties * each, LEAST_TIES))


def _run(setup: AnyCalibration, seed: int, advance: Advance) -> CalibrationRun:
    if not isinstance(setup, MeasuredCalibrationSetup):
        _require_memory(setup)
    campaign = source_of(setup, np.random.SeedSequence(seed).spawn(1)[0], advance)
    parts = 3 + len(campaign.passes)
    advance("calibration", 1, parts)
    latitude = campaign_adjustment.latitude_fits(campaign, campaign_adjustment.simultaneous(campaign))
    rates = campaign_adjustment.rate_priors(campaign, latitude)
    campaign = campaign_adjustment.with_detected_drift(campaign, rates)
    together = campaign_adjustment.simultaneous(campaign, rates)
    advance("calibration", 2, parts)
    fields = {}
    for k, flight in enumerate(campaign.passes):
        adjustment = campaign_adjustment.calibrated_alone(campaign, flight)
        fields[flight.name] = FieldResult(adjustment, *third_differences(flight))
        advance("calibration", 3 + k, parts)
    first = campaign.spec.schemes[0][0]
    control = next(p.control for p in campaign.passes if p.name == first)
    held, cameras = campaign_adjustment.gauge_of(campaign).held, campaign.laboratory
    stepwise_result = stepwise([control], cameras, campaign.noise, held=held, tolerance=STEPWISE_TOLERANCE)
    alone = {name: result.adjustment for name, result in fields.items()}
    schemes = scheme_tests.scheme_errors(campaign, alone)
    advance("calibration", parts, parts)
    return CalibrationRun(
        setup,
        seed,
        campaign,
        together,
        None if campaign.known_truth is None else true_values(campaign, together.names),
        FrozenMap(fields),
        stepwise_result,
        scheme_tests.laboratory_errors(campaign),
        schemes,
        scheme_tests.SchemeMeans.of(schemes),
        latitude,
        scheme_tests.repeatability(campaign, alone),
        influences.unexpected_changes(campaign, together),
        influences.AttitudeDrift.of(campaign, together),
        influences.ChipStep.of(campaign, together),
        scheme_tests.Monitoring.of(campaign),
        scheme_tests.adjust_strips(campaign, advance),
    )


def source_of(setup: AnyCalibration, seed: np.random.SeedSequence, advance: Advance = silent) -> Campaign:
    """Return the campaign of a test: read from its files if it names measurements, otherwise simulated.

    Points measured in images are screened for gross errors.

    Parameters
    ----------
    setup : AnyCalibration
        Resolved test file and camera.
    seed : np.random.SeedSequence
        Seed of a simulation.
    advance : Advance
        Callback that reports the progress.

    Raises
    ------
    InputError
        Files cannot be used.
    BenchError, CalibrationError
        The passes cannot be simulated, or their points cannot be used.
    """
    if isinstance(setup, MeasuredCalibrationSetup):
        measured = measurement_tables.read_measurements(setup.data, setup.camera, advance)
        campaign = campaign_of(setup.test, setup.camera, measured, setup.test.ties == "apart")
        if setup.test.screening == "robust":
            return campaign_adjustment.screen_campaign(campaign)
        campaign_adjustment.require_correct_names(campaign)
        return campaign
    campaign = fly_fields(setup, seed, advance)
    return campaign_adjustment.screen_campaign(campaign) if campaign.images is not None else campaign


def true_values(campaign: Campaign, names: tuple[str, ...]) -> np.ndarray:
    """Return the (P,) true values of the P named unknowns, in metres and radians.

    Biases and offsets are those at the middle of the field, rates the mean of the fields.
    """
    values = {
        f"{line} {name}": value
        for line, camera in campaign.truth.items()
        for name, value in zip(INTERIOR, camera.interior, strict=True)
    }
    for flight in campaign.passes:
        values |= {f"{flight.name} {name}": v for name, v in zip(BIAS, flight.bias, strict=True)}
        values |= {f"{flight.name} offset {name}": v for name, v in zip(OFFSET, flight.truth.offset, strict=True)}
    rates = [(flight.truth.bias_at(1.0) - flight.truth.bias_at(-1.0)) / 2.0 for flight in campaign.passes]
    values |= dict(zip(RATE, np.mean(rates, axis=0), strict=True))
    for flight, rate in zip(campaign.passes, rates, strict=True):
        values |= {f"{flight.name} {name}": v for name, v in zip(RATE, rate, strict=True)}
    return np.array([values[name] for name in names])


def third_differences(flight: FieldPass) -> tuple[ThirdDifference | None, ThirdDifference | None]:
    """Return third differences of a pass's orbit and attitude readings; None for fewer than five even readings."""
    measured, table = flight.measured, flight.measured.table
    fixes, looks = _even(table.orbit_time), _even(table.attitude_time[measured.covers(table.attitude_time)])
    positions = table.position[np.isin(table.orbit_time, fixes)]
    rotation = np.swapaxes(measured.orbital_to_itrs(looks), 1, 2) @ measured.body_to_itrs(looks)
    # small angles: the skew part of the rotation
    skew = 0.5 * (rotation - np.swapaxes(rotation, 1, 2))
    angles = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=-1)
    orbit, attitude = (
        third_difference(time, values) if len(time) >= _LEAST_EVEN else None
        for time, values in ((fixes, positions), (looks, angles))
    )
    return orbit, attitude


def _even(time: np.ndarray) -> np.ndarray:
    """Return the times of the longest run of evenly spaced readings."""
    if len(time) < 2:
        return time
    step = np.diff(time)
    even = np.abs(step - np.median(step)) < _EVEN * np.median(step)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], even, [False]]).astype(int)))
    begin, end = max(edges.reshape(-1, 2).tolist(), key=lambda run: run[1] - run[0])
    return np.asarray(time[begin : end + 1])


def exported(run: CalibrationRun) -> dict[str, str]:
    """Return the files of a calibration's measurements, path -> text, including points that screening rejected."""
    return files_of(run.setup, run.campaign)


def files_of(setup: AnyCalibration, campaign: Campaign) -> dict[str, str]:
    """Return the files of a campaign, path -> text; the campaign need not be calibrated."""
    files = measurement_tables.campaign_files([flight.measurements for flight in campaign.passes], setup.camera.plain())
    return files | {measurement_tables.TEST_FILE: dump_yaml(_test(setup))}


def _test(setup: AnyCalibration) -> dict[str, Any]:
    """Return the content of a test file for the exported measurements, with the test's schemes, sigmas and limits."""
    spec = setup.test
    plain: Mapping[str, Any] = spec.plain()
    error_spec = plain["errors"]
    common = {
        "name": spec.name,
        "description": spec.description,
        "camera": f"./{measurement_tables.CAMERA_FILE}",
        "data": ".",
        "schemes": plain["schemes"],
        **{key: plain[key] for key in ("effects", "launch", "limits")},
        "strip": bool(spec.strip),
    }
    if isinstance(setup, MeasuredCalibrationSetup):
        return common | {"errors": error_spec, "screening": setup.test.screening, "ties": setup.test.ties}
    gps, tracker = error_spec["gps"], error_spec["star_tracker"]
    errors = {
        "gps": {key: gps[key] for key in ("noise", "drift", "interval")},
        "star_tracker": {key: tracker[key] for key in ("noise", "slow", "interval")},
        "season": error_spec["season"],
    }
    if not setup.test.errors.switched_on:
        nothing = {"noise": ["0 m"] * 3, "interval": gps["interval"]}
        errors = {"gps": nothing, "star_tracker": {"noise": ["0 arcsec"] * 3, "interval": tracker["interval"]}}
    drawn = setup.test.images is None
    # simulated points have errors according to their sigmas, and no gross errors
    return common | {
        "errors": errors,
        "screening": "none" if drawn else "robust",
        "ties": "apart" if drawn else "with_control",
    }
