"""What functions of orbit and laboratory refuse that no file of a command's tests leads to."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace as Ns
from typing import Any

import numpy as np
import pytest

from scenes.yaml.errors import InputError
from twin.laboratory.distortion_run import _check_angles
from twin.orbit.angle.angle_flight import angle_camera
from twin.orbit.export.export_run import read_exportable
from twin.orbit.export.rational_polynomial import RationalPolynomial
from twin.orbit.images.image_points import PointsError, measure_points
from twin.orbit.images.line_optics import optics_of
from twin.orbit.images.point_judgement import true_ground
from twin.orbit.jitter.sights import SightsError, sights_of
from twin.orbit.monitoring.monitor_series import MonitorSeries

FILE = Path("scene.ntf")
PLACES = np.column_stack([np.zeros((2, 3)), [-179.9, 179.9], np.zeros(2)])
SPOT = Ns(reading=np.ones((1, 1)), lines=np.full((1, 1), 3), file=Ns(file="spots.csv"), head="reading [deg]")
UNMADE: Any = Ns(setup=None, test=None, camera=None, instrument=None, images={"nadir": 1}, kind="other", name="th1")
CASES: list[tuple[Callable[[], object], type[Exception], str]] = [
    (lambda: measure_points(UNMADE, Ns(tie=1)), PointsError, "tie points need two lines"),
    (lambda: true_ground(UNMADE, UNMADE), ValueError, "points are of kind map or tie, not 'other'"),
    (
        lambda: optics_of(Ns(name="th1", image_of={}.get), ["nadir"], 1e-3, {}),
        ValueError,
        "how its line nadir forms an",
    ),
    (lambda: angle_camera(UNMADE, None), ValueError, "an instrument's lines need a backend"),
    (lambda: RationalPolynomial.through(PLACES, PLACES), ValueError, "the 180th meridian or a pole"),
    (lambda: sights_of(UNMADE, {}, ("blue",), None, None), SightsError, "no image points of blue"),
    (
        lambda: MonitorSeries.smoothed(Ns(experiment=Ns(disturbances=None)), Ns(noise=1), 1.0),
        ValueError,
        "needs stated",
    ),
    (lambda: _check_angles(None, SPOT, 0.0), InputError, "spots.csv:3: reading.*an angle beyond any field"),
    (lambda: read_exportable(FILE, 1, None), InputError, "a NITF file, which is not read"),
    (
        lambda: read_exportable(FILE.with_suffix(".yaml"), 1, "B0"),
        InputError,
        "only the scene of a DIMAP file has bands",
    ),
]


@pytest.mark.parametrize("case", CASES, ids=[words for _, _, words in CASES])
def test_what_is_refused(case: tuple[Any, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    FILE.write_text("NITF")
    call, error, words = case
    with pytest.raises(error, match=words):
        call()
