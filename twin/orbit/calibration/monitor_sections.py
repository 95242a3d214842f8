"""What a report says of cameras that drift from field to field, and of an on-board monitor that reads it."""

from __future__ import annotations

from analysis.units import ARCSEC
from scenes.units import ANGLE, LENGTH, format_quantity
from twin.artefact import Artefact, Cell, SvgFigure, Table
from twin.orbit.calibration.monitor import Monitoring, Treatment
from twin.orbit.calibration.monitor_figure import drift_drawn
from twin.orbit.calibration.procedure import CalibrationRun
from twin.trial.section import Section


def bought(found: Monitoring) -> str:
    """What the monitor buys, in one sentence, from the scheme with most averaged parameters."""
    none, here = found.at(0.0), found.at(1.0)
    scheme = list(none.without.schemes)[-2]
    still, blind = none.without.schemes[scheme].height, here.without.schemes[scheme].height
    text = (
        f"With cameras that drift by {found.angle / ARCSEC:.2g}″ (d_alpha, 1σ) from field to field, heights without "
        f"ground control (scheme {scheme}) are wrong by {blind:.2f} m RMS, {still:.2f} m without drift"
    )
    if here.told is None:
        return f"{text}."
    return f"{text}; with the on-board monitor's readings, {here.told.schemes[scheme].height:.2f} m."


def monitoring_section(run: CalibrationRun, found: Monitoring) -> Section:
    """Errors by size of the drift and by scheme."""
    spec = run.campaign.spec
    drifts = "; ".join(
        f"{name} {_angles(one.angles)}, d_f {format_quantity(one.focal_length, LENGTH)}"
        for name, one in spec.drift.items()
    )
    text = [
        f"Each line camera differs in every field from its reference state, 1σ of d_alpha, d_beta, d_gamma: {drifts}. "
        f"1″ of d_alpha of the forward line is {abs(found.metres):.2f} m of height; d_beta moves points across the "
        "track, and d_gamma and d_f act at the ends of the lines.",
        "Each row has the same points and the same noise. Adjusted as if nothing drifted, one interior orientation has "
        "to do for all fields: heights get worse with the drift. The fit sees it only when it is larger than the "
        "noise. Schemes without ground control use the mean of the parameters of their fields. Only a field that is "
        "calibrated in the same pass (the last scheme) does not feel the drift, for its own points tell it.",
    ]
    if spec.monitor is not None:
        text.append(
            f"The monitor reads each camera in each pass with {_angles(spec.monitor.angles)} and d_f "
            f"{format_quantity(spec.monitor.focal_length, LENGTH)}, 1σ. Where a field is calibrated, its readings are "
            "observations of the drift, so that the interior orientation is that of the reference state; where a field "
            "is tested, the reference cameras are drifted by its own readings. What a reading has in common in all "
            "passes, the interior orientation takes up. Biases of the attitude, which act in plan, a monitor of the "
            "cameras does not read."
        )
    artefacts: list[Artefact] = [
        SvgFigure(
            "monitor-heights",
            "Height errors and the drift of the cameras",
            "Left: one campaign, its drift drawn once and scaled; the dashed line is what many campaigns would have "
            "on average. Right: RMS over all fields.",
            drift_drawn(run, found),
        ),
        _by_size(found),
        _by_scheme(found),
    ]
    return Section("Cameras that drift, and the on-board monitor", tuple(text), tuple(artefacts))


def _by_size(found: Monitoring) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for size in found.sizes:
        rows.append((size.factor, size.factor * found.angle / ARCSEC, *_cells(size.without), *_cells(size.told)))
    return Table(
        "monitor-sizes",
        "All fields adjusted at once",
        "RMS at check points of all fields, metres, each field with its own bias; chance of the fit, with the noise of "
        "the readings of attitude and orbit counted as independent (which makes it too near to 1).",
        ("drift × file's", "σ d_alpha, arcsec", "plan", "height", "chance", "plan, told", "height, told", "chance"),
        rows,
        (1, 2, 2, 2, 3, 2, 2, 3),
    )


def _by_scheme(found: Monitoring) -> Table:
    none, here = found.at(0.0).without, found.at(1.0)
    rows: list[tuple[Cell, ...]] = []
    for scheme, still in none.schemes.items():
        blind = here.without.schemes[scheme]
        told = None if here.told is None else here.told.schemes[scheme]
        rows.append(
            (
                scheme,
                still.plan,
                blind.plan,
                None if told is None else told.plan,
                still.height,
                blind.height,
                None if told is None else told.height,
            )
        )
    return Table(
        "monitor-schemes",
        "Schemes without ground control, with the file's drift",
        "RMS at check points of all fields, metres; the last scheme lets each field use its own parameters.",
        (
            "scheme",
            "plan, no drift",
            "plan, no monitor",
            "plan, monitor",
            "height, no drift",
            "height, no monitor",
            "height, monitor",
        ),
        rows,
        (None, 2, 2, 2, 2, 2, 2),
    )


def _cells(one: Treatment | None) -> tuple[Cell, ...]:
    return (None, None, None) if one is None else (one.together.plan, one.together.height, one.p_value)


def _angles(values: tuple[float, float, float]) -> str:
    return ", ".join(format_quantity(v, ANGLE) for v in values)
