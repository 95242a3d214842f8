"""Cameras of 0.3 to 6 m, 6 to 200 points, attitudes with white noise, a drift, a random walk that are stated or not: an
estimate has the sigma it is given, or a warning says that it need not have; and no case is refused."""

import numpy as np
import pytest
from scipy import stats

from analysis.calibration.adjustment import adjust
from analysis.calibration.hidden_terms import FALSE_ALARM
from analysis.orbit.calibration_parameters import Noise, Prior, Unknowns
from analysis.orbit.null_space import Gauge
from analysis.orbit.three_line_model import LineModel
from tests.analysis.test_adjustment import INNER, LABORATORY, measured
from tests.analysis.test_hidden_terms import random_walk, turned
from tests.analysis.test_three_line_model import ARCSEC, PITCH, field_points, mounting, observe

AXES = ("roll", "pitch", "yaw")
LAUNCH = dict.fromkeys(INNER, 100e-6) | {f"Beijing {n}": 40.0 * ARCSEC for n in AXES}
GAUGE = Gauge(held=("nadir x", "nadir y"), start=LAUNCH)
DRIFT, WALK = 0.1 * ARCSEC, 0.3 * ARCSEC
ATTITUDES = ("white", "drift", "walk")
HALF = 6000 * PITCH


def calibrated(rng, focal, count, attitude, stated):
    """One pass of a camera whose launch changes are drawn: square of its errors in their covariance, how many of them,
    whether it was warned of."""
    models = {k: LineModel.of(mounting(k), (focal, 0.0, 0.0), half_length=HALF) for k in LABORATORY}
    change = {k: 100e-6 * rng.standard_normal(3) * (1.0 if k != "nadir" else np.array([1, 0, 0])) for k in models}
    true = {k: m.with_interior(m.interior + change[k]) for k, m in models.items()}
    bias = 40.0 * ARCSEC * rng.standard_normal(3)
    # launch moves the image by up to 0.4 mm and 160 arcsec
    wide = (0.9 * HALF - 4e-4 - 160.0 * ARCSEC * focal) / focal * 500e3 / 1.05
    view = observe(field_points(rng, count, 2.4, half=min(wide, 26e3)), 2.4, true, bias)
    noise = Noise(0.3 * PITCH, 0.5 * ARCSEC)
    field = measured(view, rng, noise)
    middle = np.mean(np.concatenate([r.time for r in field.rays.values()]))
    rate = DRIFT * rng.standard_normal(3) * (attitude == "drift")
    if attitude == "drift":
        field = turned(field, lambda t: (t - middle)[:, None] * rate)
    if attitude == "walk":
        field = turned(field, random_walk(rng, WALK))
    unknowns, priors = Unknowns(), []
    if stated and attitude == "walk":
        noise = Noise(0.3 * PITCH, 0.5 * ARCSEC, attitude_walk=WALK)
    if stated and attitude == "drift":
        unknowns = Unknowns(rate="field")
        priors = [Prior({f"Beijing {n} rate": 1.0}, 0.0, DRIFT) for n in AXES]
    found = adjust([field], models, noise, gauge=GAUGE, unknowns=unknowns, priors=priors)
    known = {f"{k} {n}": v for k, m in true.items() for n, v in zip(("f", "x", "y"), m.interior, strict=True)}
    inner = [k for k, n in enumerate(found.names) if n in known and n not in GAUGE.held]
    error = found.values[inner] - [known[found.names[k]] for k in inner]
    spread = found.covariance[np.ix_(inner, inner)]
    scale = np.sqrt(np.diag(spread))
    square = float(error / scale @ np.linalg.solve(spread / scale / scale[:, None], error / scale))
    warned = found.courses.p_value < FALSE_ALARM or (found.rates is not None and found.rates.p_value < FALSE_ALARM)
    if found.rates is not None:
        # nothing said of a drift, and what the residuals would not show is three sigmas: `twin.orbit calibrate` says so
        limit = np.sqrt(stats.chi2.isf(FALSE_ALARM, 3)) * found.rates.sigma_alone
        wrong = np.abs(found.rates.moved[inner]) * np.where(np.isfinite(limit), limit, 0.0)
        warned |= not stated and bool((wrong / scale[:, None]).max() > 3.0)
    return square, len(inner), warned


def campaign(cameras, counts, draws, seed):
    """Asserts that all is honest or warned of, false alarm 1e-4 for each of the stated kinds of attitude."""
    rng = np.random.default_rng(seed)
    for attitude in ATTITUDES:
        for stated in (True, False):
            total, size = 0.0, 0
            for focal in cameras:
                for count in counts:
                    for _ in range(draws):
                        square, dof, warned = calibrated(rng, focal, count, attitude, stated)
                        if stated:
                            total, size = total + square, size + dof
                        elif not warned:
                            assert stats.chi2.sf(square, dof) > 1e-6, (focal, count, attitude)
            if stated:
                chance = stats.chi2.sf(total, size)
                assert 5e-5 < chance < 1 - 5e-5, (attitude, total, size)


@pytest.mark.second
def test_a_small_campaign_is_honest_or_warned_of():
    campaign((0.3, 6.0), (6, 40), 1, 1)


@pytest.mark.slow
def test_five_cameras_six_to_200_points():
    campaign((0.3, 0.65, 1.5, 3.0, 6.0), (6, 8, 12, 20, 60, 200), 3, 2)
