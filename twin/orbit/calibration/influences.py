"""What is not seen in the fit: effects on the light that are left in the image points, ground coordinates in a wrong
datum. Both are carried by the parameters; how far, is found by calibrating again from the same measurements. These
comparisons count the noise of attitude and orbit as independent, which takes a tenth of the time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from analysis.orbit.adjustment import Adjustment
from analysis.orbit.calibration_parameters import OFFSET
from analysis.orbit.forward_intersection import CheckErrors
from analysis.orbit.three_line_model import BIAS
from scenes.specs.orbit.angle import LINES
from twin.orbit.calibration.campaign import Campaign, interior_names
from twin.orbit.calibration.campaign_adjustment import calibrated_alone, simultaneous
from twin.orbit.calibration.observations import EFFECTS
from twin.orbit.calibration.schemes import RMS, schemes_tested, tested_before, values_of
from twin.orbit.flight.light_effects import NO_EFFECTS

INNER = interior_names(LINES)
SURPRISE = 4.0
"""Sigmas of what is expected of an unknown; one of seventy lies beyond by chance in 1 of 200 campaigns."""
_TRIAL_TIME = 0.01
"""Seconds; by which the lines are late, 70 m on the ground."""
_TRIAL_SHIFT = 100.0
"""Metres; of a wrong datum where the file has none."""


@dataclass(frozen=True, eq=False)
class LightRow:
    """One case of what is left in the image points.

    Attributes:
        left: effects that are not taken out, of `EFFECTS`.
        moved: line -> (2,) RMS of what they move the check points' image points by, x and y, metres.
        before: mean of the fields' RMS with the laboratory's camera, plan and height, metres.
        after: likewise, each field with its own parameters.
        shift: name -> change of a parameter of the simultaneous adjustment from the case that nothing is left in.
        sigma: name -> its sigma.
        p_value: of the adjustment.
    """

    left: tuple[str, ...]
    moved: Mapping[str, np.ndarray]
    before: tuple[float, float]
    after: tuple[float, float]
    shift: Mapping[str, float]
    sigma: Mapping[str, float]
    p_value: float

    def most(self, names: tuple[str, ...]) -> tuple[str, float]:
        """Which of these unknowns is moved by the most sigmas, and by how many; held ones do not count."""
        size = {n: self.shift[n] / self.sigma[n] for n in names if self.sigma[n] > 0.0}
        worst = max(size, key=lambda n: abs(size[n]))
        return worst, size[worst]


@dataclass(frozen=True, eq=False)
class DatumRow:
    """What a common shift of all control points does.

    Attributes:
        shift: east, north, up, metres.
        bias: (3,) mean change of the fields' roll, pitch and yaw, radians.
        interior: name -> change, metres.
        offset: (3,) mean change of the orbit's offsets along, across, down, metres; zero where not solved for.
        fit: change of the chi-square of the simultaneous adjustment.
        p_value: of the adjustment with the shift.
        after: mean of the fields' RMS against the right datum, each field with its own parameters, plan and height.
        late: seconds by which the times of the lines are too late, in place of a shift.
        sigma: name -> of the elements of the interior.
        warned: shift in metres, or time in seconds, from which on `surprises` tells of it; None where it never does.
    """

    shift: tuple[float, float, float]
    bias: np.ndarray
    interior: Mapping[str, float]
    offset: np.ndarray
    fit: float
    p_value: float
    after: tuple[float, float]
    late: float
    sigma: Mapping[str, float]
    warned: float | None

    @property
    def size(self) -> float:
        """Of the shift, metres, or of the time, seconds."""
        return abs(self.late) or float(np.linalg.norm(self.shift))

    @property
    def most_sigmas(self) -> tuple[str, float]:
        """The element of the interior that is moved by the most of its sigmas, and by how many."""
        ratio = {n: abs(v) / self.sigma[n] for n, v in self.interior.items() if self.sigma[n] > 0.0}
        worst = max(ratio, key=lambda n: ratio[n])
        return worst, ratio[worst]

    @property
    def most(self) -> tuple[str, float]:
        """The element of the interior that is moved most, and its change, metres."""
        worst = max(self.interior, key=lambda n: abs(self.interior[n]))
        return worst, self.interior[worst]


@dataclass(frozen=True)
class Surprise:
    """An estimate beyond what is expected of it, in the unit of the unknown: metres or radians."""

    name: str
    change: float
    expected: float

    @property
    def ratio(self) -> float:
        """In sigmas of what is expected."""
        return abs(self.change) / self.expected


def light_rows(campaign: Campaign, sigma: Mapping[str, float]) -> tuple[LightRow, ...]:
    """Nothing left in, each effect alone, all of them; only effects that are on.

    Args:
        campaign: the measurements.
        sigma: name -> sigma of a parameter of the simultaneous adjustment.

    Raises:
        CalibrationError: a case cannot be solved.
    """
    on = [name for name in EFFECTS if getattr(campaign.effects, name)]
    cases = [(), *((name,) for name in on), *([tuple(on)] if len(on) > 1 else [])]
    clean = campaign.independent.without_effects(campaign.effects)
    base = simultaneous(clean)
    rows = []
    for left in cases:
        case, found = clean, base
        if left:
            removed = replace(campaign.effects, **dict.fromkeys(left, False))
            case = clean.without_effects(removed if len(left) < len(on) else NO_EFFECTS)
            found = simultaneous(case)
        moved = {
            line: np.sqrt(
                np.mean(
                    np.concatenate(
                        [
                            (a.check[line].image - b.check[line].image) ** 2
                            for a, b in zip(case.passes, clean.passes, strict=True)
                            if line in b.check
                        ]
                    ),
                    axis=0,
                )
            )
            for line in campaign.lines
        }
        shift = dict(zip(found.names, (found.values - base.values).tolist(), strict=True))
        rows.append(LightRow(left, moved, _means(tested_before(case)), _after(case), shift, sigma, found.p_value))
    return tuple(rows)


def datum_rows(campaign: Campaign) -> tuple[DatumRow, ...]:
    """The file's datum, or 100 m along each axis and lines that are 10 ms late where it has none.

    Raises:
        CalibrationError: a case cannot be solved.
    """
    errors = campaign.spec.errors
    right = campaign.independent
    shifts = [(_TRIAL_SHIFT, 0.0, 0.0), (0.0, _TRIAL_SHIFT, 0.0), (0.0, 0.0, _TRIAL_SHIFT), (0.0, 0.0, 0.0)]
    if errors.switched_on and any(errors.datum):
        east, north, up = errors.datum
        right, shifts = right.shifted((-east, -north, -up)), [errors.datum]
    base = simultaneous(right)
    rows = []
    for east, north, up in shifts:
        late = 0.0 if any((east, north, up)) else _TRIAL_TIME
        wrong = right.later(late) if late else right.shifted((east, north, up))
        found = simultaneous(wrong)
        change = dict(zip(found.names, found.values - base.values, strict=True))
        names = [p.name for p in campaign.passes]
        rows.append(
            DatumRow(
                (float(east), float(north), float(up)),
                np.array([np.mean([change[f"{n} {axis}"] for n in names]) for axis in BIAS]),
                {n: float(change[n]) for n in campaign.inner},
                np.array([np.mean([change.get(f"{n} offset {axis}", 0.0) for n in names]) for axis in OFFSET]),
                found.chi_square - base.chi_square,
                found.p_value,
                _after(wrong),
                late,
                {n: base.sigma[n] for n in campaign.inner},
                _warned(campaign, change, late or float(np.linalg.norm((east, north, up)))),
            )
        )
    return tuple(rows)


def _warned(campaign: Campaign, change: Mapping[str, float], size: float) -> float | None:
    """How large a cause of this size (metres or seconds) and these changes must be for `surprises` to tell it."""
    known = _expected(campaign)
    ratio = max((abs(change.get(name, 0.0)) / sigma for name, (_, sigma) in known.items()), default=0.0)
    return SURPRISE * size / ratio if ratio > 0.0 else None


def surprises(campaign: Campaign, found: Adjustment) -> tuple[Surprise, ...]:
    """Estimates beyond `SURPRISE` sigmas of what launch and orbit leave to expect, the largest first."""
    known = _expected(campaign)
    all_of_them = [Surprise(n, float(found.value(n) - v), s) for n, (v, s) in known.items() if n in found.names]
    return tuple(sorted((s for s in all_of_them if s.ratio > SURPRISE), key=lambda s: -s.ratio))


def _expected(campaign: Campaign) -> dict[str, tuple[float, float]]:
    """Unknown -> value and standard deviation that launch and orbit leave to expect."""
    launch, errors = campaign.spec.launch, campaign.spec.errors
    inner = campaign.inner
    start = dict(zip(inner, np.ravel([campaign.laboratory[line].interior for line in campaign.lines]), strict=True))
    known = {name: (start[name], launch.interior) for name in inner}
    for one in campaign.passes:
        # a season's part is no surprise either
        spread = np.hypot(launch.bias, np.array(errors.season))
        known |= {f"{one.name} {axis}": (0.0, s) for axis, s in zip(BIAS, spread.tolist(), strict=True) if s > 0.0}
        if errors.switched_on:
            drift = zip(OFFSET, errors.gps.drift, strict=True)
            known |= {f"{one.name} offset {axis}": (0.0, s) for axis, s in drift if s > 0.0}
    return known


def _after(campaign: Campaign) -> tuple[float, float]:
    """Mean RMS in plan and height, each field with its own parameters."""
    alone = {p.name: calibrated_alone(campaign, p) for p in campaign.passes}
    return _means(list(schemes_tested(campaign, alone).values())[-1])


def _means(errors: Mapping[str, CheckErrors]) -> tuple[float, float]:
    """Of the fields' RMS in plan and height, metres."""
    plan, height = (float(values_of(errors, what).mean()) for what in RMS)
    return plan, height
