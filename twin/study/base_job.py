"""The jobs that a study can vary: how each is read and run, and what a run of it gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from optics.backend import Backend
from scenes.errors import InputError, Issue, KeyPath
from scenes.spec import Spec
from twin.study.config_tree import Tree


@dataclass(frozen=True)
class Run:
    """One run of a study.

    Attributes:
        number: from 0.
        values: (place, value) of everything the factors change in the base's tree.
        seed: of its noise; None for the base's own.
    """

    number: int
    values: tuple[tuple[KeyPath, Any], ...]
    seed: int | None


@dataclass(frozen=True)
class Failure:
    """A run that cannot be: light is lost, or its values do not go together.

    Attributes:
        message: why, one line.
    """

    message: str


Outcome = Mapping[str, Any] | Failure
"""Results by file, as the run folder's JSON files without .json hold them; or why there are none."""


class BaseJob(Protocol):
    """A command that a study can vary."""

    @property
    def model(self) -> type[Spec]:
        """What its config.yaml describes."""

    @property
    def block(self) -> int:
        """Consecutive runs that are always evaluated together, whoever does it."""

    def resolve(self, file: Path | str) -> Spec:
        """Read its file, or the name of one in the library, with all it refers to. Raises InputError."""

    def check(self, tree: Tree, backend: Backend) -> None:
        """What can only be told with the job built; called once, in a worker, before the study. Raises InputError."""

    def evaluate(self, tree: Tree, runs: Sequence[Run], backend: Backend) -> list[Outcome]:
        """Outcome of every run. The numbers may depend on which runs are done together, but on nothing else."""


def base_job(command: str) -> BaseJob:
    """The job of that name.

    Raises:
        InputError: this version of the twin does not have it.
    """
    try:
        return JOBS[command]()
    except (ImportError, KeyError) as error:
        issue = Issue(f"this version of the twin cannot run {command!r} in a study", allowed=", ".join(JOBS))
        raise InputError(issue) from error


# A study imports only what its own base needs: a worker then starts in half the time.
def _render() -> BaseJob:
    from twin.study.render_base import RenderBase

    return RenderBase()


def _focus() -> BaseJob:
    from scenes.lab_setup import FocusSetup, resolve_focus
    from twin.laboratory.focus_result import run_focus
    from twin.study.bench_base import BenchBase

    return BenchBase(FocusSetup, resolve_focus, run_focus)


def _distortion() -> BaseJob:
    from scenes.lab_setup import DistortionSetup, resolve_distortion
    from twin.laboratory.distortion import run_distortion
    from twin.study.bench_base import BenchBase

    return BenchBase(DistortionSetup, resolve_distortion, run_distortion)


def _turntable() -> BaseJob:
    from scenes.lab_setup import TurntableSetup, resolve_turntable
    from twin.laboratory.turntable_result import run_turntable_test
    from twin.study.bench_base import BenchBase

    return BenchBase(TurntableSetup, resolve_turntable, run_turntable_test)


def _angle() -> BaseJob:
    from scenes.orbit_setup import AngleSetup, resolve_angle
    from twin.orbit.angle.result import run_angle
    from twin.study.bench_base import BenchBase

    return BenchBase(AngleSetup, resolve_angle, run_angle)


def _calibrate() -> BaseJob:
    from scenes.orbit_setup import CalibrationSetup, resolve_calibration
    from twin.orbit.calibration.result import run_calibration
    from twin.study.bench_base import BenchBase

    return BenchBase(CalibrationSetup, resolve_calibration, run_calibration)


def _monitor() -> BaseJob:
    from scenes.orbit_setup import MonitorSetup, resolve_monitor
    from twin.orbit.monitoring.result import run_monitor
    from twin.study.bench_base import BenchBase

    return BenchBase(MonitorSetup, resolve_monitor, run_monitor)


JOBS: dict[str, Callable[[], BaseJob]] = {
    "render": _render,
    "lab focus": _focus,
    "lab distortion": _distortion,
    "lab turntable": _turntable,
    "orbit angle": _angle,
    "orbit calibrate": _calibrate,
    "orbit monitor": _monitor,
}
"""As scenes.study.BaseCommand names them -> the job. A test that ``twin.trial.command.run_test`` runs needs no more
than its set-up, its ``resolve`` and its ``run``.
"""
