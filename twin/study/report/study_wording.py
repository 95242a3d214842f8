"""Numbers and statements of a study's report as text."""

from __future__ import annotations

from collections.abc import Sequence

from twin.run.artefact import decimals_for, fixed, significant
from twin.study.report.study_runs import Response, typeset
from twin.study.report.study_statistics import Description, Estimate, Interval

DASH = "\N{EN DASH}"


def number(value: float | None, digits: int = 4) -> str:
    """A number with some digits, a dash for none."""
    return DASH if value is None else significant(value, digits, floor=0.0)


def with_unit(value: float | None, unit: str, digits: int = 3) -> str:
    """A number with its unit."""
    sign = typeset(unit)
    space = "" if sign in ("°", "") else " "
    return f"{number(value, digits)}{space}{sign}"


def limits(interval: Interval) -> str:
    """An interval as text; an end that cannot be told is left open."""
    low, high = interval
    if low is None and high is None:
        return ""
    if low is not None and high is not None:
        places = decimals_for(0.5 * abs(high - low))
        if places < 7 and max(abs(low), abs(high)) < 1e6:
            return f"{fixed(low, places)} … {fixed(high, places)}"
    return f"{'?' if low is None else number(low, 4)} … {'?' if high is None else number(high, 4)}"


def with_limits(value: Estimate | None) -> str:
    """A number and its interval, as many decimals as the interval has."""
    if value is None:
        return DASH
    low, high = value.interval
    if low is not None and high is None and value.value <= low:
        return f"> {number(low)}"
    half = value.half_width
    if half == 0.0:
        return number(value.value)
    if half is not None:
        places = decimals_for(half)
        if places < 7 and abs(value.value) < 1e6:
            return f"{fixed(value.value, places)} ({limits(value.interval)})"
    text = limits(value.interval)
    return f"{number(value.value)} ({text})" if text else number(value.value)


def share(value: Estimate | None) -> str:
    """An index between 0 and 1 and its interval, three decimals."""
    if value is None:
        return DASH
    low, high = value.interval
    text = fixed(value.value, 3)
    return text if low is None or high is None else f"{text} ({fixed(low, 3)} … {fixed(high, 3)})"


def percent(value: float | None, decimals: int = 1) -> str:
    """A share as percent; not 100 or 0 when it is not quite."""
    if value is None:
        return DASH
    least = 10.0 ** -(decimals + 2)
    if 0.0 < value < 0.5 * least:
        return f"< {fixed(100.0 * least, decimals)}%"
    if 1.0 - 0.5 * least < value < 1.0:
        return f"> {fixed(100.0 * (1.0 - least), decimals)}%"
    return f"{fixed(100.0 * value, decimals)}%"


def span(interval: tuple[float, float]) -> str:
    """An interval of a share."""
    return f"{percent(interval[0])} … {percent(interval[1])}"


def listed(texts: Sequence[str]) -> str:
    """a, b and c."""
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}"


def plural(count: int, noun: str) -> str:
    """1 run, 2 runs."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def normality_text(response: Response, about: Description) -> str | None:
    """What the distribution looks like; None where it was not judged."""
    if about.normality is None or about.mean is None or about.std is None:
        return None
    test = about.normality
    p = "below 0.0001" if test.p < 1e-4 else number(test.p, 2)
    shape = f"skewness {fixed(test.skewness, 2, sign=True)}, excess kurtosis {fixed(test.kurtosis, 2, sign=True)}"
    if test.normal:
        return f"{response.name}: nothing speaks against a normal distribution ({shape}, p = {p})."
    text = f"{response.name} is not normal ({shape}, p {'= ' if test.p >= 1e-4 else ''}{p})"
    if about.tails is None:
        return f"{text}; where 0.135% and 99.865% of the runs lie, {about.count} runs cannot tell (741 are needed)."
    low, high = ((tail - about.mean.value) / about.std.value for tail in about.tails)
    return (
        f"{text}: 99.73% of the runs lie from {fixed(low, 2, sign=True)}σ to {fixed(high, 2, sign=True)}σ of the mean, "
        f"from {with_unit(about.tails[0], response.unit)} to {with_unit(about.tails[1], response.unit)}."
    )
