"""Check of a paper's statement: the statement, the value from the simulation, and the verdict.

A check is a row of the validation's table and of the paper's YAML file. An input that the paper does not print and that
was therefore chosen here is reported with the range over which the verdict does not change.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from operator import itemgetter
from string import Formatter
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from analysis.arrays import ARCMIN, ARCSEC
from analysis.statistics import rms
from optics.numerics.number_tree import FrozenMap
from scenes.yaml.errors import Problem, shown
from scenes.yaml.spec import Number, Spec, Text
from twin.framework.artefact import plain, significant
from twin.validation.row_names import REAL

FARTHEST = 100.0
"""Largest factor on an input, chosen because the paper does not print it, up to which the limit of its range is
searched.
"""
_STEP = 1.1
"""Ratio of one trial value of a chosen input to the one before, in the search for the limit of its range."""
_HALVINGS = 20
"""Number of bisections that locate the limit of an input's range.

An interval of a factor 1.1 is narrowed to 2^-20 of it, far below the two digits shown.
"""


@dataclass(frozen=True)
class InputRange:
    """Chosen input of a check, with the range over which the verdict stays the same.

    All other inputs are fixed.

    Attributes
    ----------
    name : str
        Name of the input.
    value : float or None
        Chosen value; None if it is not a number.
    unit : str
        Unit of the numbers; "1" for a factor.
    low, high : float or None
        Limits of the range; None if there is none within a factor of `FARTHEST`, or if the check does not agree.
    agrees : bool
        True if the simulation agrees with the paper's statement.
    alternatives : str
        Other choices for which they agree, if the input is not a number.
    """

    name: str
    value: float | None
    unit: str
    low: float | None
    high: float | None
    agrees: bool
    alternatives: str = ""

    @property
    def text(self) -> str:
        """Text for the report: the chosen value, and the limits of its range to two digits."""
        if self.value is None:
            return f"{self.name}, {self.alternatives}"
        unit = "" if self.unit == "1" else f" {self.unit}"
        if not self.agrees:
            return f"{self.name} {plain(self.value, 4)}{unit}"
        if self.low is not None and self.high is not None:
            limits = f"from {_two(self.low)} to {_two(self.high)}{unit}"
        elif self.high is not None:
            limits = f"up to {_two(self.high)}{unit}"
        else:
            limits = "whatever it is" if self.low is None else f"from {_two(self.low)}{unit}"
        return f"{self.name} {plain(self.value, 4)}{unit}, holds {limits}"


def _two(value: float) -> str:
    """Return a number as text with two significant digits and without an exponent."""
    return significant(value, 2, floor=0.0)


@dataclass(frozen=True)
class Chosen:
    """Numerical input of a check that was chosen here, with the dependence of the simulated value on it.

    Attributes
    ----------
    name : str
        Name of the input, a phrase.
    value : float
        Chosen value, not zero.
    unit : str
        Unit of the value.
    response : callable
        Function from a factor on the input to the simulated value, in the unit of the check.
    """

    name: str
    value: float
    unit: str
    response: Callable[[float], float]

    @classmethod
    def power(cls, name: str, value: float, unit: str, measured: float, exponent: float = 1.0) -> Chosen:
        """Return an input on which the simulated value depends as a power; exponent 1 for simple proportionality."""
        return cls(name, value, unit, lambda factor: measured * factor**exponent)

    def range(self, confirms: Callable[[float], bool], agrees: bool) -> InputRange:
        """Return the range of the input over which the simulation agrees with the paper's statement.

        Parameters
        ----------
        confirms : callable
            Function that returns True if a simulated value agrees.
        agrees : bool
            True if the simulated value of the check agrees; otherwise no limits are searched.
        """
        low = high = None
        if agrees:
            low, high = (self._limit(confirms, step) for step in (1.0 / _STEP, _STEP))
        low, high = (None if end is None else self.value * end for end in (low, high))
        return InputRange(self.name, self.value, self.unit, low, high, agrees)

    def _limit(self, confirms: Callable[[float], bool], step: float) -> float | None:
        """Return the factor on the input at which the check begins to fail; None if it does not fail.

        ``step`` is the ratio between two trial values.
        """
        inside, outside = 1.0, step
        while confirms(self.response(outside)):
            if not 1.0 / FARTHEST <= outside <= FARTHEST:
                return None
            inside, outside = outside, outside * step
        for _ in range(_HALVINGS):
            middle = 0.5 * (inside + outside)
            inside, outside = (middle, outside) if confirms(self.response(middle)) else (inside, middle)
        return inside


@dataclass(frozen=True)
class Supposed:
    """Input of a check that was chosen here and is not a number.

    Attributes
    ----------
    name : str
        Name of the input with the choice, a phrase.
    alternatives : str
        Other choices for which the simulation agrees with the statement, determined by trying them.
    """

    name: str
    alternatives: str

    def range(self, confirms: Callable[[float], bool], agrees: bool) -> InputRange:
        """Return this choice as an input without limits of a range, because it is not a number."""
        return InputRange(self.name, None, "1", None, None, agrees, self.alternatives)


def mean_of(values: NDArray[Any]) -> tuple[float, float]:
    """Return the mean of (n,) independent measurements, n > 1, and its standard deviation from their scatter."""
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))


def median_of(values: NDArray[Any]) -> tuple[float, float]:
    """Return the median of (n,) independent measurements, n > 1, and its standard deviation for a normal scatter."""
    return float(np.median(values)), float(np.sqrt(0.5 * np.pi / len(values)) * np.std(values, ddof=1))


_UNITS = {
    "arcsec": ARCSEC, "arcmin": ARCMIN, "deg": np.pi / 180.0, "km": 1e3, "mm": 1e-3, "µm": 1e-6, "nm": 1e-9, "%": 0.01,
    "ppm": 1e-6,
}  # fmt: skip
_STATISTICS: Mapping[str, Callable[[Any], Any]] = {
    "abs": np.abs, "count": len, "last": itemgetter(-1), "max": np.max, "mean": np.mean, "median": np.median,
    "min": np.min, "minus": np.negative, "rms": rms, "sd": lambda values: np.std(values, ddof=1), "sum": np.sum,
}  # fmt: skip


class _Sentences(Formatter):
    """Formatter that inserts computed values into the texts of ``printed.yaml``."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """Format a value for a text.

        The format may name statistics and a unit before the digits; they are applied first. The values of a mapping get
        their names.
        """
        *words, digits = format_spec.split(" ")
        for word in words:
            if isinstance(value, Mapping) and word in _UNITS:
                value = {name: item / _UNITS[word] for name, item in value.items()}
                continue
            value = list(value.values()) if isinstance(value, Mapping) else value
            value = _STATISTICS[word](value) if word in _STATISTICS else np.asarray(value) / _UNITS[word]
        if isinstance(value, Mapping):
            return ", ".join(f"{name} {item:{digits}}" for name, item in value.items())
        if isinstance(value, list | tuple | np.ndarray):
            return ", ".join(format(item, digits) for item in value)
        return format(value, digits)


def sentence(text: str, facts: Mapping[str, Any]) -> str:
    """Return a text of ``printed.yaml`` with computed values (facts) inserted.

    Parameters
    ----------
    text : str
        Text with facts in braces as for `str.format`. Statistics and a unit may precede the digits, separated by
        spaces: ``{error:abs max arcsec .3f}`` is the largest absolute value of an SI array in arcseconds. Several
        values are listed, those of a mapping with their names.
    facts : mapping of str to object
        Facts by name.
    """
    return _Sentences().vformat(text, (), facts)


Verdict = Literal[
    "confirmed", "reproduced", "consistent", "confirmed with correction", "refuted", "undecided", "not checkable",
    "failed", "skipped",
]  # fmt: skip
CONFIRMED: Verdict = "confirmed"
REPRODUCED: Verdict = "reproduced"
CONSISTENT: Verdict = "consistent"
CORRECTED: Verdict = "confirmed with correction"
REFUTED: Verdict = "refuted"
UNDECIDED: Verdict = "undecided"
NOT_CHECKABLE: Verdict = "not checkable"
FAILED: Verdict = "failed"
SKIPPED: Verdict = "skipped"
VERDICTS: dict[Verdict, str] = {
    CONFIRMED: "The simulation gives the printed value or finds the printed statement to hold, within the check's "
    "tolerance plus three sigma, with inputs that were not chosen for it: it could have failed.",
    REPRODUCED: "It gives the printed value or finds the statement to hold with inputs that the paper does not print "
    "and that were chosen here. They are listed, with the range of each within which the row agrees.",
    CONSISTENT: "The paper prints no value: the simulation agrees with the theory that the row names.",
    CORRECTED: "It does not agree with the print, but with the value that follows when a named fault, gap or ambiguity "
    "of the print is corrected; the correction is given.",
    REFUTED: "It does not agree, and no correction of the print makes it agree: the statement does not hold for "
    "the simulated instrument, or the cause is not known. The finding is given.",
    UNDECIDED: "It agrees, but tolerance plus three sigma exceed the distance of the alternative: a wrong statement "
    "would have passed as well.",
    NOT_CHECKABLE: "The paper does not print what a comparison needs; the reason is given.",
    FAILED: "The check could not be computed; this says nothing about the paper.",
    SKIPPED: "The measured data that the row needs are absent.",
}
"""Verdict of a check -> its meaning in words."""

SIGMAS = 3.0
"""Noise allowance of a comparison, in standard deviations of the measured value."""

PAPERS = {
    "000": "Liu and Huang, Infrared and Laser Engineering 43(10) (2014)",
    "001": "Wang et al., Acta Photonica Sinica 47(10) 1012001 (2018), doi 10.3788/gxzb20184710.1012001",
    "003": "Mo et al. (2015), doi 10.3969/J.ISSN.1672-7274.2015.06.003",
    "004": "Li et al., Infrared and Laser Engineering, doi 10.3788/IRLA20200143",
    "017": "Wang Renxiang, Acta Geodaetica et Cartographica Sinica 46(3) 332 (2017)",
    REAL: "Measured data of other projects, and what they print of it",
}
"""Number of each source paper, or `REAL` -> its citation."""

Comparison = Literal["two-sided", "at most", "at least"]
Basis = Literal["printed", "chosen", "theory"]
AGREED: dict[Basis, Verdict] = {"printed": CONFIRMED, "chosen": REPRODUCED, "theory": CONSISTENT}
"""Basis of a check -> verdict if simulation and statement agree.

The basis is a printed value that could have failed, a printed value with inputs chosen here, or a theory where the
paper prints nothing.
"""


@dataclass(frozen=True)
class CheckResult:
    """Result of a check; its attributes are the keys in JSON.

    Attributes
    ----------
    id : str
        Dotted id that begins with the paper's number.
    also : tuple of str
        Further ids of the same check.
    paper : str
        Number of the paper.
    equation : str
        Equation, table or section where it is printed.
    statement : str
        Statement of the paper, in one sentence.
    printed : float or None
        Number that the paper prints; None if it prints none.
    implied : float or None
        Number that the statement implies, if none is printed.
    measured : float or None
        Number from the simulation; None if it failed or nothing can be compared.
    sigma : float or None
        Standard deviation of ``measured``; None if there is no noise.
    unit : str
        Unit of all these numbers; "1" for a ratio.
    tolerance : float
        Largest difference of printed or implied number and ``measured`` that counts as agreement, without the noise.
    comparison : {"two-sided", "at most", "at least"}
        Sides that are tested; a one-sided check accepts any value on the other side.
    because : str
        Reason of the tolerance, a phrase.
    power : float or None
        Tolerance + 3 sigma: the smallest error of the statement that the check would have detected. An error of this
        size is detected half the time, one that is 3 sigma larger practically always. None if nothing is compared.
    tells : float or None
        Distance from the printed statement to the alternative one, which the check must be able to distinguish.
    against : str
        The alternative statement, a phrase.
    theory : str
        Theory that the value is compared with if nothing is printed; else empty.
    inputs : tuple of InputRange
        Inputs chosen here, with their admissible ranges.
    verdict : Verdict
        One of VERDICTS.
    how : str
        Lines: the method; the reason, unless the statement is confirmed; the comparison that gives the verdict.
    seconds : float
        Computing time since the previous result of the group; the first one includes the work that all share.
    """

    id: str
    also: tuple[str, ...]
    paper: str
    equation: str
    statement: str
    printed: float | None
    implied: float | None
    measured: float | None
    sigma: float | None
    unit: str
    tolerance: float
    comparison: Comparison
    because: str
    power: float | None
    tells: float | None
    against: str
    theory: str
    inputs: tuple[InputRange, ...]
    verdict: Verdict
    how: str
    seconds: float

    def __post_init__(self) -> None:
        """Raise an error if a value of the result is not finite or does not fit the others."""
        if self.verdict not in VERDICTS:
            raise ValueError(f"{self.id}: no verdict {self.verdict!r}; there are {', '.join(VERDICTS)}")
        for name in ("printed", "implied", "measured", "sigma", "tolerance", "power", "tells", "seconds"):
            value = getattr(self, name)
            if value is None:
                continue
            if not math.isfinite(value):
                raise ValueError(f"{self.id}: {name} must be finite, found {value!r}")
            object.__setattr__(self, name, float(value))
        if (self.sigma is not None and self.sigma < 0) or self.seconds < 0:
            raise ValueError(f"{self.id}: sigma and seconds cannot be negative")
        if (self.measured is None) != (self.verdict in (FAILED, NOT_CHECKABLE, SKIPPED)):
            raise ValueError(
                f"{self.id}: a measured value goes with every verdict but {FAILED!r}, {NOT_CHECKABLE!r} and "
                f"{SKIPPED!r}, and with no other"
            )

    @property
    def claim(self) -> float | None:
        """Number with which the simulated one was compared: the printed or the implied number of the statement."""
        return self.implied if self.printed is None else self.printed

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain data for JSON."""
        return asdict(self) | {"also": list(self.also), "inputs": [asdict(i) for i in self.inputs]}


class Explanation(Spec):
    """Known reason why the simulated value differs from the one that the paper prints or implies.

    Attributes
    ----------
    verdict : {"confirmed with correction", "refuted"}
        CORRECTED if the reason is an error, a gap or an ambiguity of the print, else REFUTED.
    text : str
        Reason, with the facts that `Check.evaluate` receives; see `sentence`.
    """

    verdict: Literal["confirmed with correction", "refuted"]
    text: Text


class Check(Spec):
    """Check of the validation: a paper's statement, a tolerance with its reason, and the alternative to be excluded.

    A check is a row of the paper's ``printed.yaml``, fixed before anything is computed, so that no tolerance can be
    adapted to a result. `evaluate` compares the simulated value, with the inputs that were chosen for it, and gives the
    result.

    Attributes
    ----------
    id : str
        Dotted id that begins with the paper's number, for instance ``001.table3.centroid``.
    equation : str
        Place where it is printed, for instance ``eq. (5)``.
    statement : str
        Statement of the paper, in one sentence.
    unit : str
        Unit of printed value, simulated value and tolerance; "1" for a ratio.
    printed : float or None
        Number that the paper prints; None if it prints none.
    tolerance : float
        Largest difference of printed and simulated value that counts as agreement, without the noise.
    because : str
        Reason of the tolerance.
    comparison : {"two-sided", "at most", "at least"}
        ``two-sided`` if a difference to either side counts; ``at most`` or ``at least`` if the paper claims a limit, so
        that any value on the other side agrees.
    expected : Verdict
        Verdict known from earlier work; any other one is reported and fails the command. Agreement by default.
    tells : float or None
        Distance of the nearest alternative statement from this one, in the unit of the check; if tolerance plus noise
        exceed it, the check confirms nothing. None only if nothing can be compared.
    against : str
        The alternative statement, a phrase that completes "distinguished from".
    basis : {"printed", "chosen", "theory"}
        Basis of agreement, see AGREED; for ``chosen`` the inputs are passed to `evaluate`.
    theory : str
        Theory that agreement is based on, a phrase; the basis is then ``theory``.
    also : tuple of str
        Further ids of the same check, if one comparison tests two equations.
    not_checkable : str
        Reason why nothing can be compared; empty if something can.
    explanations : tuple of Explanation
        Known reasons for other values, the likeliest first; `evaluate` receives the values.
    otherwise : str
        Conclusion if neither the statement nor an explanation agrees.
    how : str
        Method of the simulation and further findings, with facts like the explanations.
    """

    id: Text
    equation: Text
    statement: Text
    unit: Text = "1"
    printed: Number | None = None
    tolerance: Annotated[Number, Field(ge=0.0)] = 0.0
    because: Text = "nothing is compared"
    comparison: Comparison = "two-sided"
    expected: Verdict
    tells: Annotated[Number, Field(gt=0.0)] | None = None
    against: Text = ""
    basis: Basis = "printed"
    theory: Text = ""
    also: tuple[Text, ...] = ()
    not_checkable: Text = ""
    explanations: tuple[Explanation, ...] = ()
    otherwise: Text = ""
    how: Text = ""

    @model_validator(mode="before")
    @classmethod
    def _follow(cls, row: Any) -> Any:
        """Fill in keys of a check that follow from others.

        They are the basis, which follows from a theory, and the expected verdict, which follows from the basis.
        """
        if not isinstance(row, dict):
            return row
        basis = row.get("basis", "theory" if row.get("theory") else "printed")
        agreed = NOT_CHECKABLE if row.get("not_checkable") else AGREED.get(basis, CONFIRMED)
        return {"basis": basis, "expected": agreed, **row}

    @model_validator(mode="after")
    def _can_separate(self) -> Check:
        """Raise an error for ids that cannot be selected, and for checks that cannot distinguish what they test."""
        for name in self.names:
            parts = name.split(".")
            if parts[0] not in PAPERS or len(parts) < 2 or not all(p and p.replace("_", "").isalnum() for p in parts):
                allowed = f"a paper ({', '.join(PAPERS)}) and names, joined by dots"
                raise Problem("not an id of a check", shown(name), allowed)
        if self.expected == FAILED or (self.expected == NOT_CHECKABLE) != bool(self.not_checkable):
            allowed = "a verdict that the row can have; `not_checkable` says why nothing can be compared"
            raise Problem("no verdict to expect", shown(self.expected), allowed, within=("expected",))
        if self.not_checkable:
            return self
        if missing := {"tolerance", "because"} - self.model_fields_set:
            raise Problem(f"{sorted(missing)[0]!r} is missing", None, "tolerance: a number, and because: its reason")
        if self.tells is None or not self.against:
            raise Problem("what the row tells from what is missing", None, "tells: above 0, and against: a phrase")
        if self.tolerance > self.tells:
            raise Problem(
                "can never tell that", f"{self.tolerance:g}", f"at most {self.tells:g}", within=("tolerance",)
            )
        if (self.basis == "theory") != bool(self.theory) or (self.theory and self.printed is not None):
            allowed = "a theory where the row rests on one and nothing is printed"
            raise Problem("not what the row rests on", shown(self.theory), allowed, within=("theory",))
        return self

    @property
    def names(self) -> tuple[str, ...]:
        """All ids of the check, the main one first."""
        return (self.id, *self.also)

    @property
    def agreed(self) -> Verdict:
        """Verdict if the simulation agrees with the paper's statement."""
        return AGREED[self.basis]

    @property
    def paper(self) -> str:
        """Number of the paper, with which the check's id begins."""
        return self.id.partition(".")[0]

    def evaluate(
        self,
        measured: float,
        sigma: float | None = None,
        how: str = "",
        implied: float | None = None,
        explained: Sequence[float | None] = (),
        inputs: Sequence[Chosen | Supposed] = (),
        facts: Mapping[str, Any] = FrozenMap(),
    ) -> CheckResult:
        """Return the result of the check, with the verdict that the numbers give.

        The check agrees if ``measured`` is within ``tolerance`` + 3 ``sigma`` of the printed or implied value.
        Otherwise the first explanation whose value is within the same limit gives verdict and reason; if there is none,
        the statement is refuted. A limit above ``tells`` (the distance of the alternative statement) turns either
        agreement into ``undecided``.

        Parameters
        ----------
        measured : float
            Number from the simulation.
        sigma : float or None
            Its standard deviation; None without noise.
        how : str
            Text appended to the check's own ``how``.
        implied : float or None
            Number that the paper's statement implies, if it prints none.
        explained : sequence of float or None
            Values that the check's explanations would give, in their order; None for one that does not apply.
        inputs : sequence of Chosen or Supposed
            Inputs chosen here; required if the check's basis is ``chosen``.
        facts : mapping of str to object
            Facts that the check's texts name in braces, in addition to ``measured``.

        Returns
        -------
        CheckResult
            Result with its verdict.

        Raises
        ------
        ValueError
            A number is not finite, there is nothing to compare with, or inputs are missing.
        """
        measured, noise = float(measured), SIGMAS * float(sigma or 0.0)
        goal = self.printed if self.printed is not None else implied
        if goal is None:
            raise ValueError(f"{self.id}: the paper prints no number, so `evaluate` needs `implied`")
        if not (math.isfinite(measured) and math.isfinite(noise) and math.isfinite(goal)):
            raise ValueError(
                f"{self.id}: measured {measured!r}, sigma {sigma!r} and expected {goal!r} must be finite numbers"
            )
        if self.tells is None or (self.basis == "chosen") != bool(inputs):
            raise ValueError(f"{self.id}: it must say what it tells, and its inputs just where they are chosen")
        goal, allowed = float(goal), self.tolerance + noise
        facts = {**facts, "measured": measured, "sigma": sigma, "implied": implied}
        verdict, reason = self._verdict(measured, goal, allowed, explained, facts)
        agrees = verdict == self.agreed
        ranges = tuple(i.range(lambda value: self.outside(value, goal) <= allowed, agrees) for i in inputs)
        chosen = f"Chosen here: {'; '.join(r.text for r in ranges)}." if ranges else ""
        name = "printed" if self.printed is not None else f"implied ({goal:.6g})"
        sign = {"two-sided": "±", "at most": "up to +", "at least": "down to -"}[self.comparison]
        limit = f"Measured minus {name}: {measured - goal:+.3g}; allowed {sign}{allowed:.3g}, that is "
        limit += f"{self.tolerance:.3g} ({self.because})" + (" + 3 sigma." if noise else ".")
        if self.comparison != "two-sided":
            limit += f" One-sided: any value that is {'less' if self.comparison == 'at most' else 'more'} agrees."
        limit += f" The alternative, {self.against}, is {self.tells:.3g} away."
        text = "\n".join(part for part in (sentence(self.how, facts) + how, chosen, reason, limit) if part)
        result = self._result(measured, sigma, verdict, text)
        return replace(result, implied=None if self.printed is not None else goal, power=allowed, inputs=ranges)

    def worse(self, *results: CheckResult) -> CheckResult:
        """Return one of several results for a statement: the first with an unexpected verdict, else the first."""
        return next((r for r in results if r.verdict != self.expected), results[0])

    def failed(self, why: str) -> CheckResult:
        """Return the result of a check that could not be computed."""
        return self._result(None, None, FAILED, f"Could not be computed: {why}")

    def skipped(self, why: str) -> CheckResult:
        """Return the result of a check whose measured data are absent."""
        return self._result(None, None, SKIPPED, why)

    def without_comparison(self) -> CheckResult:
        """Return the result of a check for which the paper does not print what a comparison needs."""
        return self._result(None, None, NOT_CHECKABLE, self.not_checkable)

    def outside(self, measured: float, goal: float) -> float:
        """Return the distance of a value from the paper's number, positive where it disagrees.

        ``goal`` is the paper's number.
        """
        distance = measured - goal
        return {"two-sided": abs(distance), "at most": distance, "at least": -distance}[self.comparison]

    def _verdict(
        self, measured: float, goal: float, allowed: float, explained: Sequence[float | None], facts: Mapping[str, Any]
    ) -> tuple[Verdict, str]:
        assert self.tells is not None
        weak = (
            f"tolerance plus three sigma, {allowed:.3g}, exceed the distance of the alternative: {self.against} is "
            f"{self.tells:.3g} away and would have passed as well."
        )
        if self.outside(measured, goal) <= allowed:
            return (self.agreed, "") if allowed <= self.tells else (UNDECIDED, f"It agrees, but {weak}")
        known = [
            (value, reason)
            for value, reason in zip(explained, self.explanations[: len(explained)], strict=True)
            if value is not None
        ]
        for value, reason in known:
            if abs(measured - value) <= allowed:
                text = f"{sentence(reason.text, facts)} That gives {value:.6g}."
                if reason.verdict == CORRECTED and allowed > self.tells:
                    return UNDECIDED, f"{text} But {weak}"
                return reason.verdict, text
        tried = ", ".join(f"{value:.6g}" for value, _ in known)
        unknown = f"The cause is not known{f'; the known explanations give {tried}' if tried else ''}."
        return REFUTED, sentence(self.otherwise, facts) or unknown

    def _result(self, measured: float | None, sigma: float | None, verdict: Verdict, how: str) -> CheckResult:
        printed: dict[str, Any] = {name: getattr(self, name) for name in _OF_THE_ROW}
        return CheckResult(
            **printed, implied=None, measured=measured, sigma=sigma, power=None, inputs=(), verdict=verdict, how=how,
            seconds=0.0,
        )  # fmt: skip


_OF_THE_ROW = (
    "id", "also", "paper", "equation", "statement", "printed", "unit", "tolerance", "comparison", "because", "tells",
    "against", "theory",
)  # fmt: skip
"""Attributes of a check that its result repeats."""
