"""What the benchmarks work on, made once."""

from __future__ import annotations

from functools import cache, cached_property
from importlib.util import find_spec

from optics.numerics.backend import Backend, load_backend
from scenes.models.camera_model import CameraModel, derive_camera
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.specs.job import JobSpec
from scenes.specs.load import load_camera, load_instrument
from scenes.specs.resolved import resolve_job
from twin.monitor.monitor_experiment import MonitorExperiment


class Workbench:
    """Backend, cameras, instruments and experiments of the library; kernels stay compiled."""

    def __init__(self) -> None:
        self.camera = cache(self._camera)
        self.instrument = cache(self._instrument)
        self.experiment = cache(self._experiment)

    @cached_property
    def backend(self) -> Backend:
        """The processor's."""
        return load_backend("llvm")

    def _camera(self, name: str) -> CameraModel:
        return derive_camera(load_camera(name), self.backend)

    def _instrument(self, name: str) -> Instrument:
        spec = load_instrument(name)
        stems = {site.camera for site in spec.cameras.values()}
        return build_instrument(spec, {stem: load_camera(stem) for stem in stems}, self.backend)

    def _experiment(self, name: str) -> MonitorExperiment:
        return MonitorExperiment(resolve_job(JobSpec(instrument=name)), self.backend)


def installed(peer: str) -> bool:
    """Whether somebody else's package is there."""
    return find_spec(peer) is not None


def absent(peer: str) -> str:
    """The remark in its place."""
    return f"{peer} not installed (extra `oracles`): no comparison with it"
