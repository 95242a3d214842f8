"""One check of a paper: its statement, what the simulation gives, and the verdict."""

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
from optics.numerics.number_tree import FrozenMap
from scenes.yaml.errors import Problem, shown
from scenes.yaml.spec import Number, Spec, Text
from twin.framework.artefact import plain, significant

FARTHEST = 100.0
"""Factor on an input up to which its limit is looked for."""
_STEP = 1.1
_HALVINGS = 20


@dataclass(frozen=True)
class InputRange:
    """A chosen input and where the row stays as it is, all other inputs being what they are.

    Attributes
    ----------
    name : str
        What it is.
    value : float | None
        As chosen; None where it is no number.
    unit : str
        Of the numbers; "1" for a factor.
    low, high : float | None
        Limits; None where there is none within a factor of `FARTHEST`, or the row does not agree.
    agrees : bool
        Whether the row does.
    said : str
        Where else the row holds, where the input is no number.
    """

    name: str
    value: float | None
    unit: str
    low: float | None
    high: float | None
    agrees: bool
    said: str = ""

    @property
    def text(self) -> str:
        """For a reader: the value, and its limits to two digits."""
        if self.value is None:
            return f"{self.name}, {self.said}"
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
    """Two digits; an exponent would be noise."""
    return significant(value, 2, floor=0.0)


@dataclass(frozen=True)
class Chosen:
    """An input that was chosen, and how the measured value goes with it.

    Attributes
    ----------
    name : str
        What it is, a phrase.
    value : float
        As chosen, not zero.
    unit : str
        Of it.
    response : Callable[[float], float]
        What is measured, in the row's unit, when the input is so many times what it is.
    """

    name: str
    value: float
    unit: str
    response: Callable[[float], float]

    @classmethod
    def power(cls, name: str, value: float, unit: str, measured: float, exponent: float = 1.0) -> Chosen:
        """An input that the measured value goes with as its power: 1 where it is proportional to it."""
        return cls(name, value, unit, lambda factor: measured * factor**exponent)

    def range(self, holds: Callable[[float], bool], agrees: bool) -> InputRange:
        """Where a row stays as it is.

        Parameters
        ----------
        holds : Callable[[float], bool]
            Whether a measured value agrees.
        agrees : bool
            Whether that of the row does; if not, no limits are looked for.
        """
        low = high = None
        if agrees:
            low, high = (self._limit(holds, step) for step in (1.0 / _STEP, _STEP))
        low, high = (None if end is None else self.value * end for end in (low, high))
        return InputRange(self.name, self.value, self.unit, low, high, agrees)

    def _limit(self, holds: Callable[[float], bool], step: float) -> float | None:
        """Factor at which the row begins to fail, going by a step; None where it does not."""
        inside, outside = 1.0, step
        while holds(self.response(outside)):
            if not 1.0 / FARTHEST <= outside <= FARTHEST:
                return None
            inside, outside = outside, outside * step
        for _ in range(_HALVINGS):
            middle = 0.5 * (inside + outside)
            inside, outside = (middle, outside) if holds(self.response(middle)) else (inside, middle)
        return inside


@dataclass(frozen=True)
class Supposed:
    """A choice that is no number.

    Attributes
    ----------
    name : str
        What it is, a phrase with the choice.
    said : str
        Where else the row holds, found by trying.
    """

    name: str
    said: str

    def range(self, holds: Callable[[float], bool], agrees: bool) -> InputRange:
        """Range of this choice. It has no limits, because the choice is not a number."""
        return InputRange(self.name, None, "1", None, None, agrees, self.said)


def mean_of(values: NDArray[Any]) -> tuple[float, float]:
    """Mean of (n,) independent measurements, n > 1, and its standard deviation from their scatter."""
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))


def median_of(values: NDArray[Any]) -> tuple[float, float]:
    """Median of (n,) independent measurements, n > 1, and its standard deviation from their scatter, were it normal."""
    return float(np.median(values)), float(np.sqrt(0.5 * np.pi / len(values)) * np.std(values, ddof=1))


def rms(values: Any) -> float:
    """Root mean square of all of an array's values."""
    return float(np.sqrt(np.mean(np.square(values))))


_UNITS = {
    "arcsec": ARCSEC, "arcmin": ARCMIN, "deg": np.pi / 180.0, "km": 1e3, "mm": 1e-3, "µm": 1e-6, "nm": 1e-9, "%": 0.01,
    "ppm": 1e-6,
}  # fmt: skip
_STATISTICS: Mapping[str, Callable[[Any], Any]] = {
    "abs": np.abs, "count": len, "last": itemgetter(-1), "max": np.max, "mean": np.mean, "median": np.median,
    "min": np.min, "minus": np.negative, "rms": rms, "sd": lambda values: np.std(values, ddof=1), "sum": np.sum,
}  # fmt: skip


class _Sentences(Formatter):
    """Formatter of texts with facts, see `sentence`."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """Apply the words before the digits, and name each value of a mapping."""
        *words, digits = format_spec.split(" ")
        for word in words:
            if isinstance(value, Mapping) and word in _UNITS:
                value = {name: one / _UNITS[word] for name, one in value.items()}
                continue
            value = list(value.values()) if isinstance(value, Mapping) else value
            value = _STATISTICS[word](value) if word in _STATISTICS else np.asarray(value) / _UNITS[word]
        if isinstance(value, Mapping):
            return ", ".join(f"{name} {one:{digits}}" for name, one in value.items())
        if isinstance(value, list | tuple | np.ndarray):
            return ", ".join(format(one, digits) for one in value)
        return format(value, digits)


def sentence(text: str, facts: Mapping[str, Any]) -> str:
    """Return a text of ``printed.yaml`` with its facts.

    Parameters
    ----------
    text : str
        Facts stand in braces as for `str.format`. Before the digits may stand statistics and a unit, separated by
        spaces: ``{error:abs max arcsec .3f}`` is the largest size of an SI array's values in arcseconds. Several values
        are listed, those of a mapping with their names.
    facts : Mapping[str, Any]
        By name.
    """
    return _Sentences().vformat(text, (), facts)


Verdict = Literal[
    "confirmed", "reproduced", "consistent", "confirmed with correction", "refuted", "undecided", "not checkable",
    "failed",
]  # fmt: skip
CONFIRMED: Verdict = "confirmed"
REPRODUCED: Verdict = "reproduced"
CONSISTENT: Verdict = "consistent"
CORRECTED: Verdict = "confirmed with correction"
REFUTED: Verdict = "refuted"
UNDECIDED: Verdict = "undecided"
NOT_CHECKABLE: Verdict = "not checkable"
FAILED: Verdict = "failed"
VERDICTS: dict[Verdict, str] = {
    CONFIRMED: "The simulation gives the printed value or finds the printed statement to hold, within the check's "
    "tolerance plus three sigma, with inputs that were not chosen for it: it could have failed.",
    REPRODUCED: "It gives the printed value or finds the statement to hold with inputs that the paper does not print "
    "and that were chosen here. They stand beside it, with how far each may move before the row fails.",
    CONSISTENT: "The paper prints nothing of it: the simulation agrees with the theory that the row names.",
    CORRECTED: "It does not agree, and it does give the value that follows when a named fault, gap or ambiguity of "
    "what is printed is put right; the correction stands beside it.",
    REFUTED: "It does not agree, and no correction of the print would make it do so: the statement does not hold for "
    "the simulated instrument, or the cause is not known. What was found stands beside it.",
    UNDECIDED: "It agrees, but tolerance plus three sigma is more than what the row is to tell: a wrong statement "
    "would have passed as well.",
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
    "017": "Wang Renxiang, Acta Geodaetica et Cartographica Sinica 46(3) 332 (2017)",
}
"""The source papers by the number that the ids begin with."""

Comparison = Literal["two-sided", "at most", "at least"]
Basis = Literal["printed", "chosen", "theory"]
AGREED: dict[Basis, Verdict] = {"printed": CONFIRMED, "chosen": REPRODUCED, "theory": CONSISTENT}
"""What a row rests on -> its verdict where simulation and claim agree: a print that could have failed, a print with
inputs chosen here, or a theory beside which nothing is printed.
"""


@dataclass(frozen=True)
class CheckResult:
    """What a check found; exactly these are the keys in JSON.

    Attributes
    ----------
    id : str
        Dotted, beginning with the paper's number.
    also : tuple[str, ...]
        Further ids of the same row.
    paper : str
        The paper's number.
    equation : str
        Where it is printed: equation, table or section.
    statement : str
        What the paper says, in one sentence.
    printed : float | None
        The paper's number; None where it prints none.
    implied : float | None
        What the statement implies, where no number is printed.
    measured : float | None
        The simulation's number; None when it failed or nothing can be compared.
    sigma : float | None
        Standard deviation of ``measured``; None where there is no noise.
    unit : str
        Of all these numbers; "1" for a ratio.
    tolerance : float
        How far apart claim and measurement may be, without the noise.
    comparison : Comparison
        Two-sided, at most or at least; a row with one side takes whatever lies on the other.
    because : str
        Why that tolerance, a phrase.
    power : float | None
        Tolerance + 3 sigma: the smallest error of the statement that the row would have found. An error just so large
        is found half the time, one of 3 sigma more practically always. None where nothing is compared.
    tells : float | None
        How far away the other statement is that the row is to tell from the printed one.
    against : str
        That other statement, a phrase.
    theory : str
        With what it agrees, where nothing is printed; else empty.
    inputs : tuple[InputRange, ...]
        Chosen here, and how far each may move.
    verdict : Verdict
        One of VERDICTS.
    how : str
        Lines: how it was measured; the reason, unless it is confirmed; the comparison that makes the verdict.
    seconds : float
        Computing time since the group's result before; the first one holds the work that all share.
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
        """Check that a reader, and JSON, can take it."""
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
        if (self.measured is None) != (self.verdict in (FAILED, NOT_CHECKABLE)):
            raise ValueError(
                f"{self.id}: a measured value goes with every verdict but {FAILED!r} and {NOT_CHECKABLE!r}, and with "
                "no other"
            )

    @property
    def claim(self) -> float | None:
        """What was compared with: the printed or the implied number."""
        return self.implied if self.printed is None else self.printed

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self) | {"also": list(self.also), "inputs": [asdict(i) for i in self.inputs]}


class Explanation(Spec):
    """A known reason for a value other than the claimed one.

    Attributes
    ----------
    verdict : Literal['confirmed with correction', 'refuted']
        CORRECTED if the reason is a fault, a gap or an ambiguity of the print, else REFUTED.
    text : Text
        The reason, with the facts that `Check.evaluate` is given, see `sentence`.
    """

    verdict: Literal["confirmed with correction", "refuted"]
    text: Text


class Check(Spec):
    """A row: what a paper states and prints, a tolerance with its reason, the alternative that it has to be told from,
    and what agreement rests on. It stands in the paper's ``printed.yaml`` and is known before anything is computed, so
    that no tolerance can follow a result; `evaluate` compares what was measured, with the inputs that were chosen for
    it, and gives the result.

    Attributes
    ----------
    id : Text
        Dotted, beginning with the paper's number, for instance ``001.table3.centroid``.
    equation : Text
        Where it is printed, for instance ``eq. (5)``.
    statement : Text
        What the paper says, in one sentence.
    unit : Text
        Of printed, measured and tolerance; "1" for a ratio.
    printed : Number | None
        The paper's number; None where it prints none.
    tolerance : Number
        How far apart printed and measured may be and still agree, without the noise.
    because : Text
        Why that tolerance.
    comparison : Comparison
        ``two-sided``: off to either side counts; or what the paper claims of the measured value: ``at most`` or ``at
        least`` the printed, so that whatever lies on the other side agrees, however far away.
    expected : Verdict
        The verdict that is known from earlier work; any other one is reported and fails the command. By default that of
        agreement.
    tells : Number | None
        How far away the nearest other statement is that the row is to tell from this one, in its unit; with a tolerance
        plus noise above that it confirms nothing. None only where nothing can be compared.
    against : Text
        That other statement, a phrase that goes on "told from".
    basis : Basis
        What agreement rests on, see AGREED; the inputs of ``chosen`` are given to `evaluate`.
    theory : Text
        Which theory agreement rests on, a phrase; the basis is then ``theory``.
    also : tuple[Text, ...]
        Further ids of the same row, where one comparison is of two equations.
    not_checkable : Text
        Why nothing can be compared; empty where something can.
    explanations : tuple[Explanation, ...]
        Known reasons for other values, the likeliest first; `evaluate` is given the values.
    otherwise : Text
        What can be said where neither claim nor explanation agrees.
    how : Text
        How the number is measured and what else is found, with facts like the explanations.
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
        """What follows from other keys: a basis from a theory, the expected verdict from the basis."""
        if not isinstance(row, dict):
            return row
        basis = row.get("basis", "theory" if row.get("theory") else "printed")
        agreed = NOT_CHECKABLE if row.get("not_checkable") else AGREED.get(basis, CONFIRMED)
        return {"basis": basis, "expected": agreed, **row}

    @model_validator(mode="after")
    def _can_tell(self) -> Check:
        """Refuse ids that nobody can select and rows that cannot tell what they are for."""
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
        """All ids of the row, its own first."""
        return (self.id, *self.also)

    @property
    def agreed(self) -> Verdict:
        """The verdict where simulation and claim agree."""
        return AGREED[self.basis]

    @property
    def paper(self) -> str:
        """The paper's number."""
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
        """The result, with the verdict that the numbers give.

        It agrees if ``measured`` is the claimed value within ``tolerance`` + 3 ``sigma``; else the first explanation
        whose value it is within the same limit gives verdict and reason; else it is refuted. A limit above
        ``tells`` makes of either agreement ``undecided``.

        Parameters
        ----------
        measured : float
            The simulation's number.
        sigma : float | None
            Its standard deviation, None without noise.
        how : str
            What stands after the row's own ``how``.
        implied : float | None
            What the paper's statement implies, where it prints no number.
        explained : Sequence[float | None]
            Values that the row's explanations would give, in their order; None where one is no reason here.
        inputs : Sequence[Chosen | Supposed]
            Chosen here; needed where the row's basis is ``chosen``.
        facts : Mapping[str, Any]
            What the row's texts name in braces, beside ``measured``.

        Raises
        ------
        ValueError
            a number is not finite, there is nothing to compare with, or inputs are missing.
        """
        measured, noise = float(measured), SIGMAS * float(sigma or 0.0)
        goal = self.printed if self.printed is not None else implied
        if goal is None:
            raise ValueError(f"{self.id}: the paper prints no number, so `evaluate` needs `implied`")
        if not (math.isfinite(measured) and math.isfinite(noise) and math.isfinite(goal)):
            raise ValueError(f"{self.id}: {measured!r} with sigma {sigma!r} against {goal!r} is no comparison")
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
            limit += f" One-sided: whatever is {'less' if self.comparison == 'at most' else 'more'} agrees."
        limit += f" To be told from {self.against}, {self.tells:.3g} away."
        text = "\n".join(part for part in (sentence(self.how, facts) + how, chosen, reason, limit) if part)
        found = self._result(measured, sigma, verdict, text)
        return replace(found, implied=None if self.printed is not None else goal, power=allowed, inputs=ranges)

    def worse(self, *results: CheckResult) -> CheckResult:
        """The result of a statement in several forms: the first that is not the expected one, otherwise the first."""
        return next((r for r in results if r.verdict != self.expected), results[0])

    def failed(self, why: str) -> CheckResult:
        """The result when it could not be computed."""
        return self._result(None, None, FAILED, f"Could not be computed: {why}")

    def without_comparison(self) -> CheckResult:
        """The result where the text does not print what a comparison needs."""
        return self._result(None, None, NOT_CHECKABLE, self.not_checkable)

    def outside(self, measured: float, goal: float) -> float:
        """By how much a value is not what is claimed, on the claim's side."""
        distance = measured - goal
        return {"two-sided": abs(distance), "at most": distance, "at least": -distance}[self.comparison]

    def _verdict(
        self, measured: float, goal: float, allowed: float, explained: Sequence[float | None], facts: Mapping[str, Any]
    ) -> tuple[Verdict, str]:
        assert self.tells is not None
        weak = (
            f"tolerance plus three sigma, {allowed:.3g}, is more than what the row is to tell: {self.against} is "
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
        unknown = f"The cause is not known{f'; what was thought of gives {tried}' if tried else ''}."
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
"""What a result repeats of its row."""
