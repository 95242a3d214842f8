"""Report of an adjusted block: metres first, then what each sensor is worth, then whether what was stated holds."""

from __future__ import annotations

import numpy as np

from twin.framework.artefact import Cell, Table
from twin.framework.report import Report, Section, answer
from twin.orbit.block.block_numbers import ALARM, CHANGE, GROUP
from twin.orbit.block.block_run import ALL, DATUM_ALARM, BlockRun
from twin.orbit.measured.pass_measurements import duplicates, listed

_TOLD = 0.1
"""Sigmas beforehand: what is told less well is listed as left to the priors."""


def block_report(run: BlockRun) -> Report:
    """Report of a run."""
    return Report(
        "Block adjustment",
        *_verdict(run),
        _facts(run),
        _summary(run),
        (_groups(run), _cameras(run), _open(run), _points(run)),
        warnings=_warnings(run),
    )


def _verdict(run: BlockRun) -> tuple[str, tuple[str, ...]]:
    full = run.worth[ALL]
    said, found = full.predicted, full.found
    losses = {
        name: (one.predicted.ce90 / said.ce90, one.predicted.le90 / said.le90)
        for name, one in run.worth.items()
        if len(one.left_out) == 1
    }
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
    full = run.worth[ALL].predicted
    rows: list[tuple[Cell, ...]] = []
    for name, one in run.worth.items():
        ratio = (one.predicted.ce90 / full.ce90, one.predicted.le90 / full.le90)
        errors = (None, None) if one.found is None else (one.found.ce90, one.found.le90)
        rows.append((name, one.predicted.ce90, one.predicted.le90, *errors, *ratio, one.agreement))
    return Table(
        "sensors",
        "What each sensor is worth",
        "Errors that hold nine check points in ten, by the covariances and by the true places, and the former over"
        " those with all sensors. Agreement: mean square of the errors over their sigmas. Points of a block err alike,"
        " so that the found errors of one block scatter.",
        ("sensors", "CE90 [m]", "LE90 [m]", "CE90 found [m]", "LE90 found [m]", "plan ×", "height ×", "agreement"),
        rows,
        (None, 3, 3, 3, 3, 2, 2, 2),
    )


def _groups(run: BlockRun) -> Section:
    rows = {name: GROUP(one) for name, one in run.adjustment.groups.items()}
    table = GROUP.table(
        "groups",
        "Observations and laws",
        "Variance of the residuals over that of the sigmas, with the share of the observations that others check. Laws"
        " of readings' errors are groups of their own.",
        rows,
        label="group",
    )
    text = (
        "The chance of a group is that of a chi-square with its redundancy for its freedom. A law with a course in time"
        " is also tested for its neighbours, which should be independent: the warnings name one that is not.",
    )
    return Section("Whether what was stated holds", text, (table,))


def _cameras(run: BlockRun) -> Section:
    rows = {name: CHANGE(one) for name, one in run.cameras.items()}
    keys = [
        f"{name}{end}"
        for name in ("d_alpha_arcsec", "d_beta_arcsec", "d_gamma_arcsec", "d_f_um")
        for end in (("", "_sigma", "_true") if run.drawn is not None else ("", "_sigma"))
    ]
    table = CHANGE.table("cameras", "Cameras", "Changes since the calibration, in each scene.", rows, keys, "scene")
    return Section("Cameras", (), (table,))


def _open(run: BlockRun) -> Section:
    rows: list[tuple[Cell, ...]] = [
        (str(one).rsplit(" (", 1)[0], 100.0 * one.told) for one in run.open if one.told < _TOLD
    ]
    table = Table(
        "open",
        "Left to what is known beforehand",
        "Combinations for one sigma of what is known beforehand; told: by how much of a sigma of the observations alone"
        " they are known, in percent.",
        ("change of", "told [%]"),
        rows,
        (None, 3),
    )
    text = (
        "No image point, control point or footprint tells these changes; they are as good as the sigmas that the file"
        " states, and so is their part of the errors of the ground.",
    )
    return Section("What the observations do not tell", text, (table,))


def _points(run: BlockRun) -> Section:
    where, error, sigma = run.check
    ids = run.adjustment.assembly.block.points.ids
    rows: list[tuple[Cell, ...]] = [
        (str(ids[k]), *e.tolist(), *s.tolist()) for k, e, s in zip(where, error, sigma, strict=True)
    ]
    table = Table(
        "check_points",
        "Check points",
        "Errors and sigmas.",
        ("point", "east [m]", "north [m]", "up [m]", "σ east [m]", "σ north [m]", "σ up [m]"),
        rows,
        (None, 3, 3, 3, 3, 3, 3),
    )
    return Section("Check points", (), (table,), folded=1)


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
