"""Calibration over fields by simultaneous adjustment, and each field by itself as in paper 003; all that is computed
from the measurements of a campaign. Truth enters only where an estimate is compared with it.

What a calibration was made from, as a folder of tables with a test file that reads them back.
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
from twin.orbit.calibration.campaign import Campaign, FieldPass, campaign_of
from twin.orbit.calibration.campaign_adjustment import (
    LatitudeFit,
    calibrated_alone,
    drift_looked_for,
    gauge_of,
    latitude_fits,
    rate_priors,
    simultaneous,
)
from twin.orbit.calibration.flown_campaign import fly_fields
from twin.orbit.calibration.influences import (
    AttitudeDrift,
    ChipStep,
    DatumRow,
    LightRow,
    Surprise,
    datum_rows,
    light_rows,
    surprises,
)
from twin.orbit.calibration.schemes import (
    Monitoring,
    Repeatability,
    Repeats,
    SchemeMeans,
    Strips,
    meets,
    monitored,
    repeatability,
    repeated,
    schemes_tested,
    strips_adjusted,
    tested_before,
)
from twin.orbit.calibration.screening import require_labelled, screened
from twin.orbit.measured.measurement_tables import CAMERA_FILE, TEST_FILE, campaign_files, read_measurements

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.setup import AnyCalibration, CalibrationSetup

_EVEN = 1e-3
"""Largest deviation of an interval between readings from their median interval, relative, for even times."""
_LEAST_EVEN = 5
"""Readings that third differences take."""
STEPWISE_TOLERANCE = 1e-3
"""Largest last step of a round of the stepwise solution, in sigmas."""
_TIE = 1.7e5
"""Bytes per tie point of a strip, in each line and field, with the splines that it determines."""


@dataclass(frozen=True, eq=False)
class FieldResult:
    """A field calibrated by itself, with paper 003's twelve unknowns.

    Attributes
    ----------
    adjustment : Adjustment
        simultaneous.
    orbit : ThirdDifference | None
        Third differences of the measured positions, ITRS; None for fewer than five even readings.
    attitude : ThirdDifference | None
        Third differences of the measured attitude against the orbital frame, roll, pitch, yaw, by readings within the
        orbit's; None likewise.
    """

    adjustment: Adjustment
    orbit: ThirdDifference | None
    attitude: ThirdDifference | None


@dataclass(frozen=True, eq=False)
class CalibrationRun:
    """All that was computed.

    Attributes
    ----------
    setup : AnyCalibration
        What its file says.
    seed : int
        Of all random numbers.
    campaign : Campaign
        Truth and measurements.
    together : Adjustment
        Simultaneous adjustment of all fields, with the orbit's offsets and, where the latitude fit tells it, the drift
        of the biases during the passes.
    truth : np.ndarray | None
        (P,) true values of its unknowns; None where nobody knows them.
    fields : Mapping[str, FieldResult]
        Name -> that field by itself.
    stepwise : Stepwise
        The first scheme's first field by the stepwise solution, bias and interior in turn.
    before : Mapping[str, CheckErrors]
        Field -> errors with the laboratory's camera.
    schemes : Mapping[str, Mapping[str, CheckErrors]]
        Scheme, "1" on -> field -> errors; the last lets each field use its own parameters.
    scheme_means : SchemeMeans | None
        Over the fields; None for a single scheme of averaged parameters.
    latitude : tuple[LatitudeFit, ...]
        The biases against latitude, roll, pitch, yaw; empty for too few fields.
    repeatability : tuple[Repeatability, ...]
        Of the parameters from field to field; empty for one field.
    light : tuple[LightRow, ...]
        What effects on the light do where they are left in.
    datum : tuple[DatumRow, ...]
        What a wrong datum does.
    surprises : tuple[Surprise, ...]
        Estimates beyond what is expected of them.
    drift : AttitudeDrift
        Of the attitude within the passes, by the residuals.
    chip_steps : tuple[ChipStep, ...]
        Within the lines, by the residuals.
    repeats : Repeats | None
        Campaigns repeated with everything drawn anew; None for none.
    monitoring : Monitoring | None
        What a monitor of drifting cameras buys; None for cameras that keep.
    strips : Strips | None
        Passes adjusted on tie points; None for none.
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
    scheme_means: SchemeMeans | None
    latitude: tuple[LatitudeFit, ...]
    repeatability: tuple[Repeatability, ...]
    light: tuple[LightRow, ...]
    datum: tuple[DatumRow, ...]
    surprises: tuple[Surprise, ...]
    drift: AttitudeDrift
    chip_steps: tuple[ChipStep, ...]
    repeats: Repeats | None
    monitoring: Monitoring | None
    strips: Strips | None

    @property
    def within_limits(self) -> list[str]:
        """Schemes with which every field meets the limits of the test's file."""
        return [name for name, errors in self.schemes.items() if meets(errors, self.setup.test.limits)]


def unit(name: str) -> str:
    """SI unit of an unknown."""
    if name.endswith(RATE):
        return "rad/s"
    return "rad" if name.split()[-1] in BIAS else "m"


@dataclass(frozen=True)
class Unknown:
    """An unknown of the adjustment of all fields, in SI units.

    Attributes
    ----------
    name : str
        Of the unknown.
    value : float
        estimated.
    sigma : float
        With the gauge's held unknowns exact; 0 where held.
    sigma_with_gauge : float
        With what launch leaves to expect of the held unknowns.
    from_start : float
        Share of its variance that comes from the sigmas of launch and season, not from the points, 0 to 1.
    held : bool
        By the gauge.
    truth : float | None
        None where nobody knows it.
    """

    name: str
    value: float
    sigma: float
    sigma_with_gauge: float
    from_start: float
    held: bool
    truth: float | None

    @property
    def unit(self) -> str:
        """SI unit."""
        return unit(self.name)


def unknowns(run: CalibrationRun) -> dict[str, Unknown]:
    """Name -> unknown of the adjustment of all fields."""
    found = run.together
    sigma, held = found.sigma, found.gauge.held
    whole = found.sigma_with(dict.fromkeys(held, run.campaign.spec.launch.interior))
    truth = [None] * len(found.names) if run.truth is None else run.truth.tolist()
    return {
        name: Unknown(name, value, sigma[name], whole[name], share, name in held, true)
        for name, value, share, true in zip(
            found.names, found.values.tolist(), found.from_start.tolist(), truth, strict=True
        )
    }


@one_blas_thread()  # of small matrices: threads would only wait for each other
def run_calibration(
    setup: AnyCalibration, backend: Backend | None, seed: int, advance: Advance = silent
) -> CalibrationRun:
    """Fly or read, calibrate, test: ``python -m twin.orbit calibrate``. Nothing is traced: the backend is not used.

    Raises
    ------
    BenchError
        The orbit, the points or the adjustment do not allow it.
    """
    try:
        return _run(setup, seed, advance)
    except ValueError as error:
        key, remedy = _what_to_do(error, isinstance(setup, MeasuredCalibrationSetup))
        raise BenchError(str(error), key, remedy) from error


_NOISE_KEYS = {
    "attitude": ("errors", "star_tracker", "noise"),
    "slow attitude": ("errors", "star_tracker", "slow"),
    "station": ("errors", "gps", "noise"),
}
"""Source of noise -> its key; image and control points have keys of their own in a simulation, sigmas in tables."""


def _what_to_do(error: ValueError, measured: bool) -> tuple[tuple[str, ...], str]:
    """Key and remedy of an error of the adjustment, in a test on measurements or in a simulation."""
    if isinstance(error, RankError):
        return ("data" if measured else "points",), "a field with width and length, and more points"
    if isinstance(error, NoiseError):
        tables = {"image": "image_points", "control": "ground"}
        own = ("data",) if measured else ("errors", error.largest)
        table = f"in the table {tables[error.largest]}" if measured and error.largest in tables else "there"
        return _NOISE_KEYS.get(error.largest, own), f"smaller sigmas {table}; are their units right?"
    if isinstance(error, FarPointsError):
        if measured:
            remedy = "check the points' names and datum, the epoch, the conventions (`twin.orbit check`)"
            return ("data",), f"{remedy}, state a larger launch.bias, or leave points out (`screening: robust`)"
        return ("errors",), "a datum and biases within what launch.bias leaves to expect"
    if measured:
        return ("data",), "points whose names, images and coordinates belong together, and more of them"
    return ("errors",), "errors that an adjustment can take, and more points"


def _require_memory(setup: CalibrationSetup) -> None:
    """See whether the adjustments of all strips, which take the most, fit into the memory."""
    test, strip = setup.test, setup.test.strip
    if strip is not None:
        each = len(setup.camera.lines) * len(test.fields) * _TIE
        require_memory(Lowered(test, ("strip", "ties"), strip.ties, "tie points", lambda ties: ties * each, LEAST_TIES))


def _run(setup: AnyCalibration, seed: int, advance: Advance) -> CalibrationRun:
    if not isinstance(setup, MeasuredCalibrationSetup):
        _require_memory(setup)
    shown, others = np.random.SeedSequence(seed).spawn(2)
    campaign = source_of(setup, shown, advance)
    parts = 6 + len(campaign.passes)
    advance("calibration", 1, parts)
    latitude = latitude_fits(campaign, simultaneous(campaign))
    rates = rate_priors(campaign, latitude)
    campaign = drift_looked_for(campaign, rates)
    together = simultaneous(campaign, rates)
    advance("calibration", 2, parts)
    fields = {}
    for k, one in enumerate(campaign.passes):
        fields[one.name] = FieldResult(calibrated_alone(campaign, one), *third_differences(one))
        advance("calibration", 3 + k, parts)
    first = campaign.spec.schemes[0][0]
    control = next(p.control for p in campaign.passes if p.name == first)
    in_turn = stepwise(
        [control], campaign.laboratory, campaign.noise, held=gauge_of(campaign).held, tolerance=STEPWISE_TOLERANCE
    )
    alone = {name: result.adjustment for name, result in fields.items()}
    schemes = schemes_tested(campaign, alone)
    advance("calibration", parts - 3, parts)
    light = light_rows(campaign, together.sigma)
    advance("calibration", parts - 1, parts)
    datum = datum_rows(campaign)
    advance("calibration", parts, parts)
    return CalibrationRun(
        setup,
        seed,
        campaign,
        together,
        None if campaign.known_truth is None else true_values(campaign, together.names),
        FrozenMap(fields),
        in_turn,
        tested_before(campaign),
        schemes,
        SchemeMeans.of(schemes),
        latitude,
        repeatability(campaign, alone),
        light,
        datum,
        surprises(campaign, together),
        AttitudeDrift.of(campaign, together),
        ChipStep.of(campaign, together),
        None if isinstance(setup, MeasuredCalibrationSetup) else repeated(setup, others, advance),
        None if isinstance(setup, MeasuredCalibrationSetup) else monitored(setup, shown, advance),
        strips_adjusted(campaign, advance),
    )


def source_of(setup: AnyCalibration, seed: np.random.SeedSequence, advance: Advance = silent) -> Campaign:
    """The campaign of a test: read from its files where it names measurements, else flown; and screened where points
    were measured in images.

    Parameters
    ----------
    setup : AnyCalibration
        The test.
    seed : np.random.SeedSequence
        Of a simulation.
    advance : Advance
        How far it is.

    Raises
    ------
    InputError
        Files that cannot be used.
    BenchError, CalibrationError
        As `fly_fields`.
    """
    if isinstance(setup, MeasuredCalibrationSetup):
        measured = read_measurements(setup.data, setup.camera, advance)
        campaign = campaign_of(setup.test, setup.camera, measured, setup.test.ties == "apart")
        if setup.test.screening == "robust":
            return screened(campaign)
        require_labelled(campaign)
        return campaign
    campaign = fly_fields(setup, seed, advance)
    return screened(campaign) if campaign.images is not None else campaign


def true_values(campaign: Campaign, names: tuple[str, ...]) -> np.ndarray:
    """True values of unknowns (P,) by name, metres and radians; of biases and offsets, those at the field's middle, of
    rates the mean of the fields.
    """
    known = {
        f"{line} {name}": value
        for line, camera in campaign.truth.items()
        for name, value in zip(INTERIOR, camera.interior, strict=True)
    }
    for one in campaign.passes:
        known |= {f"{one.name} {name}": v for name, v in zip(BIAS, one.bias, strict=True)}
        known |= {f"{one.name} offset {name}": v for name, v in zip(OFFSET, one.truth.offset, strict=True)}
    rates = [(one.truth.bias_at(1.0) - one.truth.bias_at(-1.0)) / 2.0 for one in campaign.passes]
    known |= dict(zip(RATE, np.mean(rates, axis=0), strict=True))
    for one, own in zip(campaign.passes, rates, strict=True):
        known |= {f"{one.name} {name}": v for name, v in zip(RATE, own, strict=True)}
    return np.array([known[name] for name in names])


def third_differences(one: FieldPass) -> tuple[ThirdDifference | None, ThirdDifference | None]:
    """Return the third differences of orbit and attitude of a pass; None for fewer than five even readings."""
    measured, table = one.measured, one.measured.table
    fixes, looks = _even(table.orbit_time), _even(table.attitude_time[measured.known(table.attitude_time)])
    places = table.position[np.isin(table.orbit_time, fixes)]
    turned = np.swapaxes(measured.orbital_to_itrs(looks), 1, 2) @ measured.body_to_itrs(looks)
    # small angles: the skew part of the rotation
    skew = 0.5 * (turned - np.swapaxes(turned, 1, 2))
    angles = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=-1)
    orbit, attitude = (
        third_difference(time, values) if len(time) >= _LEAST_EVEN else None
        for time, values in ((fixes, places), (looks, angles))
    )
    return orbit, attitude


def _even(time: np.ndarray) -> np.ndarray:
    """Return the longest run of readings that are evenly spaced."""
    if len(time) < 2:
        return time
    step = np.diff(time)
    even = np.abs(step - np.median(step)) < _EVEN * np.median(step)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], even, [False]]).astype(int)))
    begin, end = max(edges.reshape(-1, 2).tolist(), key=lambda run: run[1] - run[0])
    return np.asarray(time[begin : end + 1])


def exported(run: CalibrationRun) -> dict[str, str]:
    """Path -> text of the files. Points that screening left out are in them, as they were measured."""
    return files_of(run.setup, run.campaign)


def files_of(setup: AnyCalibration, campaign: Campaign) -> dict[str, str]:
    """Path -> text of the files of a campaign, which need not be calibrated."""
    files = campaign_files([one.measurements for one in campaign.passes], setup.camera.plain())
    return files | {TEST_FILE: dump_yaml(_test(setup))}


def _test(setup: AnyCalibration) -> dict[str, Any]:
    """The test file: the same schemes, sigmas of readings, effects and limits."""
    spec = setup.test
    plain: Mapping[str, Any] = spec.plain()
    given = plain["errors"]
    common = {
        "name": spec.name,
        "description": spec.description,
        "camera": f"./{CAMERA_FILE}",
        "data": ".",
        "schemes": plain["schemes"],
        **{key: plain[key] for key in ("effects", "launch", "limits")},
        "strip": bool(spec.strip),
    }
    if isinstance(setup, MeasuredCalibrationSetup):
        return common | {"errors": given, "screening": setup.test.screening, "ties": setup.test.ties}
    gps, tracker = given["gps"], given["star_tracker"]
    errors = {
        "gps": {key: gps[key] for key in ("noise", "drift", "interval")},
        "star_tracker": {key: tracker[key] for key in ("noise", "slow", "interval")},
        "season": given["season"],
    }
    if not setup.test.errors.switched_on:
        nothing = {"noise": ["0 m"] * 3, "interval": gps["interval"]}
        errors = {"gps": nothing, "star_tracker": {"noise": ["0 arcsec"] * 3, "interval": tracker["interval"]}}
    drawn = setup.test.images is None
    # drawn points have the errors that their sigmas say, and no gross ones
    return common | {
        "errors": errors,
        "screening": "none" if drawn else "robust",
        "ties": "apart" if drawn else "with_control",
    }
