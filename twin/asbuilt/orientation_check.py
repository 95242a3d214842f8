"""Command ``camtwin asbuilt check``: orientation and sign of measured wavefronts, tested against the data.

A wavefront map may be mirrored, rotated or inverted in sign; the check finds which of sixteen orientations agree with
the instrument's other data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.arrays import UndeterminedError
from analysis.wavefront_maps.pupil_fit import Orientation, OrientationEvidence, orientation_evidence
from optics.numerics.array_math import PhysicalError
from optics.numerics.backend import Backend
from scenes.specs.asbuilt import AsBuiltSetup
from twin.asbuilt.asbuilt_bench import AsBuiltBench
from twin.asbuilt.measured_kinds import UNKNOWN_FOCUS, MeasuredKind, WavefrontReadings
from twin.asbuilt.wavefront_files import read_coefficients, specified_orientation
from twin.framework.artefact import Cell, Table
from twin.framework.procedure import Advance, silent
from twin.framework.record import Quantity, Record
from twin.framework.report import Report, Section, answer

FREE_FOCUS = 100.0 * UNKNOWN_FOCUS
"""Standard deviation, metres, so large that a focus with it counts as unknown before the measurement."""
ANOTHER, NONE = 3, 4
"""Exit codes if another orientation of the maps than the specified one explains the data, and if none does."""


@dataclass(frozen=True, eq=False)
class OrientationCheck:
    """Comparison of all sixteen orientations of measured wavefronts that share their Zernike terms.

    Attributes
    ----------
    setup : AsBuiltSetup
        Test with the measurements.
    names : tuple of str
        Names of the measurements.
    specified : Orientation
        Orientation specified in the file of the test.
    evidence : OrientationEvidence
        Chi-square and Bayesian evidence of every orientation.
    """

    setup: AsBuiltSetup
    names: tuple[str, ...]
    specified: Orientation
    evidence: OrientationEvidence

    @property
    def code(self) -> int:
        """Exit code: 0 if the specified orientation is not excluded."""
        if not self.evidence.allowed:
            return NONE
        return 0 if self.specified in self.evidence.indistinguishable else ANOTHER


def run_check(
    setup: AsBuiltSetup, backend: Backend, seed: int | None = None, advance: Advance = silent
) -> OrientationCheck:
    """Compare all sixteen orientations in which the wavefronts of a test may have been recorded.

    Parameters
    ----------
    setup : AsBuiltSetup
        Test with the measurements; known moves made between them discriminate best between orientations.
    backend : Backend
        Array backend of the ray trace.
    seed : int, optional
        Seed of a simulated instrument's errors.
    advance : Advance
        Callback that reports progress.

    Raises
    ------
    InputError
        There are no measured wavefronts, or they differ in their terms or orientations.
    """
    test = setup.test
    advance("readings", 0, 1)
    bench = AsBuiltBench(setup, backend)
    pairs = [(kind, after) for kind, after in zip(bench.kinds, bench.afters, strict=True)]
    wavefronts = [(kind, after) for kind, after in pairs if isinstance(kind, WavefrontReadings)]
    if not wavefronts:
        allowed = "at least one measurement under `wavefronts`"
        raise test.error(
            "no measured wavefronts whose orientation could be determined", ("measurements",), allowed=allowed
        )
    kinds, afters = [kind for kind, _ in wavefronts], [after for _, after in wavefronts]
    terms = tuple(kinds[0].spec.numbers)
    specified = specified_orientation(kinds[0])
    for kind in kinds[1:]:
        if tuple(kind.spec.numbers) != terms or specified_orientation(kind) != specified:
            raise kind.wrong("other terms or another orientation than the first wavefronts", "terms", "the same")
    if setup.test.simulate is None:
        data = [read_coefficients(kind, Orientation()) for kind in kinds]
    else:
        rng = np.random.default_rng(setup.test.simulate.seed if seed is None else seed)
        true = _exact_readings(bench, bench.draw(rng, setup.test.simulate.law), kinds, afters)
        drawn = [kind.drawn(values, rng) for kind, values in zip(kinds, true, strict=True)]
        # as a file would have them that lies as it says
        undone = specified.inverse
        data = [undone.coefficients(values.reshape(-1, len(terms)), terms) for values in drawn]
    prior = bench.parameters.prior
    mean = np.concatenate(_exact_readings(bench, prior.mean, kinds, afters))
    slope = bench.slope(prior.mean, kinds, afters) @ prior.root
    covariance = slope @ slope.T
    start = 0
    for kind in kinds:
        rows = slice(start, start + len(kind.labels))
        start = rows.stop
        columns, sigmas, _ = kind.biases()
        known = np.where(np.isinf(sigmas), FREE_FOCUS, sigmas)
        covariance[rows, rows] += kind.covariance() + (columns * known**2) @ columns.T
    try:
        evidence = orientation_evidence(np.concatenate(data), mean.reshape(-1, len(terms)), covariance, terms)
    except UndeterminedError as error:
        raise test.error(str(error), ("measurements",)) from error
    advance("readings", 1, 1)
    return OrientationCheck(setup, tuple(kind.name for kind in kinds), specified, evidence)


def _exact_readings(
    bench: AsBuiltBench, values: np.ndarray, kinds: Sequence[MeasuredKind], afters: Sequence[str | None]
) -> list[np.ndarray]:
    """Return the error-free readings of each measurement in a state; raise InputError if the light is lost.

    The state is given by the estimated parameters, ``values``.
    """
    out = []
    for kind, after in zip(kinds, afters, strict=True):
        try:
            out.append(kind.predict(bench.view(values[None], after))[0])
        except PhysicalError as error:
            where = "the instrument" if after is None else f"after the move {after} the instrument"
            raise kind.wrong(f"{where} has no light: {error}", "after", "smaller moves, or a narrower prior") from error
    return out


def _plain(orientation: Orientation) -> dict[str, Any]:
    return {"orientation": orientation.name, "sign": orientation.sign}


def _readings(check: OrientationCheck) -> list[dict[str, Any]]:
    evidence = check.evidence
    return [
        {
            **_plain(orientation),
            "chi_square": float(evidence.chi_square[k]),
            "p_value": float(evidence.p_value[k]),
            "log_evidence": float(evidence.log_evidence[k]),
            "allowed": orientation in evidence.allowed,
            "indistinguishable": orientation in evidence.indistinguishable,
        }
        for k, orientation in enumerate(evidence.readings)
    ]


ORIENTATION: Record[OrientationCheck] = Record(
    "orientation.json: orientation of measured wavefronts.",
    Quantity("measurements", lambda check: check.names, "measurements whose wavefronts share one orientation"),
    Quantity("stated", lambda check: _plain(check.specified), "orientation in the file"),
    Quantity("degrees", lambda check: check.evidence.degrees, "degrees of freedom"),
    Quantity("readings", _readings, "all sixteen orientations, the best first"),
)


def check_report(check: OrientationCheck) -> Report:
    """Return the report of a check: which orientations of the measured wavefronts the data allow."""
    verdict, more = answer(*_words(check))
    evidence = check.evidence
    rows: list[list[Cell]] = [
        [
            orientation.name,
            "+1" if orientation.sign > 0 else "\N{MINUS SIGN}1",
            float(evidence.chi_square[k]),
            float(evidence.p_value[k]),
            "yes" if orientation in evidence.allowed else "no",
            "yes" if orientation in evidence.indistinguishable else "no",
            "as specified" if orientation == check.specified else "",
        ]
        for k, orientation in enumerate(evidence.readings)
    ]
    heads = ("orientation", "sign", "chi-square", "p", "allowed", "indistinguishable", "")
    caption = (
        f"Chi-square of the coefficients against the prediction of prior and moves, for {evidence.degrees} degrees of "
        "freedom. Allowed: not rejected at the 1 % level. Indistinguishable: at most a hundred times less probable "
        "than the best."
    )
    table = Table("readings", "Orientations", caption, heads, rows, (None, None, 1, 4, None, None, None))
    facts = (("measurements", ", ".join(check.names)),)
    text = (
        "Deviations from the drawing may have either sign, so that several orientations can fit equally well. A known "
        "move of one part that causes coma or astigmatism discriminates between them.",
    )
    sections = (Section("How to discriminate", text, ()),)
    return Report("Orientation of wavefronts", verdict, more, facts, table, sections, code=check.code)


def _words(check: OrientationCheck) -> list[str]:
    evidence, specified = check.evidence, check.specified
    best = evidence.readings[0]
    if check.code == NONE:
        return ["No orientation of the wavefronts agrees with the prior and the moves: check fields, units and moves"]
    if evidence.determined is not None:
        same = "as specified" if best == specified else f"not {_text(specified)} as specified"
        return [f"The orientation of the wavefronts is {_text(best)}, {same}"]
    others = ", ".join(_text(orientation) for orientation in evidence.indistinguishable[1:])
    head = f"The data do not discriminate between {_text(best)} and {others}"
    if specified in evidence.indistinguishable:
        return [head, f"The specified orientation, {_text(specified)}, is among them"]
    return [head, f"The specified orientation, {_text(specified)}, is excluded"]


def _text(orientation: Orientation) -> str:
    return orientation.name if orientation.sign > 0 else f"{orientation.name} with reversed sign"
