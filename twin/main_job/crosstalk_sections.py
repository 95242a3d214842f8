"""Report sections on elementary motions: spot shifts, estimates by all estimators, factors of the papers' formulas."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from itertools import groupby

import numpy as np
from markupsafe import Markup

from analysis.monitor import parameters
from scenes.specs.instrument import BASE
from twin.framework.artefact import (
    SAME,
    SYMBOLS,
    Artefact,
    Cell,
    Marked,
    Table,
    Text,
    fixed,
    plain,
    significant,
    unit_for_reports,
)
from twin.framework.report import Section
from twin.main_job.render_results import RenderRun
from twin.main_job.result_sections import IN_PAGE, figure
from twin.monitor.crosstalk import PRINTED, CameraCrosstalk

WRONG = 0.1
"""Relative error above which an estimate is marked as wrong, if the error also exceeds that of ``UNOBSERVED``."""
UNOBSERVED = 0.01
"""Smallest error of an estimate, per unit of motion, that is marked, in units of the noise sigma of the run.

Below it, even a hundred units of the motion would cause an error no larger than the noise.
"""


def motion_section(run: RenderRun, drawn: Mapping[str, str]) -> Section:
    """Return the section with the spot shifts due to each motion, and three ways to change the principal distance.

    ``drawn`` holds the figures of the section by name.
    """
    caption = (
        "Shift of each spot on its area CCD in µm per unit of each motion (1 µm, 1 arcsec, 1 ppm, or 1 nm rms of a "
        "figure term), of one body alone, to first order; x is along the flight direction, y along the line. Colours "
        "are logarithmic over three decades, red is positive. 0 means less than 10⁻⁶. The CSV also has the "
        "true change and the reading of each estimator. Four coordinates for each camera cannot separate these "
        "motions. The first four are the family that the papers' estimators assume. `crosstalk.json` describes the "
        "response of the spots to every motion."
    )
    parts: list[Artefact] = [figure(drawn, "motions", caption, full=_motions(run))]
    for k, (name, table) in enumerate(run.crosstalk.items()):
        labels = {f"{m.label} [{m.unit}]" for m in table.motions} | {m.label for m in table.motions}
        first = _pretty(table.observability.sentences[0].split(": ", 1), labels)
        points = [_pretty(s.split(": ", 1), labels, keep=True) for s in table.principal_distance_sentences()]
        title = f"Three ways to change the principal distance of {name}: piston, despace, scale"
        parts.append(Text(f"focal-{k}", title, first, points, within=IN_PAGE))
    return Section("Response of the spots to motions", (), tuple(parts), len(run.crosstalk), "motions")


_TYPESET = (*SYMBOLS.items(), (" um", " µm"), ("[um]", "[µm]"), ('"', " arcsec"))


def _pretty(parts: list[str], labels: set[str], keep: bool = False) -> str:
    """Typeset the name of a motion for reports; its label at the start is removed unless ``keep`` is set."""
    known = len(parts) > 1 and parts[0] in labels
    text = parts[1] if known and not keep else ": ".join(parts)
    for plain_text, typeset in _TYPESET:
        text = text.replace(plain_text, typeset)
    text = re.sub(r"(?<=\d) x (?=[A-Za-z])", " × ", text)
    text = re.sub(r"(?<=\d)e-0?(\d)", "e\N{MINUS SIGN}\\1", text)
    return re.sub(r"(?<= )-(?=\d| )", "\N{MINUS SIGN}", text)


def _motions(run: RenderRun) -> Table:
    """Return the table with spot shifts, true change and estimate by every estimator, per unit of each motion."""
    pitch = 1e6 * run.experiment.path.pitch
    coordinates = list(
        dict.fromkeys(coordinate for table in run.crosstalk.values() for coordinate in table.coordinates)
    )
    heads = ["camera", "motion", "body", "per", *(f"{coordinate} [µm]" for coordinate in coordinates)]
    readers = ("true", *(estimator.title for estimator in run.estimators.values()))
    heads += [f"{p.label} {reader}" for reader in readers for p in parameters.CAMERA_PARAMETERS.values()]
    rows: list[list[Cell]] = []
    for name, table in run.crosstalk.items():
        for k, motion in enumerate(table.motions):
            row: list[Cell] = [name, motion.label, motion.body, unit_for_reports(motion.unit)]
            shifts = dict(zip(table.coordinates, table.spot_shift[:, k], strict=True))
            row += [float(shifts[coordinate]) * pitch if coordinate in shifts else None for coordinate in coordinates]
            row += [float(true) for true in table.true[:, k]]
            for estimator in run.estimators:
                row += [float(reading) for reading in table.readings[estimator][:, k]]
            rows.append(row)
    return Table("motions", "Motions", "", heads, rows)


def crosstalk_section(run: RenderRun) -> Section:
    """Return the section that compares true and estimated changes per unit of motion, a table for each camera."""
    about = (
        "Per unit of motion: the true change of the camera (bold) and the reading of every estimator, to first order. "
        f"Underlined: wrong by more than {round(100 * WRONG)} % of the truth and by more than a hundredth of this "
        "run's noise, so that a hundred units of the motion would be noticed. 0 means less than 10⁻⁶. The column paper "
        "is both paper single, eqs. (2), (3), (5), and paper joint, Table 1, where these agree."
    )
    tables = tuple(_crosstalk(run, k) for k in range(len(run.crosstalk)))
    return Section("Crosstalk: readings of each motion", (about,), tables, name="crosstalk", closed=True)


def _crosstalk(run: RenderRun, camera: int) -> Table:
    name, table = list(run.crosstalk.items())[camera]
    columns = [_columns(run, table, p) for p in range(len(parameters.CAMERA_PARAMETERS))]
    rows_of_camera = [row for row in run.reading.table.rows if row.estimator == run.judged and row.camera == name]
    floors = [max(SAME, UNOBSERVED * row.noise) for row in rows_of_camera]  # SAME where the estimator has no value
    bodies = [motion.body for motion in table.motions]
    rows: list[list[Cell]] = []
    bands: dict[int, str] = {}
    for body, members in groupby(sorted(range(len(bodies)), key=lambda k: bodies.index(bodies[k])), bodies.__getitem__):
        bands[len(rows)] = body.removeprefix(f"{BASE}/")
        for k in members:
            motion = table.motions[k]
            row: list[Cell] = [_short(motion.label), Marked(unit_for_reports(motion.unit), "", "number")]
            for p, floor in enumerate(floors):
                true = float(table.true[p, k])
                row.append(Marked(significant(true), "", "truth start"))
                for _, estimator in columns[p]:
                    reading = float(table.readings[estimator][p, k])
                    row.append(
                        Marked(significant(reading), "", "wrong" if is_wrong(reading, true, floor) else "number")
                    )
            rows.append(row)
    caption = Markup('All digits: the table of <a href="#motions">motions and spots</a>.')
    heads = [
        "Motion",
        "per",
        *(head for of_parameter in columns for head in ("true", *(label for label, _ in of_parameter))),
    ]
    spans = zip(parameters.CAMERA_PARAMETERS.values(), columns, strict=True)
    over = [("", 2), *((p.label, 1 + len(of_parameter)) for p, of_parameter in spans)]
    title = f"Camera {name}"
    return Table(f"crosstalk-{camera}", title, caption, heads, rows, over=over, bands=bands, within=IN_PAGE)


def _columns(run: RenderRun, table: CameraCrosstalk, parameter: int) -> list[tuple[str, str]]:
    """Return (heading, estimator) of the table columns for one parameter.

    The formulas of the two papers share a column where they agree.
    """
    single, joint = (table.readings[e][parameter] for e in ("paper_single", "paper_joint"))
    same = np.allclose(single, joint, rtol=1e-9, atol=0.0)
    columns = []
    for estimator in run.estimators:
        if estimator == "paper_joint" and same:
            continue
        heading = run.estimators[estimator].title
        if (estimator, parameter) in PRINTED:
            heading = "paper" if same else f"{heading}, {'(7)' if estimator == 'paper_single' else 'Table 1'}"
        columns.append((heading, estimator))
    return columns


def _short(label: str) -> str:
    """Return a motion's label without the body's name, which the table shows above the motions of that body."""
    for word in ("figure ", "along ", "about "):
        if word in label:
            return (word + label.partition(word)[2]).removeprefix("figure ")
    return label.removeprefix("whole camera ")


def is_wrong(reading: float, true: float, floor: float = SAME) -> bool:
    """Return True if an estimate's error exceeds both ``WRONG`` times the true value and ``floor``."""
    return abs(reading - true) > max(WRONG * abs(true), floor)


def formula_section(run: RenderRun) -> Section:
    """Return the section with the scale factors of the papers' formulas and their explanation.

    Its table has two columns for each camera.
    """
    about = (
        "Each printed formula is evaluated with the traced spot shifts of the motion for which it was derived. A "
        "factor of 1 means that the formula is correct."
    )
    factors_by_camera = {name: table.factors for name, table in run.crosstalk.items()}
    symbols = {p.key: p.symbol for p in parameters.CAMERA_PARAMETERS.values()}
    rows: list[list[Cell]] = []
    for factors_of_formula in zip(*factors_by_camera.values(), strict=True):
        row: list[Cell] = [
            f"{symbols[factors_of_formula[0].parameter]}, {factors_of_formula[0].formula}",
            factors_of_formula[0].motion,
        ]
        for name, f in zip(factors_by_camera, factors_of_formula, strict=True):
            for which in ("by_model", "by_truth"):
                key = f"factor.{name}.{f.estimator}.{f.parameter}.{which}"
                row.append(Marked(fixed(float(getattr(f, which)), 4), "", "number", key))
        rows.append(row)
    full: list[list[Cell]] = [
        [name, f.formula, f.parameter, f.motion, float(f.by_model), float(f.by_truth)]
        for name, factors in factors_by_camera.items()
        for f in factors
    ]
    heads = ["camera", "formula", "parameter", "motion", "of the paper's model", "of the real camera"]
    table = Table(
        "factors",
        "Reading divided by the change",
        "",
        ("Formula", "Motion", *("of the paper's model", "of the real camera") * len(factors_by_camera)),
        rows,
        over=(("", 2), *((name, 2) for name in factors_by_camera)),
        within=IN_PAGE,
        full=Table("factors", "Factors", "", heads, full),
    )
    texts: dict[str, list[str]] = {}
    for name in factors_by_camera:
        texts.setdefault(_factor_text(run, name), []).append(name)
    points = (
        "The factor of the paper's model divides by the change of a thin lens (shift/f, the rotation, scale × f). That "
        "of the real camera divides by the traced change, and so includes its anamorphism fₓ/f and its distortion.",
        *(f"{', '.join(names)}: {text}" for text, names in texts.items()),
        "The paper's X and Y are before − after. Table 1 does not say how Y_L is signed and uses it in both Δβ and Δf; "
        "here each row takes the sign that agrees with the single-change formula beside it: Y_L = y₀₁ − y₁₁ for Δβ, "
        "y₁₁ − y₀₁ for Δf.",
    )
    notes = Text("formula-notes", "", "", points, within=IN_PAGE)
    return Section("Factors of the printed formulas", (about,), (table, notes), name="formulas", closed=True)


def _factor_text(run: RenderRun, name: str) -> str:
    """Return a sentence with the numbers that explain the scale factors of the formulas for one camera."""
    geometry, factors = run.experiment.geometry(name), run.crosstalk[name].factors
    f, f_x = geometry.principal_distance_m, geometry.principal_distance_across_m or geometry.principal_distance_m
    by_model = {(factor.estimator, factor.parameter): float(factor.by_model) for factor in factors}
    beta, alpha = geometry.field_beta_rad, geometry.field_alpha_rad
    return (
        f"the printed Δγ, eq. (5), reads {fixed(by_model['paper_single', 'd_gamma_arcsec'], 3)} times the rotation "
        f"of the line; the joint Δf of Table 1 reads {fixed(by_model['paper_joint', 'd_f_um'], 3)} times the change. "
        f"The anamorphism is fₓ/f = {fixed(f_x / f, 4)} (plate scale across the line {fixed(f_x, 4)} m, "
        f"principal distance along it {fixed(f, 4)} m). Eqs. (2), (3) and Table 1 carry a cos² of angles that the "
        "paper leaves undefined; taken as the field angles of the area CCDs, "
        f"cos² β = {fixed(math.cos(beta) ** 2, 5)} at {plain(math.degrees(beta))}° and "
        f"cos² α = {fixed(math.cos(alpha) ** 2, 5)} at {plain(math.degrees(alpha))}°."
    )
