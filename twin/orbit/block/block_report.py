"""Report of an adjusted block: metres first, then what each sensor is worth, then whether what was stated holds.

The quantities of an adjusted block, as block.json has them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from analysis.block.block_adjustment import LawTest
from analysis.block.network import DatumTest, Network, Open
from analysis.block.reweighting import GroupTest
from analysis.orbit.forward_intersection import Accuracy
from twin.framework.artefact import Table
from twin.framework.record import Quantity, Record
from twin.framework.report import Report, Section, answer
from twin.orbit.block.block_run import ALL, DATUM_ALARM, BlockRun, CameraChange, Worth
from twin.orbit.measured.pass_measurements import duplicates, listed

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
    Quantity("predicted", lambda one: one.predicted, "by the covariances of the points", "predicted", record=ACCURACY),
    Quantity("found", lambda one: one.found, "by true or given places of check points", "found", record=ACCURACY),
    Quantity("plan_ratio", lambda one: one.plan, "predicted CE90 over that with all sensors", "plan ×", 2),
    Quantity("height_ratio", lambda one: one.height, "predicted LE90 over that with all sensors", "height ×", 2),
    Quantity(
        "agreement",
        lambda one: one.agreement,
        "mean square of errors over sigmas; 1 where the sigmas are right",
        "agreement",
        2,
    ),
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


_TOLD = 0.1
"""Sigmas beforehand: what is told less well is listed as left to the priors."""


def block_report(run: BlockRun) -> Report:
    """Report of a run."""
    return Report(
        "Block adjustment", *_verdict(run), _facts(run), _summary(run), _sections(run), warnings=_warnings(run)
    )


def _verdict(run: BlockRun) -> tuple[str, tuple[str, ...]]:
    full = run.worth[ALL]
    said, found = full.predicted, full.found
    losses = {name: (one.plan, one.height) for name, one in run.worth.items() if len(one.left_out) == 1}
    most = ""
    if losses:
        plan, height = (max(losses, key=lambda name: losses[name][k]) for k in (0, 1))
        most = (
            f"Plan loses most {plan}, by a factor of {losses[plan][0]:.2f}, and height {height}, by"
            f" {losses[height][1]:.2f}"
        )
    checked = ""
    if found is not None:
        checked = f"; {found.count} check points have {found.ce90:.2f} m and {found.le90:.2f} m"
    control = "with" if "control" in run.used else "without"
    return answer(
        f"Nine ground points in ten lie within {said.ce90:.2f} m in plan and {said.le90:.2f} m in height, {control}"
        f" ground control{checked}",
        most,
        f"residuals have {run.adjustment.chi_square:.0f} for chi-square where {run.adjustment.degrees_of_freedom} is"
        f" expected, chance {run.adjustment.p_value:.2g}",
    )


def _facts(run: BlockRun) -> tuple[tuple[str, str], ...]:
    block, spec = run.adjustment.assembly.block, run.setup.test
    role = block.points.role
    counts = ", ".join(f"{int(np.sum(role == name))} {name}" for name in ("control", "tie", "check"))
    return (
        ("Camera", f"{run.setup.camera.name}: {', '.join(block.cameras)}"),
        ("Scenes", f"{len(block.scenes)} of {len(block.passes)} passes"),
        ("Points", counts),
        ("Sensors", ", ".join(one.replace("_", " ") for one in run.used)),
        ("Unknowns", f"{len(run.adjustment.x)} beside the points, {run.adjustment.iterations} steps"),
        ("Description", spec.description),
    )


def _summary(run: BlockRun) -> Table:
    return WORTH.flat().table(
        "sensors",
        "What each sensor is worth",
        "Errors that hold nine check points in ten, by the covariances and by the true places, and the former over"
        " those with all sensors. Agreement: mean square of the errors over their sigmas. Points of a block err alike,"
        " so that the found errors of one block scatter.",
        {name: WORTH(one) for name, one in run.worth.items()},
        label="sensors",
    )


def _sections(run: BlockRun) -> tuple[Section, ...]:
    """Return groups and laws, cameras, what stays open, and check points; docs/block.md explains them."""
    groups = GROUP.table(
        "groups",
        "Observations and laws",
        "Variance of the residuals over that of the sigmas, with the share of the observations that others check. Laws"
        " of readings' errors are groups of their own.",
        {name: GROUP(one) for name, one in run.adjustment.groups.items()},
        label="group",
    )
    hidden = ("_sigma_before",) if run.drawn is not None else ("_sigma_before", "_true")
    keys = [one.key for one in CHANGE if not one.key.endswith(hidden)]
    changes = {name: CHANGE(one) for name, one in run.cameras.items()}
    cameras = CHANGE.table(
        "cameras", "Cameras", "Changes since the calibration, in each scene.", changes, keys, "scene"
    )
    left = Table(
        "open",
        "Left to what is known beforehand",
        "Combinations for one sigma of what is known beforehand; told: by how much of a sigma of the observations alone"
        " they are known, in percent.",
        ("change of", "told [%]"),
        [(str(one).rsplit(" (", 1)[0], 100.0 * one.told) for one in run.open if one.told < _TOLD],
        (None, 3),
    )
    ids = run.adjustment.assembly.block.points.ids
    points = Table(
        "check_points",
        "Check points",
        "Errors and sigmas.",
        ("point", "east [m]", "north [m]", "up [m]", "σ east [m]", "σ north [m]", "σ up [m]"),
        [(str(ids[k]), *e.tolist(), *s.tolist()) for k, e, s in zip(*run.check, strict=True)],
        (None, 3, 3, 3, 3, 3, 3),
    )
    return (
        Section("Whether what was stated holds", (), (groups,)),
        Section("Cameras", (), (cameras,)),
        Section("What the observations do not tell", (), (left,)),
        Section("Check points", (), (points,), folded=1),
    )


def _warnings(run: BlockRun) -> tuple[str, ...]:
    found, points = list(_network(run)), run.adjustment.assembly.block.points
    if twice := duplicates(points.ids, points.start):
        found.append(twice)
    if run.rejected:
        names = [f"{point} in {scene}" for point, scene in run.rejected]
        found.append(f"left out as gross errors: {listed(names)}")
    if run.datum is not None and run.datum_chance < DATUM_ALARM:
        d = run.datum
        found.append(
            f"the control points lie {d.east:+.2f} m east, {d.north:+.2f} m north and {d.up:+.2f} m up of where all"
            f" else puts them (chance {run.datum_chance:.1g}): are they given in another datum?"
        )
    found += [str(one) for one in run.laws if one.p_value < ALARM]
    for name, group in run.adjustment.groups.items():
        if group.p_value < ALARM:
            size = float(np.sqrt(group.ratio))
            found.append(
                f"{name}: residuals are {size:.2g} times as large as stated (chance {group.p_value:.1g});"
                f" `components: [{name}]` estimates their variance, and another law may be the right one"
            )
    if run.adjustment.p_value < ALARM:
        found.append("the block as a whole contradicts what was stated of it; its sigmas are too small")
    return tuple(found)


def _network(run: BlockRun) -> list[str]:
    found, network = [], run.network
    if network.empty:
        found.append(f"scenes without image points: {listed(network.empty)}")
    if network.alone:
        found.append(f"scenes that share no point with another: {listed(network.alone)}")
    if len(network.parts) > 1:
        parts = "; ".join(
            f"{listed(part)}{'' if held else ' (no control)'}"
            for part, held in zip(network.parts, network.controlled, strict=True)
        )
        found.append(f"the block falls into {len(network.parts)} parts that no point connects: {parts}")
    return found
