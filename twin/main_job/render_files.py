"""Result files of a run, and copies of the tables of nodes and of surface scatter and coatings that its job names.

The run folder keeps a copy of each such table, so that its config.yaml repeats the run without the originals.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from optics.numerics.number_tree import FrozenMap
from optics.thermal.nodal_deformation import PRINTED, SEEN, NodalDeformation
from scenes.models.job_state import HeatedBody, HeatedFace
from scenes.specs.instrument import Channel
from scenes.specs.job import JobSpec
from scenes.specs.job_tables import FinishTableSpec
from scenes.specs.resolved import ResolvedJob
from twin.framework.data_files import FRAME_FORMATS, SPOT_STEEPNESS, FrameFacts, GridData, Gridded, frame_files, netcdf
from twin.framework.record import Quantity, Record, described, frames_text
from twin.framework.run_folder import RunFolder
from twin.main_job.render_results import JobRun, RenderRun
from twin.main_job.verdict import recovered_numbers
from twin.monitor.image_quality import QUALITY
from twin.monitor.time_series import TimeSeries
from twin.targets.target_measurement import TargetRun
from twin.uncertainty.uncertainty_numbers import LIMITS


def irradiance_file(run: RenderRun) -> bytes:
    """Return the contents of irradiance.nc (NetCDF): the expected images before and after, in photons per pixel."""
    return netcdf(irradiance(run))


def write_results(run: JobRun, folder: RunFolder) -> None:
    """Write all results of a run except irradiance.nc into its folder.

    Parameters
    ----------
    run : JobRun
        Run to write.
    folder : RunFolder
        Open run folder.
    """
    # TIFF and netCDF are made in memory: on a full disk NumPy's writer gives no reason, and HDF5 crashes the process
    folder.write_text("config.yaml", config_text(run.resolved))
    for (path, kind), name in table_names(run.resolved.job).items():
        table = getattr(run.resolved.job.perturb[path], kind)
        folder.write_bytes(name, Path(table.table).read_bytes())
    tables = finish_tables(run.resolved.job)
    for key, name in finish_names(run.resolved.job).items():
        folder.write_bytes(name, Path(tables[key].table).read_bytes())
    _write_numbers(folder, "truth", run.truth_dict())
    if isinstance(run, RenderRun):
        _write_monitor(run, folder)
    if run.targets is not None:
        _write_targets(run.targets, folder)
    for kind, numbers in table_numbers(run).items():
        _write_numbers(folder, kind, numbers)
    if run.quality is not None:
        _write_numbers(folder, "quality", QUALITY(run.quality))


def _write_monitor(run: RenderRun, folder: RunFolder) -> None:
    """Write the frames, the estimated changes and the tables of a run's monitor."""
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
    """Write the JSON file of a kind of results (``KIND.json``), with its schema and reference frames."""
    folder.write_json(f"{kind}.json", described(kind, data))


def _spot_facts(run: RenderRun, channel: Channel, note: str) -> FrameFacts:
    """Return the metadata for the file of a monitor CCD's frames."""
    camera = f"{channel.camera}, {channel.name} area CCD"
    return FrameFacts(camera, run.experiment.path.pitch, run.experiment.exposure, note=note)


def _write_series(run: RenderRun, series: TimeSeries, folder: RunFolder) -> None:
    """Write a time series: numbers, expected images, and for each channel a file with the first frame of every time."""
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
    """Write MTF and frames of the targets; previews of pinhole images are stretched to show their faint rings."""
    _write_numbers(folder, "mtf", targets.to_dict())
    for stem, name, frames, facts in targets.images():
        for file, content in frame_files(stem, frames, facts, SPOT_STEEPNESS if name == "pinhole" else None):
            folder.write_bytes(file, content)


_WAVELENGTH = {"units": "m", "standard_name": "radiation_wavelength", "long_name": "wavelength of the light in vacuum"}


def irradiance(run: RenderRun) -> GridData:
    """Return expected photons per pixel before and after, (state, channel, row, column), and stray light separately."""
    photons = np.stack([run.photons_before, run.photons_after])
    states = ("state", ["before", "after"], {"long_name": "before the disturbance or after it"})
    images = _images(run, "state", states, photons)
    if run.stray is None:
        return images
    stray = np.stack([run.stray.before.photons, run.stray.after.photons])
    about = {"units": "photons", "long_name": "part of the photons from ghosts and stray light"}
    apart: Gridded = (("state", "channel", "row", "column"), stray, about)
    return replace(images, variables={**images.variables, "stray_photons": apart})


def _images(run: RenderRun, first: str, coordinate: Gridded, photons: np.ndarray) -> GridData:
    """Return expected images (N, C, rows, columns) as grid data, for N states or times and C channels.

    The coordinate of the first axis is attached.
    """
    path = run.experiment.path
    about = {"units": "photons", "long_name": "expected photons per pixel and frame"}
    return GridData(
        {"photons": ((first, "channel", "row", "column"), photons, about)},
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


def table_names(job: JobSpec) -> Mapping[tuple[str, str], str]:
    """Return (body, key of its perturbation) -> name of the table of nodes in the run folder."""
    return {
        (path, kind): f"{kind}/{path.replace('/', '_')}{PurePath(spec.table).suffix.lower()}"
        for path, what in job.perturb.items()
        for kind, spec in (("deformation", what.deformation), ("temperature", what.temperature))
        if spec is not None and spec.table is not None
    }


def finish_tables(job: JobSpec) -> Mapping[tuple[str, str], FinishTableSpec]:
    """Return (kind of surface, measured quantity) -> table of a surface finish (scatter, coating) for stray light."""
    stray = job.render.stray
    return {} if stray is None or stray.finishes is None else stray.finishes.tables


def finish_names(job: JobSpec) -> Mapping[tuple[str, str], str]:
    """Return (kind of surface, measured quantity) -> file name of its table of a surface finish in the run folder."""
    tables = finish_tables(job).items()
    return {(kind, what): f"finish/{kind}_{what}{PurePath(t.table).suffix.lower()}" for (kind, what), t in tables}


def config_text(resolved: ResolvedJob) -> str:
    """Return the text of the run folder's config.yaml, which names the tables beside it."""
    names, finishes = table_names(resolved.job), finish_names(resolved.job)
    if not names and not finishes:
        return resolved.to_yaml()
    perturb = dict(resolved.job.perturb)
    for (path, kind), name in names.items():
        renamed = getattr(perturb[path], kind).model_copy(update={"table": name})
        perturb[path] = perturb[path].model_copy(update={kind: renamed})
    render = resolved.job.render
    if finishes and render.stray is not None and render.stray.finishes is not None:
        tables_of_finishes = finish_tables(resolved.job)
        tables = {key: tables_of_finishes[key].model_copy(update={"table": name}) for key, name in finishes.items()}
        stray = render.stray.model_copy(update={"finishes": render.stray.finishes.with_tables(tables)})
        render = render.model_copy(update={"stray": stray})
    job = resolved.job.model_copy(update={"perturb": FrozenMap(perturb), "render": render})
    return resolved.model_copy(update={"job": job}).to_yaml()


DEFORMATION: Record[NodalDeformation] = Record(
    "Deformation of an optical face by a table of displaced nodes.",
    Quantity("nodes", lambda face: len(face.weight), "nodes on the optical surface"),
    Quantity("nodes_not_used", lambda face: face.others, "nodes off the optical surface"),
    Quantity("spacing_mm", lambda face: face.spacing, "distance of neighbouring nodes"),
    Quantity("rotate_arcsec", lambda face: face.rotate, "rigid rotation about X, Y and Z"),
    Quantity("shift_um", lambda face: face.shift, "rigid shift along X, Y and Z"),
    Quantity("growth_ppm", lambda face: face.expansion, "relative change of size"),
    Quantity("change_rms_nm", lambda face: face.rms(face.change), "change of sag without rigid motion and scale"),
    Quantity("change_pv_nm", lambda face: face.range(face.change), "peak to valley of that change"),
    Quantity("figure_nm", lambda face: {f"Z{j}": a for j, a in face.figure.items()}, "Zernike terms of the change"),
    Quantity("residual_rms_nm", lambda face: face.rms(face.residual), "residual of the Zernike terms"),
    Quantity("residual_pv_nm", lambda face: face.range(face.residual), "peak to valley of that residual"),
    Quantity("not_carried_rms_nm", lambda face: face.rms(face.lost), "residual of the grid"),
    Quantity("between_nodes_rms_nm", lambda face: face.between, "error of nodes interpolated from the others"),
    Quantity(
        "mesh_prints_through", lambda face: face.printed_through, "true if the residual changes from node to node"
    ),
)
_WARMED_FACE: Record[HeatedFace] = Record(
    "Effect of the nonlinear part of a temperature field on an optical face, in its nominal axes.",
    Quantity("rotate_arcsec", lambda face: face.motion.rotate, "rotation about X, Y and Z"),
    Quantity("shift_nm", lambda face: face.motion.shift, "shift along X, Y and Z"),
    Quantity("growth_ppm", lambda face: face.motion.expansion, "relative change of size"),
    Quantity("figure_nm", lambda face: {f"Z{j}": a for j, a in face.motion.figure.items()}, "Zernike terms of its sag"),
    Quantity("not_carried_rms_nm", lambda face: face.lost, "residual of the Zernike terms"),
    Quantity("coarser_elements_rms_nm", lambda face: face.mesh_error, "difference that coarser finite elements make"),
)
HEATED_BODY: Record[HeatedBody] = Record(
    "Temperature field of a body by a table of nodes.",
    Quantity("nodes", lambda body: body.nodes, "nodes of the table"),
    Quantity("spacing_mm", lambda body: body.spacing, "distance of neighbouring nodes"),
    Quantity("linear_change_k", lambda body: body.linear.change, "change at the body's origin of the linear field"),
    Quantity("linear_gradient_k_per_m", lambda body: body.linear.gradient, "gradient of the linear field"),
    Quantity("not_linear_rms_k", lambda body: body.residual[0], "residual of the linear field, RMS over the volume"),
    Quantity("not_linear_largest_k", lambda body: body.residual[1], "largest residual of the linear field"),
    Quantity("between_nodes_rms_k", lambda body: body.between, "error of nodes interpolated from the others"),
    Quantity(
        "outside_share",
        lambda body: None if body.coverage is None else body.coverage.outside,
        "share of the body's volume beyond the nodes",
    ),
    Quantity(
        "farthest_mm",
        lambda body: None if body.coverage is None else body.coverage.farthest,
        "largest distance of the body from any node",
    ),
    Quantity("index_path_not_carried_nm", lambda body: body.index_path, "optical path error of a linear index field"),
    Quantity("faces", lambda body: body.faces, "its optical faces", record=_WARMED_FACE),
)


def table_numbers(run: JobRun) -> dict[str, dict[str, Any]]:
    """Return the contents of deformation.json and temperature.json; empty for a job without node tables."""
    names = table_names(run.resolved.job)
    numbers_by_kind = {
        "deformation": {path: DEFORMATION(face) for path, face in run.deformed.items()},
        "temperature": {path: HEATED_BODY(body) for path, body in run.heated.items()},
    }
    return {
        kind: {"bodies": {path: {"table": names[path, kind], **numbers} for path, numbers in bodies.items()}}
        for kind, bodies in numbers_by_kind.items()
        if bodies
    }


def deformation_warnings(faces: Mapping[str, NodalDeformation], planes: Collection[str] = ()) -> tuple[str, ...]:
    """Return warnings about the meshes of deformed surfaces.

    Parameters
    ----------
    faces : Mapping[str, NodalDeformation]
        Body -> deformation by its table of nodes.
    planes : Collection[str]
        Those of the bodies that are glass faces in a run with stray light, which treats them as planes.
    """
    ignored = {path: 1e9 * faces[path].rms(faces[path].change) for path in planes}
    warnings = [
        f"{path}: stray light treats faces of glass as planes, without the {size:.3g} nm rms of the face's table"
        for path, size in ignored.items()
    ]
    for path, face in faces.items():
        residual, between, lost = (1e9 * size for size in (face.rms(face.residual), face.between, face.rms(face.lost)))
        if face.printed_through:
            warnings.append(
                f"{path}: the mesh is too coarse for the residual of {residual:.3g} nm after Z{max(face.figure)}: it "
                f"changes from node to node ({1e3 * face.spacing:.3g} mm), and nodes are interpolated from the others "
                f"to {between:.3g} nm rms only; refine the mesh, or do not rely on the residual's effect on images"
            )
        if face.rms(face.lost) > max(SEEN, PRINTED * face.rms(face.residual)):
            warnings.append(
                f"{path}: {lost:.3g} nm rms of the surface's change are finer than its grid and are not modelled; "
                "give only the nodes of the clear aperture, or fewer nodes"
            )
    return tuple(warnings)
