"""The files of a run that hold its numbers and images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scenes.specs.instrument import Channel
from twin.framework.data_files import FRAME_FORMATS, SPOT_STRETCH, FrameFacts, GridData, Gridded, frame_files, netcdf
from twin.framework.reference_frames import described, frames_text
from twin.framework.run_folder import RunFolder
from twin.main_job import job_tables
from twin.main_job.render_results import JobRun, RenderRun
from twin.main_job.verdict import recovered_numbers
from twin.monitor.image_quality import QUALITY
from twin.monitor.time_series import TimeSeries
from twin.targets.target_measurement import TargetRun
from twin.uncertainty.uncertainty_numbers import LIMITS


def write_data(run: RenderRun, folder: RunFolder) -> None:
    """Write everything that a run computed: what it is of, numbers, frames and expected images.

    Args:
        run: what to write.
        folder: an open run folder.
    """
    write_results(run, folder)
    folder.write_bytes("irradiance.nc", irradiance_file(run))


def irradiance_file(run: RenderRun) -> bytes:
    """Contents of irradiance.nc."""
    return netcdf(irradiance(run))


def write_results(run: JobRun, folder: RunFolder) -> None:
    """Write everything that a run computed except irradiance.nc.

    Args:
        run: what to write.
        folder: an open run folder.
    """
    # TIFF and netCDF are made in memory: on a full disk NumPy's writer does not say why, and HDF5 crashes the process
    folder.write_text("config.yaml", job_tables.config_text(run.resolved))
    for (path, kind), name in job_tables.table_names(run.resolved.job).items():
        given = getattr(run.resolved.job.perturb[path], kind)
        folder.write_bytes(name, Path(given.table).read_bytes())
    finishes = job_tables.finish_tables(run.resolved.job)
    for key, name in job_tables.finish_names(run.resolved.job).items():
        folder.write_bytes(name, Path(finishes[key].table).read_bytes())
    _write_numbers(folder, "truth", run.truth_dict())
    if isinstance(run, RenderRun):
        _write_monitor(run, folder)
    if run.targets is not None:
        _write_targets(run.targets, folder)
    if job_tables.faces_of(run):
        _write_numbers(folder, "deformation", job_tables.table_numbers(run, "deformation"))
    if job_tables.heated_of(run):
        _write_numbers(folder, "temperature", job_tables.table_numbers(run, "temperature"))
    if run.quality is not None:
        _write_numbers(folder, "quality", QUALITY(run.quality))


def _write_monitor(run: RenderRun, folder: RunFolder) -> None:
    """What the monitor recorded and what it reads."""
    crosstalk = {name: table.to_dict() for name, table in run.crosstalk.items()}
    for kind, data in (("recovered", recovered_numbers(run)), ("crosstalk", crosstalk)):
        _write_numbers(folder, kind, data)
    if run.limits is not None:
        _write_numbers(folder, "uncertainty", LIMITS(run.limits))
    for i, channel in enumerate(run.experiment.path.channels):
        for when, frames in (("before", run.before[i]), ("after", run.after[i])):
            facts = _spot_facts(run, channel, "nominal" if when == "before" else "perturbed")
            if when == "after" and run.series is not None:
                facts = replace(facts, times=(float(run.series.times[run.series.shown]),) * len(frames))
            for file, content in frame_files(f"{channel.camera}_{channel.name}_{when}", frames, facts):
                folder.write_bytes(file, content)
    if run.stray is not None:
        _write_numbers(folder, "stray", run.stray.to_dict())
    if run.series is not None:
        _write_series(run, run.series, folder)


def _write_numbers(folder: RunFolder, kind: str, data: Mapping[str, Any]) -> None:
    """``KIND.json`` with its schema and frames."""
    folder.write_json(f"{kind}.json", described(kind, data))


def _spot_facts(run: RenderRun, channel: Channel, note: str) -> FrameFacts:
    """What is known of frames of a monitor's area CCD."""
    camera = f"{channel.camera}, {channel.name} area CCD"
    return FrameFacts(camera, run.experiment.path.pitch, run.experiment.exposure, note=note)


def _write_series(run: RenderRun, series: TimeSeries, folder: RunFolder) -> None:
    """Numbers, expected images, and of each channel the first frame of every time as one page."""
    _write_numbers(folder, "course", series.to_dict())
    for i, channel in enumerate(run.experiment.path.channels):
        times = tuple(float(time) for time in series.times)
        facts = replace(_spot_facts(run, channel, "first frame at each time of the course"), times=times)
        for ending, contents in FRAME_FORMATS.items():
            name = f"images/{channel.camera}_{channel.name}_course.{ending}"
            folder.write_bytes(name, contents(series.frames[:, i], facts))
    time = ("time", series.times, {"units": "s", "long_name": "time of the course"})
    folder.write_bytes("course.nc", netcdf(_images(run, "time", time, series.photons)))


def _write_targets(targets: TargetRun, folder: RunFolder) -> None:
    """MTF and frames; the faint rings of a pinhole are stretched in its preview, levels of the others are not."""
    _write_numbers(folder, "mtf", targets.to_dict())
    for stem, name, frames, facts in targets.images():
        for file, content in frame_files(stem, frames, facts, SPOT_STRETCH if name == "pinhole" else None):
            folder.write_bytes(file, content)


_WAVELENGTH = {"units": "m", "standard_name": "radiation_wavelength", "long_name": "of the light in vacuum"}


def irradiance(run: RenderRun) -> GridData:
    """Expected photons before and after, (state, channel, row, column), with stray light apart where it was traced."""
    photons = np.stack([run.photons_before, run.photons_after])
    states = ("state", ["before", "after"], {"long_name": "before the disturbance or after it"})
    images = _images(run, "state", states, photons)
    if run.stray is None:
        return images
    stray = np.stack([run.stray.before.photons, run.stray.after.photons])
    about = {"units": "photons", "long_name": "of these, ghosts and stray light"}
    apart: Gridded = (("state", "channel", "row", "column"), stray, about)
    return replace(images, variables={**images.variables, "stray_photons": apart})


def _images(run: RenderRun, first: str, coordinate: Gridded, photons: np.ndarray) -> GridData:
    """Expected images (N, C, rows, columns) with the coordinate of their first axis."""
    path = run.experiment.path
    return GridData(
        {
            "photons": (
                (first, "channel", "row", "column"),
                photons,
                {"units": "photons", "long_name": "expected photons per pixel and frame"},
            )
        },
        {
            first: coordinate,
            "channel": ("channel", [c.key for c in path.channels], {"long_name": "camera and side of the area CCD"}),
            "x": ("column", path.axis(1), {"units": "m", "long_name": "detector x, along which columns count"}),
            "y": ("row", path.axis(0), {"units": "m", "long_name": "detector y, along which rows count"}),
            "wavelength": ((), path.wavelength, _WAVELENGTH),
        },
        {
            "title": "expected images of the monitor's area CCDs",
            "wavelength_m": path.wavelength,
            "pitch_m": path.pitch,
            "reference_frames": frames_text("course" if first == "time" else "irradiance"),
        },
    )
