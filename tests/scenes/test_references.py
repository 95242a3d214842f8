"""A reference is read alike by every command: the library's name, a file, or the mapping itself."""

import copy
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from scenes.models.camera_design import CameraDesignSetup
from scenes.models.monitor_layout import MonitorDesignSetup
from scenes.specs import load
from scenes.specs.asbuilt import AsBuiltSetup
from scenes.specs.monitor_frames import MeasurementSetup
from scenes.specs.operation import read_operation
from scenes.specs.orbit import setup as orbit
from scenes.specs.resolved import DistortionSetup, FocusSetup, resolve, resolve_budget, resolve_on
from scenes.specs.tolerance import ToleranceSetup
from scenes.yaml.spec import Spec
from scenes.yaml.yaml_file import dump_yaml, read_yaml
from twin.operate.record.entries import digest_of_job
from twin.operate.record.telemetry import read_telemetry

MEASURED = load.SCENES / "orbit/measured"


def budget(path: Path) -> Any:
    return resolve_budget(load.load_error_budget(path))


def telemetry(path: Path) -> Any:
    """The file's instrument, after the check against a record of the pair."""
    pair = resolve(load.EXAMPLES / "perturb.yaml")
    bodies: dict[str, None] = {"warm": None, "cameras": None}
    history: Any = SimpleNamespace(sha256=digest_of_job(pair), name="gf7_pair", bodies=bodies)
    spec = read_telemetry(path, history)
    return resolve_on(spec, spec.instrument)


def frames(path: Path) -> Any:
    """Measured frames of all channels, which lie beside the file."""
    pair = load.load_instrument("gf7_pair")
    names = [f"{camera}/{channel}" for camera in pair.cameras for channel in pair.channels_of(camera)]
    rows = "".join(f"{name},before,a.fits\n{name},after,a.fits\n" for name in names)
    (path.parent / "frames.csv").write_text(f"channel,when,file\n{rows}", "utf-8")
    (path.parent / "a.fits").touch()
    return MeasurementSetup.read(path)


FRAMES = {"instrument": "gf7_pair", "frames": "frames.csv", "detector": "monitor_ccd", "disturbances": "launch"}
BUILT = {"name": "built", "design": "gf7_pair", "disturbances": "assembled"}
PAIR = read_yaml(load.LIBRARY / "instruments/gf7_pair.yaml").data
PAIR["cameras"]["backward"]["camera"] = "gf7_conic"
PARTS = "cameras.forward.camera monitor.area_ccd.detector disturbances"
READERS: dict[str, tuple[Callable[[Path], Any], Path | dict[str, Any], str]] = {
    "render": (resolve, load.EXAMPLES / "perturb.yaml", "instrument disturbances"),
    "an instrument": (lambda path: resolve_on(Spec(), str(path)), PAIR, PARTS),
    "as built": (lambda path: resolve_on(Spec(), str(path)), BUILT, "design disturbances"),
    "tolerance": (ToleranceSetup.read, load.EXAMPLES / "tolerance_gf7_pair.yaml", "instrument disturbances"),
    "tolerance camera": (ToleranceSetup.read, load.EXAMPLES / "tolerance_gf7.yaml", "instrument"),
    "asbuilt": (AsBuiltSetup.read, load.EXAMPLES / "asbuilt_gf7.yaml", "instrument prior"),
    "recover": (frames, FRAMES, "instrument detector disturbances"),
    "operate": (read_operation, load.EXAMPLES / "operation.yaml", "instrument disturbances"),
    "operate ingest": (telemetry, load.EXAMPLES / "telemetry.yaml", "instrument"),
    "validate": (budget, load.LIBRARY / "budgets/monitor_pair.yaml", "instrument disturbances"),
    "design camera": (CameraDesignSetup.read, load.EXAMPLES / "design_gf7_short.yaml", "camera"),
    "design monitor": (MonitorDesignSetup.read, load.EXAMPLES / "design_monitor_two.yaml", "instrument disturbances.0"),
    "lab focus": (FocusSetup.read, load.SCENES / "lab/focus.yaml", "camera"),
    "lab distortion": (DistortionSetup.read, load.SCENES / "lab/distortion.yaml", "camera turntable"),
    "orbit monitor": (orbit.MonitorSetup.read, load.SCENES / "orbit/monitor.yaml", "instrument"),
    "orbit angle": (orbit.AngleSetup.read, load.SCENES / "orbit/angle.yaml", "camera"),
    "orbit angle traced": (orbit.AngleSetup.read, load.SCENES / "orbit/angle_gf7.yaml", "camera"),
    "orbit calibrate": (orbit.CalibrationSetup.read, load.SCENES / "orbit/calibrate.yaml", "camera"),
    "orbit simulate": (orbit.SimulateSetup.read, load.SCENES / "orbit/simulate.yaml", "camera"),
    "orbit jitter": (orbit.JitterSetup.read, load.SCENES / "orbit/jitter.yaml", "camera"),
    "orbit adjust": (orbit.AdjustSetup.read, load.SCENES / "orbit/adjust.yaml", "camera"),
    "orbit check": (orbit.CheckSetup.read, MEASURED / "check.yaml", "camera"),
    "orbit match": (orbit.MatchSetup.read, MEASURED / "match.yaml", "camera"),
    "measured calibration": (orbit.MeasuredCalibrationSetup.read, MEASURED / "calibrate.yaml", "camera"),
    "measured angle": (orbit.MeasuredAngleSetup.read, MEASURED / "angle.yaml", "camera"),
    "measured jitter": (orbit.MeasuredJitterSetup.read, MEASURED / "jitter.yaml", "camera"),
    "measured adjust": (orbit.MeasuredAdjustSetup.read, MEASURED / "adjust.yaml", "camera"),
}
CASES = [(name, key) for name, (_, _, keys) in READERS.items() for key in keys.split()]
FOLDERS = ("instruments", "cameras", "payloads", "detectors", "disturbances", "lab")


def library_file(name: str) -> Path:
    """The file of the only thing of the library that has this name."""
    places = (load.SCENES / "lab" if folder == "lab" else load.LIBRARY / folder for folder in FOLDERS)
    (found,) = (place / f"{name}.yaml" for place in places if (place / f"{name}.yaml").is_file())
    return found


def content(reader: Callable[[Path], Any], path: Path, name: str) -> str:
    """What is read, without what the reference is called."""
    return re.sub(r"[^\s\[\],]*own\.yaml", name, dump_yaml(reader(path).plain()))


def referring(folder: Path, name: str, key: str, form: str) -> tuple[Path, str, Callable[[Path], Any]]:
    """A file whose reference at a key has another form, what it refers to, and its reader."""
    reader, base, _ = READERS[name]
    if isinstance(base, Path) and base.parent == MEASURED:
        shutil.copytree(MEASURED, folder / "measured")
    data = read_yaml(base).data if isinstance(base, Path) else copy.deepcopy(base)
    *way, last = (int(part) if part.isdigit() else part for part in key.split("."))
    owner: Any = data
    for part in way:
        owner = owner[part]
    referred = owner[last]
    file = library_file(referred)
    shutil.copy(file, folder / "own.yaml")
    path = (folder / "measured" if (folder / "measured").is_dir() else folder) / "it.yaml"
    own = "../own.yaml" if path.parent != folder else "own.yaml"
    forms = {"name": referred, "file": own, "camera": {"camera": own}, "mapping": read_yaml(file).data}
    owner[last] = forms[form]
    path.write_text(dump_yaml(data), "utf-8")
    return path, referred, reader


@pytest.mark.parametrize(("name", "key"), CASES, ids=lambda value: value.replace(" ", "-"))
def test_every_form_of_a_reference_is_read_alike(name: str, key: str, tmp_path: Path) -> None:
    found = []
    others = ["camera"] if key in ("instrument", "camera", "design") else []
    for k, form in enumerate(("name", "file", "mapping", *others)):
        folder = tmp_path / str(k)
        folder.mkdir()
        path, referred, reader = referring(folder, name, key, form)
        found.append(content(reader, path, referred).replace(str(folder), ""))
    assert found == [found[0]] * len(found)
