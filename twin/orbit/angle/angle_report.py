"""Report of an intersection-angle test: lead, the main table, facts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.units import ARCSEC
from scenes.specs.course import DEFAULT_PIVOT
from scenes.specs.job import PlainPerturbationSpec
from scenes.yaml.units import LENGTH, format_quantity
from twin.orbit.angle.angle_plots import signs
from twin.orbit.angle.angle_run import AngleRun, values_of
from twin.orbit.angle.angle_sections import listed, sections
from twin.run.artefact import FAR, Cell, Table, fixed
from twin.run.report import Report, one_sentence

if TYPE_CHECKING:
    from scenes.specs.orbit.setup import AngleSetup

SIGHTED = "lines of sight in the tls planes"
METHOD_NAMES = {
    "printed": "planes, eq. 5 as printed",
    "corrected": "planes, eq. 5 with the right sign",
    "tls": "planes, total least squares",
}


def angle_report(run: AngleRun) -> Report:
    """Report of an intersection angle test."""
    verdict, lead = _found(run)
    return Report(
        "Intersection angles from ground points",
        verdict,
        lead,
        _facts(run.setup),
        _methods(run),
        sections(run),
        warnings=_warnings(run),
    )


def _found(run: AngleRun) -> tuple[str, tuple[str, ...]]:
    """The verdict, and what else is said at the top."""
    names, flight, few = signs(run.names), run.flight, run.narrow
    tls, along = run.estimate.angles["tls"], run.estimate.along
    truth = np.where(few, values_of(flight.along_track), values_of(flight.dihedral))
    found, sigma = np.where(few, along.values, tls.values), np.where(few, along.sigma, tls.sigma) / ARCSEC
    off, difference = (found - truth) / ARCSEC, run.difference / ARCSEC
    said, lead = [], []
    for which, by in ((np.flatnonzero(~few), "by planes"), (np.flatnonzero(few), "along the track, by planes")):
        if not len(which):
            continue
        said.append(
            f"{listed([f'{names[k]} = {np.degrees(found[k]):.6f}°' for k in which])} with "
            f"{'a sigma' if len(which) == 1 else 'sigmas'} of {listed([f'{sigma[k]:.2f} arcsec' for k in which])} "
            f"{by}, "
            f"{listed([f'{fixed(off[k], 2)} arcsec' for k in which])} from the truth"
        )
        lead.append(f"Planes minus resection: {listed([f'{fixed(difference[k], 3)} arcsec' for k in which])}.")
    if flight.trace:
        (name, true), change = next(iter(flight.trace.items())), run.change / ARCSEC
        at = run.names.index(name)
        sigma_1 = along.sigma[at] / ARCSEC
        lead.append(
            f"Since the laboratory {names[at]} has changed by {fixed(change[at], 2)} ± {sigma_1:.2f} arcsec as seen "
            f"from the ground; the trace of the instrument says {fixed(true / ARCSEC, 3)} arcsec."
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        worst = float(np.nanmax(np.abs(off) / sigma)) if np.any(sigma > 0.0) else None
    if worst is not None:
        held = "all are within" if worst <= FAR else "not all are within"
        said.append(f"{held} {FAR:g} σ of the truth, the farthest {worst:.1f} σ: see the methods")
    return one_sentence(*said), tuple(lead)


def _methods(run: AngleRun) -> Table:
    truth, estimate, names = run.flight, run.estimate, signs(run.names)
    look, dihedral, along = (values_of(a) for a in (truth.look, truth.dihedral, truth.along_track))
    rows: list[tuple[Cell, ...]] = []
    for k, name in enumerate(names):
        for method, angles in estimate.angles.items():
            text = " (folded)" if angles.folded[k] else ""
            rows.append(
                (name, METHOD_NAMES[method], f"dihedral{text}", *_row(angles.values, angles.sigma, dihedral, k))
            )
        # across the track the sigma is another one
        mostly = abs(along[k]) > 0.99 * look[k]
        sighted = _row(estimate.look, estimate.along.sigma, look, k)
        rows.append((name, SIGHTED, "look", sighted[0], sighted[1] if mostly else None, sighted[2]))
        rows.append((name, SIGHTED, "along track", *_row(estimate.along.values, estimate.along.sigma, along, k)))
        rows.append((name, "resection", "along track", *_row(run.resected, run.resected_sigma, along, k)))
        for kind, true in (("dihedral", dihedral), ("look", look), ("along track", along)):
            rows.append((name, "true camera", kind, float(np.degrees(true[k])), None, None))
    return Table(
        "methods",
        "Angles by each method",
        "Dihedral: between the planes of the lines. Look: between the lines of sight of the lines' centres. Along "
        "track: the look's signed part along the track, positive where the first line looks ahead of the second. Each "
        "is compared with its own truth. The resection's angle is one of pitch in the body, which differs from the "
        "angle along the track by less than 0.01 arcsec where the lines of sight begin within 20 arcsec of each other "
        "across the track. The planes are fitted in the Earth-fixed frame. Folded: below three sigmas, where an "
        "unsigned angle is pushed up by its noise.",
        ("", "method", "angle", "deg", "σ [arcsec]", "− truth [arcsec]"),
        rows,
        (None, None, None, 7, 3, 3),
    )


def _row(values: np.ndarray, sigma: np.ndarray, truth: np.ndarray, k: int) -> tuple[float, ...]:
    return float(np.degrees(values[k])), float(sigma[k] / ARCSEC), float((values[k] - truth[k]) / ARCSEC)


def _facts(setup: AngleSetup) -> tuple[tuple[str, str], ...]:
    test = setup.test
    passing, errors, effects = test.orbit.passing, test.errors, test.effects
    orbit = f"epoch {test.orbit.epoch}"
    if passing is not None:
        orbit = (
            f"{passing.direction} pass {passing.altitude / 1e3:g} km above "
            f"{np.degrees(passing.latitude):.4g}° N {np.degrees(passing.longitude):.4g}° E, {orbit}"
        )
    on = [name.replace("_", " ") for name in ("light_time", "aberration", "refraction") if getattr(effects, name)]
    state = ("corrected" if effects.corrected else "not corrected") + " in the analysis" if on else ""
    changed = "; ".join(f"{name} {_change_text(change)}" for name, change in test.changes.items())
    described = (setup.camera or setup.instrument).description  # type: ignore[union-attr]
    pairs = "; ".join(
        f"{sign} between {a} and {b}" for sign, (a, b) in zip(signs(setup.angles), setup.angles.values(), strict=True)
    )
    datum = ", ".join(
        f"{format_quantity(v, LENGTH)} {to}" for v, to in zip(errors.datum, ("east", "north", "up"), strict=True)
    )
    return (
        ("Camera", f"{setup.camera_name}, {described}"),
        ("Angles", pairs.replace("_", " ")),
        ("Changed since the laboratory", changed or "nothing"),
        ("Orbit", orbit),
        ("Exposure", f"{test.time:g} s from the epoch"),
        ("Points", f"{test.strips.points} on each strip, pixels {test.strips.first:g} to {test.strips.last:g}"),
        (
            "Terrain",
            f"{format_quantity(test.terrain.height, LENGTH)} ± {format_quantity(test.terrain.relief, LENGTH)}",
        ),
        ("Effects on the light", f"{', '.join(on) or 'none'} {state}".strip()),
        (
            "Errors, σ of a coordinate",
            f"station {format_quantity(errors.station, LENGTH)}, points {format_quantity(errors.points, LENGTH)}",
        ),
        ("Common shift of the points", datum if any(errors.datum) else "none"),
        ("Description", test.description),
    )


def _change_text(change: PlainPerturbationSpec) -> str:
    """What happens to a line or a node, in the file's words."""
    plain = change.plain()
    text = []
    for action in change.uses():
        value = plain[action]
        items = value.items() if isinstance(value, dict) else [("", value)]
        parts = (f"{key} [{', '.join(v)}]" if isinstance(v, list) else f"{key} {v}" for key, v in items)
        about = f" about {change.pivot}" if action == "rotate" and change.pivot != DEFAULT_PIVOT else ""
        text.append(f"{action} {', '.join(part.strip() for part in parts)}{about}")
    return ", ".join(text) if text else "unchanged"


def _warnings(run: AngleRun) -> tuple[str, ...]:
    spec, found = run.flight.spec, []
    left = [e for e in ("light_time", "aberration", "refraction") if getattr(spec.effects, e)]
    if left and not spec.effects.corrected:
        found.append(
            f"the analysis leaves {', '.join(left).replace('_', ' ')} in the points; the angles are biased as the "
            "table of effects says"
        )
    if any(spec.errors.datum):
        found.append("the points share a shift that no sigma contains and no residual shows; see the table of effects")
    folded = [n for n, f in zip(signs(run.names), run.estimate.angles["tls"].folded, strict=True) if f]
    if folded:
        found.append(
            f"the planes of {listed(folded)} are parallel within their noise: the unsigned dihedral angle folds at "
            "zero; use the angle along the track, which has a sign"
        )
    if run.estimate.resection.p_value < 1e-3:
        found.append(
            f"the resection does not fit: a chi-square as large has a chance of {run.estimate.resection.p_value:.1g}; "
            "lines may have turned about the flight direction or the vertical since the laboratory"
        )
    return tuple(found)
