"""Job of `twin.render`: an instrument, its perturbation, its changes with time, and the images to be rendered."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from optics.numerics.number_tree import FrozenMap
from optics.targets.target_shapes import TARGETS
from optics.thermal.heat import Temperature
from scenes.specs import job_tables, perturbation
from scenes.specs.course import CourseSpec, read_course
from scenes.specs.disturbances import JobDisturbances
from scenes.specs.instrument import Frames
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, shown
from scenes.yaml.named import Named
from scenes.yaml.spec import Flag, NothingIsEmpty, OneOf, Paths, Ref, Seed, Spec, Whole
from scenes.yaml.unit_fields import Quantity
from scenes.yaml.units import ANGLE, SCALE


def target_names() -> tuple[str, ...]:
    """Return the names that ``render.images`` allows beside `spots`: targets whose MTF is measured, then the others."""
    return ("knife_edge", "bars", *TARGETS)


EdgeAngle = Annotated[float, Quantity(ANGLE, smallest="2 deg", largest="10 deg")]
White = Annotated[float, Quantity(SCALE, smallest="0.1 percent", largest="100 percent")]


class TargetsSpec(Spec):
    """Orientation and exposure of the test targets.

    Attributes
    ----------
    angle : float
        Angle of the knife edge to the pixel columns or rows, in radians.
    region : int
        Side of the recorded images, in pixels.
    white : float
        Signal of a large bright area in each frame through an unobstructed pupil, as a fraction of the full well;
        bodies in the beam reduce it.
    frames : int | None
        Number of frames; by default that of the spots.
    """

    angle: EdgeAngle = float(np.radians(5.0))
    region: Annotated[Whole, Field(ge=112, le=512)] = 112
    white: White = 0.6
    frames: Frames | None = None


class PerturbationSpec(perturbation.PlainPerturbationSpec):
    """Perturbation of one body of a job's instrument.

    Besides the motions it may have temperatures at nodes and, for a mirror or a prism's face, displaced nodes of a
    finite-element program, to which the motions are added.

    Attributes
    ----------
    temperature : TableTemperatureSpec | None
        Temperature change: uniform as `2 K`, with a gradient, or a table of temperatures at nodes. It replaces the
        change that the body inherits from its carrier, even if it is `0 K`; by default the change is inherited.
    deformation : DeformationSpec | None
        Table or mesh of displaced nodes; by default there is no deformation.
    """

    temperature: job_tables.TableTemperature | None = None
    deformation: job_tables.Deformation | None = None

    @property
    def heat(self) -> job_tables.TableTemperatureSpec:
        """Temperature change of the body; zero by default."""
        return job_tables.TableTemperatureSpec() if self.temperature is None else self.temperature

    @classmethod
    def of(cls, perturb: Mapping[str, perturbation.PlainPerturbationSpec]) -> "FrozenMap[str, PerturbationSpec]":
        """Return the perturbations of another file in the form of a job."""
        out = {}
        for path, what in perturb.items():
            heat = what.temperature
            with_table = None if heat is None else job_tables.TableTemperatureSpec.model_construct(**dict(heat))
            out[path] = cls.model_construct(**{**dict(what), "temperature": with_table})
        return FrozenMap(out)

    def uses(self) -> tuple[str, ...]:
        """Return the names of the changes that have an effect, such as ``shift``; ``deformation`` comes last."""
        return (*super().uses(), *(("deformation",) if self.deformation is not None else ()))


def _with_spots(images: tuple[str, ...]) -> tuple[str, ...]:
    """Return the requested images without repetitions, the spots first."""
    if not images:
        raise Problem("nothing to render", "an empty list", "[spots]")
    return tuple(dict.fromkeys(("spots", *images)))


class StraySpec(Spec):
    """Path tracing of ghosts and stray light.

    Attributes
    ----------
    paths : int
        Number of paths from every source.
    finishes : FinishesSpec | None
        Measured BSDFs and coatings of surfaces; by default the built-in finishes.
    """

    paths: Annotated[Whole, Field(ge=10_000, le=1_000_000_000)] = 1_000_000
    finishes: job_tables.FinishesSpec | None = None


def _switch(value: Any) -> Any:
    """Replace the value `true` of `stray` by a mapping of defaults, and `false` by None."""
    return {True: {}, False: None}[value] if isinstance(value, bool) else value


class RenderSpec(Spec):
    """Images and analyses of a job.

    Attributes
    ----------
    images : tuple[str, ...]
        Images to be rendered: the monitor's spots, which are always included, and test targets on the line CCDs.
    targets : TargetsSpec | None
        Orientation and exposure of the test targets; their defaults if omitted.
    stray : StraySpec | None
        Path tracing of ghosts and stray light: `true`, or a mapping with the number of paths; by default they are not
        traced.
    quality : bool
        True to compute wavefront errors, defocus and MTF on the line CCDs.
    obstruction : {'traced', 'ignore'}
        Treatment of prisms, baffles and other bodies in the cameras' beams: `traced`, they block light for image
        quality and targets; `ignore`, the pupils are unobstructed.
    frames : int | None
        Number of frames; by default that of the instrument's monitor.
    seed : int
        Seed of all random numbers of the job.
    """

    images: Annotated[
        tuple[Annotated[str, OneOf(lambda: ("spots", *target_names()))], ...], AfterValidator(_with_spots)
    ] = ("spots",)
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
        """True if bodies block light of the cameras' beams."""
        return self.obstruction == "traced"

    @property
    def target_images(self) -> tuple[str, ...]:
        """Test targets among the images, in the order of `target_names`."""
        return tuple(name for name in target_names() if name in self.images)


class AnalysisSpec(Spec):
    """Analysis of the monitor's images.

    Attributes
    ----------
    centroid : str
        Method that measures the positions of the spots.
    """

    centroid: Annotated[str, OneOf(Named("analysis.spots:CENTROIDS").get)] = "ml"


def pivot_problem(
    perturb: Mapping[str, perturbation.PlainPerturbationSpec], course: CourseSpec, within: KeyPath = ()
) -> Problem | None:
    """Return the problem of a course that rotates a node about a pivot that differs from the one in the perturbation.

    Parameters
    ----------
    perturb : Mapping[str, PlainPerturbationSpec]
        Perturbations of the job.
    course : CourseSpec
        Course with its motions, which are added to the perturbations.
    within : KeyPath
        Key path of the course.
    """
    for path, moves in course.motion.items():
        other = perturb.get(path)
        if other is not None and (any(other.rotate) or other.scale) and other.pivot != moves.pivot:
            text = "the pivot differs from that under perturb, to which the course is added"
            return Problem(text, shown(moves.pivot), other.pivot, within=(*within, "motion", path, "pivot"))
    return None


class JobSpec(Spec):
    """Job of `twin.render`: an instrument, its perturbation and the images to be rendered.

    Attributes
    ----------
    instrument : str
        Name of an instrument in scenes/library/instruments, or path of your file relative to the job's file. A camera,
        given as `{camera: NAME or FILE}` or by its name, is an instrument without a monitor.
    perturb : Mapping[str, PerturbationSpec]
        Node -> perturbation; the node is given by its path or the last parts of it. Or a list of texts such as `M2
        shift z 20 um`. By default the instrument is in its nominal state.
    course : CourseSpec | None
        Temperatures and motions that change with time; by default there is a single state.
    disturbances : JobDisturbancesSpec | None
        Expected disturbances, on which the sigmas are based: a file, or changes of single causes of it. By default
        those of the instrument; `none` for sigmas of the noise alone.
    render : RenderSpec
        Images and analyses of the job.
    analysis : AnalysisSpec
        Analysis of the monitor's images.
    refocus : bool
        True to move the focal plane of a camera without a monitor to its best position in this state, as the option
        `--refocus` of `twin.camera` does; all results are those after refocusing.
    """

    instrument: Ref
    perturb: Annotated[Paths[PerturbationSpec], perturbation.IN_WORDS] = Field(default_factory=FrozenMap)
    course: CourseSpec | None = None
    disturbances: JobDisturbances | None = None
    render: Annotated[RenderSpec, NothingIsEmpty] = RenderSpec.model_construct()
    analysis: Annotated[AnalysisSpec, NothingIsEmpty] = AnalysisSpec.model_construct()
    refocus: Annotated[Flag, Field(exclude_if=lambda refocus: not refocus)] = False

    @model_validator(mode="after")
    def _stray_of_one_state(self) -> "JobSpec":
        if self.course is not None and self.render.stray is not None:
            raise Problem(
                "stray light is traced for one state, not for every time of a course",
                "both course and render.stray",
                "one of them; put the temperatures of one time under perturb",
                within=("render", "stray"),
            )
        if self.course is not None and self.refocus:
            raise Problem("a state is refocused, not a course", "both course and refocus", within=("refocus",))
        return self

    @model_validator(mode="after")
    def _one_pivot(self) -> "JobSpec":
        # a course in a table is checked when the table has been read
        problem = None
        if self.course is not None and self.course.table is None:
            problem = pivot_problem(self.perturb, self.course, ("course",))
        if problem is not None:
            raise problem
        return self

    def fields(self, time: int | None = None) -> dict[str, Temperature]:
        """Return node path -> temperature change by the perturbation and by the course at time number ``time``."""
        out = {path: what.heat.linear for path, what in self.perturb.items() if what.temperature is not None}
        if self.course is not None and time is not None:
            for path, added in self.course.fields(time).items():
                out[path] = out.get(path, Temperature()) + added
        return out


def _with_course(job: JobSpec) -> JobSpec:
    """Return the job with the content of its course's table instead of the reference to it."""
    if job.course is None or job.course.table is None:
        return job
    path = job.course.file_at(("table",), job.course.table, Path(job.source.file).parent, "a CSV file")
    course = read_course(path, job.course)
    if problem := pivot_problem(job.perturb, course):
        raise job.course.error(problem)
    return job.model_copy(update={"course": course})


def with_tables(job: JobSpec) -> JobSpec:
    """Return the job with the content, or the checksums, of the tables to which it refers.

    The content of the course's table replaces the reference to it. The tables of nodes and of finishes get their
    absolute paths and checksums.

    Raises
    ------
    InputError
        A table cannot be read, or its checksum differs.
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


def checked_nodes(job: JobSpec, nodes: Mapping[str, perturbation.NodeInfo]) -> JobSpec:
    """Return the job with full paths of its nodes, after a check that each node allows its perturbation.

    Parameters
    ----------
    job : JobSpec
        Job as loaded.
    nodes : Mapping[str, NodeInfo]
        Node path -> allowed actions, for all bodies of the instrument.

    Returns
    -------
    JobSpec
        The job with the paths of nodes instead of their short names.

    Raises
    ------
    InputError
        A node does not exist, has no such pivot or does not allow an action; one issue for each fault, with the nearest
        valid name.
    """
    perturb = perturbation.with_full_paths(
        job.perturb, nodes, lambda problem, name: job.issue(problem, ("perturb", name))
    )
    if perturb != job.perturb:
        job = job.model_copy(update={"perturb": perturb})
    issues = [
        issue
        for path, what in job.perturb.items()
        for issue in perturbation.perturbation_issues(job, nodes, path, what, ("perturb", path))
    ]
    if job.course is not None:
        issues += _course_issues(job.course, nodes)
    if issues:
        raise InputError(*issues)
    return job


def _course_issues(course: CourseSpec, nodes: Mapping[str, perturbation.NodeInfo]) -> list[Issue]:
    issues = []
    for path in course.temperature:
        key: KeyPath = ("temperature", path)
        if path not in nodes:
            issues.append(perturbation.no_such_node(course, nodes, path, key))
        elif "temperature" not in nodes[path].allows:
            issues.append(perturbation.not_allowed(course, nodes[path], "temperature", key))
    for path, moves in course.motion.items():
        # a quantity that the course has counts at every time, even where it is zero
        does: dict[str, Any] = {
            name: 1.0 if name == "scale" else (1.0, 1.0, 1.0) for name, v in moves.series.items() if v is not None
        }
        whole = PerturbationSpec.model_construct(**does, pivot=moves.pivot)
        issues += perturbation.perturbation_issues(course, nodes, path, whole, ("motion", path))
    return issues
