"""What reads the files of the tables of refusals: each gives, from a folder and pytest's fixtures, a function of a path."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from scenes.lens.batoid_reader import read_batoid
from scenes.lens.codev_reader import read_codev
from scenes.lens.zemax_reader import read_zemax
from scenes.models.camera_model import build_camera_under_test
from scenes.models.disturbances import motions_of_spec, stated_motions
from scenes.models.instrument_builder import build_instrument
from scenes.models.scenery import measured_finishes
from scenes.specs.camera import CameraSpec
from scenes.specs.job import checked_nodes
from scenes.specs.load import (
    load_autocollimator_test,
    load_camera,
    load_cameras,
    load_disturbances,
    load_instrument,
    load_job,
)
from scenes.specs.operation import read_operation
from scenes.specs.orbit.flight import ErrorsSpec, OrbitSpec
from scenes.specs.orbit.setup import resolve_angle, resolve_loop, resolve_monitor, resolve_simulate
from scenes.specs.perturbation import NodeInfo
from scenes.specs.resolved import resolve, resolve_focus
from scenes.specs.spectrum import SpectrumSpec
from scenes.specs.study import StudySpec
from scenes.yaml.csv_table import Column, read_table
from scenes.yaml.finish_files import read_bsdf, read_coating
from scenes.yaml.json_file import read_json
from scenes.yaml.node_table import read_nodes, read_temperatures
from scenes.yaml.spec import Spec, validate
from scenes.yaml.units import ANGLE, LENGTH
from scenes.yaml.yaml_file import read_yaml

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
camera, job = _plain(load_camera), _plain(load_job)
autocollimators = _plain(load_autocollimator_test)
operation = _plain(read_operation)
orbit, errors, study, spectrum = map(_spec, (OrbitSpec, ErrorsSpec, StudySpec, SpectrumHolder))
camera_text = _spec(CameraSpec)
angle, loop, monitor, simulate = map(_plain, (resolve_angle, resolve_loop, resolve_monitor, resolve_simulate))
zemax, codev = _plain(read_zemax), _plain(read_codev)
batoid = _plain(lambda path: read_batoid(path, 650e-9))


def job_nodes(folder: Path, fixture: Fixture) -> Read:
    """A job on an instrument of three nodes."""
    return lambda path: checked_nodes(load_job(path), NODES)


def instrument(folder: Path, fixture: Fixture) -> Read:
    """An instrument, also one as built, with all that stands in it."""
    backend = fixture("backend")

    def read(path: Path) -> object:
        spec = load_instrument(path)
        return build_instrument(spec, load_cameras(spec), backend)

    return read


def focus(folder: Path, fixture: Fixture) -> Read:
    """A focus test with its camera."""
    backend = fixture("backend")

    def read(path: Path) -> object:
        setup = resolve_focus(path)
        return build_camera_under_test(setup.test, setup.camera, backend)

    return read


def disturbances(folder: Path, fixture: Fixture) -> Read:
    """Disturbances of the pair gf7; a table of correlations beside them."""
    pair = fixture("gf7_pair")
    return lambda path: motions_of_spec(load_disturbances(path), pair)


def correlations(folder: Path, fixture: Fixture) -> Read:
    """A table of correlations of the disturbances that name it."""
    components = "forward/M2 shift z: 3.1 um, base/forward/M2 rotate x about origin: 4 arcsec, base/forward/M1 conic: 2.0e-5"
    text = f"name: own\njoint: {{reason: r, components: {{{components}}}, correlation_file: corr.csv}}\n"
    (folder / "own.yaml").write_text(text, "utf-8")
    return lambda path: load_disturbances(folder / "own.yaml")


def stated_job(folder: Path, fixture: Fixture) -> Read:
    """A job on the pair gf7 and what it states to move."""
    pair = fixture("gf7_pair")

    def read(path: Path) -> object:
        return stated_motions(resolve(path), pair)

    return read


def finishes(folder: Path, fixture: Fixture) -> Read:
    """A job whose finishes are in files beside it."""
    from tests.scenes.test_finish_tables import write_finishes

    write_finishes(folder)
    return lambda path: measured_finishes(resolve(path))


