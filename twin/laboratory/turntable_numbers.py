"""Numbers of a turntable test, as turntable.json has them."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from analysis.statistics import chance_beyond
from analysis.turntable.dividing_error import CalibrationSeries, DividingCompensation, expected_rejections
from twin.framework.quantity import Quantity, Record
from twin.laboratory.measured_readings import Comparisons, DataFile
from twin.laboratory.turntable_run import TurntableRun, rms

DOUBTFUL = 1e-3
"""Chance below which a chi-square is told as a warning."""


def likely(chi_square: float, degrees: int) -> bool | None:
    """Return whether a chi-square as large has a chance of DOUBTFUL at least; None without degrees of freedom.

    Args:
        chi_square: of residuals against their sigmas.
        degrees: of freedom.
    """
    return bool(chance_beyond(chi_square, degrees) >= DOUBTFUL) if degrees else None


DATA_FILE: Record[DataFile] = Record(
    "A file of measurements.",
    Quantity("file", lambda f: f.file, "path as given"),
    Quantity("rows", lambda f: f.rows, "rows below its heads"),
    Quantity("sha256", lambda f: f.sha256, "SHA-256 of its contents"),
    Quantity("copied", lambda f: f.copied, "rows that repeat another one to the last digit"),
)
REJECTED: Record[Comparisons] = Record(
    "A comparison that Chauvenet's criterion takes out, and where it stands.",
    Quantity("file", lambda c: [c.file.file] * c.series.rejected, "path of its table"),
    Quantity("line", lambda c: c.lines[c.series.gone], "line in this file"),
    Quantity("reading_deg", lambda c: c.series.angle[np.nonzero(c.series.gone)[0]], "reading", decimals=6),
    Quantity("from_mean_arcsec", lambda c: c.series.from_mean[c.series.gone], "minus the mean", "from the mean", 3),
)
FIT: Record[tuple[TurntableRun, str]] = Record(
    "One fit of the dividing error; the source is the run and the fit's name.",
    Quantity("heldout_rms_arcsec", lambda s: s[0].held_out_rms(s[1]), "RMS residual at the held-out readings"),
    Quantity("train_rms_arcsec", lambda s: rms(s[0].residual(s[1])), "RMS residual at the calibrated readings"),
    Quantity("cross_validation_rms_arcsec", lambda s: s[0].choice[s[1]].validation.rms, "RMS at readings left out"),
    Quantity("effective_parameters", lambda s: s[0].fits[s[1]].effective_parameters, "trace of the smoothing matrix"),
    Quantity("settings", lambda s: s[0].fits[s[1]].settings, "what was selected: order, period, smoothing, trainings"),
)
COMPENSATION: Record[DividingCompensation] = Record(
    "What a compensated angle is wrong by beside the calibration's noise: one sigma of each part.",
    Quantity("common_arcsec", lambda c: c.common, "a constant, the same at all readings"),
    Quantity("smooth_arcsec", lambda c: c.smooth, "misfit along the curve, correlated over one step"),
    Quantity("white_arcsec", lambda c: c.white, "misfit of each reading by itself"),
)
TRUE_FIT: Record[Any] = Record(
    "A fit minus the true curve.",
    Quantity("true_rms_arcsec", rms, "RMS difference"),
    Quantity("true_spread_arcsec", np.std, "RMS difference without a constant, which differences of angles do not see"),
)
TRUTH: Record[TurntableRun] = Record(
    "What no test in a laboratory has.",
    Quantity("fits", lambda r: {n: r.true_residual(n) for n in r.fits}, "name -> fit minus truth", record=TRUE_FIT),
    Quantity("dividing_error_spread_arcsec", lambda r: np.std(r.true_error), "RMS of the true curve about its mean"),
    Quantity("part_rms_full_circle_arcsec", lambda r: _parts(r), "cause -> RMS of its error over the full circle"),
)
_Points: TypeAlias = tuple[TurntableRun, CalibrationSeries]
POINTS: Record[_Points] = Record(
    "One reading and its comparisons with the reference, reading minus reference.",
    Quantity("reading_deg", lambda s: s[1].angle, "reading of the table"),
    Quantity("mean_arcsec", lambda s: s[1].mean, "mean of the comparisons that are kept"),
    Quantity("mean_arcsec_sigma", lambda s: s[1].sigma, "standard deviation of this mean"),
    Quantity("rms_before_arcsec", lambda s: s[1].rms_before, "RMS scatter of all comparisons"),
    Quantity("rms_after_arcsec", lambda s: s[1].rms_after, "RMS scatter of the comparisons that are kept"),
    Quantity("comparisons_arcsec", lambda s: _each(s[1], s[1].comparisons), "all comparisons"),
    Quantity("kept", lambda s: _each(s[1], s[1].keep), "whether Chauvenet's criterion keeps each comparison"),
    Quantity("fitted_arcsec", lambda s: _fitted(*s), "fit -> dividing error by it"),
)


def _each(series: CalibrationSeries, values: Any) -> list[Any]:
    """Values (N, repeats) of a series, reading by reading, without those of comparisons that were not made."""
    return [row[taken] for row, taken in zip(values, series.taken, strict=True)]


def _fitted(run: TurntableRun, series: CalibrationSeries) -> list[dict[str, float]]:
    """Fit -> dividing error, at every reading of a series, radians."""
    values = {name: fit(series.angle) for name, fit in run.fits.items()}
    return [dict(zip(values, row, strict=True)) for row in zip(*values.values(), strict=True)]


def _parts(run: TurntableRun) -> dict[str, float]:
    return {} if run.model is None else {name: part.rms for name, part in run.model.error.parts.items()}


def rejected_rows(tables: tuple[Comparisons, ...]) -> list[dict[str, Any]]:
    """Rows of `REJECTED` of all tables that were read."""
    return [row for table in tables for row in REJECTED.rows(table)]


TURNTABLE: Record[TurntableRun] = Record(
    "turntable.json.",
    Quantity("name", lambda r: r.spec.name, "name of the test"),
    Quantity("seed", lambda r: r.seed, "seed of all that was drawn"),
    Quantity("repeat_rms_arcsec", lambda r: np.max(r.series.rms_before), "largest RMS of the repeats at a reading"),
    Quantity("chauvenet_rms_arcsec", lambda r: np.max(r.series.rms_after), "the largest of those that are kept"),
    Quantity("averaging_alone_rms_arcsec", lambda r: r.series.averaging_alone, "largest RMS of a mean of all"),
    Quantity("mean_rms_arcsec", lambda r: r.series.mean_rms, "largest RMS of a mean of what is kept"),
    Quantity(
        "repeatability_arcsec", lambda r: r.series.repeatability, "sigma of one comparison, all readings together"
    ),
    Quantity("rejected", lambda r: r.series.rejected, "comparisons that Chauvenet's criterion takes out"),
    Quantity("rejected_expected_of_good", lambda r: expected_rejections(r.series.counts), "average if all were good"),
    Quantity("suspect_angles", lambda r: np.sum(r.series.suspect), "readings that still scatter after the criterion"),
    Quantity("heldout_arcsec_sigma", lambda r: r.held_out and rms(r.held_out.sigma), "RMS sigma of the held-out means"),
    Quantity("fits", lambda r: {n: (r, n) for n in r.fits}, "name -> fit", record=FIT),
    Quantity("failed", lambda r: r.choice.failed, "name of a fit -> why it failed"),
    Quantity("chosen", lambda r: r.choice.chosen, "fit that cross-validation chooses"),
    Quantity("ranking", lambda r: r.ranking, "fits by their RMS at held-out readings or cross-validation, best first"),
    Quantity("compensation", lambda r: r.compensation, "of the chosen fit", record=COMPENSATION),
    Quantity("points", lambda r: POINTS.rows((r, r.series)), "calibrated readings"),
    Quantity("heldout_points", lambda r: POINTS.rows((r, r.held_out)) if r.held_out else [], "held-out readings"),
    Quantity("fit_chi_square", lambda r: r.chi_square[0], "of the chosen fit against the sigmas of the means"),
    Quantity("fit_degrees_of_freedom", lambda r: r.chi_square[1], "means minus effective parameters"),
    Quantity("heldout_chi_square", lambda r: r.held_out_chi_square[0], "against all that the compensation states"),
    Quantity("heldout_degrees_of_freedom", lambda r: r.held_out_chi_square[1], "number of held-out readings"),
    Quantity("heldout_agrees", lambda r: r.held_out and likely(*r.held_out_chi_square), "whether that is likely"),
    Quantity(
        "rejected_readings", lambda r: rejected_rows(r.tables) if r.tables else None, "in files", where_known=True
    ),
    Quantity(
        "too_few_angles_for", lambda r: r.too_few if r.tables else None, "fits that were left out", where_known=True
    ),
    Quantity(
        "files", lambda r: [t.file for t in r.tables] or None, "that were read", record=DATA_FILE, where_known=True
    ),
    Quantity("truth", lambda r: r.model and r, "of a simulated table", record=TRUTH, where_known=True),
)
