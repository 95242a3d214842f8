"""A camera in a script: looked at as optical designers do, and perturbed as the instrument that it is or belongs to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, Self

from optics.geometry.tree import State
from twin.camera.camera_view import CameraView
from twin.monitor.monitor_experiment import MonitorExperiment


class Twin(Protocol):
    """The instrument that a camera belongs to, as `twin.load` gives it."""

    @property
    def experiment(self) -> MonitorExperiment:
        """The modelled instrument."""

    @property
    def state(self) -> State:
        """Body -> motion."""

    def perturbed(self, *perturb: Mapping[str, Mapping[str, Any]] | str) -> Self:
        """The instrument with these bodies perturbed. Raises InputError where that cannot be."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class CameraTwin(CameraView):
    """A camera of an instrument in one state. Made by `load_camera` and `InstrumentTwin.camera`.

    Attributes:
        twin: the instrument, of which this may be all.
        name: of the camera in it.
        obstruction: whether what other bodies take of its beam is missing.
    """

    twin: Twin = field(repr=False)
    name: str
    obstruction: bool = True

    @classmethod
    def of(cls, twin: Twin, name: str, obstruction: bool = True) -> CameraTwin:
        """A camera of an instrument, in the instrument's state.

        Args:
            twin: the instrument.
            name: of the camera in it.
            obstruction: whether what other bodies take of its beam is missing.
        """
        experiment = twin.experiment
        seen = CameraView.within(experiment.instrument, name, experiment.backend, twin.state, obstruction)
        return cls(seen.path, seen.state, twin=twin, name=name, obstruction=obstruction)

    def perturbed(self, *perturb: Mapping[str, Mapping[str, Any]] | str) -> CameraTwin:
        """The same camera with bodies of its instrument perturbed; arguments and errors as `InstrumentTwin.perturbed`.

        Args:
            perturb: motions in words, such as ``"M2 shift z 20 um"``, or node -> keys of `perturb:` in a job's YAML.
        """
        return CameraTwin.of(self.twin.perturbed(*perturb), self.name, self.obstruction)
