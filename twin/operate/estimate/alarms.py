"""What of an estimate a person has to know: requirements that are broken or will be, jumps, sensors that fail, readings
that contradict all that is stated. Each is raised once, and waits in the record until somebody has seen it.

What goes on, as a requirement that stays broken, is not told again while its alarm waits, nor within a month of an
alarm that somebody has seen.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from analysis.monitor.disturbances import FALSE_ALARM
from analysis.monitor.limits import Quantity
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP
from analysis.statistics import chance_beyond, limit_of
from scenes.specs.operation import OperationSpec
from twin.operate.estimate.following import Break, Following, FoundJump
from twin.operate.record.entries import MICRO, Alarm, utc_text
from twin.operate.record.history import History
from twin.run.artefact import decimals_for, fixed, plain

AGAIN = 30 * 86_400 * MICRO
"""After which an alarm that somebody has seen is raised again, if what it tells of goes on."""
LEAST = 1e-6
"""Chance below which no number is told."""
_CLOSE = 3.0
"""Difference of log likelihood ratios, below which another body explains a jump nearly as well: 20 to 1."""
BROKEN, BREAKS, JUMP, SENSOR, CONTRADICTION = "broken", "breaks", "jump", "sensor", "contradiction"
Row = Mapping[str, Any]


def raise_alarms(history: History, plan: OperationSpec, following: Following) -> list[Alarm]:
    """Add to a record what of its estimate is to be known and has not been told.

    Args:
        history: the record.
        plan: under which it was followed.
        following: what is known after all readings.

    Returns:
        The alarms that are new.
    """
    before = history.alarms()
    return [one for one in alarms_of(plan, following) if not _is_told(one, before) and history.raise_alarm(one)]


def alarms_of(plan: OperationSpec, following: Following) -> Iterator[Alarm]:
    """What of an estimate is to be known, whether it has been told or not."""
    for one in following.breaks:
        if not one.holds_now or one.breaks_us is not None:
            yield _of_requirement(one, following.time, following.now.quantities)
    for jump in following.jumps:
        yield _of_jump(jump)
    for sensor in following.sensors:
        if sensor.state != "ok":
            text = f"the sensor of {sensor.body} is {sensor.state} since {utc_text(sensor.since_us)}: {sensor.reason}"
            yield Alarm(SENSOR, sensor.body, sensor.since_us, text, sensor.to_dict())
    if following.too_small:
        text = next(one for one in following.warnings if following.too_small[0] in one)
        yield Alarm(CONTRADICTION, "temperatures", following.time, text, {"causes": list(following.too_small)})
    far = [*_contradictions(plan, following), *map(_of_bad, following.bad_readings)]
    yield from sorted(far, key=lambda one: one.time)[-1:]


def _is_told(alarm: Alarm, before: Sequence[Row]) -> bool:
    same = [one for one in before if (one["kind"], one["subject"]) == (alarm.kind, alarm.subject)]
    if alarm.kind == JUMP:  # of a jump the time is known the better the more readings have come
        began, ended = alarm.content["after_us"], alarm.content["until_us"]
        return any(one["content"]["after_us"] < ended and began < one["content"]["until_us"] for one in same)
    if alarm.kind == CONTRADICTION:  # every reading is one of its own
        return any(one["acknowledged"] is None or alarm.time <= one["time_us"] for one in same)
    return any(one["acknowledged"] is None or abs(alarm.time - one["time_us"]) < AGAIN for one in same)


def name_of(quantity: str, quantities: Sequence[Quantity]) -> str:
    """A quantity in words: ``Δf of forward``.

    Args:
        quantity: group and key.
        quantities: all that are read.
    """
    group, _, key = quantity.partition(" ")
    symbol = next(one.parameter.symbol for one in quantities if (one.group, one.key) == (group, key))
    return {ANGLE_GROUP: f"{symbol} between the cameras", GROUND_GROUP: f"{symbol} on the ground"}.get(
        group, f"{symbol} of {group}"
    )


def percent(chance: float) -> str:
    """A chance for a sentence, with as many decimals as tell it from certainty."""
    rest = min(chance, 1.0 - chance)
    if rest < LEAST:
        return "less than 0.0001 %" if chance < 0.5 else "more than 99.9999 %"
    return f"{fixed(100.0 * chance, decimals_for(100.0 * rest))} %"


def _of_requirement(one: Break, time: int, quantities: Sequence[Quantity]) -> Alarm:
    name, allowed = name_of(one.quantity, quantities), percent(1.0 - one.probability)
    limit = f"{plain(one.limit)} {one.unit}"
    if not one.holds_now:
        text = f"{name} is beyond {limit} with a chance of {percent(one.chance_now)}; {allowed} is allowed"
        return Alarm(BROKEN, one.quantity, time, text, one.to_dict())
    assert one.breaks_us is not None
    text = f"{name} is expected to be beyond {limit} with a chance above {allowed} from {utc_text(one.breaks_us)} on"
    return Alarm(BREAKS, one.quantity, time, text, one.to_dict())


def _of_jump(one: FoundJump) -> Alarm:
    sizes = ", ".join(f"{name.removeprefix(f'{one.body} ')} {sized(z, s, unit)}" for name, unit, z, s in one.sizes)
    between = f"between {utc_text(one.after_us)} and {utc_text(one.until_us)}"
    near = [body for body, ratio in one.rivals.items() if ratio > one.log_ratio - _CLOSE][:3]
    rivals = f"; {', '.join(near)} would explain it nearly as well" if near else ""
    content = {**one.to_dict(), "after_us": one.after_us, "until_us": one.until_us}
    return Alarm(JUMP, one.body, one.until_us, f"{one.body} jumped {between}: {sizes}{rivals}", content)


def sized(value: float, sigma: float, unit: str) -> str:
    """A number with its standard deviation, two digits of it."""
    places = decimals_for(sigma)
    return f"{fixed(value, places, sign=True)} ± {fixed(sigma, places)} {unit.replace('um', 'µm')}"


def _of_bad(bad: tuple[int, str]) -> Alarm:
    time, reason = bad
    text = f"the reading of {utc_text(time)} is taken for a bad one: {reason}; exclude --include takes it all the same"
    return Alarm(CONTRADICTION, "monitor", time, text, {"time_utc": utc_text(time), "reason": reason})


def _contradictions(plan: OperationSpec, following: Following) -> Iterator[Alarm]:
    """Readings that are too far from their predictions; those at which a jump was found are explained by it.

    Of the chance of a false alarm in the whole life each reading has the share of the time since the one before it.
    """
    spans = [(one.after_us, one.told_us) for one in following.jumps]
    told = following.innovations
    # the first of all has no other before it, and a chance of a false alarm of its own
    befores = (
        [told[0][0] - round(plan.mission * MICRO) if following.readings == len(told) else told[0][0]] if told else []
    )
    befores += [time for time, _, _ in told[:-1]]
    for before, (time, chi_square, degrees) in zip(befores, told, strict=True):
        share = min((time - before) / (plan.mission * MICRO), 1.0)
        chance = float(chance_beyond(chi_square, degrees))
        if share <= 0.0 or chance >= FALSE_ALARM * share or any(after < time <= told for after, told in spans):
            continue
        limit = float(limit_of(FALSE_ALARM * share, degrees))
        text = (
            f"the reading of {utc_text(time)} contradicts what is stated: chi-square {plain(chi_square, 4)} of "
            f"{degrees} coordinates, at most {plain(limit, 3)} by chance; what moves more than the plan says?"
        )
        content = {"time_utc": utc_text(time), "chi_square": chi_square, "degrees_of_freedom": degrees, "limit": limit}
        yield Alarm(CONTRADICTION, "monitor", time, text, content)
