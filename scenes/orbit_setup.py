"""A test in orbit together with everything it refers to."""

from collections.abc import Iterable
from pathlib import Path

from scenes.errors import names_text, nearest
from scenes.experiment import ExperimentSetup, read_setup
from scenes.load import find_payload, load_orbit_test, load_three_line_camera
from scenes.orbit_angle import LINES, OrbitAngleSpec
from scenes.orbit_calibration import OrbitCalibrationSpec
from scenes.spec import Spec
from scenes.three_line_camera import ThreeLineCameraSpec


class AngleSetup(ExperimentSetup[OrbitAngleSpec]):
    """An intersection-angle test with its camera.

    Attributes:
        camera: the payload.
    """

    camera: ThreeLineCameraSpec


def resolve_angle(path: str | Path) -> AngleSetup:
    """Read a test and the camera it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid, or test and camera do not fit.
    """
    setup = read_setup(AngleSetup, path)
    if setup is None:
        test = load_orbit_test(OrbitAngleSpec, path)
        setup = AngleSetup.model_construct(test=test, camera=load_three_line_camera(find_payload(test)))
    _require_fit(setup.test, setup.camera)
    return setup


class CalibrationSetup(ExperimentSetup[OrbitCalibrationSpec]):
    """An in-orbit calibration with its camera.

    Attributes:
        camera: the payload.
    """

    camera: ThreeLineCameraSpec


def resolve_calibration(path: str | Path) -> CalibrationSetup:
    """Read a calibration and the camera it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid, or test and camera do not fit.
    """
    setup = read_setup(CalibrationSetup, path)
    if setup is None:
        test = load_orbit_test(OrbitCalibrationSpec, path)
        setup = CalibrationSetup.model_construct(test=test, camera=load_three_line_camera(find_payload(test)))
    _require_calibration(setup.test, setup.camera)
    return setup


def _require_calibration(test: OrbitCalibrationSpec, camera: ThreeLineCameraSpec) -> None:
    """InputError unless the camera has exactly the three lines, and points and changes lie on them."""
    if set(camera.lines) != set(LINES):
        found = f"{names_text(tuple(camera.lines))} in {camera.name}"
        problem = "the camera has other lines than three"
        raise test.error(problem, ("camera",), found=found, allowed=_THREE_LINES)
    _require_lines(test, test.changes)
    if "nadir" in test.changes and any(test.changes["nadir"].principal_point):
        raise test.error(
            "the nadir line's principal point is the gauge",
            ("changes", "nadir", "principal_point"),
            allowed="no change; turn the whole camera instead, by errors.star_tracker.bias",
        )
    _require_pixels(test, "points", (test.points.first, test.points.last), camera)


def _require_fit(test: OrbitAngleSpec, camera: ThreeLineCameraSpec) -> None:
    """InputError unless the camera has the three lines, and the strips and changes lie on them."""
    if missing := [name for name in LINES if name not in camera.lines]:
        found = f"{names_text(tuple(camera.lines))} in {camera.name}"
        problem = f"the camera has no {' and no '.join(missing)} line"
        raise test.error(problem, ("camera",), found=found, allowed=_THREE_LINES)
    _require_lines(test, test.changes)
    _require_pixels(test, "strips", (test.strips.first, test.strips.last), camera)


_THREE_LINES = "a camera with lines forward, nadir and aft"


def _require_lines(test: Spec, changes: Iterable[str]) -> None:
    """InputError unless every change is one of a line."""
    for name in changes:
        if name not in LINES:
            raise test.error(
                "no such line", ("changes", name), allowed=names_text(LINES), suggestion=nearest(name, LINES)
            )


def _require_pixels(test: Spec, section: str, ends: tuple[float, float], camera: ThreeLineCameraSpec) -> None:
    """InputError unless ``first`` and ``last`` of a section lie on the camera's lines."""
    last = camera.pixels - 0.5
    for key, pixel in zip(("first", "last"), ends, strict=True):
        if not -0.5 <= pixel <= last:
            allowed = f"-0.5 to {last:g}, the ends of the lines of {camera.name}"
            raise test.error("outside the line", (section, key), found=f"pixel {pixel:g}", allowed=allowed)
