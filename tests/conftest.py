"""Fixtures that every test may use. They last the session, so that kernels compile and cameras are derived once."""

from functools import cache

import pytest

from optics.backend import Backend, load_backend
from scenes.camera_model import CameraModel, derive_camera
from scenes.instrument_model import Instrument, build_instrument
from scenes.job import JobSpec
from scenes.load import load_camera, load_instrument
from scenes.resolved import resolve_job
from twin.experiment import MonitorExperiment


@pytest.fixture(scope="session")
def backend() -> Backend:
    return load_backend("llvm")


@pytest.fixture(scope="session")
def camera(backend):
    """Function: name of a camera of the library -> its derived model."""

    @cache
    def derive(name: str) -> CameraModel:
        return derive_camera(load_camera(name), backend)

    return derive


@pytest.fixture(scope="session")
def instrument(backend):
    """Function: name of an instrument of the library -> its model."""

    @cache
    def build(name: str) -> Instrument:
        spec = load_instrument(name)
        stems = {site.camera for site in spec.cameras.values()}
        return build_instrument(spec, {stem: load_camera(stem) for stem in stems}, backend)

    return build


@pytest.fixture(scope="session")
def gf7(camera) -> CameraModel:
    return camera("gf7")


@pytest.fixture(scope="session")
def gf7_pair(instrument) -> Instrument:
    return instrument("gf7_pair")


@pytest.fixture(scope="session")
def experiment(backend):
    """Function: name of an instrument of the library -> the monitoring experiment on it, calibrated."""

    @cache
    def prepare(name: str) -> MonitorExperiment:
        return MonitorExperiment(resolve_job(JobSpec(instrument=name)), backend)

    return prepare
