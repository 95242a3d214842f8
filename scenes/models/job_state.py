"""The perturbed state that a job describes: its motions, scales and figures, and what its temperatures do."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from optics.geometry.pose import triple
from optics.geometry.tree import Motion, State, compose
from optics.thermal.nodal_deformation import NodalDeformation
from scenes.models.deformed_faces import deformed_face
from scenes.models.heated_bodies import HeatedBody, heated_bodies, with_heat
from scenes.models.instrument_model import Instrument
from scenes.models.thermal_model import TemperatureError, ThermalModel
from scenes.specs.course import noll
from scenes.specs.job import JobSpec


def job_state(
    job: JobSpec,
    thermal: ThermalModel,
    progress: Callable[[str], None] = lambda path: None,
    moved: State | None = None,
    heated: Mapping[str, HeatedBody] | None = None,
) -> State:
    """The perturbed state that a job describes.

    Args:
        job: its perturbation, checked by ``scenes.specs.job.check_nodes``.
        thermal: of its instrument.
        progress: called with the path of each body whose thermo-elastic solution begins.
        moved: the state without its linear temperatures, where it is known; None for all that the job says.
        heated: what its tables of temperatures are, where it is known.

    Raises:
        InputError: a temperature at or below 0 K, or one at which a glass's index is not known; a table of nodes that
            does not describe its body.
    """
    heated = heated_bodies(job, thermal) if heated is None else heated
    fields = with_heat(job.fields(), heated)
    if moved is None:
        deformed = deformations_of(job, thermal.instrument)
        moved = on_deformed(thermal.instrument, deformed, motions_of(job), heated)
    try:
        thermal.check(fields)
        return thermal.state(fields, moved, progress)
    except TemperatureError as error:
        raise job.error(str(error), ("perturb", error.origin, "temperature"), allowed=error.allowed) from error


def deformations_of(job: JobSpec, instrument: Instrument) -> dict[str, NodalDeformation]:
    """Body -> what the table of nodes is that a job deforms it by.

    Raises:
        InputError: a table that does not describe its body.
    """
    named = {path: what.deformation for path, what in job.perturb.items() if what.deformation is not None}
    return {path: deformed_face(instrument, job, path, table) for path, table in named.items()}


def on_deformed(
    instrument: Instrument,
    deformed: Mapping[str, NodalDeformation],
    moved: State,
    heated: Mapping[str, HeatedBody] | None = None,
) -> State:
    """The motions of a state on top of its bodies' deformations, by tables of nodes and by what is not linear of tables
    of temperatures.
    """
    bodies = {body.path: body for body in instrument.assembly.tree.bodies}
    own = {path: face.motion() for path, face in deformed.items()}
    for warm in (heated or {}).values():
        moved = compose(warm.state(own), moved, bodies) if warm.faces else moved
    return compose(own, moved, bodies) if own else moved


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
