"""The quantities of an adjusted block, as block.json has them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from analysis.block.block_adjustment import LawTest
from analysis.block.network import DatumTest, Network, Open
from analysis.block.reweighting import GroupTest
from analysis.orbit.forward_intersection import Accuracy
from twin.framework.quantity import Quantity, Record
from twin.orbit.block.block_run import BlockRun, CameraChange, Worth

ACCURACY: Record[Accuracy] = Record(
    "Errors that hold nine points in ten.",
    Quantity("ce90_m", lambda one: one.ce90, "radius in plan", "CE90", 3),
    Quantity("le90_m", lambda one: one.le90, "in height", "LE90", 3),
    Quantity("points", lambda one: one.count, "of how many check points"),
)
ALARM = 1e-3
"""Chance below which a test of a run speaks; a run has some ten of them."""
WORTH: Record[Worth] = Record(
    "Check points by some of the block's sensors.",
    Quantity("left_out", lambda one: list(one.left_out), "sensors that were not used"),
    Quantity("predicted", lambda one: one.predicted, "by the covariances of the points", record=ACCURACY),
    Quantity(
        "found",
        lambda one: one.found,
        "by the points' true places, or given ones; none without check points",
        record=ACCURACY,
    ),
    Quantity("agreement", lambda one: one.agreement, "mean square of errors over sigmas; 1 where the sigmas are right"),
)
GROUP: Record[GroupTest] = Record(
    "A group of observations, or a law of errors, after the adjustment.",
    Quantity("observations", lambda one: one.count, "how many", "observations"),
    Quantity("redundancy", lambda one: one.redundancy, "how many of them the others check", "redundancy", 1),
    Quantity(
        "variance_ratio",
        lambda one: one.ratio if np.isfinite(one.ratio) else None,
        "variance of the residuals over that of the sigmas",
        "variance ratio",
        2,
    ),
    Quantity("p_value", lambda one: one.p_value, "two-sided chance of such residuals, approximately", "chance", 3),
    Quantity("factor", lambda one: one.factor, "on the variances, estimated where asked for", "factor", 2),
)
LAW: Record[LawTest] = Record(
    "Whether errors of readings that the stated law calls independent are.",
    Quantity("law", lambda one: one.kind, "as stated"),
    Quantity("excess_sigma", lambda one: one.excess, "products of neighbours beyond what is expected of the law"),
    Quantity("p_value", lambda one: one.p_value, "chance of such an excess or a larger one"),
)
OPEN: Record[Open] = Record(
    "A change that the observations tell less well than what is known beforehand.",
    Quantity("unknowns", lambda one: list(one.names), "that take part"),
    Quantity("change", lambda one: list(one.change), "of each, for one sigma beforehand; metres and radians"),
    Quantity("told", lambda one: one.told, "sigma beforehand over that of the observations alone"),
)
DATUM: Record[DatumTest] = Record(
    "By which the control points are given too large, as the rest of the block sees it.",
    Quantity("east_m", lambda one: one.east, "shift"),
    Quantity("north_m", lambda one: one.north, "shift"),
    Quantity("up_m", lambda one: one.up, "shift"),
    Quantity("sigma_m", lambda one: list(one.sigma), "of east, north and up"),
    Quantity("chi_square", lambda one: one.chi_square, "of the three"),
)
NETWORK: Record[Network] = Record(
    "How the scenes hang together.",
    Quantity("parts", lambda one: [list(part) for part in one.parts], "scenes that shared points connect"),
    Quantity("controlled", lambda one: list(one.controlled), "whether a part has control points or footprints"),
    Quantity("alone", lambda one: list(one.alone), "scenes that share no point with another"),
    Quantity("empty", lambda one: list(one.empty), "scenes without image points"),
)


def _four(get: Callable[[CameraChange], np.ndarray | None], k: int) -> Callable[[CameraChange], Any]:
    def value(one: CameraChange) -> Any:
        row = get(one)
        return None if row is None else row[k]

    return value


CHANGE: Record[CameraChange] = Record(
    "A camera in one scene, against its calibration.",
    *(
        Quantity(f"{name}_{unit}{end}", _four(get, k), f"{name}{words}", f"{name}{words}", decimals)
        for k, (name, unit, decimals) in enumerate(
            (("d_alpha", "arcsec", 3), ("d_beta", "arcsec", 3), ("d_gamma", "arcsec", 3), ("d_f", "um", 2))
        )
        for end, words, get in (
            ("", "", lambda one: one.found),
            ("_sigma", ", sigma", lambda one: one.sigma),
            ("_sigma_before", ", sigma before the block", lambda one: one.before),
            ("_true", ", true", lambda one: one.truth),
        )
    ),
)
BLOCK: Record[BlockRun] = Record(
    "block.json. A block of scenes, adjusted with all that is known of it.",
    Quantity("check_points", lambda run: run.worth, "case -> check points by the sensors of the case", record=WORTH),
    Quantity("sensors", lambda run: list(run.used), "that were used"),
    Quantity(
        "chi_square", lambda run: run.adjustment.chi_square, "of all observations and of what is known beforehand"
    ),
    Quantity("degrees_of_freedom", lambda run: run.adjustment.degrees_of_freedom, "of the chi-square"),
    Quantity("p_value", lambda run: run.adjustment.p_value, "chance of such a chi-square or a larger one"),
    Quantity("agrees", lambda run: run.adjustment.p_value >= ALARM, "whether all agrees with what was stated of it"),
    Quantity("unknowns", lambda run: len(run.adjustment.x), "beside the points"),
    Quantity("points", lambda run: int(np.isfinite(run.adjustment.ground[:, 0]).sum()), "that were adjusted"),
    Quantity("groups", lambda run: run.adjustment.groups, "group of observations, or law -> its test", record=GROUP),
    Quantity(
        "laws",
        lambda run: {one.group: one for one in run.laws},
        "law with a course in time -> whether it is that of the readings",
        record=LAW,
    ),
    Quantity("datum", lambda run: run.datum, "a common shift of the control points", record=DATUM),
    Quantity("network", lambda run: run.network, "how the scenes hang together", record=NETWORK),
    Quantity(
        "open", lambda run: list(run.open), "what the observations leave to what is known beforehand", record=OPEN
    ),
    Quantity("cameras", lambda run: run.cameras, "scene -> its camera", record=CHANGE),
    Quantity("rejected", lambda run: [list(one) for one in run.rejected], "point and scene, as gross errors"),
)
