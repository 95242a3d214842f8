"""What a script gets back: frames and truth of an exposure, and what the estimators read from it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
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
from optics.numerics.backend import Backend
from twin.framework.procedure import Session, silent
from twin.framework.reference_frames import frames_text
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
    """An exposure of the nominal and of the perturbed instrument.

    Attributes
    ----------
    before, after : xr.DataArray
        Frames, uint16 grey values, (channel, frame, row, column); without a monitor there is no channel.
    expected : xr.Dataset
        Expected photons per pixel and frame, (state, channel, row, column), as in irradiance.nc; empty without a
        monitor.
    truth : xr.Dataset
        True changes of every camera, by exact tracing: parameters of each ``camera``; of two cameras
        ``angle_change_arcsec``, and ``ground_along_m``, ``ground_across_m``, ``ground_height_m``, errors of points on
        the ground that are located as if nothing had changed.
    verdict : str
        What was recovered, how well, and what limits it.
    warnings : tuple[str, ...]
        What one should know before using the numbers.
    run : JobRun
        Everything that the command ``twin.render`` would write: image quality, targets, stray light, course.
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
        folder : str | Path
            To be made.
        force : bool
            Replace it if it is a run folder.

        Raises
        ------
        RunFolderError
            It is there already, or cannot be written.
        """
        # what draws waits until it is asked for
        from twin.main_job.render_folder import write_run

        with RunFolder(Path(folder), force) as target:
            clock = time.monotonic() - self._seconds
            write_run(self.run, Session(target, self._backend, silent, self._started, clock))
        return target.target

    @property
    def mtf(self) -> pd.DataFrame:
        """MTF at the Nyquist frequency from the images of knife edges, before and after, with sigma and beside it the
        true one; a row for every camera, place and direction. Empty unless ``knife_edge`` was among the images.
        """
        cameras = self.run.targets.cameras if self.run.targets is not None else {}
        rows = {
            (camera, name, direction): _edge_row(place, direction)
            for camera, found in cameras.items()
            for name, place in found.places.items()
            for direction in place.before.edges
        }
        table = pd.DataFrame.from_dict(rows, orient="index")
        if rows:
            table.index = pd.MultiIndex.from_tuples(rows, names=["camera", "place", "direction"])
        return table

    @property
    def quality(self) -> pd.DataFrame:
        """Image quality before and after: wavefront errors (waves rms), best focus less line CCD (um), MTF at Nyquist
        and light lost; a row for every camera, state and field. Empty unless ``quality=True`` was asked for, or the
        instrument has no monitor.
        """
        found = self.run.quality
        rows = {
            (name, when, field): {one.key: one.value(camera)[s, k] for one in AT_FIELDS}
            for name, camera in ({} if found is None else found.cameras).items()
            for s, when in enumerate(("before", "after"))
            for k, field in enumerate(() if found is None else found.fields)
        }
        table = pd.DataFrame.from_dict(rows, orient="index")
        if rows:
            table.index = pd.MultiIndex.from_tuples(rows, names=["camera", "state", "field"])
        return table

    def _repr_html_(self) -> str:
        notes = "".join(f"<p>⚠ {escape(text)}</p>" for text in self.warnings)
        told = f"<p>{escape(self.verdict)}</p>"
        return f"{told}{_truth_frame(self.truth).to_html()}{notes}{self.after._repr_html_()}"


@dataclass(frozen=True, eq=False)
class Found:
    """What every estimator reads from images.

    Attributes
    ----------
    values : xr.DataArray
        Readings, (camera, estimator, parameter), in arcsec and um as the parameters' names end.
    covariance : xr.DataArray
        Of the whole error, (camera, estimator, parameter, parameter_2), products of these units: by noise and by what
        is stated to move; where nothing is stated, by noise alone.
    covariance_noise : xr.DataArray
        Of that what the noise of the images does, likewise.
    angle : xr.Dataset
        Of two cameras, ``change_arcsec`` with ``change_arcsec_sigma`` (total) and ``change_arcsec_sigma_noise`` by
        estimator; empty otherwise.
    ground : xr.Dataset
        Of two cameras of known altitude, ``along_m``, ``across_m``, ``height_m`` with their sigmas, likewise.
    disturbances : str
        Name of what is stated to move, on which the total sigmas rest; empty for nothing.
    spots : xr.Dataset
        ``before`` and ``after`` (channel, axis), px, with ``before_sigma`` and ``after_sigma``.
    sigma_holds : bool
        Whether nothing that was measured contradicts the sigmas.
    warnings : tuple[str, ...]
        Why they do not, and what else one should know before using the numbers.
    from_statement : pd.Series
        Share of the ``posterior``'s variance of each reading that no spot constrains: that part of sigma is from the
        statement, not from the spots; (row) with levels camera and parameter, empty where nothing is stated.
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
        """Standard deviations of the whole errors of ``values``; see ``covariance``."""
        return self._root(self.covariance).rename("sigma")

    @property
    def sigma_noise(self) -> xr.DataArray:
        """Standard deviations from the noise of the images alone."""
        return self._root(self.covariance_noise).rename("sigma_noise")

    @property
    def judged(self) -> str:
        """The estimator whose sigma and error ``compare`` tells: ``posterior`` where disturbances are stated, else
        ``model``.
        """
        return preferred_estimator(self.values.estimator.values.tolist())

    def _root(self, covariance: xr.DataArray) -> xr.DataArray:
        return self.values.copy(data=np.sqrt(np.diagonal(covariance.values, axis1=-2, axis2=-1)))

    def compare(self, truth: xr.Dataset) -> pd.DataFrame:
        """Readings beside the truth.

        Parameters
        ----------
        truth : xr.Dataset
            Of the exposure, ``shot.truth``.

        Returns
        -------
        pd.DataFrame
            A row for every camera and parameter, for the angle between two cameras and for errors on the ground: what
            is ``true``, each estimator's reading, and of the ``judged`` one ``sigma`` (total), ``sigma_noise``,
            ``error`` = reading - true and ``in_sigma`` = error / sigma.
        """
        sigma, noise = self.sigma, self.sigma_noise
        rows = {}
        for camera in self.values.camera.values.tolist():
            for key in self.values.parameter.values.tolist():
                at = {"camera": camera, "parameter": key}
                true = float(truth[key].sel(camera=camera))
                rows[camera, key] = self._row(true, self.values.sel(at), sigma.sel(at), noise.sel(at))
        pairs = [("both", "angle", parameters.ANGLE, self.angle)]
        pairs += [("ground", "ground", one, self.ground) for one in parameters.GROUND]
        for where, start, one, found in pairs:
            key, name = f"{start}_{one.key}", one.key
            if key in truth and found:
                columns = (found[name], found[f"{name}_sigma"], found[f"{name}_sigma_noise"])
                rows[where, key] = self._row(float(truth[key]), *columns)
        table = pd.DataFrame.from_dict(rows, orient="index")
        table.index = pd.MultiIndex.from_tuples(rows, names=["camera", "parameter"])
        return table

    def _row(self, true: float, readings: xr.DataArray, sigma: xr.DataArray, noise: xr.DataArray) -> dict[str, float]:
        own = {str(name): float(readings.sel(estimator=name)) for name in readings.estimator.values}
        spread, error = float(sigma.sel(estimator=self.judged)), own[self.judged] - true
        by_noise = float(noise.sel(estimator=self.judged))
        told = {"sigma": spread, "sigma_noise": by_noise, "error": error, "in_sigma": error / spread}
        return {"true": true, **own, **told}

    def _repr_html_(self) -> str:
        notes = "".join(f"<p>⚠ {escape(text)}</p>" for text in self.warnings)
        return notes + _reading_frame(self).to_html(escape=True)

    def __repr__(self) -> str:
        notes = "".join(f"\nwarning: {text}" for text in self.warnings)
        return _reading_frame(self).to_string() + notes


def _edge_row(place: PlaceTargets, direction: str) -> dict[str, float]:
    out: dict[str, float] = {}
    for when, shots in place.shots.items():
        edge = shots.edges[direction]
        value, sigma = edge.nyquist or (np.nan, np.nan)
        out |= {when: value, f"{when}_sigma": sigma, f"{when}_true": edge.true_nyquist}
    return out


def _reading_frame(found: Found) -> pd.DataFrame:
    """Readings by camera and parameter, a column for each estimator, with the judged one's sigmas."""
    values = found.values.stack(row=("camera", "parameter")).transpose("row", "estimator").to_pandas()
    values.columns.name = None
    sigmas = {"sigma": found.sigma, "sigma_noise": found.sigma_noise}
    own = {name: s.sel(estimator=found.judged).stack(row=("camera", "parameter")) for name, s in sigmas.items()}
    return values.assign(**{name: column.to_pandas() for name, column in own.items()})


def _truth_frame(truth: xr.Dataset) -> pd.DataFrame:
    """True parameters, a row for each camera."""
    return truth[[one.key for one in parameters.CAMERA_PARAMETERS.values()]].to_dataframe()


def shot_of(run: JobRun, backend: Backend, started: float) -> Shot:
    """What a script sees of a run that was traced there and begun then, seconds since the epoch."""
    keys = [channel.key for channel in run.experiment.instrument.channels]
    about: dict[str, Any] = {"units": "DN", "instrument": run.resolved.instrument.name}
    before = after = np.zeros((0, run.frames, 0, 0), np.uint16)
    expected = xr.Dataset()
    if isinstance(run, RenderRun):
        before, after, expected = run.before, run.after, irradiance(run).to_xarray()
        about |= {"exposure_s": run.experiment.exposure, "pitch_m": run.experiment.path.pitch, "seed": run.seed}

    def frames(name: str, values: np.ndarray) -> xr.DataArray:
        dims = ("channel", "frame", "row", "column")
        return xr.DataArray(values, dims=dims, coords={"channel": keys}, name=name, attrs=about)

    told = judge(run)
    return Shot(
        before=frames("before", before),
        after=frames("after", after),
        expected=expected,
        truth=_truth(run),
        verdict=told.verdict,
        warnings=tuple(told.warnings),
        run=run,
        _backend=backend,
        _started=started,
        _seconds=time.time() - started,
    )


def _truth(run: JobRun) -> xr.Dataset:
    true = run.truth_dict()
    cameras = true["cameras"]
    keys = list(next(iter(cameras.values())))
    data: dict[str, Any] = {key: ("camera", [cameras[name][key] for name in cameras]) for key in keys}
    for start, group in (("angle", "intersection_angle"), ("ground", "ground")):
        data |= {f"{start}_{key}": value for key, value in true.get(group, {}).items()}
    about = {"reference_frames": frames_text("truth")}
    return xr.Dataset(data, coords={"camera": list(cameras)}, attrs=about)


def found_table(reading: MonitorReading, warnings: Sequence[str] = ()) -> Found:
    """What a script sees of the reading of one state.

    Parameters
    ----------
    reading : MonitorReading
        Of it.
    warnings : Sequence[str]
        Of the instrument; those of the reading are added.
    """
    recovery, cameras = reading.recovery, list(reading.cameras)
    channels = ["/".join(channel) for channel in reading.channels]
    disturbances = "" if reading.disturbances is None else reading.disturbances.name
    told = (*warnings, *reading.doubts, *reading.notes, *reading.unseen)
    shares = {(group, key): v for group, own in reading.from_statement.items() for key, v in own.items()}
    from_statement = pd.Series(shares, dtype=float, name="from_statement")
    if shares:
        from_statement.index = pd.MultiIndex.from_tuples(shares, names=["camera", "parameter"])
    estimators = list(recovery.parameters[cameras[0]])
    table, keys = reading.table, [one.key for one in parameters.CAMERA_PARAMETERS.values()]
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
        rows = {camera: parameters.rows_of(calibrated) for camera, calibrated in reading.cameras.items()}
        found = [[made @ of(recovery.parameters[c][e])[0] @ made.T for e in estimators] for c, made in rows.items()]
        both = {**coords, "parameter_2": keys}
        return xr.DataArray(np.array(found), dims=(*dims, "parameter_2"), coords=both)

    def by_estimator(group: str) -> xr.Dataset:
        data: dict[str, list[float]] = {}
        for row in table:
            if row.group == group:
                told = zip(("", "_sigma", "_sigma_noise"), (row.value, row.sigma, row.noise), strict=True)
                for ending, number in told:
                    data.setdefault(f"{row.parameter.key}{ending}", []).append(number)
        variables = {name: ("estimator", numbers) for name, numbers in data.items()}
        return xr.Dataset(variables, coords={"estimator": estimators} if data else {}, attrs=about)

    return Found(
        values=xr.DataArray(np.array(values), dims=dims, coords=coords, name="reading", attrs=about),
        covariance=spread(lambda found: found.error_covariance),
        covariance_noise=spread(lambda found: found.covariance),
        angle=by_estimator(ANGLE_GROUP),
        ground=by_estimator(GROUND_GROUP),
        spots=xr.Dataset(
            {name: (("channel", "axis"), value, {"units": "px"}) for name, value in spots.items()},
            coords={"channel": list(channels), "axis": ["row", "column"]},
            attrs=about,
        ),
        disturbances=disturbances,
        sigma_holds=reading.sigma_holds,
        warnings=told,
        from_statement=from_statement,
    )


def as_frames(given: Any, name: str, channels: Sequence[str], shape: tuple[int, int]) -> np.ndarray:
    """Frames as the analysis takes them, (C, frames, rows, columns), with the channels in the instrument's order.

    Raises
    ------
    ValueError
        Other dimensions, channels or pixels.
    """
    if isinstance(given, xr.DataArray) and "channel" in given.coords:
        missing = [key for key in channels if key not in given.channel.values]
        if missing:
            raise ValueError(f"{name}: no frames of the channels {', '.join(missing)}")
        given = given.sel(channel=list(channels)).transpose("channel", "frame", "row", "column")
    frames = np.asarray(given)
    if frames.ndim != 4 or frames.shape[0] != len(channels) or frames.shape[2:] != tuple(shape):
        wanted = f"({len(channels)}, frames, {shape[0]}, {shape[1]})"
        raise ValueError(f"{name}: frames are (channel, frame, row, column) = {wanted}, found {frames.shape}")
    return frames


def name_html(name: str, cameras: Sequence[str], perturbations: Mapping[str, Any]) -> str:
    """An instrument as a notebook shows it."""
    head = f"<p><b>{escape(name)}</b>, cameras {escape(', '.join(cameras))}</p>"
    if not perturbations:
        return head + "<p>not perturbed</p>"
    cells = [(node, key, value) for node, what in perturbations.items() for key, value in what.items()]
    return head + pd.DataFrame(cells, columns=["node", "what", "value"]).to_html(index=False)
