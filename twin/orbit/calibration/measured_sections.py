"""What a report says of measured passes: their points, what was left out, what limits the result."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from analysis.units import ARCSEC
from scenes.specs.measured.orbit_data_setup import MeasuredCalibrationSetup
from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from twin.orbit.calibration.calibration_run import CalibrationRun
from twin.orbit.calibration.observations import any_effect
from twin.orbit.calibration.screening import ground_sample, meeting_of
from twin.run.artefact import Cell, Table
from twin.run.report import Section

_FEW = 30
"""Image points of which a chance is hardly worth a warning."""
_LISTED = 12
"""Names that a text lists at most."""
_LEAST_CHANCE = 1e-3
_WIDE = 2.0
"""Factor on the sigmas of a line beyond which there is a warning."""
_MANY = 0.1
"""Share of image points that may be left out without a warning."""


def measured_section(run: CalibrationRun) -> Section:
    """Points and residuals of every pass, errors of check points in pixels of the ground, what no sigma contains."""
    campaign = run.campaign
    rows: list[tuple[Cell, ...]] = []
    sizes: list[tuple[Cell, ...]] = []
    own = list(run.schemes.values())[-1]
    for one in campaign.passes:
        gone = campaign.rejected.get(one.name)
        meeting = meeting_of(campaign, one, run.fields[one.name].adjustment)
        lost = (
            (None, None, None) if gone is None else (len(gone.points), len(gone.check_points), _factors(gone.factors))
        )
        alone = run.fields[one.name].adjustment
        rows.append(
            (
                one.name,
                int(one.is_control.sum()),
                one.tie_count,
                len(one.check_ground),
                *lost,
                alone.chi_square / max(alone.degrees_of_freedom, 1),
                alone.p_value,
                meeting.chi_square / max(meeting.degrees_of_freedom, 1),
            )
        )
        for line in one.data.sensors:
            along, across = ground_sample(one, line)
            pixel = float(np.sqrt(along * across))
            errors = own[one.name]
            sizes.append(
                (one.name, line, along, across, errors.plan_rms / pixel, errors.height_rms / pixel, errors.count)
            )
    points = Table(
        "measured-points",
        "Points of every pass",
        "Left out: image points that robust weights gave up, check points whose rays do not meet. Factor: on the given "
        "sigmas of image points of the lines, by the residuals of those that remain. Chi-square over its degrees of "
        "freedom, of the pass calibrated by itself and of the rays of its check points with these parameters.",
        (
            "pass",
            "control",
            "ties",
            "check",
            "image points left out",
            "check left out",
            "factor",
            "χ²/dof",
            "chance",
            "check χ²/dof",
        ),
        rows,
        (None, None, None, None, None, None, None, 2, 3, 2),
    )
    pixels = Table(
        "measured-pixels",
        "Pixels on the ground, and errors of check points in them",
        "Ground sample distance of the middle of each line, metres; RMS errors of the check points by the pass's own "
        "parameters, in ground pixels (root of along times across).",
        ("pass", "line", "along the track [m]", "across [m]", "plan [px]", "height [px]", "check points"),
        sizes,
        (None, None, 3, 3, 2, 2, None),
    )
    return Section("Measurements", (*_screening(run), *_limits(run)), (points, pixels))


def _factors(found: Mapping[str, float]) -> str:
    """In words: one where all lines have it."""
    texts = {line: f"{v:.2f}" for line, v in found.items()}
    if len(set(texts.values())) == 1:
        return next(iter(texts.values()))
    return ", ".join(f"{line} {v}" for line, v in texts.items())


def _screening(run: CalibrationRun) -> tuple[str, ...]:
    """What was left out, by name."""
    if not run.campaign.rejected:
        return ("No image point was left out: the file says `screening: none`.",)
    found = []
    for name, gone in run.campaign.rejected.items():
        listed = ", ".join(f"{point} in {line}" for point, line in gone.points[:_LISTED])
        more = f" and {len(gone.points) - _LISTED} more" if len(gone.points) > _LISTED else ""
        checks = ", ".join(gone.check_points[:_LISTED])
        text = f"{name}: {gone.left} of {gone.entered} image points are used"
        text += f"; left out {listed}{more}" if listed else "; none is left out"
        text += f"; check points whose rays do not meet: {checks}." if checks else "."
        found.append(text)
    return tuple(found)


def _limits(run: CalibrationRun) -> tuple[str, ...]:
    """What makes the sigmas, and what they do not contain."""
    noise, campaign = run.campaign.noise, run.campaign
    one = campaign.passes[0]
    focal = float(np.mean([m.interior[0] for m in campaign.laboratory.values()]))
    ground = one.altitude / focal
    # white noise of the readings by their spline, in metres on the ground, beside that of the image
    parts = {
        "image points": noise.image * ground,
        "readings of the attitude": noise.attitude * one.altitude,
        "slow errors of the attitude": noise.slow_attitude * one.altitude,
        "readings of the orbit": noise.station,
        "control points": float(
            np.sqrt(np.mean(np.trace(one.control_covariance[one.is_control], axis1=1, axis2=2) / 3.0))
        ),
    }
    listed = ", ".join(f"{name} {value:.2g} m" for name, value in sorted(parts.items(), key=lambda v: -v[1]) if value)
    return (
        f"One standard deviation on the ground at nadir, of a single ray to a single point of {one.name}: {listed}. "
        "The first of these limits the result; more points make it smaller but for slow errors of the attitude.",
        "The sigmas contain these, as the tables and the file state them. They do not contain what all points of a "
        "pass share and no point shows: a wrong datum of the control points, a wrong time, an atmosphere unlike the "
        "standard one, and biases that drift during the pass where nothing tells them. Errors at check points are "
        "against their given coordinates and contain the errors of these; n points tell an RMS to 1/√(2n) of itself.",
    )


def measured_facts(setup: MeasuredCalibrationSetup, run: CalibrationRun) -> tuple[tuple[str, str], ...]:
    """What was given."""
    test, said = setup.test, setup.data.conventions
    errors, gps = test.errors.star_tracker, test.errors.gps
    angles = ", ".join(format_quantity(v, ANGLE) for v in errors.noise)
    lengths = ", ".join(format_quantity(v, LENGTH) for v in gps.noise)
    quaternion = "as the files of the platform say"
    if said.quaternion is not None and said.body_axes is not None:
        turns = said.quaternion.turns.replace("_", " ")
        quaternion = f"scalar {said.quaternion.scalar}, {turns}, body {', '.join(said.body_axes)}"
    paths = {one.measured.interpolation for one in run.campaign.passes}
    joined = {"spline": "cubic spline", "lagrange": "Lagrange's polynomial of ten readings"}
    light = "none" if not any_effect(run.campaign.effects) else "taken out" if test.effects.corrected else "left in"
    held = " and ".join(run.together.gauge.held)
    return (
        ("Camera", f"{setup.camera.name}, {setup.camera.description}"),
        ("Passes", f"{len(run.campaign.passes)}, measured, over {', '.join(p.name for p in run.campaign.passes)}"),
        ("Line cameras", ", ".join(run.campaign.lines)),
        (
            "Frame and time",
            f"{said.frame}; epochs in {said.time_scale.upper()}; a line's time is the {said.line_moment}",
        ),
        ("Quaternions", quaternion),
        (
            "Pixels",
            f"middle of pixel n at {'n' if said.centre == 'integer' else 'n + 0.5'}, the first is {said.first_pixel}",
        ),
        ("First pixel sees", f"the {said.first_pixel_sees} side of the track"),
        ("Noise of the attitude, 1σ", f"[{angles}], slow {max(errors.slow.noise) / ARCSEC:.3g} arcsec"),
        ("Noise of the orbit, 1σ", f"[{lengths}], joined by {' and '.join(joined[p] for p in sorted(paths))}"),
        ("Effects on the light", light),
        ("Held", held),
        ("Not estimated", "distortion, mounting, what the camera's file says of single CCDs"),
        ("Description", test.description),
    )


def measured_warnings(run: CalibrationRun) -> list[str]:
    """What speaks against the result."""
    found = []
    for name, gone in run.campaign.rejected.items():
        lost = gone.entered - gone.left
        if lost > _MANY * gone.entered:
            found.append(
                f"{name}: {lost} of {gone.entered} image points were left out, more than {100.0 * _MANY:.0f}%: are the "
                "conventions right, and the points matched well?"
            )
        wide = {line: factor for line, factor in gone.factors.items() if factor > _WIDE}
        if wide:
            listed = ", ".join(f"{line} {factor:.1f}" for line, factor in wide.items())
            found.append(
                f"{name}: image points scatter more than their sigmas say, by factors of {listed}; their sigmas have "
                "been made larger by these"
            )
    for one in run.campaign.passes:
        meeting = meeting_of(run.campaign, one, run.fields[one.name].adjustment)
        if meeting.degrees_of_freedom >= _FEW and meeting.p_value < _LEAST_CHANCE:
            found.append(
                f"{one.name}: rays of the check points do not meet within their sigmas (chance {meeting.p_value:.1g}): "
                "sigmas of image points or of the attitude are too small, or it has slow errors"
            )
    return found
