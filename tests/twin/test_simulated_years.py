"""Simulated years, followed reading by reading as they would have been: sigmas hold, forecasts hold what comes, and a
sensor that is stuck is named.
"""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML
from scipy.stats import t as student

from optics.numerics.backend import load_backend
from scenes.specs.load import DISTURBANCES, EXAMPLES, LIBRARY
from scenes.specs.operation import read_operation
from scenes.yaml.yaml_file import dump_yaml
from twin.operate.lives.judged_life import JudgedLife, judged
from twin.operate.lives.judged_report import SHARES, judged_numbers, likely_shares
from twin.operate.lives.simulate import TELEMETRY, Simulation
from twin.operate.lives.simulation_run import Places, simulate_into
from twin.operate.record.entries import micros
from twin.run.procedure import silent

START = micros("2027-01-01T00:00:00Z")
DAY = 86_400.0
FALSE_ALARM = 1e-4
"""Of each check of shares."""
SENSORS = (
    "base",
    "base/forward",
    "base/backward",
    "base/central_prism",
    "base/forward/focal_plane",
    "base/backward/focal_plane",
)
STUCK, DEAD = "base/forward", ("base/backward", "base/central_prism")


def lived(plan_file: Path, place: Path, **what) -> JudgedLife:
    """A life, simulated and followed."""
    asked = Simulation(START, **{"every": 6 * DAY, "coefficient_error": 0.3, **what})
    simulate_into(Places(plan_file, str(place)), asked, load_backend(), silent)
    truth = json.loads((place / "simulated/life.json").read_text("utf-8"))
    return judged(read_operation(plan_file), place / "simulated" / TELEMETRY, truth, silent)


def plan_of_normal_motions(folder: Path) -> Path:
    """The shipped plan without what jumps: all is normal then, and shares are those of normal numbers."""
    data = YAML(typ="safe").load(LIBRARY / DISTURBANCES / "in_service.yaml")
    data["causes"] = {name: one for name, one in data["causes"].items() if "jump" not in str(one["time"])}
    (folder / "normal.yaml").write_text(dump_yaml(data), "utf-8")
    plan = {"instrument": "gf7_pair", "disturbances": "normal.yaml", "coefficients": "30 percent", "horizon": "720 h"}
    (folder / "plan.yaml").write_text(dump_yaml(plan), "utf-8")
    return folder / "plan.yaml"


def of_lives(shares: np.ndarray) -> tuple[float, float]:
    """Limits of a mean share over lives that are independent of each other, from their own scatter."""
    reach = student.ppf(1.0 - 0.5 * FALSE_ALARM, len(shares) - 1) * shares.std(ddof=1) / math.sqrt(len(shares))
    return float(shares.mean() - reach), float(shares.mean() + reach)


@pytest.mark.slow
def test_forecasts_of_thirty_days_hold_what_comes(tmp_path: Path) -> None:
    """Twenty lives of 300 days with a reading every 30: the next reading is the one that is forecast."""
    plan = plan_of_normal_motions(tmp_path)
    shares = {(what, times): [] for what in ("forecast", "filtered", "smoothed") for times in SHARES}
    components, inside = 0, {1.0: 0, 2.0: 0}
    for seed in range(20):
        life = lived(plan, tmp_path / str(seed), seconds=300 * DAY, every=30 * DAY, seed=seed)
        ratios = {"forecast": np.abs((life.forecast.values - life.came) / life.forecast.sigmas)[:-1]}
        ratios |= {way: np.abs(life.errors(way) / life.ways[way].sigmas) for way in ("filtered", "smoothed")}
        assert all(np.all(np.isfinite(ratio)) for ratio in ratios.values())
        for (what, times), found in shares.items():
            found.append(np.mean(ratios[what] <= times))
        made = life.following.scores
        components += made.components
        inside[1.0] += made.within_one
        inside[2.0] += made.within_two
    limits = {key: of_lives(np.array(found)) for key, found in shares.items()}
    assert all(low < SHARES[times] < high for (_, times), (low, high) in limits.items()), limits
    # predictions of readings before they came are independent of each other, so that binomial limits hold for them
    for times, count in inside.items():
        low, high = likely_shares(components, times)
        assert low < count / components < high


@pytest.mark.slow
def test_wrong_coefficients_and_failing_sensors(tmp_path: Path) -> None:
    """Coefficients wrong by 30 %, two of six sensors dead after a year, one stuck half a year later."""
    at = {body: START + round(365 * DAY * 1e6) for body in DEAD}
    late = START + round(547 * DAY * 1e6)
    what = {"seconds": 1096 * DAY, "seed": 3, "sensors": SENSORS, "dead": at, "stuck": {STUCK: late}}
    life = lived(EXAMPLES / "operation.yaml", tmp_path / "life", **what)
    states = {one.body: one for one in life.following.sensors}
    assert {body: states[body].state for body in SENSORS} == {
        **dict.fromkeys(SENSORS, "ok"),
        **dict.fromkeys(DEAD, "dead"),
        STUCK: "stuck",
    }
    assert STUCK in json.dumps(judged_numbers(life)["sensors"])
    # a reading goes by between the last one of a sensor and the moment from which on it is stuck
    assert abs(states[STUCK].since_us - late) <= 12 * DAY * 1e6
    made = life.following.scores
    # jumps that are stated and do not come leave sigma too large, never too small
    assert made.within_one / made.components > likely_shares(made.components, 1.0)[0]
    assert made.within_two / made.components > likely_shares(made.components, 2.0)[0]
    explained = np.array(list(life.following.explained.values()))
    assert np.all(np.isfinite(explained))
