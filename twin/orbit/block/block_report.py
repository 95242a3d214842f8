"""Report of a block adjustment.

The report begins with the errors on the ground in metres, then gives the contribution of each sensor and the tests of
the error laws that the file specifies.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from analysis.block.block import CORRECTIONS
from analysis.block.block_adjustment import BlockAdjustment
from analysis.orbit.forward_intersection import level_axes
from scenes.specs.orbit.setup import RationalAdjustSetup
from twin.framework import svg
from twin.framework.artefact import SvgFigure, Table
from twin.framework.report import Report, Section, answer
from twin.orbit.block.block_numbers import ALARM, CHANGE, CONTRIBUTION, GROUP, IMAGE
from twin.orbit.block.block_run import ALL, DATUM_ALARM, BlockRun
from twin.orbit.measured.pass_measurements import duplicates, listed

_WEAK = 0.1
"""Observability (prior sigma divided by the sigma from the observations alone) below which a combination of unknowns is
listed as determined by the priors.
"""
_FAR_BELOW = 0.5
"""Ratio of observed to predicted errors below which the report says why the observed ones are so small."""


def block_report(run: BlockRun) -> Report:
    """Return the report of a block adjustment: accuracy on the ground, contribution of each sensor, and tests."""
    return Report(
        "Block adjustment", *_verdict(run), _facts(run), _summary(run), _sections(run), warnings=_warnings(run)
    )


def _verdict(run: BlockRun) -> tuple[str, tuple[str, ...]]:
    full = run.contributions[ALL]
    predicted, observed = full.predicted, full.observed
    losses = {name: (case.plan, case.height) for name, case in run.contributions.items() if len(case.excluded) == 1}
    contribution = ""
    if losses:
        plan, height = (max(losses, key=lambda name: losses[name][k]) for k in (0, 1))
        contribution = (
            f"Errors grow most {plan} in plan ({losses[plan][0]:.2f}-fold) and {height} in height"
            f" ({losses[height][1]:.2f}-fold)"
        )
    where = f"{predicted.count} {'tie' if observed is None else 'check'} points"
    checked = ""
    if observed is not None:
        checked = f"; observed are {observed.ce90:.2f} m and {observed.le90:.2f} m"
        largest = max(observed.ce90 / predicted.ce90, observed.le90 / predicted.le90)
        if largest < _FAR_BELOW:
            checked += f", at most {largest:.1g} of the prediction, which covers errors common to all points"
    relative = run.relative_height_sigma
    control = "with" if "control" in run.used else "without"
    return answer(
        f"{control} ground control, predicted 90% errors at {where} are {predicted.ce90:.2f} m in plan and"
        f" {predicted.le90:.2f} m in height{checked}",
        contribution,
        f"relative to the mean height of all points, σ of a height is {np.median(relative):.2g} m in the median: errors"
        " that all points share do not count"
        if len(relative) > 1
        else "",
        _residuals_text(run.adjustment),
    )


def _residuals_text(adjustment: BlockAdjustment) -> str:
    """Return whether the residuals are as large as stated, by a two-sided test of chi-square."""
    square, degrees = adjustment.chi_square, adjustment.degrees_of_freedom
    chance = 2.0 * min(adjustment.p_value, 1.0 - adjustment.p_value) if degrees else 1.0
    agree = "agree with the stated errors"
    if chance < ALARM:
        agree = f"are {np.sqrt(square / degrees):.2g} times as large as stated"
    test = f"chi-square {square:.0f} for {degrees} degrees of freedom, p {_chance(chance)} two-sided"
    return f"the residuals {agree} ({test})"


def _chance(p: float) -> str:
    return "< 1e-6" if p < 1e-6 else f"= {p:.2g}"


def _facts(run: BlockRun) -> tuple[tuple[str, str], ...]:
    block, spec = run.adjustment.assembly.block, run.setup.test
    role = block.points.role
    counts = ", ".join(f"{int(np.sum(role == name))} {name}" for name in ("control", "tie", "check"))
    scenes: tuple[tuple[str, str], ...] = (("Images", f"{len(block.scenes)} with rational polynomials"),)
    if not isinstance(run.setup, RationalAdjustSetup):
        scenes = (
            ("Camera", f"{run.setup.camera.name}: {', '.join(block.cameras)}"),
            ("Scenes", f"{len(block.scenes)} of {len(block.passes)} passes"),
        )
    return (
        *scenes,
        ("Points", counts),
        ("Sensors", ", ".join(sensor.replace("_", " ") for sensor in run.used)),
        ("Unknowns", f"{len(run.adjustment.x)} beside the points, {run.adjustment.iterations} iterations"),
        ("Description", spec.description),
    )


def _summary(run: BlockRun) -> Table:
    """Return the table of errors by sensor, without columns that have no numbers or none but 1."""
    observed, several = run.contributions[ALL].observed is not None, len(run.contributions) > 1
    omitted = (*(() if observed else ("observed", "normalised")), *(() if several else ("plan", "height")))
    record = CONTRIBUTION.flat()
    caption = "90% errors of the tie points, predicted by the covariances"
    if observed:
        caption = "90% errors of the check points, predicted by the covariances and observed"
    caption += "; ratios of the predicted errors to those with all sensors." if several else "."
    if observed:
        caption += (
            " χ²/dof: mean square of the errors over their sigmas. Errors of a block's points are correlated, so that"
            " the observed errors of one block scatter."
        )
    return record.table(
        "sensors",
        "Contribution of each sensor",
        caption,
        {name: CONTRIBUTION(contribution) for name, contribution in run.contributions.items()},
        [quantity.key for quantity in record if not quantity.key.startswith(omitted)],
        label="sensors",
    )


def _sections(run: BlockRun) -> tuple[Section, ...]:
    """Return the sections of the report: errors by sensor, network, cameras and tests of the error laws."""
    groups = GROUP.table(
        "groups",
        "Observations and laws",
        "Variance of the residuals over that expected from the sigmas, and redundancy, for each group. Readings with"
        " the same error model are a group.",
        {name: GROUP(group) for name, group in run.adjustment.groups.items()},
        label="group",
        digits=3,
    )
    omitted = ("_sigma_before",) if run.drawn is not None else ("_sigma_before", "_true")
    keys = [quantity.key for quantity in CHANGE if not quantity.key.endswith(omitted)]
    changes = {name: CHANGE(change) for name, change in run.cameras.items()}
    cameras = CHANGE.table(
        "cameras", "Cameras", "Changes of the cameras since the calibration, by scene.", changes, keys, "scene"
    )
    weak = Table(
        "open",
        "Combinations determined by the priors",
        "Change of the unknowns for one prior sigma. Ratio: prior sigma over the sigma of the observations alone, in"
        " percent.",
        ("change of", "ratio [%]"),
        [(str(c).rsplit(" (", 1)[0], 100.0 * c.sigma_ratio) for c in run.open if c.sigma_ratio < _WEAK],
        (None, 3),
    )
    ids = run.adjustment.assembly.block.points.ids
    points = Table(
        "check_points",
        "Check points",
        "Errors and standard deviations of the check points.",
        ("point", "east [m]", "north [m]", "up [m]", "σ east [m]", "σ north [m]", "σ up [m]"),
        [(str(ids[k]), *e.tolist(), *s.tolist()) for k, e, s in zip(*run.check, strict=True)],
        (None, 3, 3, 3, 3, 3, 3),
    )
    return (
        *_ground_section(run),
        Section("Tests of the stated errors", (), (groups,)),
        Section("Images", (), (_images(run),)) if run.images else Section("Cameras", (), (cameras,)),
        *((Section("Weakly observable combinations", (), (weak,)),) if weak.rows else ()),
        *((Section("Check points", (), (points,), folded=1),) if points.rows else ()),
    )


def _images(run: BlockRun) -> Table:
    """Return the table of the corrections of images with rational polynomials."""
    shown = {name: IMAGE(image) for name, image in run.images.items()}
    terms = {term for image in run.images.values() for term in image.terms}
    absent = tuple(term for term in CORRECTIONS if term not in terms)
    keys = [
        q.key
        for q in IMAGE
        if not q.key.endswith(("_before", "random_m", "fit_error_px")) and not q.key.startswith(absent)
    ]
    caption = (
        "Corrections of line and sample, in pixels, with rms residuals before and after. ERR_BIAS: error of the"
        " corrected polynomials on the ground, rms of an axis, in metres; errors of several images are correlated."
    )
    return IMAGE.table("images", "Images", caption, shown, keys, "image")


def _ground_section(run: BlockRun) -> tuple[Section, ...]:
    """Return the section with the map of the errors at check points and the residuals at control points, if any."""
    where, errors, _ = run.check
    block = run.adjustment.assembly.block
    control = np.flatnonzero((block.points.role == "control") & np.isfinite(run.adjustment.ground).all(axis=1))
    residuals = np.einsum(
        "nij,nj->ni",
        level_axes(run.adjustment.ground[control]),
        run.adjustment.ground[control] - block.points.start[control],
    )
    reference = "given" if run.drawn is None else "true"
    cases = (
        (f"check points, adjusted minus {reference}", where, errors),
        ("control points, adjusted minus given", control, residuals),
    )
    shown = [case for case in cases if len(case[1])]
    if not shown:
        return ()
    caption = "Arrows: error in plan. Colours: error in height. Dots: all adjusted points."
    drawing = svg.drawn("block-ground", _ground_figure, run.adjustment.ground, shown)
    return (Section("Residuals on the ground", (), (SvgFigure("ground", "", caption, drawing),), name="ground"),)


def _ground_figure(ground: np.ndarray, cases: Sequence[tuple[str, np.ndarray, np.ndarray]]) -> Figure:
    """Draw errors at points on maps, one for each case.

    Parameters
    ----------
    ground : (m, 3) ndarray
        Adjusted coordinates of all points, ITRS, metres; NaN without an adjusted position.
    cases : sequence of (str, (k,) ndarray, (k, 3) ndarray)
        Title, indices of the points, and errors east, north and up, in metres.
    """
    known = ground[np.isfinite(ground).all(axis=1)]
    middle = known.mean(axis=0)
    axes_of_map = level_axes(middle[None])[0, :2]
    east, north = 1e-3 * axes_of_map @ (ground - middle).T
    figure = svg.new_figure(5.4)
    for axes, (title, where, errors) in zip(figure.subplots(1, len(cases), squeeze=False)[0], cases, strict=True):
        size = float(f"{max(float(np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1)))), 1e-6):.1g}")
        extent = float(np.abs(errors[:, 2]).max()) or 1.0
        axes.plot(east, north, ".", color=svg.GREY, ms=2.0, alpha=0.6)
        arrows = axes.quiver(
            east[where], north[where], *errors.T, cmap="viridis", clim=(-extent, extent), width=0.005, scale=12.0 * size
        )
        # below the title and left of its arrow, the label stays within a narrow map
        axes.quiverkey(arrows, 0.88, 1.03, size, f"{size:g} m in plan", labelpos="W", coordinates="axes", color=svg.INK)
        axes.set_title(f"{len(where)} {title}", loc="left", pad=20)
        axes.set(xlabel="east [km]", ylabel="north [km]")
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.1)
        svg.gridded(axes)
        bar = figure.colorbar(arrows, ax=axes, shrink=0.75, label="error in height [m]", location="bottom")
        bar.locator = MaxNLocator(4)
    return figure


def _warnings(run: BlockRun) -> tuple[str, ...]:
    warnings, points = list(_network(run)), run.adjustment.assembly.block.points
    if repeated := duplicates(points.ids, points.start):
        warnings.append(repeated)
    if run.rejected:
        names = [f"{point} in {scene}" for point, scene in run.rejected]
        warnings.append(f"rejected as gross errors: {listed(names)}")
    if run.datum is not None and run.datum_p_value < DATUM_ALARM:
        d = run.datum
        warnings.append(
            f"the control points are shifted by {d.east:+.2f} m east, {d.north:+.2f} m north and {d.up:+.2f} m up "
            f"against the rest of the block (p = {run.datum_p_value:.1g}): are they given in another datum?"
        )
    warnings += [str(law) for law in run.laws if law.p_value < ALARM]
    for name, group in run.adjustment.groups.items():
        if group.p_value < ALARM:
            size = float(np.sqrt(group.ratio))
            common = ""
            if name == "image" and run.images and "control" not in run.used:
                common = (
                    "; it changes σ of heights relative to other points, not CE90 and LE90, which the priors determine"
                )
            warnings.append(
                f"{name}: residuals are {size:.2g} times as large as stated (p {_chance(group.p_value)});"
                f" `components: [{name}]` estimates their variance, and another law may describe them better{common}"
            )
    if run.adjustment.p_value < ALARM:
        warnings.append("the residuals of the whole block are larger than the stated errors; its sigmas are too small")
    return tuple(warnings)


def _network(run: BlockRun) -> list[str]:
    warnings, network = [], run.network
    if network.empty:
        warnings.append(f"scenes without image points: {listed(network.empty)}")
    if network.alone:
        warnings.append(f"scenes that share no point with another: {listed(network.alone)}")
    if len(network.parts) > 1:
        parts = "; ".join(
            f"{listed(part)}{'' if held else ' (no control)'}"
            for part, held in zip(network.parts, network.controlled, strict=True)
        )
        warnings.append(f"the block consists of {len(network.parts)} parts that share no point: {parts}")
    return warnings
