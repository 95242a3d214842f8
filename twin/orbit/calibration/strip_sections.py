"""What a report says of passes that are adjusted on tie points."""

from __future__ import annotations

from collections.abc import Mapping

from analysis.orbit.forward_intersection import CheckErrors
from analysis.units import ARCSEC
from twin.artefact import Cell, Table
from twin.orbit.calibration.monitor import PooledErrors
from twin.orbit.calibration.procedure import CalibrationRun
from twin.orbit.calibration.strip import Strips
from twin.trial.section import Section


def gained(before: Mapping[str, Mapping[str, CheckErrors]], found: Strips) -> str:
    """What the adjustment gains, in one sentence, from the scheme with most averaged parameters."""
    scheme = list(found.schemes)[-2]
    old, new = (PooledErrors.of(e[scheme].values()) for e in (before, found.schemes))
    return (
        f"Calibrating with {min(found.ties.values())} tie points of each pass or more, and adjusting each pass on "
        f"them, takes the height RMS of scheme {scheme} from {old.height:.2f} m to {new.height:.2f} m and the plan RMS "
        f"from {old.plan:.2f} m to {new.plan:.2f} m."
    )


def strips_section(run: CalibrationRun, found: Strips) -> Section:
    """Errors before and after, and what tie points cannot tell."""
    rows: list[tuple[Cell, ...]] = []
    for scheme, fields in found.schemes.items():
        old, new = (PooledErrors.of(e.values()) for e in (run.schemes[scheme], fields))
        rows.append((scheme, old.plan, new.plan, old.height, new.height))
    table = Table(
        "strips",
        "Check points with and without tie points",
        "RMS at check points of all fields without ground control, metres: calibrated on control points and "
        "intersected as measured; calibrated on control and tie points and intersected with the adjusted attitude and "
        "orbit. The last scheme lets each field use its own parameters.",
        ("scheme", "plan", "plan, with ties", "height", "height, with ties"),
        rows,
        (None, 2, 2, 2, 2),
    )
    turns: list[tuple[Cell, ...]] = [
        (d.name, d.before / ARCSEC, d.after / ARCSEC, d.after / d.before) for d in found.datum
    ]
    common = Table(
        "strip-datum",
        f"What the tie points tell of turns of a whole pass, {run.campaign.passes[0].name}",
        "Sigma from the readings' noise alone and with the ties, arcseconds, of rates arcseconds per second. A ratio "
        "near 1 means that ties say nothing of it.",
        ("turn", "before", "after", "ratio"),
        turns,
        (None, 4, 4, 3),
    )
    tracker = run.campaign.spec.errors.star_tracker
    slow = max(tracker.slow.noise) / ARCSEC
    noise = f"{max(tracker.noise) / ARCSEC:g}″ from reading to reading"
    if slow:
        noise += f" and {slow:g}″ that change within {tracker.slow.interval:g} s"
    counts = ", ".join(f"{k} {n}" for k, n in found.ties.items())
    text = (
        f"Every pass is adjusted on points that three lines see ({counts}) without coordinates on the ground; the "
        "errors of its attitude and orbit are unknowns with their own sigmas as priors. Check points, which are no "
        "ties, are then intersected with the adjusted attitude and orbit. "
        f"The attitude's noise here is {noise}.",
        "Rays of one place that do not meet show errors of the attitude. What lasts for many readings and changes "
        "within the pass is seen by many ties and is taken out; noise that is independent from one reading to the next "
        "lies mostly in the mean of the three exposures, which no tie sees. A turn that the whole pass has in common "
        "stays, and so does the bias of the scheme: plan hardly gains where biases make it. In pitch even more stays: "
        "whatever repeats itself from one line's view of a place to the next, for as long as two such views last. It "
        "shifts heights, and only a strip that is long against this, with errors slower than it is long, gains much.",
        "Slow errors during the seconds in which a line sees the control points look like a change of its interior "
        "orientation or of the bias, and a calibration on control points alone takes part of them for one. Adjusting "
        "the attitude afterwards would count this part twice, and errors would grow. With the tie points of the whole "
        "strip in the calibration, interior and attitude are told apart, and the adjusted attitude belongs to them. A "
        "single campaign of few fields scatters: each slow error that a pass keeps is shared by all of its points, so "
        "that one scheme may lose by chance where it gains on average.",
    )
    return Section("Adjustment of the strips", text, (table, common))
