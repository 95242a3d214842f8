"""What a report says of the single fields: how their parameters repeat, and how their biases go with latitude."""

from __future__ import annotations

import numpy as np

from analysis.orbit.three_line_model import BIAS
from analysis.units import ARCSEC
from twin.artefact import Cell, SvgFigure, Table
from twin.orbit.calibration.figure import drawn
from twin.orbit.calibration.procedure import CalibrationRun
from twin.orbit.calibration.repeatability import repeatability
from twin.trial.section import Section


def fields_section(run: CalibrationRun) -> Section:
    """Every field by itself, and the scatter over the fields."""
    rows: list[tuple[Cell, ...]] = []
    for one in run.campaign.passes:
        alone = run.fields[one.name].adjustment
        bias = alone.bias(one.name) / ARCSEC
        errors = bias - one.bias / ARCSEC
        rows.append((one.name, float(np.degrees(one.latitude)), *map(float, bias), *map(float, errors), alone.p_value))
    table = Table(
        "fields",
        "Each field by itself",
        "Roll, pitch and yaw of the bias, arcseconds, and minus the truth at the field's middle. An offset of the "
        "orbit, which the twelve unknowns do not have, goes into roll and pitch: 0.3 m are 0.1 arcsec.",
        ("field", "latitude, deg", *BIAS, "Δ roll", "Δ pitch", "Δ yaw", "chance of the fit"),
        rows,
        (None, 1, 3, 3, 3, 3, 3, 3, 3),
    )
    found = repeatability(run)
    if not found:
        return Section("Fields", ("One field alone does not repeat.",), (table,))
    scatter: list[tuple[Cell, ...]] = []
    for r in found:
        angle = r.name in BIAS
        scale, shown = (ARCSEC, "arcsec") if angle else (1e-3, "mm")
        held = r.sigma == 0.0
        scatter.append(
            (
                r.name,
                shown,
                None if held else r.scatter / scale,
                None if held else r.sigma / scale,
                r.p_value,
                f"{'class of ' * angle}{r.paper / scale:g} {shown}",
                "held (gauge)" if held else "yes" if r.holds else "no",
            )
        )
    inner = [r for r in found if r.name not in BIAS and r.sigma > 0.0]
    worst = max(inner, key=lambda r: r.scatter)
    largest = max((r for r in found if r.name in BIAS), key=lambda r: r.scatter)
    text = [
        f"From field to field the interior orientation repeats to {1e3 * worst.scatter:.4f} mm or better (standard "
        f"deviation, {worst.name}); the paper says 0.01 mm. The biases scatter by up to "
        f"{largest.scatter / ARCSEC:.2f}″ ({largest.name}); the paper says the 1″ class.",
    ]
    failed = [r.name for r in inner if not r.holds]
    if failed:
        text.append(
            f"{', '.join(failed)} scatter more than the paper's 0.01 mm. Against the sigmas of single fields, in the "
            "table, this is what their points allow, not a camera that changes, unless the chance is small. y of the "
            "outer lines goes with yaw, and both are known far less well than their sum."
        )
    verdicts = Table(
        "repeatability",
        "Repeatability over the fields",
        "Standard deviation over the fields, sigma that a field's adjustment claims, chance of such a scatter by this "
        "sigma alone. Small for a bias means that it really differs from field to field. Within: below the paper's "
        "figure for the interior, below 3″ for the class of 1″.",
        ("parameter", "unit", "scatter", "claimed σ", "chance", "paper 003", "within"),
        scatter,
        (None, None, 4, 4, 3, None, None),
    )
    return Section("Fields", tuple(text), (verdicts, table))


def biases_section(run: CalibrationRun) -> Section:
    """Biases against latitude, and what this means for the schemes."""
    figure = SvgFigure(
        "bias-latitude",
        "Bias of the attitude against latitude",
        "From the adjustment of all fields, which knows of the orbit's offsets. The error bars of yaw are common to "
        "all fields (y of the outer lines); its differences are known far better.",
        drawn("bias-latitude", run),
    )
    if not run.latitude:
        few = "There are too few fields, or all at one latitude, to tell a drift with latitude from the season."
        return Section("Biases against latitude", (few,), (figure,))
    spec = run.campaign.spec
    # measured to true is the inverse of the drift of the measured attitude
    true = -np.array(spec.errors.star_tracker.thermal.amplitude) * spec.errors.switched_on / ARCSEC
    season = np.array(spec.errors.season) / ARCSEC
    rows: list[tuple[Cell, ...]] = []
    for k, fit in enumerate(run.latitude):
        numbers = (fit.amplitude, fit.amplitude_sigma, fit.constant, fit.constant_sigma, fit.remainder)
        amplitude, amplitude_sigma, constant, constant_sigma, left = (float(v / ARCSEC) for v in numbers)
        rows.append(
            (
                fit.axis,
                amplitude,
                amplitude_sigma,
                float(true[k]),
                constant,
                constant_sigma,
                fit.chi_square,
                fit.degrees_of_freedom,
                fit.p_value,
                left,
                float(season[k]),
            )
        )
    table = Table(
        "bias-fits",
        "Amplitude × sin(latitude − reference) + constant",
        f"Arcseconds; the reference is the middle of the fields, {np.degrees(run.latitude[0].reference):.1f}°. "
        "Chi-square with the biases' own covariance; what remains beside it is the season, and the sigmas of amplitude "
        "and constant contain it.",
        (
            "axis",
            "amplitude",
            "σ",
            "true amplitude",
            "constant",
            "σ",
            "chi-square",
            "degrees",
            "chance",
            "remains, 1σ",
            "true season",
        ),
        rows,
        (None, 2, 2, 2, 2, 2, 1, None, 3, 2, 2),
    )
    values = np.array([[run.together.value(f"{p.name} {axis}") for p in run.campaign.passes] for axis in BIAS[:2]])
    spread = float(np.hypot(*values.std(axis=1, ddof=1)))
    metres, most = spread * spec.altitude, max(len(s) for s in spec.schemes)
    weak = [f.axis for f in run.latitude if abs(f.amplitude) < 2.0 * f.amplitude_sigma]
    seen = f"in this campaign the drift does not show in {', '.join(weak)}" if weak else "the drift shows in all axes"
    reach = np.ptp(np.sin(run.latitude[0].latitude - run.latitude[0].reference))
    rest = ", ".join(f"{f.remainder / ARCSEC:.2f}″ in {f.axis}" for f in run.latitude)
    degrees = np.degrees(np.ptp(run.latitude[0].latitude))
    text = (
        f"The fields lie within {degrees:.0f}° of latitude, where the sine changes by {reach:.2f}, so that a drift of "
        f"1″ amplitude makes {reach:.2f}″ between the first and the last. Beside it there remain {rest}, the season of "
        f"each field: {seen} at two sigmas. More fields, or the same ones in all seasons, would tell them apart.",
        f"Roll and pitch of the fields scatter by {spread / ARCSEC:.2f}″ together, {metres:.1f} m on the ground. By "
        f"the rules of a mean, one field's bias leaves another field {np.sqrt(2.0) * metres:.1f} m RMS in plan, and "
        f"the mean of {most} fields {np.sqrt(1.0 + 1.0 / most) * metres:.1f} m, beside the noise of its own: averaging "
        "helps by less than a third, and no number of fields goes below the scatter itself. Only a field's own "
        "parameters do, or a reading of the bias in every pass.",
    )
    return Section("Biases against latitude", text, (figure, table))
