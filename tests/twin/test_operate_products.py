"""Products of an operation for the time of a scene: camera models, the state as a job, and a prior."""

import hashlib
import json
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2

from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.monitor.limits import Quantity
from analysis.monitor.parameters import ANGLE, ANGLE_GROUP
from optics.numerics.backend import load_backend
from scenes.models.disturbances import Component, prior_of_spec, state_of
from scenes.specs.disturbances import MOST_JOINT
from scenes.specs.load import ORBIT, SCENES, load_disturbances
from scenes.specs.operation import OperationSetup
from scenes.specs.resolved import resolve, resolve_with
from scenes.yaml.errors import InputError, Problem
from tests.twin import operation_records as records
from tests.twin.commands import files, invoke
from tests.twin.line_scanner_model import LineScannerModel
from tests.twin.products_bench import StandIn
from tests.twin.record_bench import START, given, made, pair
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.operate.__main__ import app as operate
from twin.operate.estimate.operation_filter import Operation
from twin.operate.estimate.operation_model import store_plan
from twin.operate.estimated_motions import EstimatedMotions, perturbation, prior_files, state_file
from twin.operate.products import Products, ValidityLimit, _warnings, product_files, validity
from twin.operate.products import make_products as products_of
from twin.operate.record.entries import MICRO, Entry, micros, utc_text
from twin.operate.record.history import History, initialise_record
from twin.orbit.export.export_run import ExportSource, read_source
from twin.orbit.flight.line_camera import corrected_line, traced_line_cameras

SCENE = SCENES / ORBIT / "angle_gf7.yaml"
NOISE = 0.005**2 * np.eye(8)
KNOWN = ("prior", "instrument", "thermal", "cameras", "ground")
"""Of an experiment, what products ask for beside its disturbances."""


@cache
def experiment() -> MonitorExperiment:
    return MonitorExperiment(pair(), load_backend())


def experiment_of(plan: OperationSetup) -> MonitorExperiment:
    return MonitorExperiment(plan.model, load_backend())


def drawn(seed: int, count: int = 1) -> np.ndarray:
    """Amounts (count, M), SI."""
    stated = experiment().prior
    assert stated is not None
    return stated.draw(np.random.default_rng(seed), count)


def stand_in(amounts: np.ndarray, times: tuple[int, ...] = (START,), **more: object) -> StandIn:
    """Readings of states by their linear effect on the spots."""
    stated = experiment().disturbances
    assert stated is not None
    unit = stated.sigmas * np.array([one.unit_size for one in experiment().prior.components])
    return StandIn(experiment(), np.array(times), (amounts / unit) @ stated.spots.T, NOISE, **more)


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory) -> History:
    record = made(tmp_path_factory.mktemp("record") / "record")
    record.ingest(given("reading", [Entry("monitor", "monitor", START, {"numbers": {}})]))
    return record


@cache
def scene() -> ExportSource:
    return read_source(SCENE)


@pytest.fixture(scope="module")
def one(history: History) -> Products:
    """Of a large disturbance, with a scene."""
    return products_of(stand_in(drawn(3)), history, START, scene(), load_backend())


# --- the span in which an estimate holds --------------------------------------------------------------------------


@dataclass(frozen=True)
class Walk:
    """A quantity whose variance grows by `rate` per second on either side of a time, and whose mean by `slope`."""

    rate: float
    slope: float
    quantities = (Quantity(ANGLE_GROUP, ANGLE, np.ones(8)),)

    def __call__(self, times):
        away = (np.array(times, float) - START)[:, None] / MICRO
        sigmas = np.sqrt(1.0 + self.rate * np.abs(away))
        return SimpleNamespace(quantities=self.quantities, values=self.slope * away, sigmas=sigmas)


FIRST, LAST = ValidityLimit(START - 10**12, "first"), ValidityLimit(START + 10**13, "last")


@pytest.mark.parametrize(
    ("walk", "seconds", "reason"),
    [
        # the mean square may grow to 1.44
        (Walk(1e-3, 0.0), 440.0, "its sigma grows"),
        (Walk(0.0, 1e-2), np.sqrt(0.44) / 1e-2, "its estimate changes"),
    ],
)
def test_an_estimate_holds_until_its_error_is_a_fifth_larger(walk: Walk, seconds: float, reason: str) -> None:
    found = validity(walk, START, FIRST, LAST)
    # times are looked at on a grid of which the last step is below a hundredth of the way
    for away in (found.until - START, START - found.since):
        assert 0.99 * seconds < away / MICRO <= seconds
    assert found.until_reason == found.since_reason
    assert found.until_reason.endswith(reason)
    assert found.until_reason.startswith("the error of intersection_angle change_arcsec")


def test_an_estimate_does_not_hold_across_what_is_known_to_have_happened() -> None:
    still = Walk(0.0, 0.0)
    found = validity(still, START, FIRST, LAST)
    assert (found.since, found.until) == (FIRST.time, LAST.time)
    assert (found.since_reason, found.until_reason) == ("first", "last")
    marks = [
        ValidityLimit(START - MICRO, "before"),
        ValidityLimit(START, "now"),
        ValidityLimit(START + 7, "after"),
        ValidityLimit(START + 9, "later"),
    ]
    found = validity(still, START, FIRST, LAST, marks)
    assert (found.since, found.since_reason, found.until, found.until_reason) == (START, "now", START + 7, "after")
    # a mark far away does not widen what a growing error allows
    assert validity(Walk(1e-3, 0.0), START, FIRST, LAST, marks[:1]).since_reason == "before"
    assert "grows" in validity(Walk(1.0, 0.0), START, FIRST, LAST, marks[:1]).since_reason


# --- the state as a job, the prior --------------------------------------------------------------------------------


def test_what_a_job_cannot_say_is_told() -> None:
    prism = "base/forward/monitor/left/prism_180"
    glass = Component("a", prism, "index_gradient", 1, "origin", 1e-6)
    with pytest.raises(ValueError, match="2 components"):
        EstimatedMotions.in_units((glass, glass), np.array([2e-6]), np.eye(2))
    found = EstimatedMotions((glass,), np.array([2e-6]), np.eye(1))
    assert perturbation(found, experiment().thermal) == {}
    _, (left,) = state_file(found, experiment().thermal, "gf7_pair", "orbit", "")
    assert (left.name, left.amount, left.unit) == (f"{prism} index_gradient y", 2e-6, "ppm/m")


def test_two_causes_about_two_points_are_one_motion(tmp_path: Path) -> None:
    """What they do together to the cameras is what the merged components of job and prior do."""
    body = "base/forward/focal_plane"
    components = (
        Component("one", body, "rotate", 0, "origin", 1.0),
        Component("two", body, "rotate", 0, "rear_node", 1.0),
        Component("two", body, "rotate", 1, "rear_node", 1.0),
        Component("one", "base/forward", "scale", 0, "origin", 1.0),
        Component("one", body, "shift", 1, "origin", 1.0),
    )
    amounts = np.array([3e-6, -5e-6, 4e-6, 2e-6, 1e-6])
    found = EstimatedMotions(components, amounts, np.diag(amounts**2))
    own = state_of(amounts, components, experiment().thermal)
    said = {path: what.motion() for path, what in perturbation(found, experiment().thermal).items()}
    stated = Disturbances(
        *("s", tuple(map(str, range(5))), (body,) * 5, ("a",) * 5, np.ones(5), ("1",) * 5),
        *(np.ones((2, 5)), np.ones((8, 5)), np.eye(5), (None,) * 5),
    )
    prior = prior_files(found, stated, experiment().instrument, "p", "reason", "")
    merge_components = state_of(prior.table @ amounts, prior.components, experiment().thermal)
    truth = experiment().sight.truth([own, said, merge_components])
    changes = truth.vector("forward")
    assert abs(changes[0, 1]) > 1e-6
    np.testing.assert_allclose(changes[1], changes[0], rtol=1e-9, atol=1e-14)
    # linear in the motion: products of turns of 5e-6 rad, and of a turn and a growth, over 6 m
    np.testing.assert_allclose(changes[2], changes[0], rtol=1e-4, atol=3e-10)
    for name, text in prior.files.items():
        (tmp_path / name).write_text(text, "utf-8")
    back = prior_of_spec(load_disturbances(str(tmp_path / "p.yaml")), experiment().instrument)
    np.testing.assert_allclose(back.covariance, prior.table @ found.covariance @ prior.table.T, rtol=1e-9, atol=1e-24)


def test_of_too_many_components_those_that_matter_least_are_left_out() -> None:
    """Figure terms of mirrors, each of another size; the spots and parameters see all alike."""
    mirrors = [f"base/{c}/M{k}" for c in ("forward", "backward") for k in (1, 2, 3)]
    components = tuple(Component("a", m, "figure", j, "origin", 1.0) for m in mirrors for j in range(4, 40))
    count = len(components)
    assert count > MOST_JOINT
    amounts = 1e-9 * np.random.default_rng(1).permutation(np.arange(1.0, count + 1.0)) / count
    stated = SimpleNamespace(sigmas=np.ones(count), spots=np.ones((2, count)), parameters=np.ones((8, count)))
    found = EstimatedMotions(components, np.zeros(count), np.diag(amounts**2))
    prior = prior_files(found, stated, experiment().instrument, "p", "reason", "")
    assert len(prior.components) == MOST_JOINT
    gone = {one.name for one in prior.omitted}
    least = np.argsort(amounts)[: count - MOST_JOINT]
    assert gone == {components[k].name for k in least}
    share = amounts**2 / np.sum(amounts**2)
    assert max(one.share for one in prior.omitted) == pytest.approx(share[least].max(), rel=1e-12)
    assert {one.name: one.amount for one in prior.omitted} == pytest.approx(
        {components[k].name: amounts[k] for k in least}, rel=1e-9
    )


# --- what is refused and what limits ------------------------------------------------------------------------------


def problem(history: History, time: int, source: ExportSource | None = None) -> Problem:
    with pytest.raises(Problem) as told:
        products_of(stand_in(drawn(3)), history, time, source, load_backend())
    return told.value


@pytest.mark.second
def test_times_of_which_nothing_is_known_are_refused(history: History, tmp_path: Path) -> None:
    end = START + 30 * 86400 * MICRO
    early, late, none = (
        problem(history, START - 1),
        problem(history, end + 1),
        problem(made(tmp_path / "none"), START),
    )
    assert "before the first reading" in early.problem
    assert early.allowed == f"a time from {utc_text(START)} to {utc_text(end)}"
    assert "beyond the forecast" in late.problem
    assert "lengthen the plan's horizon" in (late.allowed or "")
    assert "no reading of the monitor" in none.problem
    assert "twin.operate ingest" in (none.allowed or "")


@pytest.mark.second
def test_a_scene_that_its_orbit_does_not_cover_is_refused(history: History, tmp_path: Path) -> None:
    (tmp_path / "angle.yaml").write_text(SCENE.read_text("utf-8").replace("time: 0 s", "time: 59.9999 s"), "utf-8")
    source = read_source(tmp_path / "angle.yaml")
    with pytest.raises(InputError, match=": time: the orbit ends at the moment of the test; allowed: a longer orbit"):
        products_of(stand_in(drawn(3)), history, START, source, load_backend())


def test_a_scene_of_another_instrument_is_refused(history: History, tmp_path: Path) -> None:
    other = (SCENES / "library" / "instruments" / "gf7_pair.yaml").read_text("utf-8")
    other = other.replace("name: gf7_pair", "name: zy3_pair").replace("look: 26 deg", "look: 25 deg")
    (tmp_path / "zy3_pair.yaml").write_text(other, "utf-8")
    text = SCENE.read_text("utf-8").replace("camera: gf7_pair ", "camera: ./zy3_pair.yaml ")
    (tmp_path / "angle.yaml").write_text(text, "utf-8")
    told = problem(history, START, read_source(tmp_path / "angle.yaml"))
    assert "another instrument" in told.problem
    assert "camera: gf7_pair" in (told.allowed or "")


@pytest.mark.second
def test_the_version_goes_with_the_record_and_the_plan(tmp_path: Path) -> None:
    record, backend = made(tmp_path / "record"), load_backend()
    record.ingest(given("reading", [Entry("monitor", "monitor", START, {"numbers": {}})]))
    operation = stand_in(drawn(3))
    first, again, other = (
        products_of(one, record, START, None, backend).version
        for one in (operation, operation, replace(operation, horizon=3600.0))
    )
    assert first == again != other
    record.ingest(given("later", [Entry("temperature", "base", START, {"sigma": 1.0, "unit": "K", "values": [293.0]})]))
    assert products_of(operation, record, START, None, backend).version not in (first, other)


@pytest.mark.second
def test_events_jumps_and_requirements_limit_the_span(history: History) -> None:
    """With motions that do not go on in time nothing else does."""
    told = SimpleNamespace(**{name: getattr(experiment(), name) for name in KNOWN})
    told.disturbances = replace(experiment().disturbances, laws=(TimeLaw(),) * len(experiment().prior.components))
    hour = 3600 * MICRO
    quantity = "ground height_m"
    base = {
        "events": ((START + hour, "safe_mode", ("settling",)), (START + 1, "heater_set_point", ())),
        "jumps": (SimpleNamespace(body="base/forward/M2", after_us=START + 4 * hour, until_us=START + 5 * hour),),
        "requirements": (
            SimpleNamespace(quantity=quantity, breaks_us=START + 9 * hour, probability=0.99, holds_now=True),
        ),
    }
    operation = replace(stand_in(drawn(3), **base), experiment=told)
    spans = []
    for time in (0, 2, 6, 10):
        held = products_of(operation, history, START + time * hour, None, load_backend()).validity
        spans.append(tuple(round((t - START) / hour) for t in (held.since, held.until)))
        assert held.since_reason
    assert spans == [(0, 1), (1, 4), (5, 9), (9, 720)]
    text = f"{quantity} may violate its requirement (probability above 1.0 %) from {utc_text(START + 9 * hour)[:10]} on"
    assert text in products_of(operation, history, START + 6 * hour, None, load_backend()).validity.until_reason
    broken = replace(operation, requirements=(SimpleNamespace(quantity=quantity, breaks_us=None, holds_now=False),))
    found = products_of(broken, history, START, None, load_backend())
    assert found.warnings == ("ground height_m violates its requirement",)


def test_what_limits_products_is_told() -> None:
    """A scene a minute and more from the estimate, a model without polynomials, what a job or a prior does not have."""
    calm = SimpleNamespace(warnings=["doubt"], requirements=(SimpleNamespace(quantity="q", holds_now=True),))
    whole = SimpleNamespace(omitted=())
    assert _warnings(calm, START, START - 60 * MICRO, None, (), whole) == ("doubt",)
    assert _warnings(calm, START, None, None, (), whole) == ("doubt",)
    broken = SimpleNamespace(warnings=[], requirements=(SimpleNamespace(quantity="q", holds_now=False),))
    lines = {"a": SimpleNamespace(polynomial=None, refused="too steep"), "b": SimpleNamespace(polynomial=1)}
    small = SimpleNamespace(omitted=(SimpleNamespace(share=0.001), SimpleNamespace(share=0.02)))
    found = _warnings(broken, START, START + 60 * MICRO + 1, SimpleNamespace(lines=lines), (1, 2, 3), small)
    assert found == (
        f"the scene was taken at {utc_text(START + 60 * MICRO + 1)}, and the estimate is for {utc_text(START)}",
        "q violates its requirement",
        "a has no rational polynomials: too steep",
        "state.yaml omits 3 motions that a job cannot express",
        "prior.yaml omits the 2 least important components; none contributes more than 2 % to the variance "
        "of a spot or a parameter",
    )


# --- camera models ------------------------------------------------------------------------------------------------


def places(sensor, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(8)
    return rng.uniform(0.0, sensor.lines - 1.0, count), rng.uniform(0.0, sensor.camera.pixels - 1.0, count)


def horizontal(sensor, away: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """(N, 2) east and north of errors (N, 3)."""
    longitude, latitude, _ = sensor.earth.geodetic(ground)
    east = np.stack([-np.sin(longitude), np.cos(longitude), np.zeros_like(longitude)], axis=-1)
    north = np.stack(
        [-np.sin(latitude) * np.cos(longitude), -np.sin(latitude) * np.sin(longitude), np.cos(latitude)], axis=-1
    )
    return np.stack([np.sum(away * east, axis=-1), np.sum(away * north, axis=-1)], axis=-1)


@pytest.mark.second
def test_err_bias_is_the_scatter_of_points_of_drawn_cameras(one: Products) -> None:
    """Cameras drawn from the covariance see the ground beside where the estimated one does: their mean square is that
    of ERR_BIAS to the error of 200 draws, and the derivatives are those of the exact turn.
    """
    line = one.export.lines["forward"]
    change, window = one.changes["forward"], line.window
    laboratory = replace(window.sensor.camera, directions=window.calibrated.directions)
    root = np.linalg.cholesky(change.constant)
    rng = np.random.default_rng(4)
    square = []
    at, pixel = np.full(9, 16000.0), np.linspace(-0.5, 32767.5, 9)
    base = window.sensor.ground(at, pixel, line.ground.height_m)
    for unit in rng.standard_normal((200, 4)):
        camera = corrected_line(laboratory, window.calibrated, change.values + root @ unit)
        away = replace(window.sensor, camera=camera).ground(at, pixel, line.ground.height_m) - base
        square.append(np.mean(horizontal(window.sensor, away, base) ** 2, axis=0))
    east, north = np.sqrt(np.mean(square, axis=0))
    # a mean square of 200 normal numbers is known to 10 %, its root to 5 %: three of these
    assert line.ground.bias_east_m == pytest.approx(east, rel=0.15)
    assert line.ground.bias_north_m == pytest.approx(north, rel=0.15)
    # of one horizontal axis, as GDAL defines it
    assert line.ground.bias_m == pytest.approx(np.sqrt(0.5 * np.mean(np.sum(square, axis=1))), rel=0.15)
    both = np.hypot(line.ground.bias_east_m, line.ground.bias_north_m)
    assert line.ground.bias_m == pytest.approx(both / np.sqrt(2.0), rel=1e-12)
    assert line.ground.random_m == 0.0


@pytest.mark.second
def test_what_is_white_in_time_is_err_rand_and_not_applied(history: History) -> None:
    """The mirrors' mounts, once stated as white: whether an image is taken at a reading or a microsecond later makes no
    difference, though the estimate at the reading itself knows of them.
    """
    base = stand_in(drawn(3))
    laws = tuple(
        replace(law, white=True, drift_s=None, period_s=None) if c == "mirror_mounts" else law
        for law, c in zip(base.stated.laws, base.stated.causes, strict=True)
    )
    stated = replace(base.stated, laws=laws)
    told = SimpleNamespace(disturbances=stated, **{name: getattr(experiment(), name) for name in KNOWN})
    white = [law.white for law in laws]
    rows = stated.parameters[:4] * white
    at_once, beside = (
        products_of(replace(base, experiment=told), history, time, None, load_backend()) for time in (START, START + 1)
    )
    for found in (at_once, beside):
        np.testing.assert_allclose(found.changes["forward"].random, rows @ rows.T, rtol=1e-9)
    assert np.any(rows)
    # motions with a drift of 20 h are the same a microsecond later
    for key in ("values", "constant"):
        one, two = (getattr(found.changes["forward"], key) for found in (at_once, beside))
        unit = np.sqrt(np.diagonal(at_once.changes["forward"].constant))
        scale = unit if key == "values" else np.outer(unit, unit)
        assert np.abs((one - two) / scale).max() < 1e-6
    assert beside.course.covariance[0, 0, 0] > 1.001 * at_once.course.covariance[0, 0, 0]


@pytest.mark.second
def test_models_see_what_the_changed_instrument_sees(one: Products) -> None:
    """ISD of the product, read by an independent program, and RPC against exact chief rays of the true state: wrong by
    what ERR_BIAS says, where the models of the laboratory's cameras are wrong by several times more.
    """
    backend = load_backend()
    state = state_of(drawn(3)[0], experiment().prior.components, experiment().thermal)
    true = traced_line_cameras(experiment().instrument, backend, state)
    written, numbers = product_files(one)
    for name, line in one.export.lines.items():
        sensor = line.window.sensor
        at, pixel = places(sensor)
        height = one.export.heights[1]  # where the ISD is right
        ground = replace(sensor, camera=true[name]).ground(at, pixel, height)
        # metres on the ground of a pixel along the line and of a line along the track
        metres = [
            np.linalg.norm(sensor.ground(at + a, pixel + b, height) - sensor.ground(at, pixel, height), axis=-1)
            for a, b in ((0.5, 0.0), (0.0, 0.5))
        ]
        seen = LineScannerModel(json.loads(written[f"models/{name}.json"])).image(ground)
        isd = np.hypot(2.0 * metres[0] * (seen[0] - 0.5 - at), 2.0 * metres[1] * (seen[1] - 0.5 - pixel))
        laboratory = replace(sensor.camera, directions=line.window.calibrated.directions)
        before = np.linalg.norm(replace(sensor, camera=laboratory).ground(at, pixel, height) - ground, axis=-1)
        bias = np.hypot(line.ground.bias_east_m, line.ground.bias_north_m)
        # one state: an error of twice the root mean square comes in 2 of 100
        assert np.sqrt(np.mean(isd**2)) < 2.5 * bias
        assert np.sqrt(np.mean(before**2)) > 3.0 * np.sqrt(np.mean(isd**2))
        told = json.loads(written[f"models/{name}.json"])["notes"]
        assert any(one.version in text for text in told)
        assert any(utc_text(one.validity.until) in text for text in told)
        (tag,) = line.polynomial.tags()
        assert tag[3][:2] == (line.ground.bias_m, line.ground.random_m)
        longitude, latitude, _ = sensor.earth.geodetic(ground)
        rpc = np.stack(line.polynomial.image(np.degrees(latitude), np.degrees(longitude), np.full(len(at), height)))
        assert np.hypot(2.0 * metres[0] * (rpc[0] - at), 2.0 * metres[1] * (rpc[1] - pixel)).max() < 4.0 * bias
    assert set(numbers["models"]) == {"forward", "backward"}


# --- of a record that is followed ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Followed:
    """A record with six readings of a drawn life, one each day, and the plan that it keeps."""

    place: Path
    life: records.Life
    time: int


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> Followed:
    folder = tmp_path_factory.mktemp("followed")
    plan = records.plan_of(folder, "gf7_pair")
    place = folder / "record"
    initialise_record(str(place), pair(), True)
    own = experiment_of(plan)
    assert own.disturbances is not None
    life = records.life_of(own.disturbances, 6.0, 1.0, 3, {})
    with History(str(place)) as record:
        store_plan(plan, folder / "plan.yaml", record)
        entries = [records.monitor_entry(own, own.disturbances, life, k, 3) for k in range(len(life.times))]
        record.ingest(records.given("readings", entries))
    return Followed(place, life, int(life.times[-1]))


def command(*words: object):
    return invoke(operate, "products", *words)


def test_the_command_writes_products_of_a_record(followed: Followed, tmp_path: Path) -> None:
    """Within the sigma of the truth."""
    out = tmp_path / "products"
    when = utc_text(followed.time)
    result = command(followed.place, "--time", when, "--scene", SCENE, "--out", out, "--json")
    assert result.exit_code == 0, result.stderr
    told = json.loads(result.stdout)
    assert told == json.loads((out / "products.json").read_text("utf-8"))
    assert files(out) == {"products.json", "manifest.json", *told["sha256"]}
    again = command(followed.place, "--time", when, "--scene", SCENE, "--out", out, "--force", "--json")
    assert json.loads(again.stdout) == told, again.stderr
    for name, digest in told["sha256"].items():
        assert hashlib.sha256((out / name).read_bytes()).hexdigest() == digest
    assert (told["time_utc"], told["readings"], told["newest_utc"]) == (when, 6, when)
    assert micros(told["valid_from_utc"]) <= followed.time <= micros(told["valid_until_utc"])
    assert told["warnings"] == [f"the scene was taken at 2021-09-15T03:20:00Z, and the estimate is for {when}"]
    # the plan that a record keeps has the cameras in the order of their names
    places = [("forward", "backward").index(camera) for camera in told["cameras"]]
    truth = followed.life.changes[-1].reshape(2, 4)[places].ravel()
    error = truth - np.concatenate([told["changes"][camera] for camera in told["cameras"]])
    # eight degrees of freedom, a chance of 1e-4
    assert error @ np.linalg.solve(np.array(told["covariance"]), error) < chi2.isf(1e-4, 8)
    assert np.abs(followed.life.changes[-1][:3]).max() > 10.0 * np.sqrt(told["covariance"][0][0])
    # quantities and sigmas in the units of their keys are those of changes and covariance, in rad and m
    units = {"d_alpha_arcsec": 648000 / np.pi, "d_beta_arcsec": 648000 / np.pi, "d_gamma_arcsec": 648000 / np.pi}
    for row, (camera, (key, unit)) in enumerate(product(told["cameras"], (units | {"d_f_um": 1e6}).items())):
        one = told["estimate"][camera]
        assert one[key] == pytest.approx(unit * told["changes"][camera][row % 4], rel=1e-9)
        assert one[f"{key}_sigma"] == pytest.approx(unit * np.sqrt(told["covariance"][row][row]), rel=1e-9)


@pytest.mark.second
def test_products_are_the_same_whenever_and_by_whichever_plan_they_are_asked_for(
    followed: Followed, tmp_path: Path
) -> None:
    when, out = utc_text(followed.time), tmp_path / "products"
    told, again = (
        json.loads(command(followed.place, "--time", when, "--scene", SCENE, "--out", place, "--json").stdout)
        for place in (out, tmp_path / "again")
    )
    assert again == told
    # the plan as its user wrote it has causes and cameras in another order than the one that the record keeps
    plan = followed.place.parent / "plan.yaml"
    other = json.loads(command(followed.place, plan, "--time", when, "--out", tmp_path / "other", "--json").stdout)
    assert other["changes"] == told["changes"]
    assert {name: other["sha256"][name] for name in ("state.yaml", "prior.yaml")} == {
        name: told["sha256"][name] for name in ("state.yaml", "prior.yaml")
    }
    text = command(followed.place, "--time", when, "--out", tmp_path / "text").stdout
    assert f"gf7_pair at {when}, from 6 readings" in text
    assert files(tmp_path / "text") == files(out) - {
        f"models/{c}{e}" for c in ("forward", "backward") for e in (".json", "_RPC.TXT")
    }


@pytest.mark.second
def test_the_files_of_a_record_are_its_estimate(followed: Followed, tmp_path: Path) -> None:
    """Motions of the job make the changes of the estimate, and the prior their covariance."""
    later = utc_text(followed.time + 3600 * MICRO)
    result = command(followed.place, "--time", later, "--out", tmp_path / "p", "--json")
    told = json.loads(result.stdout)
    job = resolve(tmp_path / "p" / "state.yaml")
    own = MonitorExperiment(job, load_backend())
    truth = own.sight.truth([own.state(job.job)])
    changes = np.concatenate([truth.vector(camera)[0] for camera in told["cameras"]])
    stated = np.concatenate([told["changes"][camera] for camera in told["cameras"]])
    covariance = np.array(told["covariance"])
    # what is not linear of motions of some arcseconds is below a hundredth of a sigma
    assert np.abs((changes - stated) / np.sqrt(np.diagonal(covariance))).max() < 0.02
    prior = own.stating(resolve_with("gf7_pair", str(tmp_path / "p" / "prior.yaml"))).disturbances
    order = [4 * list(own.instrument.cameras).index(camera) + k for camera in told["cameras"] for k in range(4)]
    unit = np.sqrt(np.diagonal(covariance))
    away = prior.parameter_covariance[np.ix_(order, order)] - covariance
    assert np.abs(away / np.outer(unit, unit)).max() < 1e-6


@pytest.mark.second
def test_a_state_has_the_temperatures_that_do_what_was_found(tmp_path: Path) -> None:
    """Heat does twice what the thermal model says, and sensors tell the temperatures. The job of the state has those by
    which the thermal model does as much, so that its changes are the estimate's, and so has the prior.
    """
    plan = records.plan_of(tmp_path, "gf7_pair")
    own = experiment_of(plan)
    stated, components = own.disturbances, own.prior.components
    heat = [k for k, one in enumerate(components) if one.kind == "temperature"]
    life = records.life_of(stated, 12.0, 1.0, 4, {})
    acting = life.motions.copy()
    acting[:, heat] *= 2.0
    initialise_record(str(tmp_path / "record"), pair(), True)
    with History(str(tmp_path / "record")) as history:
        twice = replace(life, motions=acting)
        readings = [records.monitor_entry(own, stated, twice, k, 4) for k in range(len(life.times))]
        history.ingest(records.given("readings", readings))
        for k in heat:
            kelvin = history.temperature + life.motions[:, k] * components[k].sigma
            warm = [
                records.temperature_entry(components[k].body, int(time), value, 0.01)
                for time, value in zip(life.times, kelvin.tolist(), strict=True)
            ]
            history.ingest(records.given(components[k].body, warm))
        operation = Operation(history, plan)
        one = products_of(operation, history, int(life.times[-1]), None, load_backend())
        plain, found = (operation.motions(int(life.times[-1]), acting=which) for which in (False, True))
    by = stated.parameters / stated.sigmas
    unit = np.sqrt(np.diagonal(one.course.covariance[0]))
    assert np.abs((by @ found.mean - one.course.changes[0]) / unit).max() < 1e-6
    away = by @ found.covariance @ by.T - one.course.covariance[0]
    assert np.abs(away / np.outer(unit, unit)).max() < 1e-6
    # heat that does twice what is stated of it contradicts the statement from the first readings on
    assert all("contradict the prior" in text for text in one.warnings)
    # what the sensors read is half of it
    assert np.abs((by @ plain.mean - one.course.changes[0]) / unit).max() > 3.0
    np.testing.assert_allclose(plain.mean[heat], life.motions[-1, heat] * stated.sigmas[heat], atol=0.03)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--time", "yesterday"), "--time"),
        ((), "no time: give --time UTC, or --scene FILE"),
        (("--scene", SCENE), "before the first reading"),
        (("--time", "2026-03-03T00:00:00Z", "--scene", SCENES / ORBIT / "angle.yaml"), "of a payload"),
        (("--time", "2026-03-03T00:00:00Z", "--scene", SCENES / ORBIT / "monitor.yaml"), "does not read this"),
        (("--time", "2026-03-03T00:00:00Z", "--scene", "no.yaml"), "no.yaml"),
        (("--scene", SCENES / ORBIT / "simulate.yaml"), "--scene: not a scene of an instrument"),
    ],
)
def test_what_the_command_refuses(followed: Followed, tmp_path: Path, words, said: str) -> None:
    result = command(followed.place, *words, "--out", tmp_path / "products")
    assert (result.exit_code, result.stdout) == (2, "")
    assert said in result.stderr
    assert not (tmp_path / "products").exists()


def test_a_scene_that_cannot_be_flown_names_its_key(followed: Followed, tmp_path: Path) -> None:
    text = SCENE.read_text("utf-8").replace("[20 arcsec, -35 arcsec, 15 arcsec]", "[80 deg, 0 deg, 0 deg]")
    (tmp_path / "past.yaml").write_text(text, "utf-8")
    when = ("--time", utc_text(followed.time))
    result = command(followed.place, *when, "--scene", tmp_path / "past.yaml", "--out", tmp_path / "p")
    assert (result.exit_code, "past.yaml:" in result.stderr) == (2, True), result.stderr


def test_products_that_cannot_be_written_are_told(followed: Followed) -> None:
    result = command(followed.place, "--time", utc_text(followed.time), "--out", followed.place / "record.sqlite" / "x")
    said = " ".join(result.stderr.split())
    assert (result.exit_code, "cannot make the output folder" in said) == (2, True), said


def test_a_record_without_a_plan_says_how_to_keep_one(tmp_path: Path) -> None:
    made(tmp_path / "record").close()
    (tmp_path / "there").mkdir()
    for out, words in (("products", "init RECORD gf7_pair --plan FILE"), ("there", "exists; choose another")):
        result = command(tmp_path / "record", "--time", "2026-03-03T00:00:00Z", "--out", tmp_path / out)
        assert (result.exit_code, words in result.stderr) == (2, True), result.stderr
