"""Report of an intersection-angle test: against the laboratory, and of a simulated one also against the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2

from analysis.arrays import ARCSEC
from scenes.specs.course import DEFAULT_PIVOT
from scenes.specs.measured.orbit_data_setup import MeasuredAngleSetup
from scenes.specs.perturbation import PlainPerturbationSpec
from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from twin.orbit.angle.angle_numbers import UNLIKELY
from twin.orbit.angle.angle_run import AngleRun, PassAngles, SimulatedAngleRun, values_of
from twin.orbit.angle.angle_sections import listed, sections, signs
from twin.orbit.flight.light_effects import LightEffects
from twin.run.artefact import FAR, Cell, Table, fixed
from twin.run.report import Report, Section, answer

if TYPE_CHECKING:
    from scenes.specs.orbit.setup import AngleSetup

SIGHTED = "lines of sight in the tls planes"
METHOD_NAMES = {
    "printed": "planes, eq. 5 as printed",
    "corrected": "planes, eq. 5 with the right sign",
    "tls": "planes, total least squares",
}
_FALSE_ALARM = 1e-4
"""Chance that a point of a line without errors is named for its distance from the plane."""


def angle_report(run: AngleRun) -> Report:
    """Report of an intersection angle test."""
    first = run.passes[0]
    along = first.estimate.along
    change = along.values - values_of(first.laboratory.along_track)
    changed = [
        f"{name} has changed by {fixed(change[k] / ARCSEC, 2)} ± {along.sigma[k] / ARCSEC:.2f} arcsec"
        for k, name in enumerate(signs(first.pairs))
    ]
    simulated = run if isinstance(run, SimulatedAngleRun) else None
    said, lead = (
        (["the sigmas are those of points, image points and readings"], ()) if simulated is None else _found(simulated)
    )
    verdict, more = answer(
        f"Since the laboratory {listed(changed)} along the track, measured from the ground points of {first.name}",
        *said,
    )
    setup = run.setup
    return Report(
        "Intersection angles from ground points",
        verdict,
        (*more, *lead),
        _measured_facts(run, setup) if isinstance(setup, MeasuredAngleSetup) else _facts(setup),
        _methods(run),
        (_planes(run), *(() if simulated is None else sections(simulated))),
        warnings=_warnings(run),
    )


def _found(run: SimulatedAngleRun) -> tuple[list[str], tuple[str, ...]]:
    """What the verdict says of the truth, and what else is said at the top."""
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
            f"from the ground; the trace of the instrument gives {fixed(true / ARCSEC, 3)} arcsec."
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        worst = float(np.nanmax(np.abs(off) / sigma)) if np.any(sigma > 0.0) else None
    if worst is not None:
        held = "all angles are within" if worst <= FAR else "not all angles are within"
        said.insert(0, f"{held} {FAR:g} σ of the truth, with a largest error of {worst:.1f} σ: see the methods")
    return said, tuple(lead)


def _methods(run: AngleRun) -> Table:
    """Every method of every pass against the laboratory and, where it is known, the truth."""
    flight = run.flight if isinstance(run, SimulatedAngleRun) else None
    truth = () if flight is None else tuple(values_of(a) for a in (flight.dihedral, flight.look, flight.along_track))
    rows: list[tuple[Cell, ...]] = []
    for one in run.passes:
        estimate, along, resected, lab = one.estimate, one.estimate.along, one.estimate.resected, one.laboratory
        known = tuple(values_of(angles) for angles in (lab.dihedral, lab.look, lab.along_track))
        for k, name in enumerate(signs(one.pairs)):
            # across the track the sigma of the look is another one
            mostly = abs(known[2][k]) > 0.99 * known[1][k]
            kinds: list[tuple[str, str, np.ndarray, np.ndarray | None, int]] = [
                (METHOD_NAMES[method], "dihedral" + " (folded)" * bool(a.folded[k]), a.values, a.sigma, 0)
                for method, a in estimate.angles.items()
            ]
            kinds.append((SIGHTED, "look", estimate.look, along.sigma if mostly else None, 1))
            kinds.append((SIGHTED, "along track", along.values, along.sigma, 2))
            kinds.append(("resection", "along track", resected.values, resected.sigma, 2))
            for method, kind, value, sigma, which in kinds:
                off = (float((value[k] - side[which][k]) / ARCSEC) for side in (known, truth) if side)
                spread = None if sigma is None else float(sigma[k] / ARCSEC)
                rows.append((one.name, name, method, kind, float(np.degrees(value[k])), spread, *off))
    heads: tuple[str, ...] = ("pass", "", "method", "angle", "deg", "σ [arcsec]", "− laboratory [arcsec]")
    return Table(
        "methods",
        "Angles by each method",
        "Dihedral: between the planes of the lines. Look: between the lines of sight of the lines' centres. Along "
        "track: the look's signed part along the track, positive where the first line looks ahead of the second. Each "
        "is compared with that of the laboratory's camera"
        + (" and with its own truth" if truth else "")
        + ". The resection's angle is one of pitch in the body, which differs from the "
        "angle along the track by less than 0.01 arcsec where the lines of sight begin within 20 arcsec of each other "
        "across the track. The planes are fitted in the Earth-fixed frame. Folded: below three sigmas, where an "
        "unsigned angle is pushed up by its noise.",
        (*heads, "− truth [arcsec]") if truth else heads,
        rows,
        (None, None, None, None, 7, 3, 3, 3)[: len(heads) + bool(truth)],
    )


def _planes(run: AngleRun) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for one in run.passes:
        for line, fit in zip(one.measurement.strips, one.estimate.planes["tls"], strict=True):
            freedom = len(fit.residual) - 2
            rows.append(
                (
                    one.name,
                    line,
                    len(fit.residual),
                    *one.span[line],
                    float(np.sqrt(np.mean(fit.residual**2))),
                    fit.chi_square / max(freedom, 1),
                    float(chi2.sf(fit.chi_square, freedom)) if freedom > 0 else None,
                )
            )
    table = Table(
        "planes",
        "Planes of the lines",
        "Through the station and the points of each line; when its points were seen, seconds from the moment; RMS "
        "distance of the points from the plane, metres; chi-square over its degrees of freedom and its chance.",
        ("pass", "line", "points", "from [s]", "to [s]", "RMS [m]", "χ²/dof", "chance"),
        rows,
        (None, None, None, 2, 2, 3, 2, 3),
    )
    text: tuple[str, ...] = (
        "Changes of a principal distance do not change planes, but the resection, which has the laboratory's, does not "
        "fit then.",
    )
    if not isinstance(run, SimulatedAngleRun):
        text = (
            "Lines see their points at many moments. Each arm from the station to a point, freed of light time, "
            "aberration and refraction, is carried along in the body to one moment, by the measured attitude. The "
            "sigmas hold the points' coordinates, their places in the image, and the noise of orbit and attitude, "
            "which all points of one reading share.",
            "A bias of the attitude turns all arms alike and leaves the angles as they are. What no sigma holds is a "
            "bias that drifts while one line sees the field after the other, a shift that all points share, and an "
            f"atmosphere unlike the standard one. {text[0]}",
        )
    return Section("Planes", text, (table,))


def _measured_facts(run: AngleRun, setup: MeasuredAngleSetup) -> tuple[tuple[str, str], ...]:
    first = run.passes[0]
    tracker, gps, effects = setup.test.errors.star_tracker, setup.test.errors.gps, setup.test.effects
    on = LightEffects.of(effects).names
    moments = ", ".join(f"{one.name} {one.time:.4g} s" for one in run.passes)
    return (
        ("Camera", f"{setup.camera.name}, {setup.camera.description}"),
        ("Passes", ", ".join(one.name for one in run.passes)),
        ("Angles", "; ".join(f"{n} between {a} and {b}" for n, (a, b) in first.pairs.items())),
        ("Moment, from the epoch", moments),
        ("Noise of the attitude, 1σ", ", ".join(format_quantity(v, ANGLE) for v in tracker.noise)),
        ("Noise of the orbit, 1σ", ", ".join(format_quantity(v, LENGTH) for v in gps.noise)),
        ("Effects on the light", f"{', '.join(on) or 'none'}{' taken out' * bool(on and effects.corrected)}"),
        ("Description", setup.test.description),
    )


def _facts(setup: AngleSetup) -> tuple[tuple[str, str], ...]:
    test = setup.test
    passing, errors, effects = test.orbit.passing, test.errors, test.effects
    orbit = f"epoch {test.orbit.epoch}"
    if passing is not None:
        orbit = (
            f"{passing.direction} pass {passing.altitude / 1e3:g} km above "
            f"{np.degrees(passing.latitude):.4g}° N {np.degrees(passing.longitude):.4g}° E, {orbit}"
        )
    on = LightEffects.of(effects).names
    state = ("corrected" if effects.corrected else "not corrected") + " in the analysis" if on else ""
    changed = "; ".join(f"{name} {_change_text(change)}" for name, change in test.perturb.items())
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
        ("Terrain", f"{format_quantity(test.terrain.height, LENGTH)} ± {format_quantity(test.terrain.relief, LENGTH)}"),
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


def _far_points(one: PassAngles) -> list[tuple[str, int, float]]:
    """Line, number on it and sigmas of points that lie farther from their plane than chance allows."""
    found = []
    for line, fit in zip(one.measurement.strips, one.estimate.planes["tls"], strict=True):
        sigma = np.sqrt(np.einsum("i,nij,j->n", fit.normal, fit.strip.covariance, fit.normal))
        away = np.abs(fit.residual) / sigma
        limit = np.sqrt(chi2.isf(_FALSE_ALARM / len(away), 1))
        found += [(line, int(k), float(away[k])) for k in np.flatnonzero(away > limit)]
    return found


def _warnings(run: AngleRun) -> tuple[str, ...]:
    found = []
    if isinstance(run, SimulatedAngleRun):
        spec = run.flight.spec
        left = run.flight.effects.names
        if left and not spec.effects.corrected:
            found.append(
                f"the analysis leaves {', '.join(left)} in the points; the angles are biased as the table of effects "
                "says"
            )
        if any(spec.errors.datum):
            found.append(
                "the points share a shift that no sigma contains and no residual shows; see the table of effects"
            )
    for one in run.passes:
        folded = [n for n, f in zip(signs(one.pairs), one.estimate.angles["tls"].folded, strict=True) if f]
        if folded:
            found.append(
                f"{one.name}: the planes of {listed(folded)} are parallel within their noise: the unsigned dihedral "
                "angle folds at zero; use the angle along the track, which has a sign"
            )
        far = _far_points(one)
        if far:
            worst = max(far, key=lambda point: point[2])
            name = one.ids[worst[0]][worst[1]]
            found.append(
                f"{one.name}: {len(far)} points lie farther from their planes than chance allows, the farthest {name} "
                f"of {worst[0]}, {worst[2]:.0f} σ; `angle` leaves none out: look at them, or let `calibrate` find them"
            )
        if one.estimate.resection.p_value < UNLIKELY:
            found.append(
                f"{one.name}: the resection does not fit (chance {one.estimate.resection.p_value:.1g}); principal "
                "distances may have changed, or lines turned about the flight direction or the vertical"
            )
    return tuple(found)
