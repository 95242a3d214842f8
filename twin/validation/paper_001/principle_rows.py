"""Table 2 of paper 001: what is printed, and the checks of it.

30 deg between the mirrors about X and Y, 60 deg about Z. The second column of each pair is mirror 2; about Y and Z it
is printed as 2/sqrt(3) times mirror 2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from analysis.monitor.autocollimator import AXES, column_component, mean_difference, reading_of_normal, relation_factor
from analysis.units import ARCSEC
from optics.geometry.pose import rotation_matrix
from optics.numerics.backend import Backend
from scenes.models.principle_model import UNITS
from scenes.specs.principle_experiment import PrincipleExperimentSpec, PrincipleSetup
from twin.validation.checks.printed import load_printed
from twin.validation.paper_001.principle_bench import PrincipleTable, Reader, Series, run_principle_experiment, table_2

_TABLE = load_printed("001")
ANGLES = _TABLE.column("table2.turn_arcsec")
MIRROR_1 = _TABLE.columns("table2.mirror_1_arcsec")
MIRROR_2 = _TABLE.columns("table2.mirror_2_arcsec")
MEAN_DIFFERENCE = _TABLE.numbers("table2.mean_difference_arcsec")
PAPER = "001"
DRAWS = 4000
_RELATIONS = {
    "X": "a turn of the table about X turns both mirrors by d_beta",
    "Y": "a turn about Y turns mirror 1 by d_alpha and mirror 2 by d_alpha cos b about its own Y",
    "Z": "a turn about Z reads d_gamma sin b on mirror 2 (about its own Y, not its Z as printed), nothing on mirror 1",
}


@dataclass(frozen=True)
class PrincipleCheck:
    """One number of the paper beside the rendered one.

    Attributes:
        id: of the check. paper: its number. equation: where it is printed.
        statement: what is claimed, as far as it is right.
        printed, measured: the two numbers, in ``unit``; ``measured`` is the mean over the rendered benches.
        sigma: standard deviation of one bench under the errors that the scene declares.
        how: how the numbers came about, and what else they show.
    """

    id: str
    paper: str
    equation: str
    statement: str
    printed: float
    measured: float
    sigma: float
    unit: str
    how: str


def declared_spread(
    spec: PrincipleExperimentSpec, series: Series, image_sigma: float, draws: int = DRAWS, seed: int = 0
) -> np.ndarray:
    """Mean differences of a series, (draws,), radians, under the errors that the scene declares, without images.

    Args:
        spec: the experiment.
        series: one of its series.
        image_sigma: standard deviation of one reading by the noise of the images, radians.
        draws: number of benches.
        seed: of the draws.
    """
    e, rng = spec.errors, np.random.default_rng(seed)
    between = 2.0 * series.half_angle
    angles = np.broadcast_to(series.angles, (draws, series.steps + 1)).copy()
    angles[:, 1:] += e.turntable_step * rng.standard_normal((draws, series.steps))
    k = AXES.index(series.axis)
    axis = np.where(np.arange(3) == k, 1.0, e.axis_tilt * rng.standard_normal((draws, 3)))
    turn = rotation_matrix(angles[..., None] * (axis / np.linalg.norm(axis, axis=1, keepdims=True))[:, None])
    columns = []
    for unit in UNITS:
        frame = rotation_matrix(np.array([between if unit == 2 else 0.0, 0.0, 0.0]))
        mount = rotation_matrix(e.mirror_mount * rng.standard_normal((draws, 3)) * [1.0, 1.0, 0.0])
        start = mount @ np.array([0.0, 0.0, -1.0])
        normal = np.einsum("xi,drxy,yj,dj->dri", frame, turn, frame, start, optimize=True)
        reading = reading_of_normal(normal) - reading_of_normal(start)[:, None]
        roll = rotation_matrix(e.ccd_rotation * rng.standard_normal((draws, 1)) * [0.0, 0.0, 1.0])[:, :2, :2]
        reading = np.einsum("dij,drj->dri", roll, reading)[..., column_component(series.axis)]
        reading *= 1.0 + e.focal_length * rng.standard_normal((draws, 1))
        # the reading at zero is common to all rows; image_sigma already holds its share
        unrest = e.reading * rng.standard_normal((draws, series.steps + 2))
        reading += unrest[:, 1:] - unrest[:, :1] + image_sigma * rng.standard_normal(reading.shape)
        columns.append(reading)
    first = series.angles if series.axis == "Z" else columns[0]
    return np.asarray(np.mean(np.abs(first - columns[1] / relation_factor(series.axis, 2, between)), axis=1))


def printed_mean_difference(axis: str) -> float:
    """Last line of Table 2 worked out from its rows, arcsec: mirror 1 - mirror 2 (X, Y), turntable - mirror 2 (Z)."""
    return mean_difference(ANGLES if axis == "Z" else MIRROR_1[axis], MIRROR_2[axis])


def principle_checks(
    setup: PrincipleSetup,
    backend: Backend,
    seed: int = 0,
    benches: int = 8,
    progress: Callable[[str], None] | None = None,
    reader: Reader | None = None,
) -> tuple[PrincipleCheck, ...]:
    """Render Table 2, on the ideal bench and on some with errors, and set it beside the printed one.

    What "about Z" can mean. X is up and Y horizontal, so Z is the view of autocollimator 1, along the normal of mirror
    1: autocollimator 1 cannot see a turn about it, and reads its own unrest. Mirror 2 turns about Z1 = Y2 sin b +
    Z2 cos b; of that the autocollimator sees d_gamma sin b, about Y2. The printed column of mirror 1 grows by 0.8657 of
    the table's angle and not by 1 or 0: it is d_gamma sin 60 deg, and times 2/sqrt(3) it is the column of mirror 2 in
    all digits. It is therefore the unscaled reading of autocollimator 2. A stand with both mirrors theta off Z would
    read d_gamma sin(theta) = 0.5 d_gamma on both, and a turn about the vertical d_gamma; neither is printed.

    Args:
        setup: the experiment; its programme must hold the rows of the printed table.
        backend: where to trace.
        seed: of the first bench's errors and noise; the others have the seeds that follow.
        benches: how many are rendered. A bench's errors are shared by all its rows, so that one alone says little.
        progress: told what is being done.
        reader: the calibrated autocollimators, by default calibrated here.
    """
    say = progress or (lambda text: None)
    say("calibrate the autocollimators")
    reader = reader or Reader(setup, backend)
    say("the ideal bench")
    ideal = run_principle_experiment(setup, backend, seed=seed, ideal=True, reader=reader)
    real = []
    for n in range(benches):
        say(f"bench {n + 1} of {benches}")
        real.append(run_principle_experiment(setup, backend, seed=seed + n, reader=reader))
    return compare(setup.spec, ideal, real)


def compare(
    spec: PrincipleExperimentSpec, ideal: PrincipleTable, real: Sequence[PrincipleTable]
) -> tuple[PrincipleCheck, ...]:
    """The printed Table 2 beside rendered ones: of the ideal bench and of at least one with errors."""
    checks = [_relation(spec, series, ideal, real) for series in table_2(spec)]
    return (*checks, _z_columns(spec, real))


def _relation(
    spec: PrincipleExperimentSpec, series: Series, ideal: PrincipleTable, real: Sequence[PrincipleTable]
) -> PrincipleCheck:
    axis = series.axis
    perfect, result = ideal[axis], real[0][axis]
    means = [table[axis].mean_difference / ARCSEC for table in real]
    spread = declared_spread(spec, series, float(np.max(result.sigma)) / math.sqrt(2.0)) / ARCSEC
    value = MEAN_DIFFERENCE[axis]
    component = column_component(axis)
    rate = float(perfect.readings[1, -1, component] / series.angles[-1])
    factor = relation_factor(axis, 2, 2.0 * series.half_angle)
    against = "the turntable's angle" if axis == "Z" else "mirror 1"
    off = np.max(np.abs(perfect.from_exact)) / ARCSEC
    how = (
        f"mean |{against} - {result.scale:.6f} mirror 2| over {series.steps + 1} rows, from rendered spots of "
        f"{len(real)} benches with the declared errors ({min(means):.3f} to {max(means):.3f}). The printed rows give "
        f"{printed_mean_difference(axis):.6f}. Declared errors make {np.mean(spread):.3f} +- {np.std(spread):.3f} to "
        f"be expected; {np.mean(spread < value):.0%} of benches stay below the printed one. Without errors and noise "
        f"mirror 2 reads {rate:.6f} of the angle (relation {factor:.6f}) and both mirrors are within {off:.5f} arcsec "
        "of the exact reflection, second order included"
    )
    return PrincipleCheck(
        id=f"001.table2.{axis.lower()}",
        paper=PAPER,
        equation="Table 2, last line",
        statement=_RELATIONS[axis],
        printed=value,
        measured=float(np.mean(means)),
        sigma=float(np.std(spread)),
        unit="arcsec",
        how=how,
    )


def _z_columns(spec: PrincipleExperimentSpec, real: Sequence[PrincipleTable]) -> PrincipleCheck:
    first, second = (np.array([table["Z"].columns[k] for table in real]) / ARCSEC for k in (0, 1))
    one, two = np.array(MIRROR_1["Z"]), np.array(MIRROR_2["Z"])
    scale = real[0]["Z"].scale
    rate = float(np.polyfit(ANGLES, one, 1)[0])
    # each of two instruments has the unrest of a reading and of its reading at zero; equal means within half a digit
    unrest = 2.0 * spec.errors.reading / ARCSEC
    chance = math.erf(0.005 / (unrest * math.sqrt(2.0))) ** len(one) if unrest > 0.0 else 0.0
    apart = np.max(np.abs(scale * first - second), axis=1)
    how = (
        f"largest |{scale:.6f} mirror 1 - scaled mirror 2| over the rows. Printed: {one[1]:.2f} x 2/sqrt(3) = "
        f"{one[1] * 2.0 / math.sqrt(3.0):.6f} and so on in every row, to half of the last digit. Two instruments with "
        f"the scatter that the X and Y columns show would agree so with a chance of {chance:.0e}. The printed column "
        f"of mirror 1 grows by {rate:.4f} of the table's angle, sin 60 deg = {math.sqrt(0.75):.4f}: it is the "
        f"reading of mirror 2. Rendered, mirror 1 turns about its own normal and reads at most "
        f"{np.max(np.abs(first)):.2f} arcsec, while scaled mirror 2 reads {np.mean(second[:, -1]):.2f}"
    )
    # of the last row: drift, the table's position, and the unrest of both mirrors, each with its reading at zero
    drift = spec.errors.focal_length * float(np.mean(second[:, -1]))
    sigma = math.hypot(drift, spec.errors.turntable_step / ARCSEC, 2.0 * scale * spec.errors.reading / ARCSEC)
    return PrincipleCheck(
        id="001.table2.z_columns",
        paper=PAPER,
        equation="Table 2, columns Z",
        statement="about Z the columns of mirrors 1 and 2 are two mirrors' readings: no, they are one reading twice",
        printed=float(np.max(np.abs(2.0 / math.sqrt(3.0) * one - two))),
        measured=float(np.mean(apart)),
        sigma=sigma,
        unit="arcsec",
        how=how,
    )
