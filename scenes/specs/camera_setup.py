"""The camera that ``twin.camera`` is given: by itself, as mounted in an instrument, or out of an earlier run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field

from optics.numerics.frozen_map import FrozenMap
from scenes.specs.camera import CameraSpec
from scenes.specs.instrument import InstrumentSpec
from scenes.specs.load import CAMERAS, INSTRUMENTS, library_names, load_camera, load_instrument, paths_of_cameras
from scenes.yaml.errors import InputError, Issue, KeyPath, names_text, nearest, shown
from scenes.yaml.input_file import is_file
from scenes.yaml.spec import Name, Paths, Source, Spec
from scenes.yaml.translate import validate
from scenes.yaml.yaml_file import YamlFile, dump_yaml, read_yaml

ALLOWED = "the file of a camera or of an instrument, or the config.yaml of a run with one"


class CameraSetup(Spec):
    """A camera, with its instrument if it is to be looked at as mounted there.

    Attributes:
        camera: its prescription.
        mounted: its name in the instrument.
        instrument: that holds it; None for a camera by itself.
        cameras: what the instrument's cameras are called -> prescription.
    """

    camera: CameraSpec
    mounted: Name | None = None
    instrument: InstrumentSpec | None = None
    cameras: Paths[CameraSpec] = Field(default_factory=FrozenMap)

    @property
    def title(self) -> str:
        """What it is called in a report."""
        return self.camera.name if self.instrument is None else f"{self.camera.name} as {self.mounted} of {self.where}"

    @property
    def where(self) -> str:
        """The instrument's name, empty for none."""
        return "" if self.instrument is None else self.instrument.name

    def to_yaml(self) -> str:
        """Text of a config.yaml, which ``resolve_camera`` reads back to the same values."""
        return dump_yaml({key: value for key, value in self.plain().items() if value != {}})


def resolve_camera(file: Path | str, name: str | None = None) -> CameraSetup:
    """Read a camera and all it refers to.

    Args:
        file: name of a camera or instrument of the library, path of such a file, or a run's config.yaml.
        name: which camera, where there are several.

    Raises:
        InputError: the file cannot be read or is not valid, holds no camera, or several and ``name`` none of them.
    """
    text = str(file)
    if "/" not in text and not text.endswith((".yaml", ".yml")) and not is_file(Path(text)):
        return _of_library(text, name)
    yaml = read_yaml(file)
    data = yaml.data if isinstance(yaml.data, dict) else {}
    if "mirrors" in data:
        return _alone(load_camera(Path(text)), text, name)
    if "cameras" in data and "monitor" in data:
        return _mounted(load_instrument(Path(text)), text, name)
    return _of_run(yaml, name)


def _of_library(text: str, name: str | None) -> CameraSetup:
    cameras, instruments = library_names(CAMERAS), library_names(INSTRUMENTS)
    if text in cameras:
        return _alone(load_camera(text), text, name)
    if text in instruments:
        return _mounted(load_instrument(text), text, name)
    allowed = f"{names_text(cameras)}, an instrument ({names_text(instruments)}), or the path of a .yaml file"
    meant = nearest(text, (*cameras, *instruments))
    raise InputError(Issue("no such camera or instrument", found=shown(text), allowed=allowed, suggestion=meant))


def _alone(camera: CameraSpec, file: str, name: str | None) -> CameraSetup:
    if name is not None and name != camera.name:
        raise InputError(Issue(f"--camera {name}: the file holds one camera, {camera.name}", file))
    return CameraSetup.model_construct(camera=camera, mounted=None, instrument=None, cameras=FrozenMap())


def _mounted(instrument: InstrumentSpec, file: str, name: str | None) -> CameraSetup:
    chosen = _chosen(tuple(instrument.cameras), file, name)
    files = paths_of_cameras(instrument)
    cameras = {mounted.camera: load_camera(files[own]) for own, mounted in instrument.cameras.items()}
    return CameraSetup.model_construct(
        camera=cameras[instrument.cameras[chosen].camera],
        mounted=chosen,
        instrument=instrument,
        cameras=FrozenMap(cameras),
    )


def _of_run(yaml: YamlFile, name: str | None) -> CameraSetup:
    """From a run's config.yaml; a study's has its own below ``base``."""
    data: Any = yaml.data
    if isinstance(data, dict) and {"mounted", "instrument"} <= set(data):
        return validate(CameraSetup, yaml)
    way: KeyPath = ("base",) if isinstance(data, dict) and "study" in data else ()
    below = data.get("base") if way else data
    one = below.get("camera") if isinstance(below, dict) else None
    many = below.get("cameras") if isinstance(below, dict) else None
    if isinstance(one, dict) and "mirrors" in one:
        return _alone(_read(yaml, one, (*way, "camera")), yaml.file, name)
    held = {key: c for key, c in many.items() if isinstance(c, dict)} if isinstance(many, dict) else {}
    if held and all("mirrors" in camera for camera in held.values()):
        chosen = _chosen(tuple(held), yaml.file, name)
        camera = _read(yaml, held[chosen], (*way, "cameras", chosen))
        return CameraSetup.model_construct(camera=camera, mounted=None, instrument=None, cameras=FrozenMap())
    raise InputError(Issue("there is no camera's prescription in this file", yaml.file, 1, allowed=ALLOWED))


def _read(yaml: YamlFile, data: Mapping[str, Any], way: KeyPath) -> CameraSpec:
    """A camera that stands at ``way`` in a file."""
    lines = {key[len(way) :]: line for key, line in yaml.lines.items() if key[: len(way)] == way}
    camera = validate(CameraSpec, YamlFile(yaml.file, data, lines))
    placed = camera.with_source(Source(yaml.file, yaml.lines, way))
    assert isinstance(placed, CameraSpec)
    return placed


def _chosen(names: tuple[str, ...], file: str, name: str | None) -> str:
    """The camera that is meant. InputError if it is none, or nothing says which of several."""
    if name is None:
        if len(names) == 1:
            return names[0]
        raise InputError(Issue("which of its cameras is meant is not said", file, allowed=f"--camera {names[0]} ..."))
    if name not in names:
        allowed, meant = names_text(names), nearest(name, names)
        raise InputError(Issue("no such camera", file, found=shown(name), allowed=allowed, suggestion=meant))
    return name
