"""Fields calibrated by the paper's stepwise solution from points that are matched in rendered images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from analysis.orbit.adjustment import Adjustment
from analysis.orbit.forward_intersection import CheckErrors
from analysis.orbit.stepwise import Stepwise, stepwise
from analysis.orbit.three_line_model import BIAS, INTERIOR
from analysis.units import ARCSEC
from scenes.orbit_angle import LINES
from scenes.orbit_setup import CalibrationSetup
from twin.orbit.calibration.campaign import Campaign, FieldPass, fly_fields
from twin.orbit.calibration.image_sections import image_totals
from twin.orbit.calibration.schemes import GAUGE, calibrated_alone, tested, tested_before
from twin.orbit.calibration.screening import screened
from twin.validation.paper_003.exact import TOLERANCE, errors_of

Advance = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class FromImages:
    """One field.

    Attributes:
        name: of it.
        control, check: points that are left.
        way: the stepwise solution. together: the simultaneous one, for sigmas.
        error: unknown -> stepwise estimate minus truth, radians and metres; free ones only.
        covariance: of these, in their order.
        before, after: errors at check points with the laboratory's camera and with the field's parameters.
    """

    name: str
    control: int
    check: int
    way: Stepwise
    together: Adjustment
    error: dict[str, float]
    covariance: np.ndarray
    before: CheckErrors
    after: CheckErrors

    def rms(self, names: tuple[str, ...]) -> tuple[float, float]:
        """RMS error of some unknowns and the standard deviation of that, by their covariance."""
        where = [list(self.error).index(n) for n in names]
        part = self.covariance[np.ix_(where, where)]
        # variance of a sum of squares of correlated normal errors is twice the trace of the squared covariance
        mean = float(np.trace(part)) / len(where)
        spread = float(np.sqrt(2.0 * np.trace(part @ part))) / len(where)
        found = float(np.sqrt(np.mean([self.error[n] ** 2 for n in names])))
        return found, spread / (2.0 * float(np.sqrt(mean)))


ROLL_PITCH = BIAS[:2]
YAW = BIAS[2:]
FREE_INTERIOR = tuple(n for n in (f"{line} {k}" for line in LINES for k in INTERIOR) if n not in GAUGE.held)


def measured(setup: CalibrationSetup, seed: np.random.SeedSequence, advance: Advance) -> Campaign:
    """Render the fields and match their points; what the adjustment rejects is left out."""

    def told(_: str, done: int, total: int) -> None:
        advance(done / total)

    return screened(fly_fields(setup, seed, told))


def calibrated(campaign: Campaign) -> tuple[FromImages, ...]:
    """Every field by itself."""
    return tuple(_field(campaign, one) for one in campaign.passes)


def matching(campaign: Campaign) -> tuple[float, dict[str, int]]:
    """RMS of right places of control points against the truth over lines and pixels, px, and counts."""
    assert campaign.images is not None
    square, count = 0.0, 0
    for field in campaign.images:
        for patch in field.patches:
            for one in patch.judgements["control"].values():
                right = one.degrees_of_freedom // 2
                square += right * float(np.sum(np.nan_to_num(one.rms) ** 2))
                count += 2 * right
    return float(np.sqrt(square / max(count, 1))), image_totals(campaign)


def _field(campaign: Campaign, one: FieldPass) -> FromImages:
    together = calibrated_alone(campaign, one)
    way = stepwise([one.control], campaign.laboratory, campaign.noise, held=GAUGE.held, tolerance=TOLERANCE)
    free = [n for n in together.names if n not in GAUGE.held]
    error = {n: v for n, v in errors_of(campaign, one, way).items() if n not in GAUGE.held}
    where = [together.names.index(n) for n in free]
    value = dict(zip(way.names, way.values, strict=True))
    cameras = {
        line: camera.with_interior([value[f"{line} {k}"] for k in INTERIOR])
        for line, camera in campaign.laboratory.items()
    }
    bias = np.array([value[f"{one.name} {n}"] for n in BIAS])
    after = tested(campaign, one, cameras, bias)
    return FromImages(
        one.name,
        int(one.control.control.sum()),
        len(one.check_ground),
        way,
        together,
        error,
        together.covariance[np.ix_(where, where)],
        tested_before(campaign)[one.name],
        after,
    )


def told(found: FromImages, names: tuple[str, ...]) -> str:
    """Errors and sigmas of some unknowns of a field, in words."""
    sigma = dict(zip(found.error, np.sqrt(np.diag(found.covariance)).tolist(), strict=True))
    parts = []
    for n in names:
        scale, unit, digits = (ARCSEC, "″", 2) if n in BIAS else (1e-6, " µm", 1)
        parts.append(f"{n} {found.error[n] / scale:+.{digits}f} ± {sigma[n] / scale:.{digits}f}{unit}")
    return f"{found.name}, {found.control} control points: {', '.join(parts)}."
