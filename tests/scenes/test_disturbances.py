"""Disturbances as files say them: what they come to on an instrument, what a job says instead, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from optics.geometry.tree import Motion
from optics.thermal.heat import Temperature
from scenes.models import disturbances
from scenes.models.disturbances import Component, DisturbancePrior, disturbance_prior, state_of
from scenes.models.instrument_builder import build_instrument
from scenes.models.thermal_model import ThermalModel
from scenes.specs import load
from scenes.specs.disturbances import DisturbancesSpec
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from tests.tiers import quick
from twin.monitor.monitor_derivative import STEPS, disturbances_of
from twin.monitor.monitor_path import MonitorPath

MIRRORS = [f"base/{camera}/M{k}" for camera in ("forward", "backward") for k in (1, 2, 3)]
HEAD = "name: own\ncauses:\n"


@pytest.fixture(scope="module")
def pair(backend):
    resolved = resolve(load.LIBRARY.parent / "examples/aligned.yaml")
    return build_instrument(resolved.instrument, resolved.cameras, backend)


def spec(causes: str, head: str = HEAD) -> DisturbancesSpec:
    """Of a file's text, from line 3 on."""
    return validate(DisturbancesSpec, parse_yaml(head + causes, "own.yaml"))


def stated(pair, causes: str) -> DisturbancePrior:
    return disturbances.prior_of_spec(spec(causes), pair)


# --- what is stated ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", quick(1, load.library_names(load.DISTURBANCES)))
@pytest.mark.parametrize("stem", quick(1, load.library_names(load.INSTRUMENTS)))
def test_every_file_is_of_every_instrument_of_the_library(instrument, name, stem, tmp_path) -> None:
    (tmp_path / "job.yaml").write_text(f"instrument: {stem}\ndisturbances: {name}\n")
    resolved = resolve(tmp_path / "job.yaml")
    found = disturbance_prior(resolved, instrument(stem))
    assert {c.cause for c in found.components} == set(resolved.disturbances.causes)
    assert found.correlation.shape == (len(found.components),) * 2
    assert np.all(found.sigma > 0.0)


def test_names_units_and_the_number_of_sigmas(pair) -> None:
    text = """
  a: {bodies: base/*/M?, shift: [0 um, 0 um, 3 um], figure: {Z5: 6 nm}, reason: r}
  b: {bodies: base/central_prism, temperature: {change: 0.3 K, gradient: 30 mK/m}, reason: r}
  d: {bodies: base/forward/monitor/left/prism_0, index_gradient: 9e-7 1/m, reason: r}
  c: {bodies: [base/forward, base/backward], scale: 3 ppm, rotate: 3 arcsec, time: {drift: 6 h}, reason: r}
"""
    found = disturbances.prior_of_spec(spec(text.lstrip("\n"), "sigmas: 3\n" + HEAD), pair)
    names = [c.name for c in found.components]
    assert names[:4] == [f"{m} {what}" for m in MIRRORS[:2] for what in ("shift z", "figure Z5")]
    assert names[12:19] == [
        *(f"base/central_prism {what}" for what in ("temperature", "gradient x", "gradient y", "gradient z")),
        *(f"base/forward/monitor/left/prism_0 index_gradient {axis}" for axis in "xyz"),
    ]
    assert {(c.what, c.unit, round(c.sigma / c.unit_size, 9)) for c in found.components} == {
        ("shift z", "um", 1.0),
        ("figure Z5", "nm", 2.0),
        ("temperature", "K", 0.1),
        ("scale", "ppm", 1.0),
        *((f"gradient {axis}", "mK/m", 10.0) for axis in "xyz"),
        *((f"index_gradient {axis}", "ppm/m", 0.3) for axis in "xyz"),
        *((f"rotate {axis}", "arcsec", 1.0) for axis in "xyz"),
    }
    assert {c.pivot for c in found.components if c.kind == "shift"} == {"centre"}
    assert [law.text for law in found.laws[-1:]] == ["drift 6 h"]


def test_draws_have_the_stated_covariance(pair) -> None:
    """Together, single correlations in place of it, and a number that is zero; 1e5 draws, each entry within 5 sigma."""
    text = """
  a:
    bodies: [base/forward/M1, base/forward/M2, base/forward/M3]
    shift: [1 um, 0 um, 2 um]
    together: 0.5
    correlations: [{between: [base/forward/M1 shift x, base/forward/M1 shift z], correlation: -0.6},
                   {between: [base/forward/M1 shift x, base/forward/M2 shift x], correlation: 0.1}]
    reason: r
"""
    found = stated(pair, text.lstrip("\n"))
    assert len(found.components) == 6
    expected = np.eye(6)
    for i, j in ((0, 2), (0, 4), (2, 4), (1, 3), (1, 5), (3, 5)):
        expected[i, j] = expected[j, i] = 0.5
    expected[0, 1] = expected[1, 0] = -0.6
    expected[0, 2] = expected[2, 0] = 0.1
    np.testing.assert_array_equal(found.correlation, expected)
    count = 100_000
    drawn = found.draw(np.random.default_rng(4), count) / found.sigma
    np.testing.assert_allclose(drawn.T @ drawn / count, expected, atol=5.0 * np.sqrt(2.0 / count))


def test_correlations_may_be_possible_only_together(pair) -> None:
    """Two strong ones of three are impossible while the third is unsaid, and its order does not matter."""
    pairs = [("x", "y"), ("y", "z"), ("x", "z")]
    between = [
        f"{{between: [base/forward/M2 shift {a}, base/forward/M2 shift {b}], correlation: 0.9}}" for a, b in pairs
    ]
    cause = "  a: {{bodies: base/forward/M2, shift: 1 um, reason: r, correlations: [{}]}}\n"
    np.testing.assert_allclose(stated(pair, cause.format(", ".join(between))).correlation, 0.1 * np.eye(3) + 0.9)
    with pytest.raises(InputError, match="not positive definite"):
        stated(pair, cause.format(", ".join(between[:2])))


def test_a_standard_deviation_may_be_set_to_zero_where_it_is_correlated(pair) -> None:
    between = "[{between: [base/forward/M2 shift x, base/forward/M2 shift y], correlation: 0.9}]"
    found = stated(pair, f"  a: {{bodies: base/forward/M2, shift: 1 0 1 um, correlations: {between}, reason: r}}\n")
    assert [c.what for c in found.components] == ["shift x", "shift z"]
    np.testing.assert_array_equal(found.correlation, np.eye(2))


def test_states_add_what_several_causes_do_to_a_body(pair) -> None:
    """Heat adds in the body's frame before the thermal model, motions act one on the other."""
    text = """
  a: {bodies: base/central_prism, temperature: {change: 1 K, gradient: 0 0 20 mK/m}, shift: 0 0 1 um, reason: r}
  b: {bodies: base/central_prism, temperature: {change: 2 K}, shift: 0 0 2 um, reason: r}
"""
    found, thermal = stated(pair, text.lstrip("\n")), ThermalModel(pair)
    state = state_of(found.sigma, found.components, thermal)
    warm = thermal.state({"base/central_prism": Temperature(3.0, (0.0, 0.0, 0.02))})
    # the second shift is in the frame of what has grown by 0.5 ppm/K
    assert state["base/central_prism"].shift[2] - warm["base/central_prism"].shift[2] == pytest.approx(3e-6, rel=1e-5)
    assert state["base/central_prism"].expansion == pytest.approx(warm["base/central_prism"].expansion, rel=1e-9)


# --- what a job says instead ------------------------------------------------------------------------------------------


def test_a_job_changes_single_numbers(tmp_path) -> None:
    job = """instrument: gf7_pair
disturbances:
  file: orbit
  without: [base_heat]
  causes:
    mirror_figure: {figure: {Z5: 9 nm, Z11: 1 nm}}
    central_prism_heat: {temperature: {change: 0.5 K}, time: white}
    settling: {bodies: base/forward/focal_plane, shift: 1 um, reason: a test of vibration}
"""
    (tmp_path / "job.yaml").write_text(job)
    plain, found = load.load_disturbances("orbit"), resolve(tmp_path / "job.yaml").disturbances
    assert list(found.causes) == [name for name in plain.causes if name != "base_heat"] + ["settling"]
    changed = found.causes["mirror_figure"]
    figure = {t: round(v * 1e9, 9) for t, v in changed.figure.items()}
    assert figure == {**dict.fromkeys(("Z4", "Z6", "Z7", "Z8"), 2.0), "Z5": 9.0, "Z11": 1.0}
    assert changed.reason == plain.causes["mirror_figure"].reason
    heat = found.causes["central_prism_heat"]
    assert (heat.temperature.change, heat.temperature.gradient[0]) == (0.5, pytest.approx(0.04))
    assert heat.time.text == "white"
    assert found.causes["settling"].correlations == ()
    same = {name for name, cause in plain.causes.items() if found.causes.get(name) == cause}
    assert set(plain.causes) - same == {"base_heat", "mirror_figure", "central_prism_heat"}


def test_none_states_nothing_and_a_name_stands_for_a_file(tmp_path) -> None:
    def named(text: str):
        (tmp_path / "job.yaml").write_text(f"instrument: gf7_pair\ndisturbances: {text}\n")
        return resolve(tmp_path / "job.yaml").disturbances

    assert named("none") is None
    assert named("launch") == named("{file: launch}") == load.load_disturbances("launch")
    assert named("{}") == load.load_disturbances("orbit")


# --- what is refused --------------------------------------------------------------------------------------------------


def stated_of_job(folder, instrument: str, disturbances: str, backend) -> DisturbancePrior | None:
    """Return what a job states to move of an instrument of one's own."""
    (folder / "other.yaml").write_text(instrument)
    (folder / "job.yaml").write_text(f"instrument: ./other.yaml\n{disturbances}")
    resolved = resolve(folder / "job.yaml")
    return disturbance_prior(resolved, build_instrument(resolved.instrument, resolved.cameras, backend))


@pytest.mark.second
def test_what_another_instrument_does_not_have_is_told_once_for_each_pattern(backend, tmp_path) -> None:
    """Cameras of other names: the file is of another instrument, while those of the library are of any camera."""
    instrument = (load.LIBRARY / load.INSTRUMENTS / "gf7_pair.yaml").read_text("utf-8").replace("backward", "nadir")
    named = "{bodies: base/backward, rotate: 1 arcsec, reason: r}"
    (tmp_path / "own.yaml").write_text(f"{HEAD}  camera_heat: {named}\n  camera_mounts: {named}\n")
    with pytest.raises(
        InputError, match=r"own.yaml.*gf7_pair has no body of this name, nor for camera_mounts"
    ) as caught:
        stated_of_job(tmp_path, instrument, "disturbances: ./own.yaml\n", backend)
    assert len(caught.value.issues) == 1
    assert caught.value.value == "'base/backward'"
    assert stated_of_job(tmp_path, instrument, "", backend).components
    assert stated_of_job(tmp_path, instrument, "disturbances: none\n", backend) is None


JOINT = "name: own\njoint:\n  reason: r\n"
THREE = """  components:
    forward/M2 shift z: 3.1 um
    base/forward/M2 rotate x about origin: 4 arcsec
    base/forward/M1 conic: 2.0e-5
"""
MATRIX = "  correlation: [[1, 0.8, 0], [0.8, 1, -0.3], [0, -0.3, 1]]\n"


# --- what is stated ---------------------------------------------------------------------------------------------------


def test_components_stand_one_by_one(pair) -> None:
    found = disturbances.prior_of_spec(spec("", f"sigmas: 2\n{JOINT}{THREE}{MATRIX}"), pair)
    assert [(c.cause, c.name, c.pivot) for c in found.components] == [
        ("joint", "base/forward/M2 shift z", "centre"),
        ("joint", "base/forward/M2 rotate x", "origin"),
        ("joint", "base/forward/M1 conic", "centre"),
    ]
    np.testing.assert_allclose(found.sigma, [1.55e-6, np.radians(2.0 / 3600.0), 1e-5], rtol=1e-12)
    np.testing.assert_array_equal(found.correlation, [[1.0, 0.8, 0.0], [0.8, 1.0, -0.3], [0.0, -0.3, 1.0]])
    assert {law.text for law in found.laws} == {"constant"}


def test_what_does_not_move_is_left_out_with_its_correlations(pair) -> None:
    found = disturbances.prior_of_spec(spec("", f"{JOINT}{THREE}{MATRIX}".replace("4 arcsec", "0 arcsec")), pair)
    assert [c.what for c in found.components] == ["shift z", "conic"]
    np.testing.assert_array_equal(found.correlation, np.eye(2))


def test_radii_conic_constants_and_indices_reach_states(pair) -> None:
    text = """name: own
causes:
  a: {bodies: base/*/M1, radius: 90 ppm, conic: 3.0e-5, figure: {Z5: 3 nm}, reason: r}
"""
    found = disturbances.prior_of_spec(spec("", text), pair)
    assert [(c.what, c.unit) for c in found.components[:3]] == [
        ("radius", "ppm"),
        ("conic", "ppm"),
        ("figure Z5", "nm"),
    ]
    state = state_of(np.array([1e-4, -2e-5, 3e-9, 0.0, 0.0, 0.0]), found.components, ThermalModel(pair))
    assert state["base/forward/M1"] == Motion(figure={5: 3e-9}, radius=1e-4, conic=-2e-5, pivot="centre")


def test_derivatives_by_radii_and_conic_constants(backend, pair) -> None:
    """Central differences of another step agree to the term of third order, some 1e-6."""
    found = stated(pair, "  a: {bodies: base/forward/M?, radius: 100 ppm, conic: 1.0e-4, reason: r}\n")
    path = MonitorPath(pair, backend)
    known = disturbances_of(found, path, ThermalModel(pair), pair, backend)
    for k, component in enumerate(found.components):
        step = 0.3 * STEPS[component.kind]
        key = {component.kind: step}, {component.kind: -step}
        up, down = np.moveaxis(path.coarse_trace([{component.body: Motion(**one)} for one in key]).centre, 1, 0)
        expected = ((up - down) / (2.0 * step)).ravel() * component.sigma
        np.testing.assert_allclose(known.spots[:, k], expected, rtol=1e-5, atol=1e-6 * np.max(np.abs(expected)))
        assert np.max(np.abs(expected)) > 1e-4


@pytest.mark.parametrize("name", ["gf7", "korsch", "cassegrain"])
def test_assembled_is_of_cameras_alone(backend, name) -> None:
    assert name in load.library_names(load.CAMERAS)
    alone = load.load_instrument(name)
    found = disturbances.prior_of_spec(
        load.load_disturbances("assembled"), build_instrument(alone, load.load_cameras(alone), backend)
    )
    sigma = {c.name: c.sigma / c.unit_size for c in found.components}
    assert sigma[f"base/{name}/M2 shift z"] < sigma[f"base/{name}/M2 shift x"] == pytest.approx(100.0)
    assert sigma[f"base/{name}/focal_plane rotate z"] == pytest.approx(60.0)
    assert {law.text for law in found.laws} == {"constant"}


# --- what is written --------------------------------------------------------------------------------------------------


def covariance_of(sigma: np.ndarray, rng: np.random.Generator, rank: int) -> np.ndarray:
    """Of M components, of some rank, with these standard deviations."""
    root = rng.standard_normal((len(sigma), rank))
    covariance = root @ root.T
    size = sigma / np.sqrt(np.diagonal(covariance))
    return size[:, None] * covariance * size


@pytest.mark.second
@pytest.mark.parametrize(("count", "rank"), [(6, 6), (6, 2), (60, 60), (60, 5)])
def test_a_covariance_is_written_and_read_back(pair, tmp_path, count, rank) -> None:
    """In one file, and with many components in two; also one that leaves combinations without any spread."""
    every = disturbances.prior_of_spec(load.load_disturbances("assembled"), pair).components
    rng = np.random.default_rng(count + rank)
    chosen = [every[k] for k in rng.permutation(len(every))[:count]]
    for k, one in enumerate(chosen):
        if one.kind in ("rotate", "shift"):
            chosen[k] = replace(one, pivot=str(rng.choice(sorted(pair.assembly.tree[one.body].pivots))))
    sigma = np.array([c.sigma for c in chosen]) * 10.0 ** rng.uniform(-6.0, 0.0, count)
    covariance = covariance_of(sigma, rng, rank)
    made = disturbances.joint_disturbances("posterior", chosen, covariance, pair.nodes, "an estimate")
    files = disturbances.joint_files(made, "posterior", "remark")
    assert set(files) == {"posterior.yaml", *(["posterior.csv"] if count > 12 else [])}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    found = disturbances.prior_of_spec(load.load_disturbances(tmp_path / "posterior.yaml"), pair)
    assert [(c.name, c.pivot) for c in found.components] == [(c.name, c.pivot) for c in chosen]
    # correlations have twelve digits
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-12, atol=1e-12 * np.max(np.outer(sigma, sigma)))
    scaled = found.covariance / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma)
    np.testing.assert_allclose(*scaled, rtol=0.0, atol=2e-12)


def test_what_is_no_covariance(pair) -> None:
    own = [Component("a", "base/forward/M2", "shift", axis, "centre", 1e-6) for axis in range(3)]
    sound = 1e-12 * np.array([[1.0, 0.5, 0.2], [0.5, 1.0, -0.1], [0.2, -0.1, 1.0]])
    for matrix, message in (
        (sound[:2, :2], "cannot have the shape"),
        (sound * np.nan, "cannot have the shape"),
        (sound - 2e-12 * np.eye(3), "a variance is negative"),
        (sound + np.triu(0.1 * sound, 1), "the covariance is not symmetric"),
        (sound + 0.8e-12 * (np.eye(3)[::-1] - np.diag([0.0, 1.0, 0.0])), "has a negative eigenvalue"),
    ):
        with pytest.raises(ValueError, match=message):
            disturbances.joint_disturbances("posterior", own, matrix, pair.nodes, "r")
    with pytest.raises(ValueError, match="a component is named twice"):
        disturbances.joint_disturbances("posterior", [*own[:2], own[0]], sound, pair.nodes, "r")


# --- what is refused --------------------------------------------------------------------------------------------------


TABLE = [
    "forward/M2 shift z,base/forward/M1 conic,base/forward/M2 rotate x about origin",
    "1,0,0.8",
    "0,1,-0.3",
    "0.8,-0.3,1",
]


def table_of(folder, rows) -> DisturbancesSpec:
    (folder / "own.yaml").write_text(JOINT + THREE + "  correlation_file: corr.csv\n")
    (folder / "corr.csv").write_text("\n".join(rows) + "\n")
    return load.load_disturbances(folder / "own.yaml")


@pytest.mark.second
def test_a_table_may_have_its_columns_in_any_order(pair, tmp_path) -> None:
    found = disturbances.prior_of_spec(table_of(tmp_path, ["# a remark", *TABLE]), pair)
    np.testing.assert_array_equal(found.correlation, [[1.0, 0.8, 0.0], [0.8, 1.0, -0.3], [0.0, -0.3, 1.0]])
    # config.yaml has them in itself
    (tmp_path / "job.yaml").write_text("instrument: gf7_pair\ndisturbances: ./own.yaml\n")
    text = resolve(tmp_path / "job.yaml").to_yaml()
    assert "corr.csv" not in text
    (tmp_path / "config.yaml").write_text(text)
    (tmp_path / "corr.csv").unlink()
    again = disturbances.prior_of_spec(resolve(tmp_path / "config.yaml").disturbances, pair)
    np.testing.assert_array_equal(again.covariance, found.covariance)
