"""What the intersection angle test gives: angle.json, the main table, the report."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optics.backend import Backend
from scenes.units import ANGLE, LENGTH, format_quantity
from twin.artefact import Cell, Table
from twin.orbit.angle_analysis import ANGLES, ARCSEC, AngleRun, resected, run_passes, true_angles
from twin.orbit.angle_json import PRINTED_DIFFERENCE_ARCSEC, to_dict
from twin.orbit.angle_sections import sections
from twin.report.numbers import fixed
from twin.trial.result import Advance, LabResult

if TYPE_CHECKING:
    from scenes.orbit_setup import AngleSetup

METHOD_NAMES = {
    "printed": "planes, eq. 5 as printed",
    "corrected": "planes, eq. 5 with the right sign",
    "tls": "planes, total least squares",
}


def run_angle(setup: AngleSetup, backend: Backend, seed: int, advance: Advance) -> LabResult:
    """Simulate a pass and put the result together; nothing is traced, so that the backend is not used."""
    return angle_result(run_passes(setup, seed, advance), setup, seed)


def angle_result(run: AngleRun, setup: AngleSetup, seed: int) -> LabResult:
    """Numbers, table and report of an intersection angle test."""
    flight = run.flight
    found, sigma = run.estimate.angles["tls"].values, run.estimate.angles["tls"].sigma
    off = (found - true_angles(flight.dihedral)) / ARCSEC
    difference = run.difference / ARCSEC
    lead = (
        f"α = {np.degrees(found[0]):.6f}° and β = {np.degrees(found[1]):.6f}° with sigmas of {sigma[0] / ARCSEC:.2f}″ "
        f"and {sigma[1] / ARCSEC:.2f}″ by planes, {fixed(off[0], 2)}″ and {fixed(off[1], 2)}″ from the truth. "
        f"Planes minus resection: {fixed(difference[0], 3)}″ and {fixed(difference[1], 3)}″; the paper prints "
        f"{PRINTED_DIFFERENCE_ARCSEC['alpha']}″ and {PRINTED_DIFFERENCE_ARCSEC['beta']}″.",
    )
    return LabResult(
        "angle",
        "Intersection angles from ground points",
        lead,
        _facts(setup),
        to_dict(run, seed),
        _methods(run),
        sections(run),
        warnings=_warnings(run),
    )


def _methods(run: AngleRun) -> Table:
    truth, estimate = run.flight, run.estimate
    look, dihedral = true_angles(truth.look), true_angles(truth.dihedral)
    section = estimate.resection
    sigma = np.array([section.sigma[name] for name in ANGLES])
    rows: list[tuple[Cell, ...]] = [
        (METHOD_NAMES[method], "dihedral", *_pairs(angles.values, angles.sigma, dihedral))
        for method, angles in estimate.angles.items()
    ]
    tls = estimate.angles["tls"]
    rows.append(("lines of sight in the tls planes", "look", *_pairs(estimate.look, tls.sigma, look)))
    rows.append(("resection", "look", *_pairs(resected(section), sigma, look)))
    for name, true in (("dihedral", dihedral), ("look", look)):
        alpha, beta = (float(v) for v in np.degrees(true))
        rows.append(("true camera", name, alpha, None, None, beta, None, None))
    heads = ("method", "angle", "α, deg", "σ, arcsec", "− truth, arcsec", "β, deg", "σ, arcsec", "− truth, arcsec")
    return Table(
        "methods",
        "Angles by each method",
        "Dihedral: between the planes of the lines. Look: between the lines of sight of the lines' centres. Each is "
        "compared with its own truth; the resection's angle is one of pitch, which differs from the look by less than "
        "0.01 arcsec where the lines of sight begin within 20 arcsec of each other across the track. The planes are "
        "fitted in the Earth-fixed frame.",
        heads,
        rows,
        (None, None, 7, 3, 3, 7, 3, 3),
    )


def _pairs(values: np.ndarray, sigma: np.ndarray, truth: np.ndarray) -> tuple[float, ...]:
    return tuple(
        float(v) for k in range(2) for v in (np.degrees(values[k]), sigma[k] / ARCSEC, (values[k] - truth[k]) / ARCSEC)
    )


def _facts(setup: AngleSetup) -> tuple[tuple[str, str], ...]:
    test, camera = setup.test, setup.camera
    passing, errors, effects = test.orbit.passing, test.errors, test.effects
    orbit = f"epoch {test.orbit.epoch}"
    if passing is not None:
        orbit = (
            f"{passing.direction} pass {passing.altitude / 1e3:g} km above "
            f"{np.degrees(passing.latitude):.4g}° N {np.degrees(passing.longitude):.4g}° E, {orbit}"
        )
    on = [name.replace("_", " ") for name in ("light_time", "aberration", "refraction") if getattr(effects, name)]
    state = ("corrected" if effects.corrected else "not corrected") + " in the analysis" if on else ""
    turned = "; ".join(
        f"{name} [{', '.join(format_quantity(v, ANGLE) for v in turn)}]" for name, turn in test.changes.items()
    )
    datum = ", ".join(
        f"{format_quantity(v, LENGTH)} {to}" for v, to in zip(errors.datum, ("east", "north", "up"), strict=True)
    )
    return (
        ("Camera", f"{camera.name}, {camera.description}"),
        ("Turned since the laboratory", turned or "nothing"),
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
    if run.estimate.resection.p_value < 1e-3:
        found.append(
            f"the resection does not fit: a chi-square as large has a chance of {run.estimate.resection.p_value:.1g}; "
            "lines may have turned about the flight direction or the vertical since the laboratory"
        )
    return tuple(found)
