"""Report of intersection angles on measurements: against the laboratory, for nobody knows the truth."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from analysis.units import ARCSEC
from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from twin.orbit.angle.angle_plots import signs
from twin.orbit.angle.angle_report import METHOD_NAMES, SIGHTED, angle_report
from twin.orbit.angle.angle_run import AngleRun
from twin.orbit.angle.angle_sections import listed
from twin.orbit.angle.measured_angle import MeasuredAngleRun, MeasuredAngles
from twin.run.artefact import Cell, Table, fixed
from twin.run.report import Report, Section, one_sentence

_FALSE_ALARM = 1e-4
"""Of a point that is named for its distance from its plane, over all points of a line."""


def any_angle_report(run: AngleRun | MeasuredAngleRun) -> Report:
    """Report of a simulated test or of one on measurements."""
    return measured_angle_report(run) if isinstance(run, MeasuredAngleRun) else angle_report(run)


def measured_angle_report(run: MeasuredAngleRun) -> Report:
    """Report of a test on measurements."""
    first = run.passes[0]
    names = signs(tuple(first.pairs))
    along, change = first.estimate.along, first.estimate.along.values - first.along_track
    said = listed(
        [
            f"{name} has changed by {fixed(change[k] / ARCSEC, 2)} ± {along.sigma[k] / ARCSEC:.2f} arcsec"
            for k, name in enumerate(names)
        ]
    )
    verdict = one_sentence(
        f"Since the laboratory {said}, along the track, as the ground points of {first.name} see it",
        "the sigmas are those of points, image points and readings",
    )
    return Report(
        "Intersection angles from ground points",
        verdict,
        (),
        _facts(run),
        _summary(run),
        (_planes(run),),
        warnings=_warnings(run),
    )


def _summary(run: MeasuredAngleRun) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for one in run.passes:
        estimate, section = one.estimate, one.estimate.resection
        pairs = tuple(one.pairs.values())
        resected = np.abs(section.angles(pairs)), np.sqrt(np.diag(section.angle_covariance(pairs)))
        for k, name in enumerate(signs(tuple(one.pairs))):
            tls = estimate.angles["tls"]
            kinds = (
                (METHOD_NAMES["tls"], "dihedral", tls.values, tls.sigma, one.dihedral),
                (SIGHTED, "along track", estimate.along.values, estimate.along.sigma, one.along_track),
                ("resection", "along track", np.copysign(resected[0], one.along_track), resected[1], one.along_track),
            )
            for method, kind, value, sigma, known in kinds:
                change = float((value[k] - known[k]) / ARCSEC)
                cells = (float(np.degrees(value[k])), float(sigma[k] / ARCSEC), change)
                rows.append((one.name, name, method, kind, *cells))
    return Table(
        "methods",
        "Angles of every pass",
        "Dihedral: between the planes of the lines. Along track: the signed part along the track of the angle between "
        "the lines of sight of the lines' centres. Each is compared with that of the laboratory's camera.",
        ("pass", "", "method", "angle", "deg", "σ [arcsec]", "− laboratory [arcsec]"),
        rows,
        (None, None, None, None, 7, 3, 3),
    )


def _planes(run: MeasuredAngleRun) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for one in run.passes:
        for line, fit in zip(one.lines, one.estimate.planes["tls"], strict=True):
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
    text = (
        "Lines see their points at many moments. Each arm from the station to a point, freed of light time, aberration "
        "and refraction, is carried along in the body to one moment, by the measured attitude. The sigmas hold the "
        "points' coordinates, their places in the image, and the noise of orbit and attitude, which all points of one "
        "reading share.",
        "A bias of the attitude turns all arms alike and leaves the angles as they are. What no sigma holds is a bias "
        "that drifts while one line sees the field after the other, a shift that all points share, and an atmosphere "
        "unlike the standard one. Changes of a principal distance do not change planes, but the resection, which has "
        "the laboratory's, does not fit then.",
    )
    return Section("Planes", text, (table,))


def _facts(run: MeasuredAngleRun) -> tuple[tuple[str, str], ...]:
    setup, first = run.setup, run.passes[0]
    tracker, gps, effects = setup.test.errors.star_tracker, setup.test.errors.gps, setup.test.effects
    on = [name.replace("_", " ") for name in ("light_time", "aberration", "refraction") if getattr(effects, name)]
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


def far_points(one: MeasuredAngles) -> list[tuple[str, int, float]]:
    """Line, number on it and sigmas of points that lie farther from their plane than chance allows."""
    found = []
    for line, fit in zip(one.lines, one.estimate.planes["tls"], strict=True):
        sigma = np.sqrt(np.einsum("i,nij,j->n", fit.normal, fit.strip.covariance, fit.normal))
        away = np.abs(fit.residual) / sigma
        limit = np.sqrt(chi2.isf(_FALSE_ALARM / len(away), 1))
        found += [(line, int(k), float(away[k])) for k in np.flatnonzero(away > limit)]
    return found


def _warnings(run: MeasuredAngleRun) -> tuple[str, ...]:
    found = []
    for one in run.passes:
        far = far_points(one)
        if far:
            worst = max(far, key=lambda point: point[2])
            name = one.ids[worst[0]][worst[1]]
            found.append(
                f"{one.name}: {len(far)} points lie farther from their planes than chance allows, the farthest {name} "
                f"of {worst[0]}, {worst[2]:.0f} σ; `angle` leaves none out: look at them, or let `calibrate` find them"
            )
        if one.estimate.resection.p_value < 1e-3:
            found.append(
                f"{one.name}: the resection does not fit (chance {one.estimate.resection.p_value:.1g}); principal "
                "distances may have changed, or lines turned about the flight direction or the vertical"
            )
    return tuple(found)
