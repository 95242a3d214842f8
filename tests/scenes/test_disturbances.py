"""Disturbances as files say them: what they come to on an instrument, what a job says instead, and what is refused."""

import numpy as np
import pytest

from optics.thermal.heat import Temperature
from scenes.models.disturbances import StatedMotions, motions_of_spec, state_of, stated_motions
from scenes.models.instrument_builder import build_instrument
from scenes.models.thermal_model import ThermalModel
from scenes.specs.disturbances import DisturbancesSpec
from scenes.specs.load import DISTURBANCES, INSTRUMENTS, LIBRARY, library_names, load_disturbances
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from tests.tiers import quick

MIRRORS = [f"base/{camera}/M{k}" for camera in ("forward", "backward") for k in (1, 2, 3)]
HEAD = "name: own\ncauses:\n"


@pytest.fixture(scope="module")
def pair(backend):
    resolved = resolve(LIBRARY.parent / "examples/aligned.yaml")
    return build_instrument(resolved.instrument, resolved.cameras, backend)


def spec(causes: str, head: str = HEAD) -> DisturbancesSpec:
    """Of a file's text, from line 3 on."""
    return validate(DisturbancesSpec, parse_yaml(head + causes, "own.yaml"))


def stated(pair, causes: str) -> StatedMotions:
    return motions_of_spec(spec(causes), pair)


# --- what is stated ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", quick(1, library_names(DISTURBANCES)))
@pytest.mark.parametrize("stem", quick(2, library_names(INSTRUMENTS)))
def test_every_file_is_of_every_instrument_of_the_library(instrument, name, stem, tmp_path) -> None:
    (tmp_path / "job.yaml").write_text(f"instrument: {stem}\ndisturbances: {name}\n")
    resolved = resolve(tmp_path / "job.yaml")
    found = stated_motions(resolved, instrument(stem))
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
    found = motions_of_spec(spec(text.lstrip("\n"), "sigmas: 3\n" + HEAD), pair)
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
    assert state["base/central_prism"].stretch == pytest.approx(warm["base/central_prism"].stretch, rel=1e-9)


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
    plain, found = load_disturbances("orbit"), resolve(tmp_path / "job.yaml").disturbances
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
    assert named("launch") == named("{file: launch}") == load_disturbances("launch")
    assert named("{}") == load_disturbances("orbit")


# --- what is refused --------------------------------------------------------------------------------------------------


def stated_of_job(folder, instrument: str, disturbances: str, backend) -> StatedMotions | None:
    """Return what a job states to move of an instrument of one's own."""
    (folder / "other.yaml").write_text(instrument)
    (folder / "job.yaml").write_text(f"instrument: ./other.yaml\n{disturbances}")
    resolved = resolve(folder / "job.yaml")
    return stated_motions(resolved, build_instrument(resolved.instrument, resolved.cameras, backend))


def test_what_another_instrument_does_not_have_is_told_once_for_each_pattern(backend, tmp_path) -> None:
    """Cameras of other names: the file is of another instrument, while those of the library are of any camera."""
    instrument = (LIBRARY / INSTRUMENTS / "gf7_pair.yaml").read_text("utf-8").replace("backward", "nadir")
    named = "{bodies: base/backward, rotate: 1 arcsec, reason: r}"
    (tmp_path / "own.yaml").write_text(f"{HEAD}  camera_heat: {named}\n  camera_mounts: {named}\n")
    with pytest.raises(
        InputError, match=r"own.yaml.*gf7_pair has no body of this name, nor for camera_mounts"
    ) as caught:
        stated_of_job(tmp_path, instrument, "disturbances: ./own.yaml\n", backend)
    assert len(caught.value.issues) == 1
    assert caught.value.found == "'base/backward'"
    assert stated_of_job(tmp_path, instrument, "", backend).components
    assert stated_of_job(tmp_path, instrument, "disturbances: none\n", backend) is None
