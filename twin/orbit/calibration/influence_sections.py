"""What a report says of errors that the fit does not show: effects on the light left in, a wrong datum."""

from __future__ import annotations

from analysis.orbit.three_line_model import BIAS
from analysis.units import ARCSEC
from scenes.orbit_angle import LINES
from scenes.units import ANGLE, LENGTH, format_quantity
from twin.artefact import Cell, Table
from twin.orbit.calibration.influences import INNER, OFFSET, SURPRISE, LightRow
from twin.orbit.calibration.procedure import CalibrationRun
from twin.trial.section import Section


def light_section(run: CalibrationRun) -> Section:
    """What each effect does that is not taken out of the image points."""
    if len(run.light) < 2:
        return Section("Effects on the light", ("None is on.",))
    pitch = run.campaign.passes[0].data.pitch
    sizes: list[tuple[Cell, ...]] = []
    rows: list[tuple[Cell, ...]] = []
    for row in run.light:
        name = _left(row)
        if row.left:
            moved = [float(v / pitch[line]) for line in LINES for v in row.moved[line]]
            sizes.append((name, *moved))
        inner, turned = row.most(INNER), row.most(tuple(n for n in row.shift if n.split()[-1] in BIAS))
        said = [f"{who} {by:+.1f} σ" if row.left else "" for who, by in (inner, turned)]
        rows.append((f"{name} left in" if row.left else name, *row.before, *row.after, *said, row.p_value))
    pixels = Table(
        "light-pixels",
        "How far image points move",
        "RMS over the check points, pixels, x along the track and y along the line.",
        ("effect", *(f"{line} {axis}" for line in LINES for axis in "xy")),
        sizes,
        (None, *(3,) * 6),
    )
    effects = Table(
        "light",
        "What is not taken out of the image points",
        "RMS at check points, mean of the fields, metres: by the laboratory's camera, and by each field's own "
        "parameters; the unknowns of the simultaneous adjustment that move by the most of their sigmas; chance of the "
        "fit, with the noise of the readings counted as independent.",
        (
            "case",
            "plan before",
            "height before",
            "plan after",
            "height after",
            "interior",
            "bias",
            "chance of the fit",
        ),
        rows,
        (None, 2, 2, 2, 2, None, None, 3),
    )
    left = run.light[-1]
    most, ratio = left.most(INNER)
    text = (
        "Light time, aberration and refraction are in the image points. The analysis takes them out by its own models "
        "of them, with the laboratory's camera and the measured orbit and attitude: for each image point, the "
        "direction in which it looks and the straight line to the place that it sees are projected into the image, "
        "and the point is moved by the difference. That the camera is 100 m wrong on the ground matters to some "
        "thousandths of a pixel, most of it because the heights of check points, which refraction depends on, are "
        "first known to 100 m.",
        "Left in, they do hardly any harm where a camera is used as it was calibrated: biases and principal points "
        f"take them up, the mean error in plan goes from {run.light[0].after[0]:.3f} m to {left.after[0]:.3f} m. But "
        f"parameters are then wrong ({most} by {1e6 * left.shift[most]:+.1f} µm, {abs(ratio):.1f} sigmas), which the "
        "fit need not show, and they are no longer those of the camera: seen from another height, or by a satellite "
        "that tilts, the light does something else.",
        "The corrections use the same models of the atmosphere and of the light as the simulation: they show that the "
        "method is right, not how well an atmosphere is known.",
    )
    return Section("Effects on the light", text, (pixels, effects))


def datum_section(run: CalibrationRun) -> Section:
    """What a common shift of the control points does, and what is suspicious."""
    rows: list[tuple[Cell, ...]] = []
    for row in run.datum:
        name, change = row.most
        where = ", ".join(f"{v:g} {axis}" for v, axis in zip(row.shift, ("east", "north", "up"), strict=True) if v)
        bias = [float(v / ARCSEC) for v in row.bias]
        rows.append(
            (where, *bias, f"{name} {1e6 * change:+.1f} µm", *map(float, row.offset), row.fit, row.p_value, *row.after)
        )
    table = Table(
        "datum",
        "All control points in a wrong datum",
        "Shift in metres; mean changes of the fields' biases, arcseconds; the element of the interior that changes "
        "most; mean changes of the orbit's offsets, metres; change of the chi-square and chance of the fit; RMS at "
        "check points in the right datum, each field with its own parameters, metres.",
        (
            "shift, m",
            *BIAS,
            "interior",
            *OFFSET,
            "Δ chi-square",
            "chance of the fit",
            "plan after, m",
            "height after, m",
        ),
        rows,
        (None, 2, 2, 2, None, 3, 3, 3, 1, 3, 2, 2),
    )
    launch, spec = run.campaign.spec.launch, run.campaign.spec
    roll, inner = (format_quantity(v, k) for v, k in ((launch.bias[0], ANGLE), (launch.interior, LENGTH)))
    metres = SURPRISE * launch.bias[0] * spec.altitude
    text = [
        "A shift that all control points share in plan is a turn of the camera by shift over altitude, and one in "
        "height a change of all principal distances and of the outer lines' x. Biases and interior take it up, the "
        "orbit's offsets, which their prior holds, hardly do, and the fit need not show it. Check points of the same "
        "wrong datum would not show it either.",
        f"What remains is to ask whether the parameters are believable. The file expects {roll} (roll) and {inner} "
        f"(interior) of a launch; beyond {SURPRISE:g} times this there is a warning, which is {metres:.0f} m of "
        "shift across the track.",
    ]
    if run.surprises:
        listed = ", ".join(f"{s.name} ({s.ratio:.1f}σ)" for s in run.surprises[:6])
        text.append(f"Beyond what is expected here: {listed}.")
    else:
        text.append("Nothing is beyond what is expected here.")
    return Section("Datum of the control points", tuple(text), (table,))


def _left(row: LightRow) -> str:
    if not row.left:
        return "nothing left in"
    return "all" if len(row.left) > 2 else " and ".join(name.replace("_", " ") for name in row.left)
