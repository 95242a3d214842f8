"""Two condensed trees side by side: how far every number may move on another machine, and what has moved further."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from tests.golden.digest import flattened, is_number, skeleton

OF_SIGMA, LEAST_OF_SIGMA = 1e-3, 1e-6
"""Of its own standard deviation, where the record states one, a number may move by so much, which nobody could measure;
by no more of itself, so that 1 % is found of numbers that are small beside their sigma, but always by the second."""
RELATIVE = {"f4": 1e-5, "f2": 1e-2}
"""Of the largest number of an array, by its kind; of all others DOUBLE."""
DOUBLE = 1e-7
ZERO, ZERO_ANGLE = 1e-14, 1e-9
"""A number below this is what rounding leaves of zero; in seconds of arc, of which a turn has 1.3e6, it is more."""
BITWISE, CLOSE, DIFFERENT = "the same", "within the limits", "different"
ABSENT = "absent"


@dataclass(frozen=True)
class Allowance:
    """One kind of number that may move further than the rules say.

    Attributes:
        place: regular expression of job, file and keys.
        limit: relative to the number, or to the largest of its array; infinite where it is not compared at all.
        reason: why.
        floor: absolute limit.
    """

    place: str
    limit: float
    reason: str
    floor: float = 0.0

    def matches(self, place: str) -> bool:
        """Return whether this is of a place."""
        return re.search(self.place, place) is not None


EXCEPTIONS = [
    Allowance(**one) for one in YAML(typ="safe").load(Path(__file__).with_name("exceptions.yaml").read_text())
]


@dataclass(frozen=True)
class Difference:
    """One place at which two trees differ beyond the limits.

    Attributes:
        place: file, then keys.
        old: value in the golden run, ABSENT where it has none.
        new: value now.
        limit: by which a number may move.
    """

    place: str
    old: Any
    new: Any
    limit: float = 0.0

    def __str__(self) -> str:
        return f"{self.place}: {_short(self.old)} -> {_short(self.new)}" + (f" (+-{self.limit:.1e})" * bool(self.limit))


@dataclass
class Comparison:
    """What a comparison found.

    Attributes:
        far: all places beyond the limits, in the order of the golden run.
        bitwise: whether every file is the same to the last bit of its numbers.
    """

    far: list[Difference] = field(default_factory=list)
    bitwise: bool = False

    @property
    def status(self) -> str:
        """BITWISE, CLOSE or DIFFERENT."""
        return DIFFERENT if self.far else BITWISE if self.bitwise else CLOSE


def _short(value: Any) -> str:
    text = value if value is ABSENT else repr(value)
    return text if len(text) <= 160 else f"{text[:100]} ... {text[-50:]}"


def sigma_keys(key: str) -> Iterator[str]:
    """Yield the keys under which the standard deviation of a key's value may stand (docs/conventions.md).

    That is ``x_sigma``; words after the unit may follow it, ``d_f_um_sigma_true``, and ``_noise`` names the part that
    noise does. Columns of tables say "x, sigma [unit]" or "x σ".
    """
    words = key.split("_")
    if "sigma" in words or "σ" in key or "sigma" in key:
        return
    for k in range(len(words), 0, -1):
        yield "_".join([*words[:k], "sigma", *words[k:]])
    yield key + "_sigma_noise"
    name, bracket, unit = key.partition(" [")
    for form in ("{}_sigma", "{}, sigma", "{}, σ", "{} σ"):
        yield form.format(name) + bracket + unit


VALUES = ("value", "estimate", "bias", "mean")
"""Keys beside ``sigma`` whose standard deviation that is."""


def sigma_of(key: str, tree: dict[str, Any]) -> Any:
    """Return what stands beside a key as its standard deviation, None where nothing does."""
    names = [*sigma_keys(key), *(("sigma",) if key in VALUES else ())]
    return next((tree[name] for name in names if name in tree), None)


def limits(tree: Any, place: str = "", sigma: Any = None, scale: float = 0.0) -> dict[str, float]:
    """Return place -> how far the number there may move, of every real number of a condensed tree.

    A number may move by OF_SIGMA of its standard deviation if the record gives one, else by DOUBLE of itself, in a list
    of the largest of the list; single precision and images by what these hold.

    Args:
        tree: condensed.
        place: of it.
        sigma: standard deviation of what stands there: a number, or a condensed list as the values.
        scale: the largest number of the list in which it stands.
    """
    if isinstance(tree, dict) and "#array" in tree:
        return _array_limits(tree, place, sigma)
    found: dict[str, float] = {}
    if isinstance(tree, dict) and "#free" not in tree:
        for key, below in tree.items():
            start = f"{place} / {key}" if place else str(key)
            if key == "#each":
                for name, column in below.items():
                    own = sigma_of(name, below)
                    found |= limits(column, f"{start} / {name}", own, math.nan)
            else:
                above = sigma.get(key) if isinstance(sigma, dict) else None
                own = sigma_of(str(key), tree)
                found |= limits(below, start, above if own is None else own)
    elif isinstance(tree, list):
        # items of a column are numbers of one key of several things, which say nothing of each other's size
        sizes = [abs(one) for one in tree if is_number(one) and math.isfinite(one)]
        largest = max(sizes, default=0.0) if not math.isnan(scale) else math.nan
        for k, below in enumerate(tree):
            own = sigma[k] if isinstance(sigma, list) and len(sigma) == len(tree) else sigma
            found |= limits(below, f"{place}[{k}]", own, largest)
    elif isinstance(tree, float):
        size = max(abs(tree), 0.0 if math.isnan(scale) else scale) if math.isfinite(tree) else 0.0
        found[place] = _of_sigma(tree, sigma) if _usable(sigma) else max(DOUBLE * size, _zero(place))
    return found


def _of_sigma(value: float | None, sigma: float) -> float:
    """Return how far a number may move that has a standard deviation."""
    return max(min(OF_SIGMA * sigma, OF_SIGMA * abs(value or 0.0)), LEAST_OF_SIGMA * sigma)


def _zero(place: str) -> float:
    return ZERO_ANGLE if "arcsec" in place else ZERO


def _usable(sigma: Any) -> bool:
    return is_number(sigma) and math.isfinite(sigma) and sigma > 0


def _array_limits(tree: dict[str, Any], place: str, sigma: Any) -> dict[str, float]:
    """Return the limits of the moments and elements of an array."""
    if "whole" in tree or "mean" not in tree:
        return {}
    peak = max(abs(tree["min"]), abs(tree["max"]))
    kind = tree["kind"]
    if kind[0] == "u":
        # an image: noise is drawn for each pixel, and a last digit can make it one count more in a few of them
        some = max(10.0 / math.prod(tree["#array"]), 1e-4)
        own = {"mean": some, "rms": some, "min": 1.0, "max": 1.0}
        steps = [1.0] * len(tree["at"])
    else:
        floor = RELATIVE.get(kind, DOUBLE)
        own = {key: max(floor * tree["rms"], _zero(place)) for key in ("mean", "rms")}
        own |= {key: max(floor * peak, _zero(place)) for key in ("min", "max")}
        steps = [own["max"]] * len(tree["at"])
    values = dict.fromkeys(("mean", "rms"), tree["rms"]) | dict.fromkeys(("min", "max"), peak)
    if isinstance(sigma, dict) and sigma.get("#array") == tree["#array"] and _usable(sigma.get("mean")):
        own = {
            key: _of_sigma(value, sigma["max" if key in ("min", "max") else "mean"]) for key, value in values.items()
        }
        each = zip(tree["at"], sigma["at"], steps, strict=True)
        steps = [_of_sigma(value, one) if _usable(one) else least for value, one, least in each]
    elif _usable(sigma):
        own = {key: _of_sigma(value, sigma) for key, value in values.items()}
        steps = [_of_sigma(value, sigma) for value in tree["at"]]
    places = {f"{place} / {key}": value for key, value in own.items()}
    return places | {f"{place} / at[{k}]": step for k, step in enumerate(steps) if tree["at"][k] is not None}


def allowed(job: str, tree: Any, new: dict[str, Any] | None = None) -> dict[str, float]:
    """Return the limits of the leaves of a job, with the EXCEPTIONS; infinite where something is not compared."""
    found, values = limits(tree), {**(new or {}), **flattened(tree)}
    for one in EXCEPTIONS:
        for place, value in values.items():
            known = place in found or isinstance(value, str) or math.isinf(one.limit)
            if known and one.matches(f"{job} / {place}"):
                size = abs(value) if is_number(value) and not math.isinf(one.limit) else 1.0
                found[place] = max(found.get(place, 0.0), one.limit * size, one.floor)
    return found


def printed_close(old: Any, new: Any, limit: float = DOUBLE) -> bool:
    """Return whether two texts are the same but for printed numbers that differ by one unit of their last digit, or by
    a limit of themselves.
    """
    if not (isinstance(old, str) and isinstance(new, str)):
        return False
    (form, numbers), (other, others) = skeleton(old), skeleton(new)
    return form == other and all(_digit_close(a, b, limit) for a, b in zip(numbers, others, strict=True))


def _digit_close(old: str, new: str, limit: float) -> bool:
    if old == new:
        return True
    (a, unit), (b, other) = _printed(old), _printed(new)
    return abs(a - b) <= max(1.001 * max(unit, other), max(limit, DOUBLE) * abs(a), ZERO_ANGLE)


def _printed(text: str) -> tuple[float, float]:
    """Return a printed number and the unit of its last digit."""
    mantissa, _, power = text.replace("−", "-").partition("e")
    scale = 10.0 ** int(power or 0)
    return float(mantissa) * scale, scale * 10.0 ** -len(mantissa.partition(".")[2])


def compare_flat(before: dict[str, Any], after: dict[str, Any], limit: dict[str, float]) -> list[Difference]:
    """Return every place of flattened trees at which they differ by more than its limit."""
    far = []
    for place in [*before, *(place for place in after if place not in before)]:
        was, now, own = before.get(place, ABSENT), after.get(place, ABSENT), limit.get(place, 0.0)
        if was is now or math.isinf(own):
            continue
        if is_number(was) and is_number(now) and place in limit:
            same = abs(was - now) <= own or (math.isnan(was) and math.isnan(now))
        else:
            same = (type(was) is type(now) and was == now) or printed_close(was, now, own)
        if not same:
            far.append(Difference(place, was, now, own))
    return far


def compare(job: str, old: Any, new: Any) -> Comparison:
    """Return how a job's new tree differs from the golden one."""
    before, after = flattened(old), flattened(new)
    bitwise = before.pop("exact", None) == after.pop("exact", None)
    return Comparison(compare_flat(before, after, allowed(job, old, after)), bitwise)
