"""A camera by itself as an instrument: perturbed in the words of every command, traced, judged by its images; and its
derivatives by motions of its parts, against formulas of the first order.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import twin
from optics.geometry.tree import Motion
from optics.numerics.array_math import UnphysicalError
from optics.raytrace.trace import BeamMissedError
from scenes.models.camera_model import focal_plane_body
from scenes.models.instrument_builder import build_instrument
from scenes.models.job_state import job_state
from scenes.models.thermal_model import ThermalModel
from scenes.specs.instrument import InstrumentSpec
from scenes.specs.job import JobSpec, checked_nodes
from scenes.specs.load import load_camera, load_instrument
from scenes.specs.perturbation import NodeInfo, find_node, perturbation_in_words
from scenes.specs.resolved import resolve_camera, resolve_job
from scenes.yaml.errors import InputError, Issue, Problem
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import YamlFile
from tests.scenes.lens.colour_cameras import colour_camera
from tests.twin.commands import invoke
from tests.twin.study_bench import refusals
from twin.camera import camera_run
from twin.camera.__main__ import app as camera_app
from twin.camera.camera_optics import CameraOptics
from twin.framework.procedure import silent
from twin.main_job import render_job
from twin.main_job.render_results import JobRun, RenderRun
from twin.monitor.image_quality import image_quality
from twin.monitor.truth import LineSight, trace_truth
from twin.path_tracing.stray_light import NominalPathLost
from twin.study.gradient.study_gradient import AD, TRACED, Gradient, study_gradient
from twin.study.runs.base_job import Run
from twin.study.runs.render_base import RenderBase
from twin.study.runs.setup import resolve_study

RC = "ritchey_chretien"
DESPACE = "M2 shift z 20 um"
PATHLESS = SimpleNamespace(path=SimpleNamespace(channels=()))


def job(**says) -> JobSpec:
    return validate(JobSpec, YamlFile("", {"instrument": {"camera": RC}, **says}, {}))


@pytest.fixture(scope="module")
def run(backend) -> JobRun:
    return render_job.render_job(resolve_job(job(perturb=[DESPACE])), backend)


# --- the words -------------------------------------------------------------------------------------------


def test_words_are_what_the_keys_are() -> None:
    words = ["M2 shift z 20 um", "M2 shift x 1 um", "M2 rotate y 3 arcsec about centre", "M1 temperature 2 K",
             "M1 gradient x 50 mK/m", "M1 figure Z5 10 nm", "rc scale 1 ppm"]  # fmt: skip
    keys = {
        "M2": {"shift": "1 0 20 um", "rotate": "0 3 0 arcsec", "pivot": "centre"},
        "M1": {"temperature": {"change": "2 K", "gradient": "50 0 0 mK/m"}, "figure": {"Z5": "10 nm"}},
        "rc": {"scale": "1 ppm"},
    }
    assert job(perturb=words).perturb == job(perturb=keys).perturb


@pytest.mark.parametrize(("words", "problem"), refusals("words"))
def test_words_that_say_nothing(words: list[str], problem: str) -> None:
    with pytest.raises(Problem, match=problem):
        perturbation_in_words(words)


def test_a_wrong_unit_is_told_once() -> None:
    with pytest.raises(InputError) as error:
        job(perturb=["M2 shift z 3 arcsec"])
    assert len(error.value.issues) == 1
    assert "unit of an angle" in str(error.value)


NODES = dict.fromkeys(("base", "base/a", "base/a/M1", "base/b", "base/b/M1", "base/b/M2"), NodeInfo())


def test_short_names_mean_one_body() -> None:
    assert find_node("M2", NODES) == "base/b/M2"
    assert find_node("a/M1", NODES) == "base/a/M1"
    with pytest.raises(Problem, match="several nodes have this name") as several:
        find_node("M1", NODES)
    assert several.value.allowed == "base/a/M1, base/b/M1"
    with pytest.raises(Problem, match="no such node"):
        find_node("M7", NODES)
    named = checked_nodes(job(perturb={"M2": {"shift": "1 0 0 um"}, "a/M1": {"shift": "2 0 0 um"}}), NODES)
    assert list(named.perturb) == ["base/b/M2", "base/a/M1"]
    with pytest.raises(InputError, match="perturbed twice"):
        checked_nodes(job(perturb={"M2": {"shift": "1 0 0 um"}, "b/M2": {"shift": "2 0 0 um"}}), NODES)
    with pytest.raises(InputError) as both:  # one issue for each fault
        checked_nodes(job(perturb={"M7": {"shift": "1 0 0 um"}, "M2": {"scale": "1 ppm"}}), NODES)
    assert len(both.value.issues) == 2


# --- the physics -----------------------------------------------------------------------------------------


def test_despace_as_paraxial_rays_have_it(run: JobRun) -> None:
    """A chief ray through the stop, which is the primary, unfolded: two mirrors and the image plane at rest."""
    spec = load_camera(RC)
    separation = -spec.mirrors["M2"].z
    half = 0.5 * abs(spec.mirrors["M2"].radius)
    to_image = separation + spec.image.z
    height = separation + to_image * (1.0 + separation / half)
    by_separation = 1.0 + (1.0 + separation / half) + to_image / half
    camera = run.truth_dict()["cameras"][RC]
    # M2's own z runs with the light that comes in: toward the primary
    assert camera["d_f_um"] == pytest.approx(-20.0 * by_separation, rel=1e-3)
    assert camera["principal_distance_mm"] == pytest.approx(1e3 * height, rel=1e-4)
    assert [abs(camera[key]) < 1e-9 for key in ("d_alpha_arcsec", "d_beta_arcsec", "d_gamma_arcsec")] == [True] * 3


@pytest.mark.second
def test_a_job_that_refocuses_is_the_refocused_camera(backend, tmp_path) -> None:
    """By the job, in a study's run, in a script and for ``twin.camera`` alike; other commands refuse the key."""
    asked = resolve_job(job(perturb=[DESPACE], refocus=True))
    file = tmp_path / "job.yaml"
    file.write_text(asked.to_yaml(), "utf-8")
    assert resolve_camera(file).refocus
    done = render_job.render_job(asked, backend)
    scripted, plane = twin.load_camera(RC).perturbed(DESPACE).refocused().state, focal_plane_body(f"base/{RC}")
    assert done.state[plane].shift == pytest.approx(scripted[plane].shift, rel=1e-4)  # of five digits
    assert done.state[plane] == twin.load(str(file)).state[plane]
    assert done.quality is not None
    (outcome,) = RenderBase().evaluate(asked.plain(), [Run(0, (), None)], backend)
    middle = done.quality.fields.index(0.0)
    found = outcome["quality"]["cameras"][RC]["defocus_um"]["centre"]
    assert found == pytest.approx(1e6 * done.quality.cameras[RC].defocus[1, middle], abs=1e-6)
    with pytest.raises(InputError, match=r"only twin.render, twin.study and twin.camera refocus"):
        job_state(asked.job, ThermalModel(done.experiment.instrument))
    pair = validate(JobSpec, YamlFile("", {"instrument": "monitor_pair", "refocus": True}, {}))
    with pytest.raises(InputError, match="an instrument with a monitor is not refocused"):
        render_job.render_job(resolve_job(pair), backend)
    with pytest.raises(InputError, match="a state is refocused, not a course"):
        job(refocus=True, course={"times": ["0 s", "1 s"], "motion": {"M2": {"shift": ["0 0 0 um", "0 0 1 um"]}}})
    assert "refocus" not in resolve_job(job(perturb=[DESPACE])).to_yaml()


@pytest.mark.second
def test_quality_is_that_of_the_camera_looked_at(run: JobRun, backend) -> None:
    """Two ways to the same numbers: image quality of an instrument, and a camera at fields, times the pixel."""
    assert run.quality is not None
    camera, middle = run.quality.cameras[RC], run.quality.fields.index(0.0)
    for s, seen in enumerate((twin.load_camera(RC), twin.load_camera(RC).perturbed(DESPACE))):
        along = seen.mtf((0.0, 0.0), np.array([0.0, seen.nyquist])).values[:, 1]
        pixel = np.sinc(0.5)
        told = [camera.mtf_along_line[s, middle], camera.mtf_along_track[s, middle]]
        np.testing.assert_allclose(told, along * pixel, atol=2e-5)
        assert camera.wfe[s, middle] == pytest.approx(seen.wavefront().rms, abs=2e-4)
        assert camera.light_lost[s, middle] == pytest.approx(seen.wavefront().vignetted, abs=2e-3)
        # what its quadrature was held to is told of a pupil that edges cut
        assert 0.0 < camera_run._MTF(seen.mtf((0.0, 0.0), np.array([0.0, seen.nyquist])))["accuracy"] < 1e-3
    # a camera that is symmetric about its axis, moved along it, has the same numbers at both ends
    for values in (camera.wfe, camera.mtf_along_line, camera.mtf_along_track, camera.light_lost):
        np.testing.assert_allclose(values[:, 0], values[:, -1], atol=1e-6)


@pytest.mark.second
def test_errors_are_those_of_wavefronts(backend) -> None:
    """At the focal plane and beside it, for a free pupil and for one that edges cut."""
    for name, within in (("gf7", 1e-9), (RC, 2e-3)):
        optics = CameraOptics.alone(load_camera(name), backend)
        fields = ((0.0, 0.0), (0.7, 0.0), (1.0, 1.0))
        expected = [wave.rms for wave in optics.wavefronts(fields, points=3)]
        np.testing.assert_allclose(optics.errors(fields), expected, rtol=within, atol=1e-6)


@pytest.mark.second
def test_a_pair_has_the_same_truth_without_its_monitor(backend) -> None:
    spec = load_instrument("gf7_pair")
    sites = {
        name: site.model_copy(update={"pupil_offset": None, "channels": None}) for name, site in spec.cameras.items()
    }
    bare = spec.model_copy(update={"monitor": None, "central_prism": None, "disturbances": None, "cameras": sites})
    moved = ["forward/M2 shift z 3 um", "backward/focal_plane rotate z 9 arcsec", "forward temperature 1 K"]
    given = resolve_job(validate(JobSpec, YamlFile("", {"instrument": "gf7_pair", "perturb": moved}, {})))
    alone = given.model_copy(update={"instrument": bare, "detector": None, "disturbances": None})
    with_monitor, without = (render_job.render_job(one, backend) for one in (given, alone))
    assert isinstance(with_monitor, RenderRun)
    assert not isinstance(without, RenderRun)
    first, second = with_monitor.truth_dict(), without.truth_dict()
    for name in ("forward", "backward"):
        for key, value in first["cameras"][name].items():
            assert second["cameras"][name][key] == pytest.approx(value, rel=1e-9, abs=1e-9), key
    assert second["intersection_angle"] == pytest.approx(first["intersection_angle"], rel=1e-9)
    assert second["ground"] == pytest.approx(first["ground"], rel=1e-7)


@pytest.mark.second
def test_a_camera_with_lenses_of_an_unknown_glass_is_moved_and_not_warmed(backend) -> None:
    """In its colours: every wavelength by its own rays, about one place."""
    camera = colour_camera("achromat")
    spec = InstrumentSpec.of_camera("achromat", "achromat")
    built = build_instrument(spec, {"achromat": camera}, backend)
    warmed = {path for path, info in built.nodes.items() if "temperature" in info.allows}
    root = "base/achromat"
    assert not warmed & {"base", root, *(f"{root}/{name}" for name in camera.mirrors if name != "L1")}
    assert f"{root}/L1" in warmed  # of the lens of N-BK7 all is known
    assert all({"shift", "rotate"} <= built.nodes[f"{root}/{name}"].allows for name in camera.mirrors)
    seen = CameraOptics.alone(camera, backend)
    wavelengths, weights = camera.spectrum.rule(5)
    frequency = np.array([0.0, seen.nyquist])
    colours = seen.mtfs([(0.0, 0.0)], frequency, wavelengths, weights)[0].values[:, 1] * np.sinc(0.5)
    alone = seen.mtf((0.0, 0.0), frequency).values[:, 1] * np.sinc(0.5)
    found = image_quality(built, backend, [{}], (0.0,)).cameras["achromat"]
    told = [found.mtf_along_line[0, 0], found.mtf_along_track[0, 0]]
    np.testing.assert_allclose(told, colours, atol=2e-4)
    assert np.all(np.abs(colours - alone) > 2e-3)  # of one colour it is another one


# --- what needs a monitor --------------------------------------------------------------------------------


@pytest.mark.parametrize(("says", "problem"), refusals("of_a_monitor"))
def test_what_only_a_monitor_gives_is_refused(says: dict, problem: str, backend) -> None:
    with pytest.raises(InputError, match=problem) as error:
        render_job.render_job(resolve_job(job(**says)), backend)
    assert f"{RC} has none" in str(error.value)


@pytest.mark.second
def test_a_target_that_a_perturbation_loses_is_told(backend) -> None:
    says = {
        "instrument": {"camera": "gf7"},
        "perturb": ["gf7 rotate x 10 arcmin"],
        "render": {"images": ["knife_edge"]},
    }
    with pytest.raises(InputError, match="the perturbed instrument cannot be rendered: the line CCD of camera gf7"):
        render_job.render_job(resolve_job(validate(JobSpec, YamlFile("", says, {}))), backend)


@pytest.mark.parametrize(
    ("place", "name", "error", "lose"),
    [
        (LineSight, "truth", BeamMissedError, render_job.render_job),
        (render_job, "image_quality", UnphysicalError, render_job.render_job),
        (render_job, "stray_light", NominalPathLost, lambda job, _: render_job._stray(PATHLESS, job, {}, 1, silent)),
    ],
)
def test_light_that_motions_lose_is_told_at_their_key(place, name, error, lose, backend, monkeypatch) -> None:
    resolved = resolve_job(job(perturb=[DESPACE], render={"stray": True} if name == "stray_light" else {}))

    def lost(*_: object, **__: object) -> None:
        raise error("none is left")

    monkeypatch.setattr(place, name, lost)
    words = r"perturb: the perturbed instrument cannot be rendered: none is left.*motions of .*M2.*smaller motions"
    with pytest.raises(InputError, match=words):
        lose(resolved, backend)


# --- where users meet it ---------------------------------------------------------------------------------


@pytest.mark.second
def test_a_script(backend) -> None:
    camera = twin.load_camera(RC)
    assert camera.perturbed(DESPACE).state == camera.perturbed({"M2": {"shift": "0 0 20 um"}}).state
    with pytest.raises(InputError, match="no such node"):
        camera.perturbed({"M7": {"shift": "0 0 1 um"}})
    shot = camera.twin.perturbed(DESPACE).render()
    assert shot.quality.loc[RC, "after", 0.0].wfe_rms_waves > shot.quality.loc[RC, "before", 0.0].wfe_rms_waves
    assert shot.truth.d_f_um.item() == pytest.approx(-121.0, abs=2.0)
    assert shot.before.sizes["channel"] == 0


def test_the_config_of_a_job_is_the_job(tmp_path) -> None:
    """What ``twin.camera`` looks at is in the state that the job says."""
    file = tmp_path / "job.yaml"
    file.write_text(f"instrument: {{camera: {RC}}}\nperturb: [{DESPACE}]\n", "utf-8")
    setup = resolve_camera(file)
    assert setup.mounted == RC
    assert setup.perturb["M2"].shift == (0.0, 0.0, pytest.approx(2e-5))
    again = tmp_path / "config.yaml"
    again.write_text(setup.to_yaml(), "utf-8")
    assert resolve_camera(again) == setup
    alone = resolve_camera(RC).perturbed([DESPACE])
    again.write_text(alone.to_yaml(), "utf-8")
    assert resolve_camera(again) == alone
    file.write_text(
        f"instrument: {RC}\ncourse: {{times: [0 s, 1 s], motion: {{M2: {{shift: [0 0 0 um, 0 0 1 um]}}}}}}\n", "utf-8"
    )
    with pytest.raises(InputError, match="this job describes a course"):
        resolve_camera(file)


@pytest.mark.second
def test_a_camera_is_perturbed_from_the_command_line(tmp_path, backend, monkeypatch) -> None:
    asked = []

    def run(setup, *more, **named):
        asked.append(setup)
        raise InputError(Issue("enough"))

    with monkeypatch.context() as patch:
        patch.setattr(camera_run, "run_camera", run)
        invoke(camera_app, RC, "--perturb", DESPACE, "--temperature", "+2 K", "--out", tmp_path / "seen")
    (setup,) = asked
    assert setup.perturb["M2"].shift == (0.0, 0.0, pytest.approx(2e-5))
    assert setup.perturb["base"].temperature.change == 2.0
    told = camera_run.CAMERA(camera_run.run_camera(resolve_camera("gf7").perturbed([DESPACE]), backend))
    built = build_instrument(InstrumentSpec.of_camera("gf7", "gf7"), {"gf7": load_camera("gf7")}, backend)
    moved = trace_truth(built, backend, [{"base/gf7/M2": Motion(shift=(0.0, 0.0, 2e-5), pivot="centre")}])
    assert told["perturbed"]["d_f_um"] == pytest.approx(1e6 * moved.vector("gf7")[0, 3], rel=1e-6)
    assert told["perturbed"]["worst_as_designed_waves"] == pytest.approx(0.0363, rel=0.01)
    assert told["wfe_worst_waves"] > 1.2 * told["perturbed"]["worst_as_designed_waves"]


def test_a_camera_that_images_upright_has_no_full_turn(backend) -> None:
    """Its roll is half a turn, which rounding calls by either sign; a turn of its focal plane is told as it is."""
    spec = InstrumentSpec.of_camera("korsch", "korsch")
    built = build_instrument(spec, {"korsch": load_camera("korsch")}, backend)
    small = 1e-5
    states = [{"base/korsch/M2": Motion(shift=(0.0, 0.0, z))} for z in np.linspace(-6e-6, 6e-6, 25)]
    turned = [{"base/korsch/focal_plane": Motion(rotate=(0.0, 0.0, sign * small))} for sign in (-1.0, 1.0)]
    roll = trace_truth(built, backend, [*states, *turned]).vector("korsch")[:, 2]
    assert np.all(np.abs(roll[:25]) < 1e-9)
    np.testing.assert_allclose(np.abs(roll[25:]), small, rtol=0.1)
    assert roll[25] == pytest.approx(-roll[26], rel=1e-3)


JOB = f"instrument: {{camera: {RC}}}\n"
STUDY = f"""name: study
base: {{command: render, file: job.yaml}}
factors:
  m2z: {{motion: M2 shift z, normal: {{mean: 0 um, sigma: 2 um}}}}
  m2rx: {{motion: M2 rotate x, normal: {{mean: 0 arcsec, sigma: 2 arcsec}}}}
  warmth: {{motion: base temperature, uniform: [-1 K, 1 K]}}
design: {{kind: monte_carlo, runs: 4, seed: 3}}
responses:
  da: {{key: [truth, cameras, {RC}, d_alpha_arcsec]}}
  df: {{key: [truth, cameras, {RC}, d_f_um]}}
"""


def jacobian(folder, backend, text: str = STUDY, job: str = JOB) -> Gradient:
    (folder / "job.yaml").write_text(job, "utf-8")
    (folder / "study.yaml").write_text(text, "utf-8")
    return study_gradient(resolve_study(folder / "study.yaml"), backend)


def entry(found: Gradient, response: str, factor: str) -> float:
    names = [one.name for one in found.factors]
    return float(found.best[found.responses.index(response), names.index(factor)])


def first_order() -> tuple[float, float, float, float]:
    """Spacing of the mirrors, way from M2 to the image, power of M2 (diverging positive), and the focal length that
    follows: a chief ray of slope W from the middle of M1 meets M2 at d W and the image at (d + s (1 + p d)) W.
    """
    spec = load_camera(RC)
    spacing = spec.mirrors["M1"].z - spec.mirrors["M2"].z
    way, power = spec.image.z - spec.mirrors["M2"].z, 2.0 / abs(spec.mirrors["M2"].radius)
    return spacing, way, power, spacing + way * (1.0 + power * spacing)


def test_motions_of_a_telescope_by_hand(tmp_path, backend) -> None:
    """A turn of M2 sweeps the image by twice itself over its way; a despace changes where the chief ray ends."""
    found = jacobian(tmp_path, backend)
    spacing, way, power, focal = first_order()
    assert entry(found, "da", "m2rx") == pytest.approx(-2.0 * way / focal, rel=1e-4)
    despace = -(1.0 + (1.0 + power * spacing) + way * power)
    assert entry(found, "df", "m2z") == pytest.approx(despace, rel=1e-4)
    motions = [k for k, one in enumerate(found.factors) if one.name != "warmth"]
    assert set(found.method[:, motions].ravel()) == {AD}
    # entries are judged down to 1e-3 of the largest, of differences that leave 1e-8 and rounding
    assert found.worst < 1e-6
    # heat is no elementary motion: differences of exact traces; half a kelvin each way is the same as one there
    assert set(found.method[:, 2]) == {TRACED}


@pytest.mark.second
def test_lenses_have_derivatives_too(tmp_path, backend) -> None:
    """A face of a lens moves by itself; what turns the line of sight is known by two methods."""
    (tmp_path / "lens.yaml").write_text(colour_camera("achromat").file_text(""), "utf-8")
    text = STUDY.replace("M2", "L2").replace(RC, "achromat").replace("  warmth", "  #")
    found = jacobian(tmp_path, backend, text, "instrument: {camera: lens.yaml}\n")
    assert set(found.method.ravel()) == {AD}
    assert abs(entry(found, "da", "m2rx")) > 1e-3
    # the field is 0.6 mrad to each side, of which the formulas' step has to be a small part
    assert found.worst < 1e-7
    spec, step = colour_camera("achromat"), 1e-5

    def scale(despace: float) -> float:
        """Height at the image of the chief ray of unit slope, paraxially, metres."""
        height, slope, index, place = 0.0, 1.0, 1.0, spec.mirrors["L1"].z
        for name, face in spec.mirrors.items():
            z, behind = face.z + despace * (name == "L2"), spec.index_behind(name)
            height, place = height + slope * (z - place), z
            slope, index = (index * slope - height * (behind - index) / face.radius) / behind, behind
        return height + slope * (spec.image.z - place)

    by_hand = (scale(step) - scale(-step)) / (2.0 * step)
    assert entry(found, "df", "m2z") == pytest.approx(by_hand, rel=1e-6)
