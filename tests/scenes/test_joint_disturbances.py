"""Components that go together in a file of disturbances: read, drawn from, written, refused; radii and conics."""

import numpy as np
import pytest

from optics.geometry.tree import Motion
from scenes.models.disturbances import Component, motions_of_spec, state_of
from scenes.models.instrument_builder import build_instrument
from scenes.models.joint_disturbances import joint_disturbances, joint_files
from scenes.models.thermal_model import ThermalModel
from scenes.specs.disturbances import DisturbancesSpec
from scenes.specs.load import CAMERAS, library_names, load_cameras, load_disturbances, load_instrument
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from twin.monitor.monitor_derivative import STEPS, disturbances_of
from twin.monitor.monitor_path import MonitorPath

HEAD = "name: own\njoint:\n  reason: r\n"
THREE = """  components:
    forward/M2 shift z: 3.1 um
    base/forward/M2 rotate x about origin: 4 arcsec
    base/forward/M1 conic: 2.0e-5
"""
MATRIX = "  correlation: [[1, 0.8, 0], [0.8, 1, -0.3], [0, -0.3, 1]]\n"


@pytest.fixture(scope="module")
def pair(backend):
    spec = load_instrument("gf7_pair")
    return build_instrument(spec, load_cameras(spec), backend)


def spec(text: str) -> DisturbancesSpec:
    return validate(DisturbancesSpec, parse_yaml(text, "own.yaml"))


# --- what is stated ---------------------------------------------------------------------------------------------------


def test_components_stand_one_by_one(pair) -> None:
    found = motions_of_spec(spec(f"sigmas: 2\n{HEAD}{THREE}{MATRIX}"), pair)
    assert [(c.cause, c.name, c.pivot) for c in found.components] == [
        ("joint", "base/forward/M2 shift z", "centre"),
        ("joint", "base/forward/M2 rotate x", "origin"),
        ("joint", "base/forward/M1 conic", "centre"),
    ]
    np.testing.assert_allclose(found.sigma, [1.55e-6, np.radians(2.0 / 3600.0), 1e-5], rtol=1e-12)
    np.testing.assert_array_equal(found.correlation, [[1.0, 0.8, 0.0], [0.8, 1.0, -0.3], [0.0, -0.3, 1.0]])
    assert {law.text for law in found.laws} == {"constant"}


def test_joint_components_stand_beside_causes(pair) -> None:
    causes = "causes:\n  a: {bodies: base/forward/M3, shift: [1 um, 0 um, 0 um], reason: r}\n"
    found = motions_of_spec(spec(f"{HEAD}{THREE}{MATRIX}  time: {{drift: 6 h}}\n{causes}"), pair)
    assert [c.cause for c in found.components] == ["a", "joint", "joint", "joint"]
    np.testing.assert_array_equal(found.correlation[0], [1.0, 0.0, 0.0, 0.0])
    assert [law.text for law in found.laws] == ["white", *["drift 6 h"] * 3]


def test_what_does_not_move_is_left_out_with_its_correlations(pair) -> None:
    found = motions_of_spec(spec(f"{HEAD}{THREE}{MATRIX}".replace("4 arcsec", "0 arcsec")), pair)
    assert [c.what for c in found.components] == ["shift z", "conic"]
    np.testing.assert_array_equal(found.correlation, np.eye(2))


def test_radii_conic_constants_and_indices_reach_states(pair) -> None:
    text = """name: own
causes:
  a: {bodies: base/*/M1, radius: 90 ppm, conic: 3.0e-5, figure: {Z5: 3 nm}, reason: r}
"""
    found = motions_of_spec(spec(text), pair)
    assert [(c.what, c.unit) for c in found.components[:3]] == [
        ("radius", "ppm"),
        ("conic", "ppm"),
        ("figure Z5", "nm"),
    ]
    state = state_of(np.array([1e-4, -2e-5, 3e-9, 0.0, 0.0, 0.0]), found.components, ThermalModel(pair))
    assert state["base/forward/M1"] == Motion(figure={5: 3e-9}, radius=1e-4, conic=-2e-5, pivot="centre")
    glass = Component("a", "base/forward/M1", "index", 0, "origin", 1.0)
    assert state_of(np.array([2e-4]), [glass], ThermalModel(pair)) == {"base/forward/M1": Motion(index=2e-4)}


def test_derivatives_by_radii_and_conic_constants(backend, pair) -> None:
    """Central differences of another step agree to the term of third order, some 1e-6."""
    found = motions_of_spec(
        spec("name: own\ncauses:\n  a: {bodies: base/forward/M?, radius: 100 ppm, conic: 1.0e-4, reason: r}\n"), pair
    )
    path = MonitorPath(pair, backend)
    known = disturbances_of(found, path, ThermalModel(pair), pair, backend)
    for k, component in enumerate(found.components):
        step = 0.3 * STEPS[component.kind]
        key = {component.kind: step}, {component.kind: -step}
        up, down = np.moveaxis(path.coarse_trace([{component.body: Motion(**one)} for one in key]).place, 1, 0)
        expected = ((up - down) / (2.0 * step)).ravel() * component.sigma
        np.testing.assert_allclose(known.spots[:, k], expected, rtol=1e-5, atol=1e-6 * np.max(np.abs(expected)))
        assert np.max(np.abs(expected)) > 1e-4


@pytest.mark.parametrize("name", ["gf7", "korsch", "cassegrain"])
def test_assembled_is_of_cameras_alone(backend, name) -> None:
    assert name in library_names(CAMERAS)
    alone = load_instrument(name)
    found = motions_of_spec(load_disturbances("assembled"), build_instrument(alone, load_cameras(alone), backend))
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


@pytest.mark.parametrize(("count", "rank"), [(6, 6), (6, 2), (60, 60), (60, 5)])
def test_a_covariance_is_written_and_read_back(pair, tmp_path, count, rank) -> None:
    """In one file, and with many components in two; also one that leaves combinations without any spread."""
    every = motions_of_spec(load_disturbances("assembled"), pair).components
    rng = np.random.default_rng(count + rank)
    chosen = [every[k] for k in rng.permutation(len(every))[:count]]
    sigma = np.array([c.sigma for c in chosen]) * 10.0 ** rng.uniform(-6.0, 0.0, count)
    covariance = covariance_of(sigma, rng, rank)
    made = joint_disturbances("posterior", chosen, covariance, pair.nodes, "an estimate")
    files = joint_files(made, "posterior", "remark")
    assert set(files) == {"posterior.yaml", *(["posterior.csv"] if count > 12 else [])}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    found = motions_of_spec(load_disturbances(tmp_path / "posterior.yaml"), pair)
    assert [(c.name, c.pivot) for c in found.components] == [(c.name, c.pivot) for c in chosen]
    # correlations have twelve digits
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-12, atol=1e-12 * np.max(np.outer(sigma, sigma)))
    scaled = found.covariance / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma)
    np.testing.assert_allclose(*scaled, rtol=0.0, atol=2e-12)


def test_an_unusual_pivot_is_written(pair) -> None:
    kinds = (("base/forward/M2", "rotate", "origin"), ("base/forward/M2", "shift", "origin"))
    kinds += (("base/forward/focal_plane", "rotate", "rear_node"), ("base/forward", "scale", "origin"))
    own = [Component("any", body, kind, 0, pivot, 1e-6) for body, kind, pivot in kinds]
    made = joint_disturbances("posterior", own, 1e-12 * np.eye(4), pair.nodes, "an estimate")
    assert list(made.joint.components) == [
        "base/forward/M2 rotate x about origin",
        "base/forward/M2 shift x about origin",
        "base/forward/focal_plane rotate x about rear_node",
        "base/forward scale",
    ]
    assert [c.pivot for c in motions_of_spec(made, pair).components] == [pivot for _, _, pivot in kinds]


def test_what_is_no_covariance(pair) -> None:
    own = [Component("a", "base/forward/M2", "shift", axis, "centre", 1e-6) for axis in range(3)]
    sound = 1e-12 * np.array([[1.0, 0.5, 0.2], [0.5, 1.0, -0.1], [0.2, -0.1, 1.0]])
    for matrix, message in (
        (sound[:2, :2], "has not the shape"),
        (sound * np.nan, "has not the shape"),
        (sound - 2e-12 * np.eye(3), "a variance is negative"),
        (sound + np.triu(0.1 * sound, 1), "a covariance is symmetric"),
        (sound + 0.8e-12 * (np.eye(3)[::-1] - np.diag([0.0, 1.0, 0.0])), "no negative eigenvalue"),
    ):
        with pytest.raises(ValueError, match=message):
            joint_disturbances("posterior", own, matrix, pair.nodes, "r")
    with pytest.raises(ValueError, match="a component is there twice"):
        joint_disturbances("posterior", [*own[:2], own[0]], sound, pair.nodes, "r")


# --- what is refused --------------------------------------------------------------------------------------------------


TABLE = [
    "forward/M2 shift z,base/forward/M1 conic,base/forward/M2 rotate x about origin",
    "1,0,0.8",
    "0,1,-0.3",
    "0.8,-0.3,1",
]


def table_of(folder, rows) -> DisturbancesSpec:
    (folder / "own.yaml").write_text(HEAD + THREE + "  correlation_file: corr.csv\n")
    (folder / "corr.csv").write_text("\n".join(rows) + "\n")
    return load_disturbances(folder / "own.yaml")


def test_a_table_may_have_its_columns_in_any_order(pair, tmp_path) -> None:
    found = motions_of_spec(table_of(tmp_path, ["# a remark", *TABLE]), pair)
    np.testing.assert_array_equal(found.correlation, [[1.0, 0.8, 0.0], [0.8, 1.0, -0.3], [0.0, -0.3, 1.0]])
    # config.yaml has them in itself
    (tmp_path / "job.yaml").write_text("instrument: gf7_pair\ndisturbances: ./own.yaml\n")
    text = resolve(tmp_path / "job.yaml").to_yaml()
    assert "corr.csv" not in text
    (tmp_path / "config.yaml").write_text(text)
    (tmp_path / "corr.csv").unlink()
    again = motions_of_spec(resolve(tmp_path / "config.yaml").disturbances, pair)
    np.testing.assert_array_equal(again.covariance, found.covariance)


def test_a_job_cannot_change_what_goes_together(tmp_path) -> None:
    (tmp_path / "own.yaml").write_text(HEAD + THREE)
    job = "instrument: gf7_pair\ndisturbances:\n  file: ./own.yaml\n  causes: {joint: {shift: 1 um}}\n"
    (tmp_path / "job.yaml").write_text(job)
    with pytest.raises(InputError, match=r"job.yaml:4: disturbances.causes.joint: .* stand one by one"):
        resolve(tmp_path / "job.yaml")
