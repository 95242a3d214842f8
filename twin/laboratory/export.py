"""Export of a simulated bench's measurements as files, with a test's file that reads them back (``--export DIR``).

The files are exactly those that a user of a real bench would fill in, and contain no true values. Their numbers are in
SI units with all digits, so that reading them back reproduces every bit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from analysis.turntable.dividing_error import CalibrationSeries
from optics.numerics.number_tree import FrozenMap
from scenes.specs import camera_tests
from scenes.specs.camera_tests import MeasuredTurntableSpec, TurntableFiles, TurntableTestSpec
from scenes.yaml.spec import Spec
from scenes.yaml.yaml_file import dump_yaml
from twin.framework.data_files import FrameFacts, csv_table, tiff
from twin.laboratory.distortion_run import SimulatedDistortion
from twin.laboratory.focus_run import SimulatedFocus, SimulatedState, recorder_of
from twin.laboratory.turntable_run import TurntableRun

Files: TypeAlias = Mapping[str, str | bytes]
"""Path of a file in the export folder -> its contents."""
COMPARISONS, HELD_OUT, SPOTS = "comparisons.csv", "held_out.csv", "spots.csv"
"""Names of the exported tables: comparisons of a turntable with its reference, held-out ones, and spot positions."""


def export_turntable(run: TurntableRun) -> Files:
    """Return the files of a simulated turntable test: two tables of comparisons and ``turntable.yaml``.

    A comparison is a turntable reading with the reference angle; the second table, of held-out angles, is for
    validation.
    """
    spec = run.spec
    assert isinstance(spec, TurntableTestSpec)
    assert run.held_out is not None
    out: dict[str, str | bytes] = {}
    files = _turntable_files(out, spec, run.series, run.held_out)
    test = MeasuredTurntableSpec.model_construct(
        name="turntable", description=spec.description, measured=files, seed=run.seed
    )
    return {**out, "turntable.yaml": _text(test)}


def export_distortion(run: SimulatedDistortion) -> Files:
    """Return the files of a simulated distortion test.

    They are the table of spots with turntable readings, the turntable's calibration, and ``distortion.yaml``.
    """
    setup = run.setup
    out: dict[str, str | bytes] = {}
    turntable = _turntable_files(out, setup.turntable, run.calibration, run.table.held_out())
    heads = ("point", "set", "reading [rad]", "along [m]", "sigma [m]", "fixed sigma [m]")
    reading, spots = run.reading, run.spots
    rows = (
        (
            i + 1,
            s + 1,
            float(reading[i, s]),
            float(spots.position[i, s]),
            float(spots.temporal[i, s]),
            float(spots.fixed[i, s]),
        )
        for i, s in np.ndindex(*reading.shape)
    )
    out[SPOTS] = csv_table([heads, *rows])
    files = camera_tests.DistortionFiles.model_construct(
        spots=SPOTS, zero=setup.turntable.camera_angle, turntable=turntable, line=None, angle_sigma=None, reversed=False
    )
    test = camera_tests.MeasuredDistortionSpec.model_construct(
        name="distortion",
        description=setup.test.description,
        principal_distance=run.bench.path.model.line_principal_distance,
        measured=files,
        seed=run.seed,
    )
    return {**out, "distortion.yaml": _text(test)}


def export_focus(run: SimulatedFocus) -> Files:
    """Return the measurements of a focus alignment before and after each round.

    They are the frames of all edges, a table of the frames and one of their MTF, and a test's file for each table.
    """
    mount = run.bench.setup.test.mount
    out: dict[str, str | bytes] = {}
    shims = tuple(mount.thickness for _ in mount.holes)
    for number, state in enumerate(run.states):
        stem = "before" if number == 0 else f"round_{number}"
        for name, rows in zip(("images", "mtf"), _focus_tables(run, state, number, stem, out), strict=True):
            table = f"{stem}_{name}.csv"
            out[table] = csv_table(rows)
            out[f"focus_{stem}_{name}.yaml"] = _text(_focus_test(run, state, {name: table}, shims))
        if number < len(run.shimmings):
            shims = tuple(float(thickness) for thickness in run.shimmings[number].plan.thickness)
    return out


def _focus_tables(
    run: SimulatedFocus, state: SimulatedState, number: int, stem: str, out: dict[str, str | bytes]
) -> tuple[list[Sequence[Any]], list[Sequence[Any]]]:
    """Return the rows of the tables of images and of MTF values; the image files are added to ``out``."""
    bench = run.bench
    recorder = recorder_of(bench, state.placement, run.seed, number)
    where = ("band", "x [m]", "y [m]", "edge", "shift [m]")
    images: list[Sequence[Any]] = [(*where, "file")]
    values: list[Sequence[Any]] = [(*where, "mtf", "sigma")]
    for i, (site, scan) in enumerate(zip(bench.sites, state.scans, strict=True)):
        field = bench.setup.test.fields.index(site.field) + 1
        facts = FrameFacts(f"{bench.setup.camera.name}, line CCD {site.band}", bench.ccds[site.band].band.pitch)
        x, y = (float(v) for v in site.place)
        for edge, shift in scan.shift.items():
            for k, at in enumerate(scan.target):
                position = (site.band, x, y, edge, float(shift[k]))
                file = f"{stem}/{site.band}_field{field}_{edge}_{k + 1:02d}.tiff"
                out[file] = bytes(tiff(recorder.frames(i, edge, float(at), scan.take + k), facts))
                images.append((*position, file))
                # images without a measured edge have no value
                if np.isfinite(scan.sigma[edge][k]):
                    values.append((*position, float(scan.mtf[edge][k]), float(scan.sigma[edge][k])))
    return images, values


def _focus_test(
    run: SimulatedFocus, state: SimulatedState, table: dict[str, str], shims: tuple[float, ...]
) -> camera_tests.MeasuredFocusSpec:
    """Return the test specification that reads one table of focus measurements back."""
    noise = {}
    for name, ccd in run.bench.ccds.items():
        # the file cannot express noise beyond the model of EMVA 1288: it is then estimated from the images
        if not ccd.noise.further:
            numbers: dict[str, Any] = {
                field: float(getattr(ccd.noise, field)) for field in camera_tests.NoiseSpec.model_fields
            }
            noise[name] = camera_tests.NoiseSpec.model_construct(**numbers)
    tables: dict[str, Any] = {"mtf": None, "images": None, **table}
    files = camera_tests.FocusFiles.model_construct(
        **tables,
        moved="image",
        per_shift=None,
        frequency=0.5,
        noise=FrozenMap(noise if "images" in table else {}),
        level=camera_tests.LevelSpec.model_construct(angle=state.level.angle, sigma=state.level.sigma),
    )
    return camera_tests.MeasuredFocusSpec.model_construct(
        name="focus",
        description=run.bench.setup.test.description,
        measured=files,
        mount=run.bench.setup.test.mount,
        shims=shims,
        vertex_error=camera_tests.MeasuredFocusSpec.model_fields["vertex_error"].default,
        vertex_trend=camera_tests.MeasuredFocusSpec.model_fields["vertex_trend"].default,
        seed=run.seed,
    )


def _turntable_files(
    out: dict[str, str | bytes], spec: TurntableTestSpec, series: CalibrationSeries, held_out: CalibrationSeries
) -> TurntableFiles:
    """Add the tables of both turntable series to ``out`` and return the section of a test's file that names them."""
    for name, comparisons in ((COMPARISONS, series), (HELD_OUT, held_out)):
        out[name] = csv_table(_comparisons(comparisons))
    return TurntableFiles.model_construct(
        comparisons=COMPARISONS, held_out=HELD_OUT, reference=spec.reference.calibration, folds=spec.calibration.folds
    )


def _comparisons(series: CalibrationSeries) -> Iterator[Sequence[Any]]:
    """Yield the rows of a table of turntable readings and reference angles, beginning with the column names."""
    yield "reading [rad]", "repeat", "difference [rad]"
    for angle, row in zip(series.angle, series.comparisons, strict=True):
        yield from ((float(angle), k + 1, float(value)) for k, value in enumerate(row))


def _text(test: Spec) -> str:
    return dump_yaml(test.plain())
