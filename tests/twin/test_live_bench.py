"""The live twin's computing: a state of the knobs is what the main job makes of the same numbers, and nothing else."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2

import twin
from optics.geometry.tree import Motion
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError
from tests.tiers import quick
from twin.framework.provenance import program_digest
from twin.live.camera_design import CameraPictures
from twin.live.computer import RequestHandler, course_text, job_text
from twin.live.knobs import KINDS, knob_name, perturbation
from twin.live.live_bench import LiveBench
from twin.live.messages import AskedState, AskedView, BlindState
from twin.main_job.monitor_reading import rounded
from twin.main_job.render_job import render_job
from twin.monitor.time_series import series_states

pytestmark = pytest.mark.drawn

M2, PLANE = "base/forward/M2", "base/backward/focal_plane"


@pytest.fixture(scope="module")
def bench() -> LiveBench:
    return LiveBench(twin.load("scenes/examples/perturb.yaml"))


@pytest.fixture(scope="module")
def first(bench) -> AskedState:
    return bench.initial_state


def changed(state: AskedState, knobs: dict[str, float] | None = None, **other) -> AskedState:
    return AskedState(**{**state.model_dump(), "knobs": state.knobs if knobs is None else knobs, **other})


@pytest.mark.second
def test_the_first_state_is_the_main_job(bench, first, backend):
    """Readings, truth and images of `perturb.yaml`, to the bit."""
    run = render_job(resolve("scenes/examples/perturb.yaml"), backend)
    told, after = bench.state(first)
    assert told["readings"] == rounded(run.recovered_dict())
    assert told["truth"] == run.truth_dict()
    assert np.array_equal(after, run.after[:, 0])
    assert np.array_equal(bench.before(first), run.before[:, 0])


@pytest.mark.second
def test_a_saved_job_repeats_what_was_shown(bench, first, backend, tmp_path):
    knobs = {f"{M2} shift z": 3.17, f"{M2} figure Z7": -12.5, f"{PLANE} rotate x": 0.1 + 0.2, "base temperature": 0.25}
    asked = changed(first, knobs, frames=3, seed=20)
    told, after = bench.state(asked)
    file = tmp_path / "job.yaml"
    file.write_text(job_text(bench, asked), encoding="utf-8")
    assert f"source {program_digest()}, Python" in file.read_text("utf-8").splitlines()[1]
    run = render_job(resolve(file), backend)
    assert told["readings"] == rounded(run.recovered_dict())
    assert np.array_equal(after, run.after[:, 0])
    blind = job_text(bench, BlindState.model_validate({**asked.model_dump(), "blind": 7})).splitlines()
    said = [line for line in blind if line not in file.read_text("utf-8").splitlines()]
    assert (len(said), "# " in said[0], "holds the guess of the knobs alone" in said[0]) == (2, True, True)


@pytest.mark.second
def test_a_recorded_course_has_the_states_that_were_shown(bench, first, backend, tmp_path):
    """The truth of every time to rounding; the noise of a course is another draw."""
    pivots = {PLANE: "rear_node"}
    knobs = [{}, {f"{M2} shift z": 1.0, f"{PLANE} rotate z": 3.0}]
    knobs += [{**knobs[1], f"{M2} shift z": 2.5, "base temperature": 0.5}]
    states = [changed(first, own, pivots=pivots) for own in knobs]
    steps = list(zip((0.0, 0.5004, 1.25), states, strict=True))
    file = tmp_path / "course.yaml"
    file.write_text(course_text(bench, steps), encoding="utf-8")
    run = render_job(resolve(file), backend, frames=2)
    assert run.series is not None
    assert run.series.times.tolist() == [0.0, 0.5, 1.25]
    for k, (_, asked) in enumerate(steps):
        told, _ = bench.state(asked)
        for camera, values in told["truth"]["cameras"].items():
            keys = ("d_alpha_arcsec", "d_beta_arcsec", "d_gamma_arcsec", "d_f_um")
            series = [run.series.readings.row(camera, key, "model").true[k] for key in keys]
            shown = [values[key] for key in keys]
            # a batch of states rounds in another order than one; lines of sight hold 1e-16 of a turn, 2e-11 arcsec each
            assert series == pytest.approx(shown, abs=1e-9)


def test_a_course_refuses_what_it_cannot_hold(bench, first):
    figure = changed(first, {f"{M2} figure Z5": 3.0})
    turned, played = changed(first, pivots={M2: "centre"}), changed(first, time=0)
    cases = (("figure", (changed(first, {}), figure)), ("at least 2", (first,)), ("nothing moved", (first, first)))
    for words, states in (*cases, ("pivot", (first, turned)), ("in the job's own file", (first, played))):
        with pytest.raises(ValueError, match=words):
            course_text(bench, list(enumerate(states)))


@pytest.mark.second
def test_a_long_recording_is_thinned_to_what_a_course_may_have(bench, first):
    steps = [(0.01 * k, changed(first, {f"{M2} shift z": 0.001 * k})) for k in range(1500)]
    times = [line for line in course_text(bench, steps).splitlines() if line.strip().startswith("times:")]
    assert len(times) == 1
    assert "0.0 s" in times[0]


@pytest.mark.second
def test_without_noise_readings_are_those_of_the_expected_image(bench, first):
    """All estimators agree with the noisy reading within its noise, 5 sigma for 60 numbers: false alarm 3e-5."""
    noisy, _ = bench.state(changed(first, frames=9))
    clean, image = bench.state(changed(first, noise=False, frames=9))
    for camera, estimators in clean["readings"]["cameras"].items():
        for name, values in estimators.items():
            for key in ("d_alpha_arcsec", "d_beta_arcsec", "d_gamma_arcsec", "d_f_um"):
                other = noisy["readings"]["cameras"][camera][name]
                sigma = other[f"{key}_sigma_noise"]
                assert abs(values[key] - other[key]) < 5.0 * sigma
                # expected sigma differs from the one estimated in noisy frames by the noise of the flux alone
                assert values[f"{key}_sigma_noise"] == pytest.approx(sigma, rel=0.05)
    assert image is not None
    assert image.dtype == np.uint16


@pytest.mark.parametrize(
    ("knobs", "cause"),
    quick(
        2,
        [
            ({"base/forward/M1 shift x": 90_000.0}, "misses"),
            ({f"{PLANE} shift x": 2000.0}, "outside its area CCD"),
            ({"base temperature": -300.0}, "0 K"),
            ({f"{M2} shift z": 1e9}, "too large"),
            ({"base/forward/M9 shift z": 1.0}, "no such knob"),
        ],
    ),
)
def test_an_impossible_state_says_why_and_the_next_good_one_is_good(bench, first, knobs, cause):
    before, _ = bench.state(first)
    told, image = bench.state(changed(first, knobs))
    assert image is None
    assert cause in " ".join([told["problem"], *told["causes"]])
    assert "readings" not in told
    after, _ = bench.state(first)
    assert after["readings"] == before["readings"]


def test_little_light_and_full_pixels_are_told(bench, monkeypatch):
    """Of each channel by itself, beside what is coarse of the instrument."""
    monkeypatch.setattr("twin.live.live_bench.coarse_warnings", lambda resolved: ["coarse"])
    detector = SimpleNamespace(saturated=lambda after: SimpleNamespace(pixels=np.array([0, 2, 0])))
    channels = [SimpleNamespace(key=key) for key in "abc"]
    experiment = SimpleNamespace(detector=detector, path=SimpleNamespace(channels=channels))
    own = SimpleNamespace(twin=SimpleNamespace(experiment=experiment, resolved=None))
    found = LiveBench._warnings(own, SimpleNamespace(after=None), np.array([1.0, 0.95, 0.05]))
    assert found == [
        "coarse",
        "b: saturated pixels; its centroid is biased",
        "c: only 5 % of its light reaches the CCD",
    ]


def test_bodies_in_each_other_are_told(bench, first):
    """The left 0-degree prism of the forward camera, moved through the central prism's room or another body."""
    placed = bench.twin.experiment.instrument.assembly.place([{}])
    assert bench.clearances.overlaps(placed) == ()
    clear = bench.clearances
    i, j = clear.pairs[np.argmin(np.where(clear.gaps > 0.0, clear.gaps, np.inf))]
    middle = [pose.apply(own).mean(axis=0) for pose, own in zip(clear.poses, clear.corners, strict=True)]
    toward = Motion(shift=tuple(clear.poses[i].rotation.T @ (middle[j] - middle[i])))
    found = clear.overlaps(bench.twin.experiment.instrument.assembly.place([{clear.paths[i]: toward}]))
    assert {clear.paths[i], clear.paths[j]} in [{one.first, one.second} for one in found]


def test_what_is_hidden_is_not_told(bench, first):
    asked = BlindState(**{**changed(first, {}).model_dump(), "blind": 5})
    told, image = bench.state(asked)
    assert "truth" not in told
    assert "motions" not in told
    other, again = bench.state(BlindState(**{**changed(first, {f"{M2} shift z": 3.0}).model_dump(), "blind": 5}))
    # the guess changes nothing of what is hidden
    assert other["readings"] == told["readings"]
    assert np.array_equal(image, again)
    assert other["guess"]["spots"] != told["guess"]["spots"]
    shown = bench.hidden(asked)
    sigmas = [abs(one["sigmas"]) for one in shown["hidden"]]
    parts = {part.name: part for part in bench.twin.experiment.prior.components}
    for one in shown["hidden"]:
        part = parts[one["what"]]
        assert one["sigmas"] == pytest.approx(one["value"] * part.unit_size / part.sigma, rel=1e-12)
    assert sigmas == sorted(sigmas, reverse=True)
    assert shown["truth"]["cameras"]


def test_hidden_motions_are_drawn_from_what_is_stated(bench, first):
    """Each component over its sigma is a unit normal: chi-square of 40 draws, two-sided false alarm 1e-4."""
    sigma = bench.twin.experiment.prior.sigma
    drawn = [bench._drawn(BlindState(**{**first.model_dump(), "blind": seed})) for seed in range(40)]
    white = (np.array(drawn) / np.where(sigma > 0.0, sigma, np.inf)).ravel()
    low, high = chi2.ppf([0.5e-4, 1 - 0.5e-4], 40 * np.count_nonzero(sigma))
    assert low < white @ white < high


@pytest.mark.second
def test_every_knob_moves_what_it_names(bench):
    """One knob of every kind at every body gives a perturbation of this body alone, with the number as typed."""
    first, nodes = bench.twin.resolved.job.plain()["perturb"], bench.twin.experiment.instrument.nodes
    seen = set()
    for name, knob in bench.knobs.items():
        if (knob.node, knob.kind) in seen:
            continue
        seen.add((knob.node, knob.kind))
        made = bench.twin.with_perturbations(perturbation({name: 0.123}, {}, bench.knobs, first))
        own = made.resolved.job.perturb[knob.node]
        assert own.uses() == (KINDS[knob.kind].key,)
        assert all(not what.uses() for node, what in made.resolved.job.perturb.items() if node != knob.node)
    assert {node for node, _ in seen} == {node for node, info in nodes.items() if info.allows - {"deformation"}}


def test_knobs_keep_the_units_of_the_job(tmp_path):
    file = tmp_path / "job.yaml"
    file.write_text(
        "instrument: gf7_pair\nperturb:\n"
        "  base/forward/M2: {shift: [0 mm, 0 mm, 0.003 mm], figure: {Z20: 7 nm}}\n"
        "  base/backward/M2: {shift: [1 um, 2 mm, 0 um]}\n"
        "  base/backward/M3: {shift: [2500 um, 0 um, 0 um]}\n"
        "  base/forward: {temperature: {change: 0.5 K, gradient: [1 mK/m, 0 mK/m, 0 mK/m]}, scale: 3 ppm}\n",
        encoding="utf-8",
    )
    loaded = twin.load(file)
    bench = LiveBench(loaded)
    asked = bench.initial_state
    assert asked.knobs[f"{M2} shift z"] == 3.0
    # of several units the usual one; of one the file's
    assert asked.knobs["base/backward/M2 shift y"] == 2000.0
    assert bench.knobs["base/backward/M2 shift y"].extent == 4000.0
    knob = bench.knobs["base/backward/M3 shift x"]
    assert (knob.unit, knob.value, knob.extent, knob.limit) == ("mm", 2.5, 5.0, 100.0)
    assert asked.knobs[f"{M2} figure Z20"] == 7.0
    assert asked.knobs["base/forward temperature"] == 0.5
    # to the bit, whatever the unit
    assert bench.perturbed(asked).state == loaded.state


def test_an_unknown_knob_names_the_nearest(bench):
    with pytest.raises(InputError, match="shift z"):
        perturbation({f"{M2} shft z": 1.0}, {}, bench.knobs, {})
    assert knob_name("base", "temperature", "") == "base temperature"
    name = f"{M2} shift z"
    limit = bench.knobs[name].limit
    perturbation({name: limit}, {}, bench.knobs, {})
    with pytest.raises(InputError, match="too large"):
        perturbation({name: 1.001 * limit}, {}, bench.knobs, {})


@pytest.mark.second
@pytest.mark.parametrize("view", ["wavefront", "spot", "mtf", "focus", "target"])
def test_pictures_of_a_camera(bench, view):
    pictures = CameraPictures(bench.twin.experiment)
    assert pictures.draw(view, "forward", (0.5, 0.0), bench.twin.state, 1, 1).startswith("<svg")
    with pytest.raises(ValueError, match="no camera"):
        pictures.draw(view, "sideward", (0.5, 0.0), {}, 1, 1)


@pytest.mark.second
def test_a_course_is_played_with_the_main_jobs_states(backend):
    """A time of the job's course: the truth of the main job's series."""
    bench = LiveBench(twin.load("scenes/examples/orbit.yaml"))
    course = bench.twin.resolved.job.course
    assert course is not None
    states = series_states(bench.twin.experiment, bench.twin.resolved.job)
    asked = bench.initial_state
    assert asked.time == course.shown
    for k in (0, 7, 20):
        assert bench.states(changed(asked, time=k)) == states[k]


@pytest.mark.second
def test_other_values_of_a_factor_build_the_instrument_anew():
    """With half the aperture a quarter of the light comes, and the readings are noisier."""
    answers = RequestHandler("scenes/examples/study_aperture.yaml", "llvm", lambda part: None)
    asked = answers.bench.initial_state
    whole, _ = answers.bench.state(asked)
    opened = answers.handle("factors", {"aperture": 25.0})
    assert not isinstance(opened, str)
    half, _ = answers.bench.state(asked)
    known = (asked.noise, asked.frames, asked.seed)
    for change, sent in (({}, False), ({"noise": False}, True), ({"frames": 3}, True), ({"seed": 99}, True)):
        message = answers.handle("state", (changed(asked, **change), known))
        head = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
        assert ("before" in head["images"]) == sent, change
    key = "d_alpha_arcsec_sigma_noise"
    camera = whole["readings"]["cameras"]["forward"]["model"]
    assert half["readings"]["cameras"]["forward"]["model"][key] > 1.5 * camera[key]
    assert "aperture" in answers.handle("factors", {"aperture": -3.0})
    view = AskedView(n=1, state=asked, view="spot", camera="forward")
    assert "svg" in json.loads(answers.handle("view", view))
    told = json.loads(answers.handle("course", []))
    assert "at least" in told["problem"]
