"""Sources that the live twin can open.

They are an instrument, a job, a measurement, a study whose factors become knobs, or a run folder of any command from
which an instrument can be shown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from scenes.specs.file_kinds import kind_of, read_for
from scenes.specs.job import JobSpec
from scenes.specs.load import CAMERAS, INSTRUMENTS, library_names
from scenes.specs.monitor_frames import MeasurementSetup
from scenes.specs.orbit.setup import MonitorSetup
from scenes.specs.resolved import ResolvedJob, resolve, resolve_job
from scenes.yaml.errors import InputError, Issue, Problem, names_text, unknown
from scenes.yaml.named import FileKind
from scenes.yaml.spec import validate
from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from scenes.yaml.yaml_file import YamlFile, read_yaml
from twin.framework.durable import digest
from twin.framework.run_folder import Manifest, read_manifest
from twin.live.knobs import FactorKnob, base_with_factors, factor_knobs
from twin.live.messages import MOST_FRAMES
from twin.study.runs.plan import Plan
from twin.study.runs.setup import StudySetup, resolve_study

PROGRAM = "twin.live"
CONFIG, REPORT = "config.yaml", "report.html"
ALLOWED = (
    "an instrument, a camera, a job or a measurement of one, a study of jobs, or a run folder of twin.render, "
    "twin.recover, twin.uncertainty, twin.orbit monitor or such a study"
)
"""Description of the sources that can be opened, for error messages."""
MOST_NAMED = 3
"""Largest number of run folders named in an error about a folder of run folders."""


@dataclass(frozen=True, eq=False)
class Source:
    """Opened source: the job to be shown on the page, and where it comes from.

    Attributes
    ----------
    resolved : ResolvedJob
        Job with the contents of all files that it refers to.
    name : str
        Name of the file or run folder, with the number of a study's run; empty for an instrument of the library.
    about : str
        Short description.
    notes : tuple[str, ...]
        Sentences on differences between the page and the source.
    study : StudySetup | None
        Study whose base, or run, it is; None for other sources.
    factors : tuple[FactorKnob, ...]
        Numeric factors of the study.
    scalars : Mapping[str, Any] | None
        Factor -> its value in the opened run; None for the base.
    has_own_seed : bool
        Whether the opened run has a seed of its own, which is then the job's.
    """

    resolved: ResolvedJob
    name: str = ""
    about: str = ""
    notes: tuple[str, ...] = ()
    study: StudySetup | None = None
    factors: tuple[FactorKnob, ...] = ()
    scalars: Mapping[str, Any] | None = None
    has_own_seed: bool = False

    def with_factors(self, values: Mapping[str, float]) -> ResolvedJob:
        """Return the job with other values of a study's factors, including the values that scale with them.

        Parameters
        ----------
        values : Mapping[str, float]
            Factor -> number in its unit; the others keep those of the base, or of the opened run.

        Raises
        ------
        InputError
            A factor does not exist, or a value is not possible.
        """
        if self.study is None or not values:
            return self.resolved
        known = {factor.name: factor for factor in self.factors}
        for name in values:
            if name not in known:
                raise InputError(unknown("no such factor", name, known).at())
        scalars = {**(self.scalars or {}), **{name: known[name].scalar(value) for name, value in values.items()}}
        job: ResolvedJob = validate(ResolvedJob, YamlFile("", base_with_factors(self.study, scalars), {}))
        return job.with_render(job.frames, self.resolved.job.render.seed) if self.has_own_seed else job


def read_source(what: str, run: int | None = None) -> Source:
    """Read a source that the live twin can open.

    Parameters
    ----------
    what : str
        Name of an instrument or a camera in the library, or path of such a file, of a job, of a measurement, of a
        study, of a run folder or of its config.yaml.
    run : int | None
        Number of one of a study's runs, from 0; None for its base.

    Raises
    ------
    InputError
        The source cannot be read, is not valid, or cannot be opened.
    """
    if what in (*library_names(INSTRUMENTS), *library_names(CAMERAS)):
        _require_no_run(what, run)
        return Source(resolve_job(validate(JobSpec, YamlFile("", {"instrument": what}, {}))), about=what)
    path = Path(what)
    if path.name == CONFIG and read_manifest(path.parent) is not None:
        path = path.parent
    source = _of_folder(path, run) if path.is_dir() else _of_file(path, run)
    name = path.resolve().name if run is None else f"{path.resolve().name}, run {run}"
    return _limited_to_page(replace(source, name=name))


def _of_folder(folder: Path, run: int | None) -> Source:
    """Return the source that a run folder represents, by the command that wrote it."""
    config, manifest = folder / CONFIG, read_manifest(folder)
    if not config.is_file():
        raise InputError(_no_config(folder, manifest))
    source = _of_file(config, run, manifest)
    notes = list(source.notes)
    listed = None if manifest is None else manifest.sha256.get(CONFIG)
    if listed is not None and listed != digest(config):
        notes.append(f"{config} was changed after the run: the page shows its present content, not that of the run")
    return replace(source, about=f"{folder.name}: {source.about}", notes=tuple(notes))


def _no_config(folder: Path, manifest: Manifest | None) -> Issue:
    """Return the error that a run folder has no config.yaml."""
    if manifest is not None:
        return _nothing_to_show(folder, f"a run folder of {manifest.program}", folder)
    try:
        inside = sorted(child.name for child in folder.iterdir() if (child / CONFIG).is_file())
    except OSError:
        inside = []
    meant = names_text(str(folder / name) for name in inside[:MOST_NAMED])
    hint = f"one of the run folders in it, as {meant}" if inside else ALLOWED
    return Issue(f"this is not a run folder: it has no {CONFIG}", str(folder), allowed=hint)


def _of_file(file: Path, run: int | None, manifest: Manifest | None = None) -> Source:
    """Return the source of a file; the kind of a run's config.yaml is recognised by its content.

    Parameters
    ----------
    file : Path
        File to read.
    run : int | None
        Number of a study's run.
    manifest : Manifest | None
        Manifest of the run folder whose config.yaml the file is; None for any other file.
    """
    data = read_yaml(file).data
    kind = kind_of(data)
    name = "" if kind is None else kind.name
    if name == "study":
        return _of_study(file, run)
    _require_no_run(str(file), run)
    if name == "job":
        return Source(resolve(file), about="a job of the monitor")
    if name == "measurement":
        return _of_measurement(file)
    if name == "orbit_monitor":
        return _of_orbit(file)
    if name in ("instrument", "as_built_instrument", "camera"):
        path = str(file.resolve())
        return Source(resolve_job(validate(JobSpec, YamlFile("", {"instrument": path}, {}))), about=file.stem)
    if manifest is not None and manifest.program != "twin.render":
        raise InputError(_nothing_to_show(file, _run_of(kind, manifest), file.parent, data))
    return Source(read_for(PROGRAM, file, resolve), about="a job of the monitor")


def _require_no_run(what: str, run: int | None) -> None:
    """Raise InputError if the number of a run is given for a source that is not a study."""
    if run is not None:
        raise InputError(Issue("--run chooses a run of a study, but this is not a study", what, value=f"--run {run}"))


def _run_of(kind: FileKind | None, manifest: Manifest) -> str:
    """Return a description of what kind of run folder it is, as text."""
    if kind is not None and kind.command.startswith(manifest.program):
        return f"the run folder of {kind.what} ({kind.command})"
    return f"a run folder of {manifest.program}"


def _nothing_to_show(place: Path, what: str, folder: Path, data: Any = None) -> Issue:
    """Return the error that a run folder cannot be opened, with the reason and what to open instead."""
    remedies = []
    if (folder / REPORT).is_file():
        remedies.append(f"its results are in {folder / REPORT}")
    instruments = sorted(path for path in (folder / "artefacts").glob("*.yaml") if _is_instrument(path))
    instrument = data.get("instrument") if isinstance(data, dict) else None
    name = instrument.get("name") if isinstance(instrument, dict) else None
    if instruments:
        remedies.append(f"python -m {PROGRAM} {instruments[0]} opens an instrument that it made")
    elif name in library_names(INSTRUMENTS):
        remedies.append(f"python -m {PROGRAM} {name} opens its instrument")
    text = "; ".join(["this is " + what + ", which contains no state of a monitor to show", *remedies])
    return Issue(text, str(place), allowed=ALLOWED)


def _is_instrument(file: Path) -> bool:
    """Return whether a file is an instrument."""
    try:
        kind = kind_of(read_yaml(file).data)
    except InputError:
        return False
    return kind is not None and kind.name == "instrument"


def _of_measurement(file: Path) -> Source:
    """Return the unperturbed instrument with which the frames of a measurement were taken, as a source.

    The perturbation is not known; it is what the measurement was to find.
    """
    model = MeasurementSetup.read(file).model
    if model is None:
        text = "this measurement uses the geometry of the cameras alone, without an instrument to show"
        raise InputError(Issue(text, str(file), allowed=ALLOWED))
    note = (
        "the measured frames are not shown: the page renders the nominal instrument, and the knobs are a guess of "
        "the motions"
    )
    return Source(model, about="a measurement", notes=(note,))


def _of_orbit(file: Path) -> Source:
    """Return a monitored orbit as a job with a time series of states, which includes its stepwise motions."""
    setup = MonitorSetup.read(file)
    if setup.test.course is None:
        problem = "the motions of this orbit are random, so that it has no course to show"
        raise setup.test.error(problem, ("mechanisms", "readings"), allowed="a course")
    note = "changes are relative to the nominal instrument, not to the reference time of the orbit's test"
    return Source(_with_motions(setup), about="a monitored orbit", notes=(note,))


def _with_motions(setup: MonitorSetup) -> ResolvedJob:
    """Return the job of a monitored orbit with tabulated motions of the mounts at each of its times.

    In its file these motions are functions of time.

    Raises
    ------
    InputError
        A body's pivot differs from the one under ``perturb``.
    """
    resolved, test = setup.resolved, setup.test
    if not test.motion:
        return resolved
    plain = resolved.plain()
    motions: dict[str, Any] = {}
    for node, motion in test.motion.items():
        shares = [motion.share(time) for time in test.times]
        motions[node] = {"pivot": motion.pivot}
        for name, kind, values in (("rotate", ANGLE, motion.rotate), ("shift", LENGTH, motion.shift)):
            if any(values):
                motions[node][name] = [[format_quantity(share * value, kind) for value in values] for share in shares]
    plain["job"]["course"]["motion"] = motions
    made: ResolvedJob = validate(ResolvedJob, YamlFile(test.source.file, plain, {}))
    return made


def _of_study(file: Path, run: int | None) -> Source:
    """Return the base job of a study, or one of its runs, as a source."""
    setup = resolve_study(file)
    if setup.study.base.command != "render":
        command, allowed = setup.study.base.command, "a study of base: {command: render}"
        raise setup.error(Problem("this study does not vary a job of a monitor", command, allowed), ("base", "command"))
    factors, name = factor_knobs(setup), setup.study.name
    if run is None:
        resolved: ResolvedJob = validate(ResolvedJob, YamlFile("", setup.base, {}))
        return Source(resolved, about=f"the base of the study {name}", study=setup, factors=factors)
    plan = Plan.of(setup)
    if not 0 <= run < plan.runs:
        text = "the study has no such run"
        raise InputError(Issue(text, str(file), value=f"--run {run}", allowed=f"0 to {plan.runs - 1}"))
    single, scalars = plan.run(run), {column.name: column.cell(run) for column in plan.columns}
    try:
        resolved = validate(ResolvedJob, YamlFile("", base_with_factors(setup, scalars), {}))
    except InputError as error:
        raise setup.blamed(error) from None
    if single.seed is not None:
        resolved = resolved.with_render(resolved.frames, single.seed)
    factors = tuple(factor.starting_at(scalars[factor.name]) for factor in factors)
    values = ", ".join(f"{key} {value}" for key, value in scalars.items())
    about, has_own_seed = f"run {run} of the study {name}: {values}", single.seed is not None
    return Source(resolved, about=about, study=setup, factors=factors, scalars=scalars, has_own_seed=has_own_seed)


def _limited_to_page(source: Source) -> Source:
    """Return the source with notes on what the page cannot show of it."""
    frames = source.resolved.frames
    if frames <= MOST_FRAMES:
        return source
    return replace(source, notes=(*source.notes, f"the page uses {MOST_FRAMES} frames instead of {frames}"))
