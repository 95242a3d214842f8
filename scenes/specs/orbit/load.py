"""What a test in orbit refers to, from the library by name or from a user's own files by path."""

from pathlib import Path

from scenes.specs.detector import DetectorSpec
from scenes.specs.load import (
    INSTRUMENTS,
    ORBIT,
    PAYLOADS,
    SpecType,
    find_detector,
    find_named,
    library_names,
    load_detector,
    load_named,
    place_of,
)
from scenes.specs.orbit.angle import OrbitAngleSpec
from scenes.specs.orbit.calibration import OrbitCalibrationSpec
from scenes.specs.orbit.flight import PayloadTestSpec
from scenes.specs.orbit.scene import LineImageSpec
from scenes.specs.orbit.simulate import OrbitSimulateSpec
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.yaml.errors import KeyPath, names_text, nearest


def load_orbit_test(model: type[SpecType], name_or_path: str | Path) -> SpecType:
    """Read a test in orbit of that sort; arguments and errors as `load_instrument`."""
    return load_named(model, ORBIT, name_or_path, None)


def load_three_line_camera(name_or_path: str | Path, relative_to: str | Path | None = None) -> ThreeLineCameraSpec:
    """Read a three-line payload; arguments and errors as `load_instrument`."""
    return load_named(ThreeLineCameraSpec, PAYLOADS, name_or_path, relative_to)


def find_payload(test: OrbitAngleSpec | OrbitCalibrationSpec | OrbitSimulateSpec | PayloadTestSpec) -> Path:
    """The file of the payload of a test in orbit. Raises InputError if there is none."""
    return find_named(PAYLOADS, test.camera, test, ("camera",))


def find_orbit_camera(test: OrbitAngleSpec) -> Path:
    """The file of the payload or instrument of a test in orbit. Raises InputError if there is none."""
    reference, file = test.camera, test.source.file
    for folder in (PAYLOADS, INSTRUMENTS):
        if place_of(folder, reference, Path(file).parent if file else Path()) is not None:
            return find_named(folder, reference, test, ("camera",))
    payloads, instruments = library_names(PAYLOADS), library_names(INSTRUMENTS)
    allowed = f"{names_text(payloads)}, an instrument ({names_text(instruments)}), or the path of a .yaml file"
    meant = nearest(reference, (*payloads, *instruments))
    problem = "no such name in payloads or instruments"
    raise test.error(problem, ("camera",), found=reference, allowed=allowed, suggestion=meant)


def load_line_detectors(camera: ThreeLineCameraSpec) -> dict[str, DetectorSpec]:
    """Data sheets of a payload's line CCDs, by the name that the image sections give. Raises InputError as
    `load_instrument`.
    """
    sections: list[tuple[KeyPath, LineImageSpec | None]] = [(("image",), camera.image)]
    sections += [(("lines", name, "image"), line.image) for name, line in camera.lines.items()]
    return {
        image.detector: load_detector(find_detector(image.detector, camera, (*key, "detector")))
        for key, image in sections
        if image is not None
    }
