"""The quantities of an intersection-angle test, as angle.json has them.

Keys below those that name a result begin with the name of an angle, such as alpha_deg and alpha_arcsec_sigma.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.stats import chi2

from analysis.arrays import ARCSEC
from analysis.orbit.planes import AlongTrackAngles, PlaneAngles
from twin.orbit.angle.angle_run import AngleRun, EffectRow, FrameRow, PassAngles, Scatter, SimulatedAngleRun, values_of
from twin.run.quantity import Quantity, Record

ByAngle = dict[str, float | None]
"""A number for each angle of the test's file; None for what could not be computed."""


def _by_angle(names: Iterable[str], values: Iterable[float]) -> ByAngle:
    return {name: float(v) if np.isfinite(v) else None for name, v in zip(names, values, strict=True)}


def _degrees(names: Iterable[str], values: Iterable[float]) -> ByAngle:
    """Radians as degrees; the keys say so, since they stand beside those of sigmas."""
    return _by_angle([f"{name}_deg" for name in names], np.degrees(list(values)))


def _with_sigmas(names: Iterable[str], angles: PlaneAngles | AlongTrackAngles | FrameRow) -> ByAngle:
    """Angles in degrees, then their sigmas in arcseconds."""
    names = tuple(names)
    return _degrees(names, angles.values) | _by_angle([f"{n}_arcsec_sigma" for n in names], angles.sigma / ARCSEC)


def _plane_chances(one: PassAngles) -> dict[str, float]:
    fits = zip(one.measurement.strips, one.estimate.planes["tls"], strict=True)
    return {line: float(chi2.sf(fit.chi_square, len(fit.residual) - 2)) for line, fit in fits}


PASS: Record[PassAngles] = Record(
    "The angles of one pass, and those of the laboratory's camera.",
    Quantity("time_s", lambda one: one.time, "moment to which the points are brought, from the epoch"),
    Quantity("points", lambda one: {k: len(ids) for k, ids in one.ids.items()}, "line -> number of its points"),
    Quantity(
        "dihedral",
        lambda one: _with_sigmas(one.pairs, one.estimate.angles["tls"]),
        "angles between the planes, which are fitted by total least squares",
    ),
    Quantity(
        "along_track",
        lambda one: _with_sigmas(one.pairs, one.estimate.along),
        "angles between the lines of sight of the lines' centres, their signed part along the track",
    ),
    Quantity(
        "resection", lambda one: _with_sigmas(one.pairs, one.estimate.resected), "angles by space resection, signed"
    ),
    Quantity(
        "laboratory_dihedral",
        lambda one: _degrees(one.pairs, one.laboratory.dihedral.values()),
        "angles between the planes of the laboratory's camera",
    ),
    Quantity(
        "laboratory_along_track",
        lambda one: _degrees(one.pairs, one.laboratory.along_track.values()),
        "angles along the track of the laboratory's camera",
    ),
    Quantity(
        "change_arcsec",
        lambda one: _by_angle(one.pairs, one.estimate.along.values - values_of(one.laboratory.along_track)),
        "change of the angles along the track since the laboratory",
    ),
    Quantity("plane_p_value", _plane_chances, "line -> chance of a chi-square of its plane as large or larger"),
    Quantity("resection_p_value", lambda one: one.estimate.resection.p_value, "the same for the resection"),
    Quantity("resection_agrees", lambda one: one.estimate.resection.p_value >= UNLIKELY, "whether that is likely"),
)
UNLIKELY = 1e-3
"""Chance of a chi-square as large below which a resection does not fit."""
TRUTH: Record[SimulatedAngleRun] = Record(
    "The angles of the true camera, by each definition.",
    Quantity("look", lambda run: _degrees(run.names, run.flight.look.values()), "between the lines of sight"),
    Quantity("dihedral", lambda run: _degrees(run.names, run.flight.dihedral.values()), "between the planes"),
    Quantity("along_track", lambda run: _degrees(run.names, run.flight.along_track.values()), "along the track"),
)


def _changes(run: SimulatedAngleRun) -> dict[str, ByAngle]:
    flight = run.flight
    return {
        "ground": _by_angle(run.names, run.change),
        "truth": _by_angle(run.names, values_of(flight.look) - values_of(flight.before_launch.look)),
        "trace": _by_angle(flight.trace, flight.trace.values()),
    }


SCATTER: Record[Scatter] = Record(
    "One estimator over passes with errors drawn anew.",
    Quantity("bias_arcsec", lambda one: _by_angle(one.names, one.bias), "mean over the passes minus truth"),
    Quantity("spread_arcsec", lambda one: _by_angle(one.names, one.spread), "standard deviation over the passes"),
    Quantity("sigma_arcsec", lambda one: _by_angle(one.names, one.sigma), "standard deviation that it claims"),
    Quantity("p_value", lambda one: _by_angle(one.names, one.tail), "chance of such a spread if the sigma is right"),
)
EFFECT: Record[EffectRow] = Record(
    "What an effect on the light, or a shift of all points, does to the angles between tls planes.",
    Quantity("what", lambda row: row.what, "name of the effect"),
    Quantity("bias_arcsec", lambda row: _by_angle(row.names, row.bias), "angles minus truth without correction"),
    Quantity("corrected_arcsec", lambda row: _by_angle(row.names, row.left), "what the correction leaves of it"),
)
PASSES: Record[SimulatedAngleRun] = Record(
    "Passes with errors drawn anew.",
    Quantity("passes", lambda run: len(run.planes.values), "how many"),
    Quantity("planes", lambda run: run.planes, "dihedral angles of tls planes", record=SCATTER),
    Quantity("along_track", lambda run: run.along, "angles along the track from these planes", record=SCATTER),
    Quantity("resection", lambda run: run.resection, "angles by resection", record=SCATTER),
)


def _frame(names: Iterable[str], row: FrameRow) -> dict[str, Any]:
    normal = {"least_normal_z": row.steepest, "near_vertical": row.warned}
    return {"frame": row.frame, "method": row.method, **_with_sigmas(names, row), **normal}


ANGLE: Record[Any] = Record(
    "angle.json. Measurements have no truth: of them there is the key `measured` alone.",
    Quantity("seed", lambda run: run.seed, "of all random numbers"),
    Quantity("time_s", lambda run: run.flight.spec.time, "moment of exposure, from the epoch"),
    Quantity("angles", lambda run: run.flight.pairs, "the two lines that each angle lies between"),
    Quantity(
        "planes",
        lambda run: {name: _with_sigmas(run.names, one) for name, one in run.estimate.angles.items()},
        "dihedral angles by each form of the planes, in the Earth-fixed frame",
    ),
    Quantity(
        "folded",
        lambda run: dict(zip(run.names, run.estimate.angles["tls"].folded.tolist(), strict=True)),
        "whether an angle is below three sigmas, where its noise pushes it up",
    ),
    Quantity("look", lambda run: _degrees(run.names, run.estimate.look), "between the lines of sight of the centres"),
    Quantity("along_track", lambda run: _with_sigmas(run.names, run.estimate.along), "their part along the track"),
    Quantity(
        "resection",
        lambda run: _with_sigmas(run.names, run.estimate.resected) | {"p_value": run.estimate.resection.p_value},
        "angles by space resection, and the chance of its chi-square",
    ),
    Quantity("truth", lambda run: run, "the angles of the true camera", record=TRUTH),
    Quantity("change_arcsec", _changes, "change of the look angles since launch: found, true, and by the trace"),
    Quantity("difference_arcsec", lambda run: _by_angle(run.names, run.difference), "planes minus resection"),
    Quantity(
        "difference_arcsec_sigma",
        lambda run: _by_angle(run.names, run.difference_sigma),
        "standard deviation of the difference over the passes",
    ),
    Quantity("sensitivity", lambda run: [row.to_dict() for row in run.table], "answers of the angles to errors"),
    Quantity("effects", lambda run: run.effects, "each effect alone and all together", record=EFFECT),
    Quantity(
        "frames", lambda run: [_frame(run.names, row) for row in run.frames], "every form of the planes in every frame"
    ),
    Quantity("scatter", lambda run: run, "passes with errors drawn anew", record=PASSES),
    Quantity(
        "height_m_per_arcsec",
        lambda run: run.height,
        "error of intersected heights for 1 arcsec of an angle",
        converted=False,
    ),
    Quantity("measured", lambda run: {one.name: one for one in run.passes}, "pass -> its angles", record=PASS),
)
_MEASURED: Record[AngleRun] = Record(ANGLE.meaning, ANGLE["measured"])


def angle_numbers(run: AngleRun) -> dict[str, Any]:
    """Contents of angle.json without its frames."""
    return ANGLE(run) if isinstance(run, SimulatedAngleRun) else _MEASURED(run)
