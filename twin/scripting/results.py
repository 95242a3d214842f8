"""Results of scripts: frames and true changes of an exposure, and the changes estimated from frames.

Commands of the twin run from a Python script, with their results as Python objects.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from analysis.arrays import shows
from analysis.monitor import parameters
from analysis.monitor.estimators import preferred_estimator
from analysis.monitor.monitor_formulas import CameraParameters
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP
from optics.numerics.backend import Backend, load_backend
from scenes.specs.procedures import PROCEDURES, Procedure
from scenes.yaml.errors import InputError, Issue, unknown
from scenes.yaml.spec import Source, Spec, validate
from scenes.yaml.yaml_file import YamlFile
from twin.framework.artefact import cell_text
from twin.framework.page import RunFacts, write_test
from twin.framework.procedure import Session, performed, seeded, silent
from twin.framework.record import frames_text
from twin.framework.report import Report, with_warnings
from twin.framework.run_folder import RunFolder
from twin.main_job.monitor_reading import MonitorReading
from twin.main_job.render_files import irradiance
from twin.main_job.render_results import JobRun, RenderRun
from twin.main_job.verdict import judge
from twin.monitor.image_quality import AT_FIELDS
from twin.targets.target_measurement import PlaceTargets


@shows("verdict", "truth", "before [DN]", "after [DN]", "warnings")
@dataclass(frozen=True, eq=False)
class Shot:
    """Exposure of the nominal and of the perturbed instrument.

    Attributes
    ----------
    before, after : xr.DataArray
        Frames, uint16 grey values, (channel, frame, row, column); without a monitor there is no channel.
    expected : xr.Dataset
        Expected photons per pixel and frame, (state, channel, row, column), as in irradiance.nc; empty without a
        monitor.
    truth : xr.Dataset
        True changes of every ``camera`` by exact ray tracing: rotations and change of the principal distance. For two
        cameras also ``angle_change_arcsec``, the change of the angle between them, and ``ground_along_m``,
        ``ground_across_m``, ``ground_height_m``, the errors of ground points located without correcting for the
        changes.
    verdict : str
        Result, its accuracy, and what limits it.
    warnings : tuple[str, ...]
        Warnings to read before using the numbers.
    run : JobRun
        All results that the command ``twin.render`` would write: image quality, test targets, stray light, changes over
        time.
    """

    before: xr.DataArray
    after: xr.DataArray
    expected: xr.Dataset
    truth: xr.Dataset
    verdict: str
    warnings: tuple[str, ...]
    run: JobRun = field(repr=False)
    _backend: Backend = field(repr=False)
    _started: float = field(repr=False)
    _seconds: float = field(repr=False)

    def save(self, folder: str | Path, force: bool = False) -> Path:
        """Write the run folder that the command would write, with its report.

        Parameters
        ----------
        folder : str or Path
            Folder to create.
        force : bool
            Whether an existing run folder is replaced.

        Raises
        ------
        RunFolderError
            The folder exists or cannot be written.
        """
        # Imported here, because scripts need the plotting libraries only for this.
        from twin.main_job.render_folder import write_run

        with RunFolder(Path(folder), force) as target:
            clock = time.monotonic() - self._seconds
            write_run(self.run, Session(target, self._backend, silent, self._started, clock))
        return target.target

    @property
    def mtf(self) -> pd.DataFrame:
        """MTF at the Nyquist frequency measured in the images of knife edges, before and after.

        Sigmas and the true values are in further columns. There is a row for every camera, place and direction; the
        table is empty unless ``knife_edge`` is among the images.
        """
        cameras = self.run.targets.cameras if self.run.targets is not None else {}
        rows = {
            (camera, name, direction): _edge_row(targets_at, direction)
            for camera, targets in cameras.items()
            for name, targets_at in targets.positions.items()
            for direction in targets_at.before.edges
        }
        return _indexed(rows, ["camera", "place", "direction"])

    @property
    def quality(self) -> pd.DataFrame:
        """Image quality before and after.

        Columns are wavefront errors (waves rms), best focus relative to the line CCD (um), MTF at Nyquist and vignetted
        light; there is a row for every camera, state and field. The table is empty unless ``quality=True`` was set and
        the instrument has a monitor.
        """
        quality = self.run.quality
        rows = {
            (name, when, field): {quantity.key: quantity.value(camera)[s, k] for quantity in AT_FIELDS}
            for name, camera in ({} if quality is None else quality.cameras).items()
            for s, when in enumerate(("before", "after"))
            for k, field in enumerate(() if quality is None else quality.fields)
        }
        return _indexed(rows, ["camera", "state", "field"])

    def _repr_html_(self) -> str:
        notes = "".join(f"<p>⚠ {escape(text)}</p>" for text in self.warnings)
        verdict = f"<p>{escape(self.verdict)}</p>"
        return f"{verdict}{_truth_frame(self.truth).to_html()}{notes}{self.after._repr_html_()}"


@dataclass(frozen=True, eq=False)
class Recovered:
    """Changes of the cameras that every estimator computes from images ("readings").

    Attributes
    ----------
    values : xr.DataArray
        Estimated changes, (camera, estimator, parameter), in arcsec or um according to the end of the parameters'
        names.
    covariance : xr.DataArray
        Covariance of the total error, (camera, estimator, parameter, parameter_2), in products of these units: due to
        noise and to the disturbances of the prior; without a prior due to noise alone.
    covariance_noise : xr.DataArray
        Part of that covariance due to the noise of the images.
    angle : xr.Dataset
        For two cameras, the change of the angle between their lines of sight: ``change_arcsec`` with
        ``change_arcsec_sigma`` (total) and ``change_arcsec_sigma_noise`` by estimator; empty otherwise.
    ground : xr.Dataset
        For two cameras of known altitude, the errors of located ground points that the changes cause: ``along_m``,
        ``across_m``, ``height_m`` with their sigmas, by estimator; empty otherwise.
    spots : xr.Dataset
        Spot positions ``before`` and ``after`` (channel, axis), px, with ``before_sigma`` and ``after_sigma``.
    disturbances : str
        Name of the disturbance prior on which the total sigmas are based; empty if there is none.
    sigma_holds : bool
        True if all measurements are consistent with the sigmas.
    warnings : tuple[str, ...]
        Reasons why measurements are inconsistent with the sigmas, and other warnings to read before using the numbers.
    from_statement : pd.Series
        Fraction of the variance of each change estimated by ``posterior`` that would remain without image noise: it is
        due to the prior, not to the spots. The index has the levels camera and parameter; empty without a prior.
    """

    values: xr.DataArray
    covariance: xr.DataArray
    covariance_noise: xr.DataArray
    angle: xr.Dataset
    ground: xr.Dataset
    spots: xr.Dataset
    disturbances: str
    sigma_holds: bool = True
    warnings: tuple[str, ...] = ()
    from_statement: pd.Series = field(default_factory=lambda: pd.Series(dtype=float))

    @property
    def sigma(self) -> xr.DataArray:
        """Standard deviations of the total errors of ``values``, due to noise and the prior's disturbances.

        Their units are those of ``values``.
        """
        return self._root(self.covariance).rename("sigma")

    @property
    def sigma_noise(self) -> xr.DataArray:
        """Standard deviations of ``values`` due to the noise of the images alone, in the same units."""
        return self._root(self.covariance_noise).rename("sigma_noise")

    @property
    def judged(self) -> str:
        """Estimator whose sigma and error ``compare`` lists: ``posterior`` with a disturbance prior, else ``model``."""
        return preferred_estimator(self.values.estimator.values.tolist())

    def _root(self, covariance: xr.DataArray) -> xr.DataArray:
        """Return the standard deviations, roots of the diagonals of a covariance, labelled like ``values``."""
        return self.values.copy(data=np.sqrt(np.diagonal(covariance.values, axis1=-2, axis2=-1)))

    def compare(self, truth: xr.Dataset) -> pd.DataFrame:
        """Return a table of estimated ("reading") and true values of the changes.

        Parameters
        ----------
        truth : xr.Dataset
            True changes of the exposure, ``shot.truth``.

        Returns
        -------
        pd.DataFrame
            A row for every camera and parameter, for the angle between two cameras and for errors on the ground.
            Columns: ``true``, each estimator's reading, and for the ``judged`` estimator ``sigma`` (total),
            ``sigma_noise``, ``error`` = reading - true and ``in_sigma`` = error / sigma.
        """
        sigma, noise = self.sigma, self.sigma_noise
        rows = {}
        for camera in self.values.camera.values.tolist():
            for key in self.values.parameter.values.tolist():
                at = {"camera": camera, "parameter": key}
                true = float(truth[key].sel(camera=camera))
                rows[camera, key] = self._row(true, self.values.sel(at), sigma.sel(at), noise.sel(at))
        pairs = [("both", "angle", parameters.ANGLE, self.angle)]
        pairs += [("ground", "ground", parameter, self.ground) for parameter in parameters.GROUND]
        for where, start, parameter, dataset in pairs:
            key, name = f"{start}_{parameter.key}", parameter.key
            if key in truth and dataset:
                columns = (dataset[name], dataset[f"{name}_sigma"], dataset[f"{name}_sigma_noise"])
                rows[where, key] = self._row(float(truth[key]), *columns)
        return _indexed(rows, ["camera", "parameter"])

    def _row(self, true: float, readings: xr.DataArray, sigma: xr.DataArray, noise: xr.DataArray) -> dict[str, float]:
        """Return one row of ``compare``: true value, estimates, sigmas, and error of one quantity also in sigmas."""
        values = {str(name): float(readings.sel(estimator=name)) for name in readings.estimator.values}
        spread, error = float(sigma.sel(estimator=self.judged)), values[self.judged] - true
        noise_sigma = float(noise.sel(estimator=self.judged))
        errors = {"sigma": spread, "sigma_noise": noise_sigma, "error": error, "in_sigma": error / spread}
        return {"true": true, **values, **errors}

    def _repr_html_(self) -> str:
        notes = "".join(f"<p>⚠ {escape(text)}</p>" for text in self.warnings)
        return notes + _reading_frame(self).to_html(escape=True)

    def __repr__(self) -> str:
        notes = "".join(f"\nwarning: {text}" for text in self.warnings)
        return _reading_frame(self).to_string() + notes


def _indexed(rows: Mapping[tuple[Any, ...], Mapping[str, float]], names: list[str]) -> pd.DataFrame:
    """Return a table of rows by tuples of labels, whose levels have these names; empty without rows."""
    table = pd.DataFrame.from_dict(rows, orient="index")
    if rows:
        table.index = pd.MultiIndex.from_tuples(rows, names=names)
    return table


def _edge_row(targets: PlaceTargets, direction: str) -> dict[str, float]:
    """Return one row of ``Shot.mtf``: MTF of a knife edge before and after, with sigma and true value."""
    out: dict[str, float] = {}
    for when, shots in targets.shots.items():
        edge = shots.edges[direction]
        value, sigma = edge.nyquist or (np.nan, np.nan)
        out |= {when: value, f"{when}_sigma": sigma, f"{when}_true": edge.true_nyquist}
    return out


def _reading_frame(recovered: Recovered) -> pd.DataFrame:
    """Return a table of the estimated changes by camera and parameter, with a column for each estimator.

    Sigmas are those of the estimator ``Recovered.judged``.
    """
    values = recovered.values.stack(row=("camera", "parameter")).transpose("row", "estimator").to_pandas()
    values.columns.name = None
    sigmas = {"sigma": recovered.sigma, "sigma_noise": recovered.sigma_noise}
    spreads = {name: s.sel(estimator=recovered.judged).stack(row=("camera", "parameter")) for name, s in sigmas.items()}
    return values.assign(**{name: column.to_pandas() for name, column in spreads.items()})


def _truth_frame(truth: xr.Dataset) -> pd.DataFrame:
    """Return a table of the true changes of the cameras (rotations, principal distance), one row per camera."""
    return truth[[parameter.key for parameter in parameters.CAMERA_PARAMETERS.values()]].to_dataframe()


def shot_of(run: JobRun, backend: Backend, started: float) -> Shot:
    """Return the frames and truth of a finished run; ``started`` is its start in seconds since the epoch (1970)."""
    keys = [channel.key for channel in run.experiment.instrument.channels]
    attributes: dict[str, Any] = {"units": "DN", "instrument": run.resolved.instrument.name}
    before = after = np.zeros((0, run.frames, 0, 0), np.uint16)
    expected = xr.Dataset()
    if isinstance(run, RenderRun):
        before, after, expected = run.before, run.after, irradiance(run).to_xarray()
        attributes |= {"exposure_s": run.experiment.exposure, "pitch_m": run.experiment.path.pitch, "seed": run.seed}

    def frames(name: str, values: np.ndarray) -> xr.DataArray:
        dims = ("channel", "frame", "row", "column")
        return xr.DataArray(values, dims=dims, coords={"channel": keys}, name=name, attrs=attributes)

    judgement = judge(run)
    return Shot(
        before=frames("before", before),
        after=frames("after", after),
        expected=expected,
        truth=_truth(run),
        verdict=judgement.verdict,
        warnings=tuple(judgement.warnings),
        run=run,
        _backend=backend,
        _started=started,
        _seconds=time.time() - started,
    )


def _truth(run: JobRun) -> xr.Dataset:
    """Return the true changes of the cameras in a run as a data set, the content of ``Shot.truth``."""
    truth = run.truth_dict()
    cameras = truth["cameras"]
    keys = list(next(iter(cameras.values())))
    data: dict[str, Any] = {key: ("camera", [cameras[name][key] for name in cameras]) for key in keys}
    for start, group in (("angle", "intersection_angle"), ("ground", "ground")):
        data |= {f"{start}_{key}": value for key, value in truth.get(group, {}).items()}
    attributes = {"reference_frames": frames_text("truth")}
    return xr.Dataset(data, coords={"camera": list(cameras)}, attrs=attributes)


def recovered_of(reading: MonitorReading, warnings: Sequence[str] = ()) -> Recovered:
    """Convert the estimated changes of one perturbed state to the labelled arrays that a script gets.

    Parameters
    ----------
    reading : MonitorReading
        Values and covariances of all estimators in that state.
    warnings : sequence of str
        Warnings about the instrument; those of the reading are appended.
    """
    recovery, cameras = reading.recovery, list(reading.cameras)
    channels = ["/".join(channel) for channel in reading.channels]
    disturbances = "" if reading.disturbances is None else reading.disturbances.name
    texts = (*warnings, *reading.doubts, *reading.notes, *reading.unobserved)
    shares = {(group, key): v for group, named in reading.from_statement.items() for key, v in named.items()}
    from_statement = pd.Series(shares, dtype=float, name="from_statement")
    if shares:
        from_statement.index = pd.MultiIndex.from_tuples(shares, names=["camera", "parameter"])
    estimators = list(recovery.parameters[cameras[0]])
    table, keys = reading.table, [parameter.key for parameter in parameters.CAMERA_PARAMETERS.values()]
    values = [[[table.row(camera, key, name).value for key in keys] for name in estimators] for camera in cameras]
    coords = {"camera": list(cameras), "estimator": estimators, "parameter": keys}
    dims = ("camera", "estimator", "parameter")
    spots = {
        "before": recovery.before[0],
        "after": recovery.after[0],
        "before_sigma": recovery.sigma_before[0],
        "after_sigma": recovery.sigma_after[0],
    }
    about = {"reference_frames": frames_text("recovered")}

    def spread(of: Callable[[CameraParameters], np.ndarray]) -> xr.DataArray:
        """Return covariances (camera, estimator, parameter, parameter_2) in products of the parameters' units."""
        rows = {camera: parameters.rows_of(calibrated) for camera, calibrated in reading.cameras.items()}
        blocks = [
            [matrix @ of(recovery.parameters[c][e])[0] @ matrix.T for e in estimators] for c, matrix in rows.items()
        ]
        both = {**coords, "parameter_2": keys}
        return xr.DataArray(np.array(blocks), dims=(*dims, "parameter_2"), coords=both)

    def by_estimator(group: str) -> xr.Dataset:
        """Return the quantities of a group ("angle" or "ground") with their sigmas, for each estimator."""
        data: dict[str, list[float]] = {}
        for row in table:
            if row.group == group:
                numbers_by_ending = zip(("", "_sigma", "_sigma_noise"), (row.value, row.sigma, row.noise), strict=True)
                for ending, number in numbers_by_ending:
                    data.setdefault(f"{row.parameter.key}{ending}", []).append(number)
        variables = {name: ("estimator", numbers) for name, numbers in data.items()}
        return xr.Dataset(variables, coords={"estimator": estimators} if data else {}, attrs=about)

    return Recovered(
        values=xr.DataArray(np.array(values), dims=dims, coords=coords, name="reading", attrs=about),
        covariance=spread(lambda estimate: estimate.error_covariance),
        covariance_noise=spread(lambda estimate: estimate.covariance),
        angle=by_estimator(ANGLE_GROUP),
        ground=by_estimator(GROUND_GROUP),
        spots=xr.Dataset(
            {name: (("channel", "axis"), value, {"units": "px"}) for name, value in spots.items()},
            coords={"channel": list(channels), "axis": ["row", "column"]},
            attrs=about,
        ),
        disturbances=disturbances,
        sigma_holds=reading.sigma_holds,
        warnings=texts,
        from_statement=from_statement,
    )


def as_frames(images: Any, name: str, channels: Sequence[str], shape: tuple[int, int]) -> np.ndarray:
    """Return a script's frames as (channels, frames, rows, columns), with the channels in the instrument's order.

    Raises
    ------
    ValueError
        Dimensions, channels or numbers of pixels differ from those of the instrument.
    """
    if isinstance(images, xr.DataArray) and "channel" in images.coords:
        missing = [key for key in channels if key not in images.channel.values]
        if missing:
            raise ValueError(f"{name}: no frames of the channels {', '.join(missing)}")
        images = images.sel(channel=list(channels)).transpose("channel", "frame", "row", "column")
    frames = np.asarray(images)
    if frames.ndim != 4 or frames.shape[0] != len(channels) or frames.shape[2:] != tuple(shape):
        wanted = f"({len(channels)}, frames, {shape[0]}, {shape[1]})"
        raise ValueError(f"{name}: frames are (channel, frame, row, column) = {wanted}, found {frames.shape}")
    return frames


def name_html(name: str, cameras: Sequence[str], perturbations: Mapping[str, Any]) -> str:
    """Return HTML that shows an instrument in a notebook: its name, cameras and perturbations."""
    head = f"<p><b>{escape(name)}</b>, cameras {escape(', '.join(cameras))}</p>"
    if not perturbations:
        return head + "<p>not perturbed</p>"
    cells = [(node, key, value) for node, what in perturbations.items() for key, value in what.items()]
    return head + pd.DataFrame(cells, columns=["node", "what", "value"]).to_html(index=False)


@shows("name", "report.verdict", "report.warnings")
@dataclass(frozen=True, eq=False)
class TestResult:
    """Result of a finished test or procedure that ``perform`` has run.

    Attributes
    ----------
    name : str
        Name of the test or procedure as given to ``perform``, such as ``lab focus``.
    numbers : Mapping[str, Any]
        Content of the result file of a run folder, such as ``focus.json``; keys end in their unit.
    report : Report
        Verdict, tables and figures.
    setup : Spec
        The test with the content of all files that it refers to.
    run : object
        All computed results; the class depends on the test.
    """

    name: str
    numbers: Mapping[str, Any] = field(repr=False)
    report: Report = field(repr=False)
    setup: Spec = field(repr=False)
    run: Any = field(repr=False)
    _facts: RunFacts = field(repr=False)
    _kind: str = field(repr=False)

    __test__ = False  # for pytest, which looks for tests by this name

    @property
    def verdict(self) -> str:
        """Result, its accuracy, and what limits it."""
        return self.report.verdict

    @property
    def summary(self) -> pd.DataFrame:
        """Main table of the test's report, as a data frame."""
        table = self.report.summary
        return pd.DataFrame([[cell_text(cell) for cell in row] for row in table.shown()], columns=list(table.heads))

    def save(self, folder: str | Path, force: bool = False) -> Path:
        """Write the run folder that the command would write.

        Parameters
        ----------
        folder : str or Path
            Folder to create.
        force : bool
            Whether an existing run folder is replaced.

        Raises
        ------
        RunFolderError
            The folder exists or cannot be written.
        """
        with RunFolder(Path(folder), force) as target:
            write_test(self._kind, self.numbers, self.report, self._facts, target)
        return target.target

    def _repr_html_(self) -> str:
        lead = "".join(f"<p>{escape(line)}</p>" for line in (self.report.verdict, *self.report.lead))
        notes = "".join(f"<p>⚠ {escape(text)}</p>" for text in self.report.warnings)
        return f"<h4>{escape(self.report.title)}</h4>{lead}{self.summary.to_html(index=False)}{notes}"


def perform(
    name: str, file: str | Path, *, seed: int | None = None, backend: str = "llvm", **changes: Any
) -> TestResult:
    """Run the procedure of a command, such as ``lab focus``, on its input file.

    Parameters
    ----------
    name : str
        ``camera``, ``recover``, ``tolerance``, ``uncertainty``; or any of ``lab``, ``orbit`` (except export),
        ``design`` and ``asbuilt`` with its subcommand, such as ``lab focus``.
    file : str or Path
        Path of the test's file, or its name in the library.
    seed : int or None
        Seed of all random numbers; by default that of the file.
    backend : str
        Backend that traces the rays, ``llvm`` or ``cuda``.
    changes : keyword arguments
        Keys of the test's file with other values, for ``camera`` and ``uncertainty`` those of the run's config.yaml; a
        mapping replaces single keys of a mapping. A key that refers to another file, such as ``camera``, is read anew.
        For ``camera`` also its options ``refocus=True`` and, with it, ``tilt=True``.

    Raises
    ------
    InputError
        No such test, file or key; or the simulated test failed, with the key to be changed.
    """
    if name not in PROCEDURES:
        raise InputError(unknown("no such test", name, PROCEDURES).at())
    procedure = PROCEDURES[name]
    chosen = {key: changes.pop(key) for key in procedure.options if key in changes}
    procedure = _with_options(procedure, chosen)
    setup = procedure.resolve(file)
    if changes:
        tree, test = setup.plain(), getattr(setup, "test", None)
        tree = _merged(tree, changes if test is None else {"test": changes})
        setup = validate(type(setup), YamlFile("", tree, {}))
        if test is not None:
            changed = setup.test.with_source(Source(test.source.file))
            setup = setup.model_copy(update={"test": changed})
            if any(key in type(setup).model_fields for key in changes):  # another camera, turntable, instrument
                setup = type(setup).model_construct(**{"test": changed, **type(setup).parts(changed)}).checked()
    setup, number, options = seeded(procedure, setup, seed)
    started, clock = time.time(), time.monotonic()
    run, warnings = performed(procedure, setup, load_backend(backend), number)
    seconds = time.monotonic() - clock
    report = with_warnings(procedure.report(run), warnings)
    program, _, command = name.partition(" ")
    run_times = (f"twin.{program}", started, seconds, backend)
    options |= {"options": tuple(f"--{key}" for key, value in chosen.items() if value), "checks": report.checks}
    facts = RunFacts(options.pop("config"), *run_times, command=command, **options)
    numbers = report.with_verdict(procedure.numbers(run))
    return TestResult(name, numbers, report, setup, run, facts, procedure.kind)


def _with_options(procedure: Procedure, chosen: Mapping[str, Any]) -> Procedure:
    """Return the procedure of a command with some of its options set; raise `InputError` where they are not allowed."""
    for key, value in chosen.items():
        if not isinstance(value, bool):
            raise InputError(Issue("an option is set or not", key=(key,), value=repr(value), allowed="True or False"))
    if chosen.get("tilt") and not chosen.get("refocus"):
        raise InputError(Issue("tilt goes with refocus", key=("tilt",), allowed="refocus=True, tilt=True"))
    # a refocused camera is not judged: its verdict states its image quality
    judged = procedure.judged and not chosen.get("refocus")
    return replace(procedure, run=partial(procedure.run, **chosen), judged=judged) if chosen else procedure


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested mappings with the values of ``changes`` replaced in ``base``; other keys keep their values."""
    out = dict(base)
    for key, value in changes.items():
        inner = out.get(key)
        out[key] = _merged(inner, value) if isinstance(value, Mapping) and isinstance(inner, Mapping) else value
    return out
