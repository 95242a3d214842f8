"""Command ``camtwin asbuilt check``: orientation and sign of measured wavefronts, as far as the data determine them."""

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
from twin.asbuilt.wavefront_files import read_coefficients, stated_orientation
from twin.framework.artefact import Cell, Table
from twin.framework.procedure import Advance, silent
from twin.framework.record import Quantity, Record
from twin.framework.report import Report, Section, answer

FREE_FOCUS = 100.0 * UNKNOWN_FOCUS
"""Standard deviation that represents a free focus, metres."""
ANOTHER, NONE = 3, 4
"""Exit codes: another reading than the stated one explains the data; none does."""


@dataclass(frozen=True, eq=False)
class OrientationCheck:
    """Comparison of all sixteen orientations of measured wavefronts that share their Zernike terms.

    Attributes
    ----------
    setup : AsBuiltSetup
        Test with the measurements.
    names : tuple of str
        Names of the measurements.
    stated : Orientation
        Orientation specified in the file of the test.
    evidence : OrientationEvidence
        Chi-square and evidence of every orientation.
    """

    setup: AsBuiltSetup
    names: tuple[str, ...]
    stated: Orientation
    evidence: OrientationEvidence

    @property
    def code(self) -> int:
        """Exit code: 0 if the specified orientation is not excluded."""
        if not self.evidence.allowed:
            return NONE
        return 0 if self.stated in self.evidence.indistinguishable else ANOTHER


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
    own = [(kind, after) for kind, after in pairs if isinstance(kind, WavefrontReadings)]
    if not own:
        allowed = "at least one measurement under `wavefronts`"
        raise test.error("no wavefronts whose orientation could be told", ("measurements",), allowed=allowed)
    kinds, afters = [kind for kind, _ in own], [after for _, after in own]
    terms = tuple(kinds[0].spec.numbers)
    stated = stated_orientation(kinds[0])
    for kind in kinds[1:]:
        if tuple(kind.spec.numbers) != terms or stated_orientation(kind) != stated:
            raise kind.wrong("other terms or another orientation than the first wavefronts", "terms", "the same")
    if setup.test.simulate is None:
        data = [read_coefficients(kind, Orientation()) for kind in kinds]
    else:
        rng = np.random.default_rng(setup.test.simulate.seed if seed is None else seed)
        true = _lit(bench, bench.draw(rng, setup.test.simulate.law), kinds, afters)
        drawn = [kind.drawn(values, rng) for kind, values in zip(kinds, true, strict=True)]
        # as a file would have them that lies as it says
        undone = stated.inverse
        data = [undone.coefficients(values.reshape(-1, len(terms)), terms) for values in drawn]
    prior = bench.parameters.prior
    mean = np.concatenate(_lit(bench, prior.mean, kinds, afters))
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
    return OrientationCheck(setup, tuple(kind.name for kind in kinds), stated, evidence)


def _lit(
    bench: AsBuiltBench, values: np.ndarray, kinds: Sequence[MeasuredKind], afters: Sequence[str | None]
) -> list[np.ndarray]:
    """Return the error-free readings of each measurement in a state; raise InputError if the light is lost."""
    out = []
    for kind, after in zip(kinds, afters, strict=True):
        try:
            out.append(kind.predict(bench.view(values[None], after))[0])
        except PhysicalError as error:
            where = "the instrument" if after is None else f"after the move {after} the instrument"
            raise kind.wrong(f"{where} has no light: {error}", "after", "smaller moves, or a narrower prior") from error
    return out


def _plain(one: Orientation) -> dict[str, Any]:
    return {"orientation": one.name, "sign": one.sign}


def _readings(check: OrientationCheck) -> list[dict[str, Any]]:
    found = check.evidence
    return [
        {
            **_plain(one),
            "chi_square": float(found.chi_square[k]),
            "chance": float(found.chance[k]),
            "log_evidence": float(found.log_evidence[k]),
            "allowed": one in found.allowed,
            "like_the_best": one in found.indistinguishable,
        }
        for k, one in enumerate(found.readings)
    ]


ORIENTATION: Record[OrientationCheck] = Record(
    "orientation.json: which way round measured wavefronts lie.",
    Quantity("measurements", lambda check: check.names, "whose wavefronts share one reading"),
    Quantity("stated", lambda check: _plain(check.stated), "as the file says"),
    Quantity("degrees", lambda check: check.evidence.degrees, "of freedom"),
    Quantity("readings", _readings, "all sixteen, the best one first"),
)


def check_report(check: OrientationCheck) -> Report:
    """Return the report of a check of orientations."""
    told, more = answer(*_words(check))
    found = check.evidence
    rows: list[list[Cell]] = [
        [
            one.name,
            "+1" if one.sign > 0 else "\N{MINUS SIGN}1",
            float(found.chi_square[k]),
            float(found.chance[k]),
            "yes" if one in found.allowed else "no",
            "yes" if one in found.indistinguishable else "no",
            "stated" if one == check.stated else "",
        ]
        for k, one in enumerate(found.readings)
    ]
    heads = ("orientation", "sign", "chi-square", "chance", "allowed", "like the best", "")
    caption = (
        f"Chi-square of {found.degrees} degrees of freedom of the coefficients about what the prior and the moves "
        "predict. Allowed: not rejected at 1 %. Like the best: at most a hundred times less probable."
    )
    table = Table("readings", "Readings", caption, heads, rows, (None, None, 1, 4, None, None, None))
    facts = (("measurements", ", ".join(check.names)),)
    text = (
        "Parts may stand to either side of the drawing, so that wavefronts look alike in several readings. A known "
        "move of one part that makes coma or astigmatism tells them apart.",
    )
    sections = (Section("How to tell more", text, ()),)
    return Report("Orientation of wavefronts", told, more, facts, table, sections, code=check.code)


def _words(check: OrientationCheck) -> list[str]:
    found, stated = check.evidence, check.stated
    best = found.readings[0]
    if check.code == NONE:
        return ["No reading of the wavefronts agrees with the prior and the moves: look at fields, units and moves"]
    if found.found is not None:
        same = "as stated" if best == stated else f"and not {_text(stated)}, as stated"
        return [f"The wavefronts lie {_text(best)}, {same}"]
    others = ", ".join(_text(one) for one in found.indistinguishable[1:])
    head = f"The data do not tell {_text(best)} from {others}"
    if stated in found.indistinguishable:
        return [head, f"The stated reading, {_text(stated)}, is among them"]
    return [head, f"The stated reading, {_text(stated)}, is excluded"]


def _text(one: Orientation) -> str:
    return one.name if one.sign > 0 else f"{one.name} with the sign changed"
