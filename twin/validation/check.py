"""One check of a paper: what is printed, what the simulation gives, and the verdict that follows from the two."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

Verdict = Literal["confirmed", "confirmed with correction", "refuted", "not checkable", "failed"]
CONFIRMED: Verdict = "confirmed"
CORRECTED: Verdict = "confirmed with correction"
REFUTED: Verdict = "refuted"
NOT_CHECKABLE: Verdict = "not checkable"
FAILED: Verdict = "failed"
VERDICTS: dict[Verdict, str] = {
    CONFIRMED: "The simulation gives the printed value within the check's tolerance plus three sigma.",
    CORRECTED: "It does not, and it does give the value that follows when a named fault, gap or ambiguity of what is "
    "printed is put right; the correction stands beside it.",
    REFUTED: "It does not, and no correction of the print would make it do so: the statement does not hold for the "
    "simulated instrument, or the cause is not known. What was found stands beside it.",
    NOT_CHECKABLE: "The text does not print what a comparison needs; the reason stands beside it.",
    FAILED: "The check could not be computed; this says nothing about the paper.",
}
"""The verdicts and what they mean."""

SIGMAS = 3.0
"""The noise allowance of a comparison, in standard deviations of the measured value."""

PAPERS = {
    "000": "Liu and Huang, Infrared and Laser Engineering 43(10) (2014)",
    "001": "Wang et al., Acta Photonica Sinica 47(10) 1012001 (2018), doi 10.3788/gxzb20184710.1012001",
    "003": "Mo et al. (2015), doi 10.3969/J.ISSN.1672-7274.2015.06.003",
    "004": "Li et al., Infrared and Laser Engineering, doi 10.3788/IRLA20200143",
}
"""The source papers by the number that the ids begin with."""

Comparison = Literal["equal", "at most", "at least"]


@dataclass(frozen=True)
class CheckResult:
    """What a check found; exactly these are the keys in JSON.

    Attributes:
        id: dotted, beginning with the paper's number.
        paper: the paper's number.
        equation: where it is printed: equation, table or section.
        statement: what the paper says, in one sentence.
        printed: the paper's number; None where it prints none.
        measured: the simulation's number; None when it failed or nothing can be compared.
        sigma: standard deviation of ``measured``; None where there is no noise.
        unit: of the three numbers; "1" for a ratio.
        verdict: one of VERDICTS.
        how: lines: how it was measured; the reason, unless it is confirmed; the comparison that makes the verdict.
        seconds: computing time since the group's result before; the first one holds the work that all share.
    """

    id: str
    paper: str
    equation: str
    statement: str
    printed: float | None
    measured: float | None
    sigma: float | None
    unit: str
    verdict: Verdict
    how: str
    seconds: float

    def __post_init__(self) -> None:
        """Check that a reader, and JSON, can take it."""
        if self.verdict not in VERDICTS:
            raise ValueError(f"{self.id}: no verdict {self.verdict!r}; there are {', '.join(VERDICTS)}")
        for name in ("printed", "measured", "sigma", "seconds"):
            value = getattr(self, name)
            if value is None:
                continue
            if not math.isfinite(value):
                raise ValueError(f"{self.id}: {name} must be finite, found {value!r}")
            object.__setattr__(self, name, float(value))
        if (self.sigma is not None and self.sigma < 0) or self.seconds < 0:
            raise ValueError(f"{self.id}: sigma and seconds cannot be negative")
        if (self.measured is None) != (self.verdict in (FAILED, NOT_CHECKABLE)):
            raise ValueError(
                f"{self.id}: a measured value goes with every verdict but {FAILED!r} and {NOT_CHECKABLE!r}, and with "
                "no other"
            )

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self)

    def timed(self, seconds: float) -> CheckResult:
        """The same with its computing time."""
        return replace(self, seconds=seconds)


@dataclass(frozen=True)
class Explanation:
    """A value that the check would give for a known reason other than the printed one.

    Attributes:
        value: what the measurement should then be, in the check's unit.
        verdict: CORRECTED if the reason is a fault, a gap or an ambiguity of the print, else REFUTED.
        text: the reason, a sentence.
    """

    value: float
    verdict: Verdict
    text: str

    def __post_init__(self) -> None:
        """Only these two can be explained."""
        if self.verdict not in (CORRECTED, REFUTED):
            raise ValueError(f"an explanation is of {CORRECTED!r} or {REFUTED!r}, not of {self.verdict!r}")


@dataclass(frozen=True)
class Check:
    """What is to be checked, known before anything is computed, so that no tolerance can follow its result.

    Attributes:
        id: dotted, beginning with the paper's number, for instance ``001.table3.centroid``.
        equation: where it is printed, for instance ``eq. (5)``.
        statement: what the paper says, in one sentence.
        unit: of printed, measured and tolerance; "1" for a ratio.
        printed: the paper's number; None where it prints none.
        tolerance: how far apart printed and measured may be and still agree, without the noise.
        because: why that tolerance.
        comparison: ``equal``, or what the paper claims of the measured value: ``at most`` or ``at least`` the printed.
        expected: the verdict that is known from earlier work; any other one is reported and fails the command.
    """

    id: str
    equation: str
    statement: str
    unit: str
    printed: float | None
    tolerance: float
    because: str
    comparison: Comparison = "equal"
    expected: Verdict = CONFIRMED

    def __post_init__(self) -> None:
        """Refuse ids that nobody can select and tolerances that are none."""
        parts = self.id.split(".")
        if parts[0] not in PAPERS or len(parts) < 2 or not all(p and p.replace("_", "").isalnum() for p in parts):
            raise ValueError(f"check id {self.id!r} must be a paper ({', '.join(PAPERS)}) and names, joined by dots")
        if not (math.isfinite(self.tolerance) and self.tolerance >= 0):
            raise ValueError(f"{self.id}: the tolerance must be finite and >= 0, found {self.tolerance!r}")
        if self.expected not in VERDICTS or self.expected == FAILED:
            raise ValueError(f"{self.id}: {self.expected!r} is no verdict to expect")

    @property
    def paper(self) -> str:
        """The paper's number."""
        return self.id.partition(".")[0]

    def judge(
        self,
        measured: float,
        sigma: float | None,
        how: str,
        expected: float | None = None,
        explanations: Sequence[Explanation] = (),
    ) -> CheckResult:
        """The result, with the verdict that the numbers give.

        It is confirmed if ``measured`` is the printed value within ``tolerance`` + 3 ``sigma``; else the first
        explanation whose value it is within the same limit gives verdict and reason; else it is refuted for no known
        reason.

        Args:
            measured: the simulation's number.
            sigma: its standard deviation, None without noise.
            how: how it was measured and what else was found, in sentences.
            expected: what the paper's statement implies, where it prints no number.
            explanations: values that known reasons would give, the likeliest first.

        Raises:
            ValueError: a number is not finite, or there is nothing to compare with.
        """
        measured, noise = float(measured), SIGMAS * float(sigma or 0.0)
        goal = self.printed if self.printed is not None else expected
        if goal is None:
            raise ValueError(f"{self.id}: the paper prints no number, so judge() needs `expected`")
        if not (math.isfinite(measured) and math.isfinite(noise) and math.isfinite(goal)):
            raise ValueError(f"{self.id}: measured {measured!r} with sigma {sigma!r} against {goal!r} is no comparison")
        verdict, reason = self._verdict(measured, float(goal), self.tolerance + noise, explanations)
        name = "printed" if self.printed is not None else f"implied ({goal:.6g})"
        sign = {"equal": "±", "at most": "up to +", "at least": "down to -"}[self.comparison]
        limit = f"Measured minus {name}: {measured - goal:+.3g}; allowed {sign}{self.tolerance + noise:.3g}"
        limit += f", that is {self.tolerance:.3g} ({self.because})" + (" + 3 sigma." if noise else ".")
        weak = " The noise exceeds the tolerance: a weak check." if noise > self.tolerance else ""
        text = "\n".join(part for part in (how, reason, limit + weak) if part)
        return self._result(measured, sigma, verdict, text)

    def failed(self, why: str) -> CheckResult:
        """The result when it could not be computed."""
        return self._result(None, None, FAILED, f"Could not be computed: {why}")

    def not_checkable(self, why: str) -> CheckResult:
        """The result where the text does not print what a comparison needs."""
        return self._result(None, None, NOT_CHECKABLE, why)

    def _verdict(
        self, measured: float, goal: float, allowed: float, explanations: Sequence[Explanation]
    ) -> tuple[Verdict, str]:
        distance = measured - goal
        outside = {"equal": abs(distance), "at most": distance, "at least": -distance}[self.comparison]
        if outside <= allowed:
            return CONFIRMED, ""
        for reason in explanations:
            if abs(measured - reason.value) <= allowed:
                return reason.verdict, f"{reason.text} That gives {reason.value:.6g}."
        tried = ", ".join(f"{e.value:.6g}" for e in explanations)
        return REFUTED, f"The cause is not known{f'; what was thought of gives {tried}' if tried else ''}."

    def _result(self, measured: float | None, sigma: float | None, verdict: Verdict, how: str) -> CheckResult:
        return CheckResult(
            id=self.id,
            paper=self.paper,
            equation=self.equation,
            statement=self.statement,
            printed=self.printed,
            measured=measured,
            sigma=sigma,
            unit=self.unit,
            verdict=verdict,
            how=how,
            seconds=0.0,
        )
