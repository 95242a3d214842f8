"""A job: which instrument, what is perturbed, what changes with time, what is rendered and how."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from optics.numerics.number_tree import FrozenMap
from optics.targets.target_shapes import TARGETS
from optics.thermal.heat import Temperature
from scenes.specs import job_tables
from scenes.specs.course import CourseSpec, read_course
from scenes.specs.disturbances import JobDisturbances
from scenes.specs.instrument import Frames
from scenes.specs.perturbation import (
    IN_WORDS,
    NodeInfo,
    PlainPerturbationSpec,
    in_full,
    no_such_node,
    not_allowed,
    perturbation_issues,
)
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, shown
from scenes.yaml.named import Named
from scenes.yaml.spec import Flag, NothingIsEmpty, OneOf, Paths, Ref, Seed, Spec, Whole
from scenes.yaml.unit_fields import Quantity
from scenes.yaml.units import ANGLE, SCALE


def target_names() -> tuple[str, ...]:
    """What ``render.images`` may name beside the monitor's spots: targets whose MTF is measured, then the others."""
    return ("knife_edge", "bars", *TARGETS)


EdgeAngle = Annotated[float, Quantity(ANGLE, smallest="2 deg", largest="10 deg")]
White = Annotated[float, Quantity(SCALE, smallest="0.1 percent", largest="100 percent")]


class TargetsSpec(Spec):
    """How the test targets are turned and exposed.

    Attributes
    ----------
    angle : EdgeAngle
        Of the knife edge against the pixel columns or rows, radians.
    region : Whole
        Side of the recorded images, pixels.
    white : White
        Signal of a wide bright area in each frame, as a share of the full well, through a free pupil; what bodies in
        the beam take is missing.
    frames : Frames | None
        Number of frames, None for as many as there are of the spots.
    """

    angle: EdgeAngle = float(np.radians(5.0))
    region: Annotated[Whole, Field(ge=112, le=512)] = 112
    white: White = 0.6
    frames: Frames | None = None


class PerturbationSpec(PlainPerturbationSpec):
    """What happens to one body of a job's instrument: also temperatures at nodes and, for a mirror or a prism's face,
    displaced nodes of a finite-element program. The other motions come on top of these.

    Attributes
    ----------
    rotate
        Rotation vector in the body's own frame, about the pivot, radians; it comes before the shift.
    shift
        In the body's own frame, metres.
    pivot
        Name of the body's point that the rotation leaves in place and that the scale change starts from.
    figure
        Zernike terms of the surface error, by Noll's numbering and normalisation, metres.
    scale
        Relative growth of the body and all it carries, 1e-6 for 1 ppm.
    radius
        Relative change of the vertex radius of curvature, 1e-6 for 1 ppm.
    conic
        Change of the conic constant, a pure number.
    index
        Change of the refractive index of the lens that begins at this face, a pure number.
    abbe
        Relative change of the Abbe number of the lens that begins at this face; its index at the d line stays.
    temperature : job_tables.TableTemperature | None
        Uniform change as `2 K`, with a gradient, or a table of temperatures at nodes, in place of what the body
        inherits from the one that carries it, also where the change is `0 K`; None for what it inherits.
    deformation : job_tables.Deformation | None
        The table of displaced nodes, or a mesh; None for none.
    """

    temperature: job_tables.TableTemperature | None = None
    deformation: job_tables.Deformation | None = None

    @property
    def heat(self) -> job_tables.TableTemperatureSpec:
        """Its own temperature; no change where none is given."""
        return job_tables.TableTemperatureSpec() if self.temperature is None else self.temperature

    @classmethod
    def of(cls, perturb: Mapping[str, PlainPerturbationSpec]) -> "FrozenMap[str, PerturbationSpec]":
        """Perturbations of another file's as a job has them."""
        return FrozenMap(
            {
                path: cls.model_construct(
                    **{
                        **dict(what),
                        "temperature": None
                        if what.temperature is None
                        else job_tables.TableTemperatureSpec.model_construct(**dict(what.temperature)),
                    }
                )
                for path, what in perturb.items()
            }
        )

    def uses(self) -> tuple[str, ...]:
        """Which of the actions do something, deformation the last."""
        return (*super().uses(), *(("deformation",) if self.deformation is not None else ()))


def _some(images: tuple[str, ...]) -> tuple[str, ...]:
    """Every image once, the spots first."""
    if not images:
        raise Problem("nothing to render", "an empty list", "[spots]")
    return tuple(dict.fromkeys(("spots", *images)))


class StraySpec(Spec):
    """Path tracing of ghosts and stray light.

    Attributes
    ----------
    paths : Whole
        From every source.
    finishes : job_tables.FinishesSpec | None
        Measured BSDFs and coatings of surfaces in place of the built-in finishes.
    """

    paths: Annotated[Whole, Field(ge=10_000, le=1_000_000_000)] = 1_000_000
    finishes: job_tables.FinishesSpec | None = None


def _switch(value: Any) -> Any:
    """`stray: true` takes the defaults, `stray: false` is none."""
    return {True: {}, False: None}[value] if isinstance(value, bool) else value


class RenderSpec(Spec):
    """What is rendered.

    Attributes
    ----------
    images : tuple[str, ...]
        Which images: the monitor's spots, which are always among them, and test targets on the line CCDs.
    targets : TargetsSpec | None
        How the test targets are turned and exposed, None for the defaults.
    stray : StraySpec | None
        Whether ghosts and stray light are path-traced and added: true, or the number of paths.
    quality : Flag
        Whether wavefront errors, defocus and MTF on the line CCDs are worked out.
    obstruction : Literal['traced', 'ignore']
        `traced`: what prisms, baffles and other bodies take of the cameras' beams is missing in image quality and
        targets; `ignore`: their pupils are free.
    frames : Frames | None
        Number of frames, None for as many as the instrument's monitor takes.
    seed : Seed
        Of every random number in the job.
    """

    images: Annotated[tuple[Annotated[str, OneOf(lambda: ("spots", *target_names()))], ...], AfterValidator(_some)] = (
        "spots",
    )
    targets: TargetsSpec | None = None
    stray: Annotated[StraySpec | None, BeforeValidator(_switch)] = None
    quality: Flag = False
    obstruction: Literal["traced", "ignore"] = "traced"
    frames: Frames | None = None
    seed: Seed = 1

    @model_validator(mode="after")
    def _targets_are_rendered(self) -> "RenderSpec":
        if self.targets is not None and not self.target_images:
            known = ", ".join(target_names())
            raise Problem(
                "targets are described, but none is rendered", "no target among images", known, within=("images",)
            )
        return self

    @property
    def obstructed(self) -> bool:
        """Whether bodies in the cameras' beams count."""
        return self.obstruction == "traced"

    @property
    def target_images(self) -> tuple[str, ...]:
        """The test targets among the images, in the order of `target_names`."""
        return tuple(name for name in target_names() if name in self.images)


class AnalysisSpec(Spec):
    """How the images are analysed: by which method the centres of the spots are found."""

    centroid: Annotated[str, OneOf(Named("analysis.spots:CENTROIDS").get)] = "ml"


def pivot_problem(
    perturb: Mapping[str, PlainPerturbationSpec], course: CourseSpec, within: KeyPath = ()
) -> Problem | None:
    """What is wrong where a course turns a node about another pivot than the perturbation that it is added to.

    Parameters
    ----------
    perturb : Mapping[str, PlainPerturbationSpec]
        Of the job.
    course : CourseSpec
        With its motions.
    within : KeyPath
        Where the course stands.
    """
    for path, moves in course.motion.items():
        own = perturb.get(path)
        if own is not None and (any(own.rotate) or own.scale) and own.pivot != moves.pivot:
            text = "another pivot than under perturb, to which the course is added"
            return Problem(text, shown(moves.pivot), own.pivot, within=(*within, "motion", path, "pivot"))
    return None


class JobSpec(Spec):
    """A job.

    Attributes
    ----------
    instrument : Ref
        Name of an instrument in scenes/library/instruments, or path of an own file, relative to the job's file. A
        camera, as `{camera: NAME or FILE}` or named like an instrument, is one without a monitor.
    perturb : Paths[PerturbationSpec]
        Node -> perturbation, by the node's path or the last parts of it; or a list of texts such as `M2 shift z 20 um`.
        Empty for the nominal state.
    course : CourseSpec | None
        Temperatures and motions that change with time, None for a single state.
    disturbances : JobDisturbances | None
        What is expected to move, on which the sigmas rest: a file, or changes of single lines of it; the instrument's
        own by default, `none` for the noise alone.
    render : RenderSpec
        What is rendered.
    analysis : AnalysisSpec
        How it is analysed.
    """

    instrument: Ref
    perturb: Annotated[Paths[PerturbationSpec], IN_WORDS] = Field(default_factory=FrozenMap)
    course: CourseSpec | None = None
    disturbances: JobDisturbances | None = None
    render: Annotated[RenderSpec, NothingIsEmpty] = RenderSpec.model_construct()
    analysis: Annotated[AnalysisSpec, NothingIsEmpty] = AnalysisSpec.model_construct()

    @model_validator(mode="after")
    def _stray_of_one_state(self) -> "JobSpec":
        if self.course is not None and self.render.stray is not None:
            raise Problem(
                "stray light is traced for one state, not for every time of a course",
                "both course and render.stray",
                "one of them; put the temperatures of one time under perturb",
                within=("render", "stray"),
            )
        return self

    @model_validator(mode="after")
    def _one_pivot(self) -> "JobSpec":
        # a table is added to when it has been read
        problem = None
        if self.course is not None and self.course.table is None:
            problem = pivot_problem(self.perturb, self.course, ("course",))
        if problem is not None:
            raise problem
        return self

    def fields(self, time: int | None = None) -> dict[str, Temperature]:
        """Node path -> change of its temperature, of the perturbation and of the course at time number ``time``."""
        out = {path: what.heat.linear for path, what in self.perturb.items() if what.temperature is not None}
        if self.course is not None and time is not None:
            for path, added in self.course.fields(time).items():
                out[path] = out.get(path, Temperature()) + added
        return out


def _with_course(job: JobSpec) -> JobSpec:
    """The job with the times, temperatures and motions of its course's table, which is then no longer named."""
    if job.course is None or job.course.table is None:
        return job
    path = job.course.file_at(("table",), job.course.table, Path(job.source.file).parent, "a CSV file")
    course = read_course(path, job.course)
    if problem := pivot_problem(job.perturb, course):
        raise job.course.error(problem)
    return job.model_copy(update={"course": course})


def with_tables(job: JobSpec) -> JobSpec:
    """The job with the contents of its course's table, and the full paths and checksums of its other tables: of nodes
    that deform or warm its bodies, of finishes.

    Raises
    ------
    InputError
        a table that cannot be read or is not the one of the checksum.
    """
    job = _with_course(job)
    changed = {}
    for path, what in job.perturb.items():
        update: dict[str, Any] = {}
        if what.deformation is not None:
            update["deformation"] = job_tables.checked(job, ("perturb", path, "deformation"), what.deformation)
        if what.heat.table is not None:
            update["temperature"] = job_tables.checked(job, ("perturb", path, "temperature"), what.heat)
        if update:
            changed[path] = what.model_copy(update=update)
    whole: dict[str, Any] = {"perturb": FrozenMap({**job.perturb, **changed})} if changed else {}
    stray = job.render.stray
    if stray is not None and stray.finishes is not None:
        finishes = job_tables.checked_finishes(job, ("render", "stray", "finishes"), stray.finishes)
        whole["render"] = job.render.model_copy(update={"stray": stray.model_copy(update={"finishes": finishes})})
    return job.model_copy(update=whole) if whole else job


def checked_nodes(job: JobSpec, nodes: Mapping[str, NodeInfo]) -> JobSpec:
    """Check that every perturbed node exists, has the named pivot and allows what is done to it.

    Parameters
    ----------
    job : JobSpec
        As loaded.
    nodes : Mapping[str, NodeInfo]
        Node path -> what may be done to it, for all bodies of the instrument.

    Returns
    -------
    JobSpec
        The job with the paths of nodes in place of their short names.

    Raises
    ------
    InputError
        One issue for each fault, with the nearest valid name.
    """
    perturb = in_full(job.perturb, nodes, lambda problem, name: job.issue(problem, ("perturb", name)))
    if perturb != job.perturb:
        job = job.model_copy(update={"perturb": perturb})
    issues = [
        issue
        for path, what in job.perturb.items()
        for issue in perturbation_issues(job, nodes, path, what, ("perturb", path))
    ]
    if job.course is not None:
        issues += _course_issues(job.course, nodes)
    if issues:
        raise InputError(*issues)
    return job


def _course_issues(course: CourseSpec, nodes: Mapping[str, NodeInfo]) -> list[Issue]:
    issues = []
    for path in course.temperature:
        key: KeyPath = ("temperature", path)
        if path not in nodes:
            issues.append(no_such_node(course, nodes, path, key))
        elif "temperature" not in nodes[path].allows:
            issues.append(not_allowed(course, nodes[path], "temperature", key))
    for path, moves in course.motion.items():
        # what is given at any time counts, also where it is zero
        does: dict[str, Any] = {
            name: 1.0 if name == "scale" else (1.0, 1.0, 1.0) for name, v in moves.given.items() if v is not None
        }
        whole = PerturbationSpec.model_construct(**does, pivot=moves.pivot)
        issues += perturbation_issues(course, nodes, path, whole, ("motion", path))
    return issues
