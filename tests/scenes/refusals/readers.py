"""What reads the files of the tables of refusals: each gives, from a folder and pytest's fixtures, a function."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshlane
import numpy as np

from scenes.lens.batoid_reader import read_batoid
from scenes.lens.camera_reader import camera_of
from scenes.lens.codev_reader import read_codev
from scenes.lens.statements import own_glasses, read_catalogue
from scenes.lens.zemax_reader import read_zemax
from scenes.models.camera_design import CameraDesignSetup
from scenes.models.camera_model import build_camera_under_test, derive_camera
from scenes.models.disturbances import disturbance_prior, prior_of_spec
from scenes.models.instrument_builder import build_instrument
from scenes.models.monitor_layout import MonitorDesignSetup
from scenes.models.scenery import measured_finishes
from scenes.schema import MODELS
from scenes.specs import load
from scenes.specs.camera import CameraSpec
from scenes.specs.job import checked_nodes
from scenes.specs.monitor_frames import MeasurementSetup, read_frame_table
from scenes.specs.operation import read_operation
from scenes.specs.orbit import setup as orbit_setup
from scenes.specs.orbit.flight import ErrorsSpec, OrbitSpec
from scenes.specs.perturbation import NodeInfo
from scenes.specs.procedures import PROCEDURES
from scenes.specs.resolved import FocusSetup, resolve
from scenes.specs.spectrum import SpectrumSpec
from scenes.specs.study import StudySpec
from scenes.yaml.csv_table import Column, read_table
from scenes.yaml.finish_files import read_bsdf, read_coating
from scenes.yaml.input_file import read_json
from scenes.yaml.node_table import read_nodes, read_temperatures
from scenes.yaml.spec import Spec, validate
from scenes.yaml.units import ANGLE, LENGTH
from scenes.yaml.yaml_file import read_yaml
from tests.scenes.lens.colour_cameras import colour_camera
from tests.scenes.refusals.tables import changed, good
from tests.scenes.test_finish_tables import bsdf_text
from twin.monitor.monitor_experiment import MonitorExperiment

Fixture = Callable[[str], Any]
Read = Callable[[Path], object]

COLUMNS = (
    Column("point", text=True),
    Column("x", LENGTH),
    Column("turn", ANGLE, needed=False),
    Column("count", needed=False, least=0.0, most=9.0, whole=True),
)
NODES = {
    "base/backward/focal_plane": NodeInfo(("origin", "rear_node"), frozenset({"rotate", "shift", "scale"})),
    "base/forward/M1": NodeInfo(allows=frozenset({"rotate", "shift", "figure"})),
    "base/forward/M2": NodeInfo(allows=frozenset({"rotate", "shift", "figure"})),
}


class SpectrumHolder(Spec):
    """A file of a spectrum alone."""

    spectrum: SpectrumSpec


def _plain(read: Read) -> Callable[[Path, Fixture], Read]:
    return lambda folder, fixture: read


def _spec(model: type[Spec]) -> Callable[[Path, Fixture], Read]:
    return _plain(lambda path: validate(model, read_yaml(path)))


yaml_file, json_file = _plain(read_yaml), _plain(read_json)
table = _plain(lambda path: read_table(path, COLUMNS))
nodes, temperatures = _plain(read_nodes), _plain(read_temperatures)
bsdf, coating = _plain(read_bsdf), _plain(read_coating)
camera, job = _plain(load.load_camera), _plain(load.load_job)
autocollimators = _plain(load.load_autocollimator_test)
operation = _plain(read_operation)
orbit, errors, study, spectrum = map(_spec, (OrbitSpec, ErrorsSpec, StudySpec, SpectrumHolder))
camera_text = _spec(CameraSpec)
measured_adjust, resolved = _plain(orbit_setup.MeasuredAdjustSetup.read), _plain(resolve)
zemax, codev = _plain(read_zemax), _plain(read_codev)
batoid = _plain(lambda path: read_batoid(path, 650e-9))


def test(*command: str) -> Callable[[Path, Fixture], Read]:
    """The test of a command with all that it refers to."""
    return _plain(PROCEDURES[" ".join(command)].resolve)


def job_nodes(folder: Path, fixture: Fixture) -> Read:
    """A job on an instrument of three nodes."""
    return lambda path: checked_nodes(load.load_job(path), NODES)


def instrument(folder: Path, fixture: Fixture) -> Read:
    """An instrument, also one as built, with all that stands in it."""
    backend = fixture("backend")

    def read(path: Path) -> object:
        spec = load.load_instrument(path)
        return build_instrument(spec, load.load_cameras(spec), backend)

    return read


def focus(folder: Path, fixture: Fixture) -> Read:
    """A focus test with its camera."""
    backend = fixture("backend")

    def read(path: Path) -> object:
        setup = FocusSetup.read(path)
        return build_camera_under_test(setup.test, setup.camera, backend)

    return read


def disturbances(folder: Path, fixture: Fixture) -> Read:
    """Disturbances of the pair gf7; a table of correlations beside them."""
    pair = fixture("gf7_pair")
    return lambda path: prior_of_spec(load.load_disturbances(path), pair)


def correlations(folder: Path, fixture: Fixture) -> Read:
    """A table of correlations of the disturbances that name it."""
    components = (
        "forward/M2 shift z: 3.1 um, base/forward/M2 rotate x about origin: 4 arcsec, base/forward/M1 conic: 2.0e-5"
    )
    text = f"name: own\njoint: {{reason: r, components: {{{components}}}, correlation_file: corr.csv}}\n"
    (folder / "own.yaml").write_text(text, "utf-8")
    return lambda path: load.load_disturbances(folder / "own.yaml")


def stated_job(folder: Path, fixture: Fixture) -> Read:
    """A job on the pair gf7 and what it states to move; a file of components that go together beside it."""
    pair = fixture("gf7_pair")
    (folder / "own.yaml").write_text("name: own\njoint: {reason: r, components: {forward/M2 shift z: 3 um}}\n", "utf-8")

    def read(path: Path) -> object:
        return disturbance_prior(resolve(path), pair)

    return read


def experiment(folder: Path, fixture: Fixture) -> Read:
    """A job's state and what it states to move; tables with temperatures from 20 degC to others across a mirror."""
    backend = fixture("backend")
    places = [(x, y, z) for x in (-300, -9, 9, 300) for y in (-500, -100) for z in (-20, 20)]
    for name, low, high in (("hot", 20, 130), ("cold", -273, 20)):
        rows = "".join(f"{x},{y},{z},{low if x < 0 else high}\n" for x, y, z in places)
        (folder / f"{name}.csv").write_text(f"x [mm],y [mm],z [mm],T [degC]\n{rows}", "utf-8")

    def read(path: Path) -> object:
        resolved = resolve(path)
        experiment = MonitorExperiment(resolved, backend)
        return experiment.state(resolved.job), experiment.prior

    return read


def layout_search(folder: Path, fixture: Fixture) -> Read:
    """A search for a layout; beside it an instrument as built, and one of which there are no disturbances."""
    (folder / "built.yaml").write_text(good("as built"), "utf-8")
    (folder / "still.yaml").write_text(good("room in an instrument").replace("disturbances: orbit\n", ""), "utf-8")
    return MonitorDesignSetup.read


def camera_design(folder: Path, fixture: Fixture) -> Read:
    """An optimisation of a camera; one with a mirror that is turned beside it."""
    camera = changed(
        (load.SCENES / "library/cameras/gf7.yaml").read_text("utf-8"), "@mirrors.M1.rotate => [0 deg, 1 arcsec, 0 deg]"
    )
    (folder / "tilted.yaml").write_text(camera, "utf-8")
    return CameraDesignSetup.read


def of_a_job(folder: Path, fixture: Fixture) -> Read:
    """An instrument that a job names, with all its files."""
    (folder / "job.yaml").write_text("instrument: own.yaml\n", "utf-8")
    return lambda path: resolve(folder / "job.yaml")


PAYLOAD_TESTS = {
    "simulate": "patch: {pixel: 6000}\nperturb: {nadir: {principal_distance: 10 um}}\n",
    "angle": "strips: {points: 3, first: 0, last: 11999}\n",
    "jitter": "points: {count: 100, duration: 8 s}\nsearch: {highest: 6 Hz}\n",
}


def payload(kind: str) -> Callable[[Path, Fixture], Read]:
    """A three-line camera of a test in orbit."""

    def reader(folder: Path, fixture: Fixture) -> Read:
        orbit = "{epoch: 2011-03-05T03:05:00Z, passing: {longitude: 116 deg, latitude: 40 deg}}"
        text = f"name: small\ncamera: own.yaml\norbit: {orbit}\n{PAYLOAD_TESTS[kind]}"
        (folder / "test.yaml").write_text(text, "utf-8")
        return lambda path: getattr(orbit_setup, f"{kind.title()}Setup").read(folder / "test.yaml")

    return reader


def filter_table(folder: Path, fixture: Fixture) -> Read:
    """A table of a filter that a camera of lenses names."""
    text = colour_camera("achromat", "{table: filter.csv}").file_text("")
    (folder / "c.yaml").write_text(text, "utf-8")
    return lambda path: load.load_camera(folder / "c.yaml")


def heated(folder: Path, fixture: Fixture) -> Read:
    """A job on tables and meshes of nodes that lie beside it."""
    numbers = np.arange(48.0).reshape(16, 3) % [5.0, 7.0, 3.0]
    rows = "".join(f"{x},{y},{z},28{x:g},0.1,0\n" for x, y, z in numbers)
    (folder / "heat.csv").write_text("x [mm],y [mm],z [mm],T [K]\n" + re.sub(r",0.1,0$", "", rows, flags=re.M), "utf-8")
    (folder / "m1.csv").write_text("x [mm],y [mm],z [mm],dx [um],dy [um],dz [um]\n" + rows, "utf-8")
    cells = [("vertex", np.arange(16)[:, None])]
    data = {"a": 280.0 + numbers[:, 0], "b": numbers[:, 1]}
    meshlane.Mesh(numbers, cells, point_data=data).write(folder / "heat.vtu")
    meshlane.Mesh(numbers, cells, point_data={"U": numbers}).write(folder / "m1.vtu")
    meshlane.Mesh(numbers, cells, point_data={"U": numbers, "v": numbers}).write(folder / "two.vtu")
    meshlane.Mesh(numbers, cells).write(folder / "none.vtu")
    for name, level in (("cold", -280.0), ("hot", 2500.0)):
        meshlane.Mesh(numbers, cells, point_data={"a": level + numbers[:, 0]}).write(folder / f"{name}.vtu")
    far = numbers.copy()
    far[[3, 11], [0, 1]] = 100.0, -100.01  # metres: just allowed, and just not
    meshlane.Mesh(far, cells, point_data=data).write(folder / "far.vtu")
    few = [("vertex", np.arange(3)[:, None])]
    meshlane.Mesh(numbers[:3], few, point_data={"a": numbers[:3, 0]}).write(folder / "few.vtu")
    (folder / "text.vtu").write_text("no mesh\n", "utf-8")
    for name in ("heat.inp", "m1.bdf", "m1.xlsx"):
        (folder / name).write_text("*NODE\n", "utf-8")
    return load.load_job


def finishes(folder: Path, fixture: Fixture) -> Read:
    """A job whose finishes are in files beside it."""
    for name, wavelengths, reflectance in (
        ("ar", (600, 700), 0.4), ("ag", (640, 660), 97), ("dim", (640, 660), 10), ("blue", (440, 460), 10)
    ):  # fmt: skip
        rows = "".join(f"{wavelength},0,{reflectance}\n" for wavelength in wavelengths)
        (folder / f"{name}.csv").write_text(f"wavelength [nm],angle [deg],R [percent]\n{rows}", "utf-8")
    (folder / "m.bsdf").write_text(bsdf_text(), "utf-8")
    return lambda path: measured_finishes(resolve(path))


def agf(folder: Path, fixture: Fixture) -> Read:
    """A glass catalogue."""
    return read_catalogue


def frames(folder: Path, fixture: Fixture) -> Read:
    """A table of frames of one channel."""
    for name in ("a.fits", "b.fits"):
        (folder / name).touch()
    return lambda path: read_frame_table(path, ("one/left",))


def measurement(folder: Path, fixture: Fixture) -> Read:
    """Measured frames of all channels of an instrument that a table lists."""
    pair = load.load_instrument("gf7_pair")
    channels = [f"{camera}/{channel}" for camera in pair.cameras for channel in pair.channels_of(camera)]
    rows = "".join(f"{name},before,a.fits\n{name},after,a.fits\n" for name in channels)
    (folder / "frames.csv").write_text(f"channel,when,file\n{rows}", "utf-8")
    (folder / "a.fits").touch()
    return MeasurementSetup.read


def derived(folder: Path, fixture: Fixture) -> Read:
    """A camera with all that follows from its surfaces."""
    return lambda path: derive_camera(load.load_camera(path), fixture("backend"))


def _lens_camera(read: Read) -> Callable[[Path, Fixture], Read]:
    """A camera made of a prescription."""
    return lambda folder, fixture: lambda path: camera_of(read(path), "c", fixture("backend"))


zemax_camera = _lens_camera(lambda path: read_zemax(path, own_glasses()))
codev_camera = _lens_camera(read_codev)


def model(name: str) -> Callable[[Path, Fixture], Read]:
    """A kind of file by the name of its schema."""
    return _spec(MODELS[name])
