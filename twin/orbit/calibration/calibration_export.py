"""What a calibration was made from, as a folder of tables with a test file that reads them back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.orbit.calibration_parameters import level_covariance
from scenes.specs.orbit.setup import AnyCalibration, MeasuredCalibrationSetup
from scenes.yaml.yaml_file import dump_yaml
from twin.orbit.calibration.calibration_run import CalibrationRun
from twin.orbit.calibration.campaign import Campaign
from twin.orbit.flight.line_camera import LineTimes
from twin.orbit.flight.platform_table import PlatformTable
from twin.orbit.images.image_points import BEYOND
from twin.orbit.measured.measurement_tables import CAMERA_FILE, campaign_files
from twin.orbit.measured.pass_measurements import GroundPoints, ImagePoints, PassMeasurements

if TYPE_CHECKING:
    from twin.orbit.images.simulate_run import Simulation

TEST_FILE = "calibrate.yaml"
_EXACT = 1e-3
"""Metres; of control without errors."""


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


def simulation_exported(run: Simulation) -> dict[str, str]:
    """Path -> text of the files of one pass over a patch, whose points were measured in its images.

    Raises:
        InputError: the test measures no points.
    """
    spec = run.spec
    if run.points is None or run.points.control is None or spec.points is None:
        raise spec.error("images alone give no tables", ("points",), allowed="`points:` with control and check points")
    errors = spec.errors
    plain = spec.plain()
    platform = PlatformTable.sampled(run.measured, errors.gps.interval, errors.star_tracker.interval)
    lines = max(int((run.measured.last - run.measured.first) / spec.line_time) - 1, 1)
    times = LineTimes.even(run.measured.first + 0.5 * spec.line_time, spec.line_time, lines)
    known = run.points.control
    sorts = [known] if run.points.ties is None else [known, run.points.ties]
    role = np.concatenate([np.where(known.check, "check", "control"), *(["tie"] * len(s.ground) for s in sorts[1:])])
    letter = {"control": "c", "check": "k", "tie": "t"}
    ids = [f"{letter[r]}{k}" for k, r in enumerate(role.tolist())]
    ground = np.concatenate([known.ground, *(np.full((len(s.ground), 3), np.nan) for s in sorts[1:])])
    covariance = np.zeros((len(role), 3, 3))
    # one error in plan moves all points of a patch: each of n weighs as if it had n times the variance
    share = float(np.sqrt(max(int(np.sum(known.in_all & ~known.check)), 1)))
    plan, tall = max(spec.control.sigma * share, _EXACT), max(spec.points.height_sigma, _EXACT)
    covariance[: len(known.ground)] = level_covariance(known.ground, plan, tall)
    images = {}
    for name in known.lines:
        parts, first = [], 0
        for sort in sorts:
            line = sort.lines[name]
            good = np.flatnonzero(line.accepted)
            place, spread = line.image[good], line.covariance[good] + BEYOND**2 * np.eye(2)
            parts.append((good + first, place[:, 0], place[:, 1], spread))
            first += len(sort.ground)
        images[name] = ImagePoints.of(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    points = GroundPoints.of(ids, ground, covariance, role.astype(object))
    one = PassMeasurements(spec.name, platform, dict.fromkeys(known.lines, times), points, images)
    gps, tracker = plain["errors"]["gps"], plain["errors"]["star_tracker"]
    test = {
        "name": spec.name,
        "description": spec.description,
        "camera": f"./{CAMERA_FILE}",
        "data": ".",
        "schemes": [[spec.name]],
        "effects": {**plain["effects"], "corrected": True},
        "errors": {
            "gps": {key: gps[key] for key in ("noise", "drift", "interval")},
            "star_tracker": {key: tracker[key] for key in ("noise", "slow", "interval")},
        },
    }
    return campaign_files([one], run.laboratory.plain()) | {TEST_FILE: dump_yaml(test)}
