"""What a script gets back: frames and truth of an exposure, and what the estimators read from it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from analysis.monitor.estimators import ESTIMATORS
from analysis.monitor.monitoring import PARAMETERS, PER_SI
from analysis.monitor.recovery import Recovery
from analysis.units import ARCSEC
from optics.numerics.backend import Backend
from twin.main_job.render_files import irradiance
from twin.main_job.render_results import RenderRun
from twin.main_job.verdict import judge
from twin.run.command import Session
from twin.run.procedure import silent
from twin.run.reference_frames import frames_text
from twin.run.run_folder import RunFolder
from twin.targets.target_result import PlaceTargets

ANGLE = "angle_change_arcsec"
"""Name of the change of the angle between two cameras' lines of sight."""


@dataclass(frozen=True, eq=False)
class Shot:
    """An exposure of the nominal and of the perturbed instrument.

    Attributes:
        before, after: frames, uint16 grey values, (channel, frame, row, column).
        expected: expected photons per pixel and frame, (state, channel, row, column), as in irradiance.nc.
        truth: true changes of every camera, by exact tracing: parameters of each ``camera`` and, of two cameras,
            ``angle_change_arcsec``.
        verdict: what was recovered, how well, and what limits it.
        warnings: what one should know before using the numbers.
        run: everything that the command ``twin.render`` would write: image quality, targets, stray light, course.
    """

    before: xr.DataArray
    after: xr.DataArray
    expected: xr.Dataset
    truth: xr.Dataset
    verdict: str
    warnings: tuple[str, ...]
    run: RenderRun = field(repr=False)
    _backend: Backend = field(repr=False)
    _started: float = field(repr=False)
    _seconds: float = field(repr=False)

    def save(self, folder: str | Path, force: bool = False) -> Path:
        """Write the run folder that the command would write, with its report.

        Args:
            folder: to be made.
            force: replace it if it is a run folder.

        Raises:
            RunFolderError: it is there already, or cannot be written.
        """
        # what draws waits until it is asked for
        from twin.main_job.render_command import write_run

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

    def _repr_html_(self) -> str:
        notes = "".join(f"<p>⚠ {escape(text)}</p>" for text in self.warnings)
        told = f"<p>{escape(self.verdict)}</p>"
        return f"{told}{truth_frame(self.truth).to_html()}{notes}{self.after._repr_html_()}"


@dataclass(frozen=True, eq=False)
class Found:
    """What every estimator reads from images.

    Attributes:
        values: readings, (camera, estimator, parameter), in arcsec and um as the parameters' names end.
        covariance: (camera, estimator, parameter, parameter_2), products of these units.
        angle: of two cameras, ``change_arcsec`` and ``change_arcsec_sigma`` by estimator; empty otherwise.
        spots: ``before`` and ``after`` (channel, axis), px, with ``before_sigma`` and ``after_sigma``.
    """

    values: xr.DataArray
    covariance: xr.DataArray
    angle: xr.Dataset
    spots: xr.Dataset

    @property
    def sigma(self) -> xr.DataArray:
        """Standard deviations of ``values``."""
        variance = np.diagonal(self.covariance.values, axis1=-2, axis2=-1)
        return self.values.copy(data=np.sqrt(variance)).rename("sigma")

    def compare(self, truth: xr.Dataset) -> pd.DataFrame:
        """Readings beside the truth.

        Args:
            truth: of the exposure, ``shot.truth``.

        Returns:
            A row for every camera and parameter, and for the angle between two cameras: what is ``true``, each
            estimator's reading, and of the model ``sigma``, ``error`` = reading - true and ``in_sigma`` = error /
            sigma.
        """
        sigma = self.sigma
        rows = {}
        for camera in self.values.camera.values.tolist():
            for key in PARAMETERS:
                at = {"camera": camera, "parameter": key}
                rows[camera, key] = _row(float(truth[key].sel(camera=camera)), self.values.sel(at), sigma.sel(at))
        if ANGLE in truth and self.angle:
            rows["both", ANGLE] = _row(
                float(truth[ANGLE]), self.angle["change_arcsec"], self.angle["change_arcsec_sigma"]
            )
        table = pd.DataFrame.from_dict(rows, orient="index")
        table.index = pd.MultiIndex.from_tuples(rows, names=["camera", "parameter"])
        return table

    def _repr_html_(self) -> str:
        return reading_frame(self).to_html(escape=True)

    def __repr__(self) -> str:
        return reading_frame(self).to_string()


def _edge_row(place: PlaceTargets, direction: str) -> dict[str, float]:
    out: dict[str, float] = {}
    for when, shots in place.shots.items():
        edge = shots.edges[direction]
        value, sigma = edge.nyquist or (np.nan, np.nan)
        out |= {when: value, f"{when}_sigma": sigma, f"{when}_true": edge.true_nyquist}
    return out


def _row(true: float, readings: xr.DataArray, sigma: xr.DataArray) -> dict[str, float]:
    model, spread = float(readings.sel(estimator="model")), float(sigma.sel(estimator="model"))
    own = {name: float(readings.sel(estimator=name)) for name in ESTIMATORS}
    return {"true": true, **own, "sigma": spread, "error": model - true, "in_sigma": (model - true) / spread}


def reading_frame(found: Found) -> pd.DataFrame:
    """Readings by camera and parameter, a column for each estimator, with the model's sigma."""
    values = found.values.stack(row=("camera", "parameter")).transpose("row", "estimator").to_pandas()
    values.columns.name = None
    sigma = found.sigma.sel(estimator="model").stack(row=("camera", "parameter")).to_pandas()
    return values.assign(sigma=sigma)


def truth_frame(truth: xr.Dataset) -> pd.DataFrame:
    """True parameters, a row for each camera."""
    return truth[list(PARAMETERS)].to_dataframe()


def shot_of(run: RenderRun, backend: Backend, started: float) -> Shot:
    """What a script sees of a run that was traced there and begun then, seconds since the epoch."""
    path = run.experiment.path
    keys = [channel.key for channel in path.channels]
    about = {
        "units": "DN",
        "instrument": run.resolved.instrument.name,
        "exposure_s": run.experiment.exposure,
        "pitch_m": path.pitch,
        "seed": run.seed,
    }

    def frames(name: str, values: np.ndarray) -> xr.DataArray:
        dims = ("channel", "frame", "row", "column")
        return xr.DataArray(values, dims=dims, coords={"channel": keys}, name=name, attrs=about)

    told = judge(run)
    return Shot(
        before=frames("before", run.before),
        after=frames("after", run.after),
        expected=irradiance(run),
        truth=_truth(run),
        verdict=told.verdict,
        warnings=tuple(told.warnings),
        run=run,
        _backend=backend,
        _started=started,
        _seconds=time.time() - started,
    )


def _truth(run: RenderRun) -> xr.Dataset:
    true = run.truth_dict()
    cameras = true["cameras"]
    keys = list(next(iter(cameras.values())))
    data: dict[str, Any] = {key: ("camera", [cameras[name][key] for name in cameras]) for key in keys}
    if "intersection_angle" in true:
        data[ANGLE] = true["intersection_angle"]["change_arcsec"]
        data["angle_nominal_deg"] = true["intersection_angle"]["nominal_deg"]
    about = {"reference_frames": frames_text("truth")}
    return xr.Dataset(data, coords={"camera": list(cameras)}, attrs=about)


def found_table(recovery: Recovery, cameras: Sequence[str], channels: Sequence[str]) -> Found:
    """What a script sees of the recovery of one state."""
    parts = [[recovery.parameters[camera][name] for name in ESTIMATORS] for camera in cameras]
    values = [[np.asarray(p.vector)[0] * PER_SI for p in row] for row in parts]
    spread = [[np.asarray(p.covariance)[0] * np.outer(PER_SI, PER_SI) for p in row] for row in parts]
    coords = {"camera": list(cameras), "estimator": list(ESTIMATORS), "parameter": list(PARAMETERS)}
    dims = ("camera", "estimator", "parameter")
    angle: dict[str, Any] = {}
    if recovery.angle:
        changes = [float(np.ravel(recovery.angle[name].change_rad)[0]) / ARCSEC for name in ESTIMATORS]
        sigmas = [float(np.ravel(recovery.angle[name].sigma_rad)[0]) / ARCSEC for name in ESTIMATORS]
        angle = {"change_arcsec": ("estimator", changes), "change_arcsec_sigma": ("estimator", sigmas)}
    spots = {
        "before": recovery.before[0],
        "after": recovery.after[0],
        "before_sigma": recovery.sigma_before[0],
        "after_sigma": recovery.sigma_after[0],
    }
    about = {"reference_frames": frames_text("recovered")}
    return Found(
        values=xr.DataArray(np.array(values), dims=dims, coords=coords, name="reading", attrs=about),
        covariance=xr.DataArray(
            np.array(spread), dims=(*dims, "parameter_2"), coords={**coords, "parameter_2": list(PARAMETERS)}
        ),
        angle=xr.Dataset(angle, coords={"estimator": list(ESTIMATORS)} if angle else {}, attrs=about),
        spots=xr.Dataset(
            {name: (("channel", "axis"), value, {"units": "px"}) for name, value in spots.items()},
            coords={"channel": list(channels), "axis": ["row", "column"]},
            attrs=about,
        ),
    )


def as_frames(given: Any, name: str, channels: Sequence[str], shape: tuple[int, int]) -> np.ndarray:
    """Frames as the analysis takes them, (C, frames, rows, columns), with the channels in the instrument's order.

    Raises:
        ValueError: other dimensions, channels or pixels.
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
