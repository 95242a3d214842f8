"""Checks of Table 2 of paper 001 (Wang et al. 2018), its principle experiment (section 3.1).

The experiment has two autocollimators and two mirrors on a turntable.

The rotation "about Z" has to be interpreted. X is up and Y horizontal, so Z is the view of autocollimator 1, along the
normal of mirror 1: autocollimator 1 cannot observe a rotation about it, and reads its own noise. Mirror 2 rotates about
Z1 = Y2 sin b + Z2 cos b, with the angle b between the mirrors' normals (indices 1 and 2 name the autocollimators); of a
rotation d_gamma its autocollimator observes d_gamma sin b, about Y2. The printed column of mirror 1 grows by 0.8657 of
the table's angle and not by 1 or 0: it is d_gamma sin 60 deg, and times 2/sqrt(3) it is the column of mirror 2 in all
digits. It is therefore the unscaled reading of autocollimator 2. An arrangement with both mirrors at an angle theta =
b/2 from Z would read d_gamma sin(theta) = 0.5 d_gamma on both, and a rotation about the vertical d_gamma; neither is
printed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor import autocollimator
from analysis.monitor.autocollimator import column_component, mean_difference, relation_factor
from optics.numerics.quadrature import PupilNodes
from scenes.specs.camera_tests import AutocollimatorSetup
from scenes.specs.load import load_autocollimator_test
from twin.framework.svg import BLUE, GREY, INK, LIGHT, ORANGE, VERMILION, look, to_png
from twin.laboratory import autocollimator_bench as laboratory
from twin.laboratory.autocollimator_bench import UNITS, AutocollimatorPath, mirror_body
from twin.validation.check import CheckResult, Chosen
from twin.validation.group import Context, group_of, load_printed

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TABLE = load_printed("001")
ANGLES = _TABLE.column("table2.turn_arcsec")
MIRROR_1 = _TABLE.columns("table2.mirror_1_arcsec")
MIRROR_2 = _TABLE.columns("table2.mirror_2_arcsec")
MEAN_DIFFERENCE = _TABLE.numbers("table2.mean_difference_arcsec")
_CLAIMED = _TABLE.numbers("table2.claimed_arcsec")
_AXES = {"d_beta": "X", "d_alpha": "Y", "d_gamma": "Z"}


@dataclass(frozen=True, eq=False)
class Measured:
    """Readings of the ideal bench and of benches with the specified errors, with the setup and calibration used."""

    setup: AutocollimatorSetup
    reader: laboratory.Reader
    ideal: laboratory.ReadingTable
    real: tuple[laboratory.ReadingTable, ...]


def measured(context: Context) -> Measured:
    """Simulate the readings of the ideal bench and of benches with the specified errors."""
    setup = load_autocollimator_test()
    context.progress(0.0, "calibrate the autocollimators")
    reader = laboratory.Reader(setup, context.backend)
    count = context.count(full=24, fast=12)

    def bench(n: int) -> laboratory.ReadingTable:
        context.progress(0.1 + 0.8 * n / count, f"bench {n + 1} of {count}")
        return laboratory.run_autocollimator_test(setup, context.backend, seed=context.seed + n, reader=reader)

    ideal = laboratory.run_autocollimator_test(setup, context.backend, seed=context.seed, ideal=True, reader=reader)
    return Measured(setup, reader, ideal, tuple(bench(n) for n in range(count)))


def run(context: Context) -> Iterator[CheckResult]:
    """Yield the results of the checks of Table 2 and of its text."""
    for name, claimed in _CLAIMED.items():
        value = printed_mean_difference(_AXES[name])
        explained = [MEAN_DIFFERENCE[_AXES[name]]]
        yield context.row(f"001.table2.claimed.{name}", value, explained=explained, times=claimed / value)
    if not any(".claimed." not in identifier for identifier in context.selected):
        return
    measurement = measured(context)
    differences: dict[str, tuple[float, float]] = {}
    for series in laboratory.series_per_axis(measurement.setup.spec):
        row = _mean_difference(context, measurement, series)
        differences[series.axis] = float(row.measured or 0.0), float(row.sigma or 0.0)
        yield row
    yield _z_columns(context, measurement)
    yield from _relations(context, measurement)
    worst, spread = max(differences.values())
    text = ", ".join(f"about {axis} {value:.3f}" for axis, (value, _) in differences.items())
    facts: dict[str, Any] = {
        "rendered_benches": measurement,
        "text": text,
        "printed": {axis: printed_mean_difference(axis) for axis in differences},
    }
    for name in ("mean_error", "below_1"):
        sigma = spread / math.sqrt(len(measurement.real))
        yield context.row(f"001.table2.{name}", worst, sigma, inputs=[_errors(worst)], **facts)
    _show(context, measurement)


def printed_mean_difference(axis: str) -> float:
    """Return the mean absolute difference computed from the rows of Table 2, arcsec, to compare with its last line.

    The difference is mirror 1 - mirror 2 for the axes X and Y, and turntable - mirror 2 for Z.
    """
    return mean_difference(ANGLES if axis == "Z" else MIRROR_1[axis], MIRROR_2[axis])


def _mean_difference(context: Context, measurement: Measured, series: laboratory.Series) -> CheckResult:
    """Check the last line of Table 2 for one axis by the mean over the benches.

    The noise is the standard deviation of one bench under the errors that the scene's file specifies.
    """
    axis, spec = series.axis, measurement.setup.spec
    perfect, result = measurement.ideal[axis], measurement.real[0][axis]
    means = np.array([table[axis].mean_difference for table in measurement.real])
    spread = laboratory.declared_spread(spec, series, float(np.max(result.sigma)) / math.sqrt(2.0))
    facts: dict[str, Any] = {
        "rendered_benches": measurement,
        "result": result,
        "rows": series.steps + 1,
        "means": means,
        "printed_rows": printed_mean_difference(axis),
        "spread": spread,
        "below": np.mean(spread / ARCSEC < MEAN_DIFFERENCE[axis]),
        "rate": perfect.readings[1, -1, column_component(axis)] / series.angles[-1],
        "factor": relation_factor(axis, 2, 2.0 * series.half_angle),
        "off": np.abs(perfect.from_exact),
    }
    value = float(np.mean(means)) / ARCSEC
    sigma = float(np.std(spread)) / ARCSEC
    return context.row(f"001.table2.{axis.lower()}", value, sigma, inputs=[_errors(value)], **facts)


def _z_columns(context: Context, measurement: Measured) -> CheckResult:
    spec, real = measurement.setup.spec, measurement.real
    first, second = (np.array([table["Z"].columns[k] for table in real]) / ARCSEC for k in (0, 1))
    mirror_1 = np.array(MIRROR_1["Z"])
    scale = real[0]["Z"].scale
    # each of two instruments has the unrest of a reading and of its reading at zero; equal means within half a digit
    unrest = 2.0 * spec.errors.reading / ARCSEC
    probability = math.erf(0.005 / (unrest * math.sqrt(2.0))) ** len(mirror_1) if unrest > 0.0 else 0.0
    apart = np.max(np.abs(scale * first - second), axis=1)
    facts: dict[str, Any] = {
        "scale": scale,
        "mirror_1": mirror_1,
        "twice": mirror_1[1] * 2.0 / math.sqrt(3.0),
        "probability": probability,
        "rate": np.polyfit(ANGLES, mirror_1, 1)[0],
        "sine": math.sqrt(0.75),
        "first": first,
        "end": second[:, -1],
    }
    # of the last row: drift, the table's position, and the unrest of both mirrors, each with its reading at zero
    drift = spec.errors.focal_length * float(np.mean(second[:, -1]))
    sigma = math.hypot(drift, spec.errors.turntable_step / ARCSEC, 2.0 * scale * spec.errors.reading / ARCSEC)
    return context.row("001.table2.z_columns", float(np.mean(apart)), sigma, explained=[float(ANGLES[-1])], **facts)


def _errors(measured: float) -> Chosen:
    """Return all errors of the bench, multiplied by one factor, as an input that the paper does not print.

    Mean differences are proportional to that factor.
    """
    return Chosen.power("errors of the bench (scenes/lab/principle_experiment.yaml), times", 1.0, "1", measured)


def _relations(context: Context, measurement: Measured) -> Iterator[CheckResult]:
    """Check the relations of section 3.1.1 on the ideal bench, which has no errors."""
    for axis in "XYZ":
        result, component = measurement.ideal[axis], column_component(axis)
        between = 2.0 * result.series.half_angle
        read = float(result.readings[1, -1, component] / result.series.angles[-1])
        facts: dict[str, Any] = {"series": result.series, "between": between, "read": read, "axis": "XY"[component]}
        row = f"001.table2.relation.{axis.lower()}"
        yield context.row(row, read / autocollimator.relation_factor(axis, 2, between), **facts)
    result = measurement.ideal["Z"]
    read = float(result.readings[0, -1, 1] / result.series.angles[-1])
    expected = [autocollimator.relation_factor("Z", 1, 0.0)]
    yield context.row("001.table2.relation.mirror_1_z", read, explained=expected, series=result.series)


def _show(context: Context, measurement: Measured) -> None:
    context.progress(0.95, "draw")
    table = measurement.real[0]
    columns = [table["X"].series.angles, *(column for axis in "XYZ" for column in table[axis].columns)]
    context.table("table2", [[round(float(v) / ARCSEC, 4) for v in row] for row in zip(*columns, strict=True)])
    context.figure("bench", bench_png(measurement.reader, [table]))


DPI = 130
_ACROSS = PupilNodes(np.array([0.0, 0.0, 0.0]), np.array([-1.0, 0.0, 1.0]), np.full(3, 1.0 / 3.0))
_TITLES = {
    "X": "about X: mirror 1 − mirror 2",
    "Y": "about Y: mirror 1 − mirror 2 / cos 30°",
    "Z": "about Z: turntable − mirror 2 / sin 60°",
}


def bench_png(reader: laboratory.Reader, tables: Sequence[laboratory.ReadingTable]) -> bytes:
    """Return the picture of the bench as PNG.

    Parameters
    ----------
    reader : laboratory.Reader
        Reader of the experiment.
    tables : sequence of laboratory.ReadingTable
        Rendered benches, each with the series of Table 2.
    """
    from matplotlib.figure import Figure

    with look("principle"):
        figure = Figure(figsize=(13.0, 7.4), layout="constrained", facecolor="white")
        grid = figure.add_gridspec(3, 2, width_ratios=(1.25, 1.0))
        axes = figure.add_subplot(grid[:, 0])
        _bench(axes, AutocollimatorPath(reader.path(reader.spec.programme.wide).bench, reader.backend, _ACROSS))
        for i, axis in enumerate(_TITLES):
            _differences(figure.add_subplot(grid[i, 1]), tables, axis, i == 2)
        return to_png(figure, DPI)


def _plan(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project points of the bench, (..., 3), metres, onto the plan view: two coordinates in millimetres.

    They are seen from above (X up): Z to the right, Y down.
    """
    return 1e3 * points[..., 2], -1e3 * points[..., 1]


def _bench(axes: Axes, path: AutocollimatorPath) -> None:
    from matplotlib.patches import Circle

    bench, spec = path.bench, path.bench.spec
    placed = bench.assembly.place()
    for n, unit in enumerate(UNITS):
        colour = (BLUE, VERMILION)[n]
        for ray in path.polylines({})[n]:
            axes.plot(*_plan(ray), color=colour, lw=0.8, alpha=0.8)
        frame = bench.frame(unit)
        front = -spec.autocollimator.distance * frame[:, 2]
        across, view = frame[:, 1], frame[:, 2]
        lens = spec.autocollimator.lens
        rim = 0.5 * lens.diameter * np.array([-1.0, 1.0])[:, None] * across
        for depth in (0.0, lens.thickness):
            axes.plot(*_plan(front - depth * view + rim), color=INK, lw=1.2)
        image = front - (lens.thickness + lens.focal_distance) * view
        chip = 0.5 * spec.autocollimator.area_ccd.columns * spec.autocollimator.area_ccd.pitch
        axes.plot(*_plan(image + np.array([-chip, chip])[:, None] * across), color=INK, lw=4)
        mirror = placed.pose(mirror_body(unit))
        edge = 0.5 * spec.mirrors.aperture * np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
        axes.plot(*_plan(mirror.apply(edge)), color=INK, lw=3.5)
        # the names stand beside the beams, away from the other autocollimator
        beside = across * (-1.0 if unit == 1 else 1.0)
        anchor: dict[str, Any] = {"ha": "center" if unit == 1 else "left", "va": "center"}
        axes.annotate(f"autocollimator {unit}", _plan(image + 0.05 * beside + 0.14 * view), color=colour, **anchor)
        axes.annotate(f"mirror {unit}", _plan(mirror.translation + 0.05 * beside - 0.06 * view), **anchor)
        for vector, name in ((across, "Y"), (view, "Z")):
            tip = _plan(0.1 * vector)
            axes.annotate("", tip, (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.2})
            axes.annotate(f"{name}$_{unit}$", _plan(0.122 * vector), color=colour, ha="center", va="center")
    axes.add_patch(Circle((0.0, 0.0), 1e3 * (spec.mirrors.radius + 0.03), fill=False, color=GREY, lw=1.0, ls="--"))
    axes.annotate("turntable", (140.0, 175.0), color=GREY, ha="center")
    title = f"From above (X toward you), mirrors {np.degrees(bench.mirror_angle):.0f}° apart; mm"
    axes.set(aspect="equal", title=title, xlabel="Z", ylabel="−Y")
    axes.grid(color=LIGHT, lw=0.5)


def _differences(axes: Axes, tables: Sequence[laboratory.ReadingTable], axis: str, last: bool) -> None:
    for k, table in enumerate(tables):
        result = table[axis]
        first, second = result.columns
        start = result.series.angles if axis == "Z" else first
        label = f"rendered, {len(tables)} bench{'es' if len(tables) > 1 else ''}" if k == 0 else None
        axes.plot(result.series.angles / ARCSEC, (start - second) / ARCSEC, color=BLUE, lw=0.9, alpha=0.6, label=label)
    printed = load_printed("001")
    angles, mirror_1 = (printed.column("table2.turn_arcsec"), printed.columns("table2.mirror_1_arcsec"))
    difference = np.array(angles if axis == "Z" else mirror_1[axis]) - printed.columns("table2.mirror_2_arcsec")[axis]
    axes.plot(angles, difference, "o-", color=ORANGE, ms=4, lw=1.2, label="printed Table 2")
    axes.axhline(0.0, color=GREY, lw=0.7)
    axes.set(title=_TITLES[axis], ylabel="arcsec")
    if last:
        axes.set_xlabel("turn of the table, arcsec")
        most = max(float(np.max(np.abs(t["Z"].columns[0]))) for t in tables) / ARCSEC
        text = f"mirror 1: rendered at most {most:.1f}″ (it turns about its normal), printed {mirror_1['Z'][-1]}″"
        axes.text(0.02, 0.04, text, transform=axes.transAxes, color=INK, fontsize=8)
    axes.legend(loc="upper left", fontsize=8)
    axes.margins(y=0.2)
    axes.grid(color=LIGHT, lw=0.5)


GROUP = group_of("001.table2", run)
