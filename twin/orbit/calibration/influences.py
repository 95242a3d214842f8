"""Errors that a calibration hardly sees in its own fit, and what they do to the parameters.

Effects on the light that are left in the image points and ground coordinates in a wrong datum are carried by the
parameters; how far, is found by calibrating again from the same measurements. These comparisons count the noise of
attitude and orbit as independent, which takes a tenth of the time. A drift of the attitude within the passes and steps
between the chips of a line are judged by the residuals: by how much they would have to differ from zero to be seen, and
whether they do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np
from scipy.stats import chi2, norm

from analysis.arrays import ARCSEC
from analysis.calibration.adjustment import FALSE_ALARM, Adjustment, Rates, Steps
from analysis.orbit.calibration_parameters import OFFSET
from analysis.orbit.three_line_model import BIAS
from scenes.specs.orbit.measurements import MeasuredCalibrationSpec
from twin.orbit.calibration.campaign import EFFECTS, Campaign, FoundDrift
from twin.orbit.calibration.campaign_adjustment import calibrated_alone, simultaneous
from twin.orbit.calibration.schemes import FieldErrors, schemes_tested, tested_before
from twin.orbit.flight.light_effects import NO_EFFECTS

SURPRISE = 4.0
"""Sigmas of what is expected of an unknown; one of seventy lies beyond by chance in 1 of 200 campaigns."""
UNSEEN = 3.0
"""Sigmas of an unknown, by a drift that residuals show only in half of all cases, from which on a file has to say
whether there is one."""
_STEP_ALARM = 1e-4
"""False alarm of all steps of a run together."""
_TRIAL_TIME = 0.01
"""Seconds; by which the lines are late, 70 m on the ground."""
_TRIAL_SHIFT = 100.0
"""Metres; of a wrong datum where the file has none."""


@dataclass(frozen=True, eq=False)
class LightRow:
    """One case of what is left in the image points.

    Attributes
    ----------
    left : tuple[str, ...]
        Effects that are not taken out, of `EFFECTS`.
    moved : Mapping[str, np.ndarray]
        Line -> (2,) RMS of what they move the check points' image points by, x and y, metres.
    before : FieldErrors
        Mean of the fields' RMS with the laboratory's camera.
    after : FieldErrors
        Likewise, each field with its own parameters.
    shift : Mapping[str, float]
        Name -> change of a parameter of the simultaneous adjustment from the case that nothing is left in.
    sigma : Mapping[str, float]
        Name -> its sigma.
    p_value : float
        Of the adjustment.
    """

    left: tuple[str, ...]
    moved: Mapping[str, np.ndarray]
    before: FieldErrors
    after: FieldErrors
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

    Attributes
    ----------
    shift : tuple[float, float, float]
        East, north, up, metres.
    bias : np.ndarray
        (3,) mean change of the fields' roll, pitch and yaw, radians.
    interior : Mapping[str, float]
        Name -> change, metres.
    offset : np.ndarray
        (3,) mean change of the orbit's offsets along, across, down, metres; zero where not solved for.
    fit : float
        Change of the chi-square of the simultaneous adjustment.
    p_value : float
        Of the adjustment with the shift.
    after : FieldErrors
        Mean of the fields' RMS against the right datum, each field with its own parameters, plan and height.
    late : float
        Seconds by which the times of the lines are too late, in place of a shift.
    sigma : Mapping[str, float]
        Name -> of the elements of the interior.
    warned : float | None
        Shift in metres, or time in seconds, from which on `surprises` tells of it; None where it never does.
    """

    shift: tuple[float, float, float]
    bias: np.ndarray
    interior: Mapping[str, float]
    offset: np.ndarray
    fit: float
    p_value: float
    after: FieldErrors
    late: float
    sigma: Mapping[str, float]
    warned: float | None

    @property
    def size(self) -> float:
        """Size of the shift, metres, or of the delay, seconds."""
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
        """Size of the change in sigmas of what is expected."""
        return abs(self.change) / self.expected


def light_rows(campaign: Campaign, sigma: Mapping[str, float]) -> tuple[LightRow, ...]:
    """Nothing left in, each effect alone, all of them; only effects that are on.

    Parameters
    ----------
    campaign : Campaign
        The measurements.
    sigma : Mapping[str, float]
        Name -> sigma of a parameter of the simultaneous adjustment.

    Raises
    ------
    CalibrationError
        a case cannot be solved.
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
        rows.append(
            LightRow(left, moved, FieldErrors.mean(tested_before(case)), _after(case), shift, sigma, found.p_value)
        )
    return tuple(rows)


def datum_rows(campaign: Campaign) -> tuple[DatumRow, ...]:
    """The file's datum, or 100 m along each axis and lines that are 10 ms late where it has none.

    Raises
    ------
    CalibrationError
        a case cannot be solved.
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
    """Size from which on `surprises` tells a cause that makes these changes at one size (metres or seconds)."""
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


def _after(campaign: Campaign) -> FieldErrors:
    """Means of the fields' RMS errors, each field with its own parameters."""
    alone = {p.name: calibrated_alone(campaign, p) for p in campaign.passes}
    return FieldErrors.mean(list(schemes_tested(campaign, alone).values())[-1])


@dataclass(frozen=True)
class AttitudeDrift:
    """Drift of the attitude during the passes.

    Attributes
    ----------
    seconds : float
        From when the first line sees a field to when the last one does, mean of the passes.
    sigmas_per_arcsec : Mapping[str, float] | None
        Name of an unknown -> its change, in its sigmas, for a drift of 1 arcsec in these seconds (one standard
        deviation about each axis in each pass) that is no unknown; None where rates are unknowns.
    seen : np.ndarray | None
        (3,) drift about body X, Y, Z in these seconds that residuals show in half of all cases, radians; None likewise.
    unseen_sigmas : float | None
        By how many of its sigmas the most sensitive unknown is then wrong; None likewise.
    rate_p_value, course_p_value : float | None
        Chance of the residuals without rates, and without errors that change slowly along the lines; below
        `FALSE_ALARM` they count as found.
    assumed : FoundDrift | None
        What was taken into the noise since; None where nothing was found.
    """

    seconds: float
    sigmas_per_arcsec: Mapping[str, float] | None
    seen: np.ndarray | None
    unseen_sigmas: float | None
    rate_p_value: float | None
    course_p_value: float
    assumed: FoundDrift | None

    @classmethod
    def of(cls, campaign: Campaign, found: Adjustment) -> Self:
        """What the adjustment of all fields shows of a drift."""
        seconds = float(np.mean([p.seconds_apart for p in campaign.passes]))
        effect = seen = unseen = None
        chance = None
        if found.rates is not None and seconds > 0.0:
            assert isinstance(found.rates.terms, Rates)
            sigma = np.array([found.sigma[n] for n in found.names])
            change = np.linalg.norm(found.rates.moved, axis=1) * ARCSEC / seconds
            effect = {n: float(c / s) for n, c, s in zip(found.names, change, sigma, strict=True) if s > 0.0}
            # of a test of all rates together, each alone
            power = np.sqrt(chi2.isf(FALSE_ALARM, max(found.rates.degrees_of_freedom, 1)))
            alone = found.rates.sigma_alone.reshape(-1, 3)
            seen = power * np.sqrt(1.0 / np.mean(alone**-2.0, axis=0) / len(alone)) * seconds
            limit = np.where(np.isfinite(alone), alone, 0.0).ravel() * power
            wrong = np.abs(found.rates.moved) * limit
            unseen = float(np.max(wrong[sigma > 0.0] / sigma[sigma > 0.0][:, None], initial=0.0))
            chance = found.rates.p_value
        course, drifts = found.courses.p_value, campaign.drifts
        if drifts is not None:
            chance, course = drifts.rate_p_value, drifts.course_p_value
        return cls(seconds, effect, seen, unseen, chance, course, drifts)

    @property
    def most(self) -> tuple[str, float]:
        """The unknown that drift moves by the most of its sigmas, and by how many; ("", 0) where rates are unknowns."""
        if not self.sigmas_per_arcsec:
            return "", 0.0
        return max(self.sigmas_per_arcsec.items(), key=lambda item: item[1])


def drift_warnings(campaign: Campaign, drift: AttitudeDrift) -> list[str]:
    """That residuals show a drift, or that a file does not say whether there is one that would matter."""
    if drift.assumed is not None:
        rate = max(drift.assumed.rate) * drift.seconds / ARCSEC
        chance = min(drift.course_p_value, 1.0 if drift.rate_p_value is None else drift.rate_p_value)
        return [
            "the attitude drifts during the passes, or image points err alike along the lines: residuals of"
            f" neighbouring exposures are alike (chance {chance:.1g}). A random walk of"
            f" {drift.assumed.walk / ARCSEC:.2g} arcsec in a second and rates of {rate:.2g} arcsec in"
            f" {drift.seconds:.0f} s have been taken into the sigmas, which are as good as this guess: state"
            " errors.star_tracker.drift and walk"
        ]
    name, ratio = drift.most
    spec, unseen = campaign.spec, drift.unseen_sigmas or 0.0
    if isinstance(spec, MeasuredCalibrationSpec) and spec.errors.star_tracker.drift is None and unseen > UNSEEN:
        seen = float(np.min(drift.seen)) / ARCSEC if drift.seen is not None else np.inf
        return [
            f"nothing is said of a drift of the attitude within a pass: 1 arcsec in {drift.seconds:.0f} s moves"
            f" {name} by {ratio:.2g} of its sigmas, and the residuals of these points show it from {seen:.2g} arcsec:"
            " state errors.star_tracker.drift, [0 arcsec, 0 arcsec, 0 arcsec] where there is none"
        ]
    return []


@dataclass(frozen=True)
class ChipStep:
    """A step of x (along the track) or y within a line.

    Attributes
    ----------
    line : str
        camera.
    axis : str
        x or y.
    place : float
        y of the joint in the focal plane, metres.
    step : float
        What the residuals say of it, of everything beyond the joint, metres.
    sigma : float | None
        Of that, all steps together.
    seen_from : float | None
        Step that is told in half of all cases; None where the points tell none.
    found : bool
        Whether this one is told, false alarm 1e-4 for all together.
    """

    line: str
    axis: str
    place: float
    step: float
    sigma: float | None
    seen_from: float | None
    found: bool

    @classmethod
    def of(cls, campaign: Campaign, together: Adjustment) -> tuple[Self, ...]:
        """Steps of all lines of a campaign, by the adjustment of all fields."""
        steps = Steps(_joints(campaign))
        unseen = together.unseen(steps)
        limit = float(norm.isf(0.5 * _STEP_ALARM / max(steps.size, 1)))
        found = []
        for k, (value, sigma) in enumerate(zip(unseen.estimate.tolist(), unseen.sigma.tolist(), strict=True)):
            line, place = steps.places[k // 2]
            said = (value, sigma, limit * sigma, abs(value) > limit * sigma)
            found.append(cls(line, "xy"[k % 2], place, *(said if np.isfinite(sigma) else (0.0, None, None, False))))
        return tuple(found)


def _joints(campaign: Campaign) -> tuple[tuple[str, float], ...]:
    """(line, y) of the joints between chips; the middle of a line of one chip."""
    data = campaign.passes[0].data
    found = []
    for name in campaign.lines:
        ccds = data.lines[name].ccds or ()
        pixels = [0.5 * (a.last + b.first) for a, b in pairwise(ccds)]
        pixels = pixels or [0.5 * (data.sensors[name].camera.pixels - 1)]
        found += [(name, float(y)) for y in data.places(name, np.array(pixels))[:, 1]]
    return tuple(found)


def step_warnings(numbers: tuple[ChipStep, ...]) -> list[str]:
    """Steps that the residuals show."""
    found = [n for n in numbers if n.found]
    if not found:
        return []
    listed = ", ".join(
        f"{n.line} {n.axis} {1e6 * n.step:+.1f} ± {1e6 * (n.sigma or 0.0):.1f} µm at {1e3 * n.place:.1f} mm"
        for n in found
    )
    return [f"residuals show a step within a line: {listed}; its chips lie otherwise than the camera's file says"]
