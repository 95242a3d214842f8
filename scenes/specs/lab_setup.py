"""A laboratory test together with everything it refers to, so that one file says all that went into a run."""

from collections.abc import Mapping
from pathlib import Path

from optics.numerics.frozen_map import FrozenMap
from scenes.specs.camera import CameraSpec
from scenes.specs.camera_tests import DistortionTestSpec, FocusTestSpec
from scenes.specs.detector import DetectorSpec, require_detector
from scenes.specs.load import (
    find_camera,
    find_turntable_test,
    load_band_detectors,
    load_camera,
    load_lab_test,
    load_turntable_test,
)
from scenes.specs.resolved import ExperimentSetup, read_setup
from scenes.specs.turntable_test import TurntableTestSpec
from scenes.yaml.errors import names_text, nearest
from scenes.yaml.spec import Paths, Spec


class FocusSetup(ExperimentSetup[FocusTestSpec]):
    """A focal-plane alignment with its camera and detectors.

    Attributes:
        camera: prescription and bands.
        detectors: as the bands name them -> data sheet.
    """

    camera: CameraSpec
    detectors: Paths[DetectorSpec]


class DistortionSetup(ExperimentSetup[DistortionTestSpec]):
    """A distortion test with its camera, detectors and turntable.

    Attributes:
        turntable: its dividing error and calibration.
        camera: prescription and bands.
        detectors: as the bands name them -> data sheet.
    """

    turntable: TurntableTestSpec
    camera: CameraSpec
    detectors: Paths[DetectorSpec]


class TurntableSetup(ExperimentSetup[TurntableTestSpec]):
    """A turntable test, which refers to nothing else."""


def resolve_focus(path: str | Path) -> FocusSetup:
    """Read a focal-plane alignment and all it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: any of the files cannot be read or is not valid.
    """
    if (again := read_setup(FocusSetup, path)) is not None:
        _require_plane(again.test, again.camera)
        _require_detectors(again, again.camera, again.detectors)
        return again
    test = load_lab_test(FocusTestSpec, path)
    camera = load_camera(find_camera(test))
    _require_plane(test, camera)
    return FocusSetup.model_construct(test=test, camera=camera, detectors=FrozenMap(load_band_detectors(camera)))


def resolve_distortion(path: str | Path) -> DistortionSetup:
    """Read a distortion test and all it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: any of the files cannot be read or is not valid.
    """
    if (again := read_setup(DistortionSetup, path)) is not None:
        _require_bands(again.test, again.camera, again.test.band)
        _require_detectors(again, again.camera, again.detectors)
        return again
    test = load_lab_test(DistortionTestSpec, path)
    camera = load_camera(find_camera(test))
    _require_bands(test, camera, test.band)
    turntable = load_turntable_test(find_turntable_test(test))
    return DistortionSetup.model_construct(
        test=test, turntable=turntable, camera=camera, detectors=FrozenMap(load_band_detectors(camera))
    )


def resolve_turntable(path: str | Path) -> TurntableSetup:
    """Read a turntable test; a run's config.yaml can be given in its place.

    Raises:
        InputError: the file cannot be read or is not valid.
    """
    if (again := read_setup(TurntableSetup, path)) is not None:
        return again
    return TurntableSetup.model_construct(test=load_turntable_test(path))


def _require_plane(test: Spec, camera: CameraSpec) -> None:
    """Bands at one X' alone do not tell the tilt about the line."""
    _require_bands(test, camera)
    if len({band.offset for band in camera.bands.values()}) < 2:
        raise test.error(
            f"all bands of the camera {camera.name} stand at one X', so the tilt about the line cannot be told",
            ("camera",),
            allowed="a camera with bands at different offsets",
        )


def _require_detectors(setup: Spec, camera: CameraSpec, detectors: Mapping[str, DetectorSpec]) -> None:
    """InputError unless the data sheets of all bands are there."""
    for name, band in camera.bands.items():
        require_detector(setup, ("camera", "bands", name, "detector"), band.detector, detectors)


def _require_bands(test: Spec, camera: CameraSpec, band: str | None = None) -> None:
    if not camera.bands:
        raise test.error(
            f"the camera {camera.name} has no line CCDs", ("camera",), allowed="a camera with `bands:` in its file"
        )
    if band is not None and band not in camera.bands:
        names = tuple(camera.bands)
        meant = nearest(band, names)
        raise test.error("no such band", ("band",), found=band, allowed=names_text(names), suggestion=meant)
