"""The perturbed state that a job describes: its motions, scales and figures, and what its temperatures do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from optics.geometry.pose import triple
from optics.geometry.tree import Motion, State
from scenes.models.thermal_model import TemperatureError, ThermalModel
from scenes.specs.course import noll
from scenes.specs.job import JobSpec


def job_state(job: JobSpec, thermal: ThermalModel, progress: Callable[[str], None] = lambda path: None) -> State:
    """The perturbed state that a job describes.

    Args:
        job: its perturbation, checked by ``scenes.specs.job.check_nodes``.
        thermal: of its instrument.
        progress: called with the path of each body whose thermo-elastic solution begins.

    Raises:
        InputError: a temperature at or below 0 K, or one at which a glass's index is not known.
    """
    fields = job.fields()
    try:
        thermal.check(fields)
        return thermal.state(fields, motions_of(job), progress)
    except TemperatureError as error:
        raise job.error(str(error), ("perturb", error.origin, "temperature"), allowed=error.allowed) from error


def motions_of(job: JobSpec, time: int | None = None) -> State:
    """The rigid motions, scales and figures that a job asks for; its temperatures come on top of them.

    Args:
        job: its perturbation.
        time: number of a time of its course, whose motions are added; None for none.
    """
    out = {
        path: Motion(p.rotate, p.shift, p.pivot, p.scale, {noll(term): value for term, value in p.figure.items()})
        for path, p in job.perturb.items()
    }
    if job.course is not None and time is not None:
        for path, added in job.course.motions(time).items():
            own = out.get(path, Motion())
            rotate = triple(a + b for a, b in zip(own.rotate, added.rotate, strict=True))
            shift = triple(a + b for a, b in zip(own.shift, added.shift, strict=True))
            out[path] = replace(own, rotate=rotate, shift=shift, pivot=added.pivot, scale=own.scale + added.scale)
    return out
