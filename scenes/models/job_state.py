"""The perturbed state that a job describes, and what of it moves beyond what is stated to move."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

from optics.geometry.pose import triple
from optics.geometry.tree import Motion, State, compose
from optics.thermal.nodal_deformation import NodalDeformation
from scenes.models.disturbances import UNITS, StatedMotions
from scenes.models.instrument_model import Instrument
from scenes.models.nodal_bodies import HeatedBody, deformed_face, heated_bodies, with_heat
from scenes.models.thermal_model import TemperatureError, ThermalModel
from scenes.specs.job import JobSpec, PerturbationSpec
from scenes.specs.resolved import ResolvedJob


def job_state(
    job: JobSpec,
    thermal: ThermalModel,
    progress: Callable[[str], None] = lambda path: None,
    moved: State | None = None,
    heated: Mapping[str, HeatedBody] | None = None,
) -> State:
    """The perturbed state that a job describes.

    Args:
        job: its perturbation, checked by ``scenes.specs.job.checked_nodes``.
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
    """The rigid motions, scales and shapes of surfaces that a job asks for; its temperatures come on top of them.

    Args:
        job: its perturbation.
        time: number of a time of its course, whose motions are added; None for none.
    """
    out = {path: what.motion() for path, what in job.perturb.items()}
    if job.course is not None and time is not None:
        for path, added in job.course.motions(time).items():
            own = out.get(path, Motion())
            rotate = triple(a + b for a, b in zip(own.rotate, added.rotate, strict=True))
            shift = triple(a + b for a, b in zip(own.shift, added.shift, strict=True))
            out[path] = replace(own, rotate=rotate, shift=shift, pivot=added.pivot, scale=own.scale + added.scale)
    return out


LIKELY = 4.0
"""Standard deviations up to which an amount is what was stated: a normal number is larger once in 16 000."""


@dataclass(frozen=True)
class Excess:
    """A component of a job's perturbation that its statement does not hold.

    Attributes:
        body: path.
        what: ``shift z``, ``figure Z7``, ``temperature``.
        kind: of `scenes.models.disturbances.UNITS`; ``table`` for what files of nodes say.
        amount: SI; 0 for a table.
        sigma: stated of that component, SI; 0 for one that is not stated.
    """

    body: str
    what: str
    kind: str
    amount: float
    sigma: float

    @property
    def text(self) -> str:
        """In words: ``base/forward/M2 shift z (3 um, stated 0.3 um)``."""
        if self.kind == "table":
            return f"{self.body} {self.what} (not stated)"
        unit, size = UNITS[self.kind]
        stated = f"stated {self.sigma / size:.3g} {unit}" if self.sigma else "not stated"
        return f"{self.body} {self.what} ({self.amount / size:.3g} {unit}, {stated})"


def beyond_statement(resolved: ResolvedJob, stated: StatedMotions | None) -> tuple[Excess, ...]:
    """Components of a job's perturbation that are larger than `LIKELY` times what is stated of them, body by body.

    Pivots are left aside: of a turn about another point its angle counts.

    Args:
        resolved: the job.
        stated: of it; None for nothing.
    """
    return tuple(_excesses(resolved.job, _variances(stated)))


def _variances(stated: StatedMotions | None) -> Mapping[tuple[str, str], float]:
    out: dict[tuple[str, str], float] = {}
    for c in stated.components if stated is not None else ():
        out[c.body, c.what] = out.get((c.body, c.what), 0.0) + c.sigma**2
    return out


def _excesses(job: JobSpec, variance: Mapping[tuple[str, str], float]) -> Iterator[Excess]:
    for body, what in job.perturb.items():
        for kind, name, amount in _components(what):
            sigma = variance.get((body, name), 0.0) ** 0.5
            if kind == "table" or abs(amount) > LIKELY * sigma:
                yield Excess(body, name, kind, amount, sigma)


def _components(what: PerturbationSpec) -> Iterator[tuple[str, str, float]]:
    """Kind, name and amount of all that is done to a body."""
    vectors = {"shift": what.shift, "rotate": what.rotate, "gradient": what.heat.gradient}
    for kind, vector in vectors.items():
        yield from ((kind, f"{kind} {axis}", value) for axis, value in zip("xyz", vector, strict=True) if value)
    yield from (("figure", f"figure {term}", value) for term, value in what.figure.items() if value)
    for kind in ("scale", "radius", "conic", "index", "abbe"):
        if value := getattr(what, kind):
            yield kind, kind, value
    if what.heat.change:
        yield "temperature", "temperature", what.heat.change
    if what.heat.table is not None:
        yield "table", "temperatures at nodes", 0.0
    if what.deformation is not None:
        yield "table", "deformation", 0.0
