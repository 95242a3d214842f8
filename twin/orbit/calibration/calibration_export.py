"""What a calibration was made from, as a folder of tables with a test file that reads them back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scenes.specs.measured.orbit_data_setup import MeasuredCalibrationSetup
from scenes.yaml.yaml_file import dump_yaml
from twin.orbit.calibration.calibration_run import CalibrationRun
from twin.orbit.measured.measurement_files import CAMERA_FILE, campaign_files

TEST_FILE = "calibrate.yaml"


def exported(run: CalibrationRun) -> dict[str, str]:
    """Path -> text of the files. Points that screening left out are in them, as they were measured."""
    passes = [one.measurements for one in run.campaign.passes]
    files = campaign_files(passes, run.setup.camera.plain())
    return files | {TEST_FILE: dump_yaml(_test(run))}


def _test(run: CalibrationRun) -> dict[str, Any]:
    """The test file: the same schemes, sigmas of readings, effects and limits."""
    setup, spec = run.setup, run.setup.test
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
