"""The sentence that a run begins with is true, whatever was perturbed, misreadings are warnings, each truth value that
judges a result reaches the warnings, JSON and the exit code of --strict, and a number has the unit that its key says.
"""

import importlib
import io
import json
import pkgutil
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

import twin
import twin.main_job.render_job as render_job_module
from analysis.monitor.limits import Split
from analysis.monitor.parameters import ANGLE, CAMERA_PARAMETERS, GROUND
from docs.site.run_pages import golden_fields
from scenes.specs.resolved import resolve
from scenes.specs.study import UNITS, unit_of
from tests.golden.digest import expanded
from tests.twin.commands import invoke
from tests.twin.test_procedure import FILE, LEVEL, program
from twin.framework.artefact import FAR
from twin.framework.provenance import VERDICT, negative_verdicts
from twin.framework.record import Quantity, Record
from twin.main_job import verdict
from twin.main_job.render_command import _print_result
from twin.main_job.render_job import render_job
from twin.main_job.render_results import RenderRun
from twin.main_job.systematics import assumed
from twin.main_job.verdict import FALSE_ALARM, Judgement, alarm_limit, judge, readings, recovered_numbers

OUTSIDE = "a motion outside the family of the model"


@pytest.fixture(scope="module")
def job(experiment, tmp_path_factory):
    """Runs a job by what it perturbs, with no disturbances stated unless ``more`` says so; each once."""
    place, done = tmp_path_factory.mktemp("jobs"), {}

    def run(perturb: str, more: str = "", frames: int = 2, instrument: str = "gf7_pair") -> RenderRun:
        key = (perturb, more, frames, instrument)
        if key not in done:
            file = place / f"job{len(done)}.yaml"
            more += "" if "disturbances" in more else "\ndisturbances: none"
            file.write_text(
                f"instrument: {instrument}\nperturb: {perturb}\n{more}\nrender: {{frames: {frames}, seed: 3}}\n"
            )
            resolved, built = resolve(file), experiment(instrument)
            done[key] = render_job(resolved, built.backend, experiment=built.stating(resolved))
        return done[key]

    return run


def good(run: RenderRun) -> tuple[int, int]:
    """How many readings that the verdict is about are within FAR sigmas of the truth, worked out from the files'
    contents.
    """
    recovered, truth, own = run.recovered_dict(), run.truth_dict(), run.judged
    pairs = [
        (recovered["cameras"][c][own], truth["cameras"][c], p) for c in truth["cameras"] for p in CAMERA_PARAMETERS
    ]
    pairs.append((recovered["intersection_angle"][own], truth["intersection_angle"], ANGLE.key))
    pairs += [(recovered["ground"][own], truth["ground"], p.key) for p in GROUND]
    return sum(abs(r[key] - t[key]) <= FAR * r[f"{key}_sigma"] for r, t, key in pairs), len(pairs)


def all_of(told: Judgement) -> str:
    """The verdict with the sentences that follow it."""
    return " ".join((told.verdict, *told.more))


@pytest.mark.second
def test_nothing_perturbed(job) -> None:
    told = judge(job("{}"))
    assert told.verdict.startswith("Nothing was perturbed, and all 12 readings of the model are within 3 σ of zero")
    assert told.warnings == ()
    # a motion of size zero is none
    assert judge(job("{base/forward/M2: {shift: [0 um, 0 um, 0 um]}}")).verdict.startswith("Nothing was perturbed")


def test_noise_that_looks_like_a_change_is_called_noise(job) -> None:
    """Of nothing perturbed one reading is moved by 3.2 sigma, then by 9: the first happens, the second does not."""
    run = job("{}")
    small, large = (judge(moved(run, 0, sigmas)).verdict for sigmas in (3.2, 9.0))
    assert "1 of 12 readings of the model is beyond 3 σ" in small
    assert "this is consistent with chance" in small
    assert "check the warnings" in large
    assert any("misread" in warning for warning in judge(moved(run, 0, 9.0)).warnings)
    assert judge(moved(run, 0, 3.2)).warnings == ()


def moved(run: RenderRun, parameter: int, sigmas: float) -> RenderRun:
    """The run with one reading of the model that many sigmas from the truth, which is zero."""
    camera = next(iter(run.recovery.parameters))
    estimators = dict(run.recovery.parameters[camera])
    model = estimators["model"]
    names = ("d_alpha_rad", "d_beta_rad", "d_gamma_rad", "d_f_m")
    value = sigmas * model.sigma[:, parameter]
    estimators["model"] = replace(model, **{names[parameter]: value})
    parameters = {**run.recovery.parameters, camera: estimators}
    return replace(run, recovery=replace(run.recovery, parameters=parameters))


@pytest.mark.second
def test_beneath_the_noise(job, monkeypatch) -> None:
    run = job("{base/forward/focal_plane: {shift: [0.003 um, 0 um, 0 um]}}")
    told = judge(run)
    assert told.verdict.startswith("The perturbation is below the noise: no true change reaches 3 σ")
    assert all(abs(r.true) < FAR * r.sigma for r in readings(run, "model"))
    # noise falls with the root of the number of frames
    found = re.search(r"About (\d+) frames would reveal", all_of(told))
    assert found is not None
    clearest = max(readings(run, "model"), key=lambda r: abs(r.true / r.sigma))
    assert clearest.sigma * np.sqrt(run.frames / int(found[1])) == pytest.approx(abs(clearest.true) / FAR, rel=0.1)
    for most, said in ((int(found[1]), True), (int(found[1]) - 1, False)):
        monkeypatch.setattr(verdict, "MOST_FRAMES", most)
        assert ("frames would reveal" in all_of(judge(run))) == said


@pytest.mark.second
def test_recovered(job) -> None:
    run = job("{base/forward/focal_plane: {shift: [3 um, -2 um, 0 um], rotate: [0 arcsec, 0 arcsec, 5 arcsec]}}")
    told = judge(run)
    assert good(run) == (12, 12)
    seen = sum(abs(r.true) > FAR * r.sigma for r in readings(run, "model"))
    assert told.verdict.startswith(
        f"All 12 readings of the model are within 3 σ of the truth (σ: noise alone). {seen} of the changes exceed"
    )
    # the printed formula reads it twice, which is an error as large as the change
    assert [w for w in told.warnings if w.startswith("Δγ of forward [arcsec] is misread by more than the change")]


@pytest.mark.second
def test_another_motion_is_named_with_its_share(job) -> None:
    run = job("{base/forward/M2: {shift: [0 um, 0 um, 3 um]}}", frames=9)
    told = judge(run)
    count, of = good(run)
    assert count < of
    assert told.verdict.startswith(f"{count} of {of} changes are recovered within 3 σ, {of - count} are not")
    assert f"The cause is {OUTSIDE} (M2 along Z, 3 µm)" in all_of(told)
    worst = max((r for r in readings(run, "model") if r.camera), key=lambda r: abs(r.ratio))
    found = f"The worst is {worst.name}, with a reading of {worst.read} and a true value of {worst.shown(worst.true)}"
    assert found in told.verdict
    assert f"{100.0 * abs(worst.error / worst.true):.0f} % of the change" in told.verdict


@pytest.mark.second
def test_readings_larger_than_the_change(job) -> None:
    run = job("{base/forward/focal_plane: {rotate: [20 arcsec, 0 arcsec, 0 arcsec]}}")
    told = judge(run)
    assert "larger than the change itself" in told.verdict
    assert f"The cause is {OUTSIDE} (focal plane about X (tilt), 20 arcsec)" in all_of(told)
    (warning,) = [w for w in told.warnings if w.startswith("Δγ of forward [arcsec]")]
    for r in readings(run, "model"):
        if r.name == "Δγ of forward":
            assert f"it is {r.shown(r.true)}, read as" in warning
            assert re.search(rf"{r.shown(r.value)} ± {r.shown(r.sigma)} \([^)]*\bmodel\)", warning)


def test_lost_light_is_told(job) -> None:
    """A spot with a third of its light says so, whatever is read."""
    run = job("{}")
    photons = run.photons_after.copy()
    photons[0] /= 3.0
    dimmed = judge(replace(run, photons_after=photons))
    assert "Spots have lost light (forward/left 33 % of the nominal light)." in dimmed.more


@pytest.mark.second
def test_what_the_model_does_not_model_is_named(job) -> None:
    """A figure within the family of motions, one beyond it, a prism that no camera has, and heat."""
    for perturb, words in (
        ("base/forward/M1: {figure: {Z5: 20 nm}}", f"{OUTSIDE} (M1 figure Z5 (astigmatism), 20 nm)"),
        ("base/forward/M1: {figure: {Z11: 20 nm}}", "does not model base/forward/M1"),
        ("base/forward: {temperature: 1 K}", "does not model temperatures (expansion, bending, change of index)"),
        ("base/forward/monitor/left/prism_180: {rotate: 1 0 3 arcsec}", "changes no camera, and all 12 readings"),
    ):
        assert words in all_of(judge(job(f"{{{perturb}}}"))), perturb


@pytest.mark.second
def test_a_course_is_judged_over_its_times(job) -> None:
    course = (
        "course: {times: [0 min, 10 min, 20 min], temperature: {base/forward: "
        "{change: [0 K, 0.1 K, 0.2 K], gradient: [[0 mK/m, 0 mK/m, 0 mK/m], [10 mK/m, 0 mK/m, 0 mK/m], "
        "[20 mK/m, 0 mK/m, 0 mK/m]]}}}"
    )
    run = job("{}", course, instrument="monitor_pair")
    told = judge(run)
    assert run.series is not None
    assert "over 3 times from 0 s to 20 min" in told.verdict.replace("0 min to", "0 s to")
    found = readings(run, "model")
    far = [r for r in found if r.far]
    assert f"{len(found) - len(far)} of {len(found)} changes" in told.verdict
    first = found[0]
    course = run.series.to_dict()["cameras"]["forward"]
    error = np.array(course["model"]["d_alpha_arcsec"]) - course["true"]["d_alpha_arcsec"]
    assert first.error == pytest.approx(float(np.sqrt(np.mean(error**2))), rel=1e-12)


def test_rate_of_false_alarms() -> None:
    """Of readings that are all noise at most FALSE_ALARM of the runs are warned of; 5 sigma of the binomial on top."""
    count, runs = 36, 100_000
    worst = np.abs(np.random.default_rng(1).standard_normal((runs, count))).max(axis=1)
    rate = np.mean(worst > alarm_limit(count))
    assert rate < FALSE_ALARM + 5.0 * np.sqrt(FALSE_ALARM / runs)
    assert rate > 0.5 * FALSE_ALARM


def test_softer_images_are_told_where_it_matters(job) -> None:
    """Half of the MTF lost at one place is in the sentence, with that place; a loss of a hundredth is not."""
    run = job("{}")
    still = np.array([[0.3, 0.2], [0.3, 0.2]])

    def quality(after: float) -> SimpleNamespace:
        softer = SimpleNamespace(mtf_along_line=np.array([[0.3, 0.2], [0.3, after]]), mtf_along_track=still)
        same = SimpleNamespace(mtf_along_line=still, mtf_along_track=still)
        return SimpleNamespace(cameras={"forward": same, "backward": softer}, fields=(0.0, 0.9))

    told = judge(replace(run, quality=quality(0.1)))
    softer = (
        "The MTF with the pixel at Nyquist of backward along the line, at 0.9 of half the line, falls from 0.200 to "
        "0.100"
    )
    assert softer in all_of(told)
    assert "MTF" not in all_of(judge(replace(run, quality=quality(0.198))))


# --- stated disturbances ----------------------------------------------------------------------------------------------

LAUNCH = "disturbances: launch"
EXAMPLE = (
    "{base/backward/focal_plane: {rotate: [2 arcsec, -1.5 arcsec, 10 arcsec], pivot: rear_node}, "
    "base/forward/M2: {shift: [0 um, 0 um, 3 um]}}"
)


@pytest.mark.second
def test_what_is_stated_stands_in_the_sentence(job) -> None:
    """No reading of the example is beyond 3 total sigma, and the reader sees which body limits the angle."""
    run = job(EXAMPLE, LAUNCH, frames=9)
    told = judge(run)
    assert run.judged == "posterior"
    assert good(run) == (12, 12)
    for estimator in run.estimators:
        assert not any(r.far for r in readings(run, estimator))
    assert told.warnings == ()
    assert (
        "All 12 readings of the posterior are within 3 σ of the truth (σ: noise and disturbances launch)"
        in told.verdict
    )
    assert "Noise and disturbances hide changes below" in all_of(told)
    assert "more frames do not lower this limit" in all_of(told)
    # what a share of 100 % means, and which numbers are the prior's alone
    assert run.reading.repeats_prior == ()
    assert "only as good as the prior, and more frames do not reduce them" in assumed(run.reading)
    fixed = replace(run.reading)
    fixed.__dict__["repeats_prior"] = ("forward Δf",)
    assert assumed(fixed).endswith("the spots do not measure forward Δf: these numbers repeat the prior")
    found = re.search(r"Motions of (\S+) cause (\d+) % of the variance of Δθ \(σ (\S+) arcsec\)", all_of(told))
    assert found is not None
    body, share, size = found.groups()
    sigma = next(r.sigma for r in readings(run, "posterior") if r.parameter == ANGLE)
    assert float(size) == pytest.approx(sigma, rel=0.06)
    # that body taken out of what is stated takes so much of the variance
    less = job(EXAMPLE, f"disturbances: {{file: launch, {without(run, body)}}}", frames=9)
    left = next(r.sigma for r in readings(less, "posterior") if r.parameter == ANGLE)
    assert 1.0 - (left / sigma) ** 2 >= int(share) / 100.0 - 0.01


def without(run: RenderRun, body: str) -> str:
    """A job's words for the same disturbances with all others of a pattern of mirrors, and not this one."""
    others = [f"base/{c}/M{k}" for c in ("forward", "backward") for k in (1, 2, 3) if f"{c}/M{k}" != body]
    assert len(others) == 5
    return f"causes: {{mirror_mounts: {{bodies: {others}}}, mirror_figure: {{bodies: {others}}}}}".replace("'", "")


def test_the_share_of_a_body_is_that_of_its_errors() -> None:
    """By the definition of a variance: over draws of the motions."""
    rng = np.random.default_rng(3)
    bodies, left = ("a", "b", "a", "c"), rng.standard_normal(4)
    drawn = rng.standard_normal((200_000, 4)) * left
    shares = {body: float(share[0]) for body, share in Split.by(left[None] ** 2, bodies).items()}
    for body in "abc":
        own = drawn[:, [b == body for b in bodies]].sum(axis=1)
        # the scatter of a variance over n draws is sqrt(2 / n): five of them
        assert np.var(own) == pytest.approx(shares[body], rel=5.0 * np.sqrt(2.0 / 200_000))
    assert sum(shares.values()) == pytest.approx(float(left @ left), rel=1e-12)


@pytest.mark.second
def test_a_change_that_no_cause_makes_has_no_posterior(job, tmp_path) -> None:
    """Focal planes that are heated evenly lengthen lines and principal distances alike: nothing turns, and a posterior
    of 0 ± 0 was told of the turns. Files, table and verdict leave it out; the other estimators read on.
    """
    run = job("{base/forward/focal_plane: {rotate: 0 0 2 arcsec}}", "disturbances: paper_001")
    numbers = recovered_numbers(run)
    none = [key for key, value in numbers["cameras"]["forward"]["posterior"].items() if value is None]
    assert {"d_alpha_arcsec", "d_alpha_arcsec_sigma", "d_alpha_arcsec_sigma_noise", "d_gamma_arcsec"} <= set(none)
    assert numbers["from_statement"]["forward"]["d_alpha_arcsec"] is None
    assert numbers["cameras"]["forward"]["model"]["d_alpha_arcsec_sigma"] > 0.0
    console = Console(record=True, width=120, file=io.StringIO())
    _print_result(run, console)
    assert "Δα [arcsec]" not in console.export_text()
    assert "0.0 ±" not in judge(run).verdict
    assert json.loads(json.dumps(numbers, allow_nan=False)) == numbers


@pytest.mark.second
def test_motions_far_from_what_is_stated_are_found_out(job) -> None:
    """A line that turns 60 times as far as `launch` says; the common reference, where mirrors stand still."""
    still = "disturbances: {file: launch, without: [mirror_mounts, camera_mounts]}"
    for body, motion, more in (
        ("base/forward/focal_plane", "{rotate: [0 arcsec, 0 arcsec, 300 arcsec]}", LAUNCH),
        ("base/central_prism", "{rotate: [8 arcsec, 0 arcsec, 0 arcsec]}", still),
    ):
        run = job(f"{{{body}: {motion}}}", more)
        told = judge(run)
        (warning,) = [text for text in told.warnings if "contradict" in text]
        assert run.reading.consistency is not None
        assert "contradict the prior launch: chi-square" in warning
        assert f"limit {run.reading.consistency.limit:.1f} at a false-alarm rate of 0.001" in warning
        assert f"motions of {run.reading.consistency.suspects[0].body} would explain them best" in warning
        assert run.reading.consistency.suspects[0].body == body
        times = float(re.search(r"with (\S+) times the standard deviations of the prior", warning)[1])
        # of a body one or two motions are measured, which tell its sigma within a factor of some
        assert 5.0 < times < 300.0
        assert recovered_numbers(run)["warnings"] == list(told.warnings)
        assert not recovered_numbers(run)["disturbances"]["agrees"]
        assert "contradict it" in assumed(run.reading)


@pytest.mark.second
def test_a_body_of_which_nothing_is_stated_is_named_as_such(job) -> None:
    more = "disturbances: {file: launch, without: [mirror_mounts, mirror_figure, camera_mounts, moisture, heat]}"
    run = job("{base/forward/M1: {rotate: [3 arcsec, 0 arcsec, 0 arcsec]}}", more)
    (warning,) = [text for text in judge(run).warnings if "contradict" in text]
    assert ", which the prior does not contain, would explain them best" in warning


def test_a_job_that_moves_what_it_does_not_state_says_so(job) -> None:
    """A facet that turns is read as a turn of the camera, and four spot coordinates cannot contradict four numbers."""
    run = job("{base/central_prism/forward_left: {rotate: [1 arcsec, 0 arcsec, 0 arcsec]}}")
    (warning,) = [text for text in judge(run).warnings if "the job moves" in text]
    within = job("{base/forward/M2: {shift: [0 um, 0 um, 1 um]}}", LAUNCH)
    assert not [text for text in judge(within).warnings if "the job moves" in text]
    assert "base/central_prism/forward_left rotate x (1 arcsec, not in the prior), but there is no prior" in warning
    assert "of forward" in warning
    assert "of backward" not in warning


def test_full_pixels_and_lost_light_are_warnings_of_the_main_job(job) -> None:
    """A twentieth of the light on one CCD, and a frame whose brightest pixel is full; else nothing."""
    run = job("{}")
    nominal = run.photons_before
    given = (nominal, run.photons_after, run.before, run.after)
    assert render_job_module._warnings(run.experiment, *given) == ()
    dim, full = run.photons_after.copy(), run.after.copy()
    dim[1] *= 0.05
    full[2, 0][full[2, 0] == full[2, 0].max()] = run.experiment.detector.saturation_dn
    (lost,) = render_job_module._warnings(run.experiment, nominal, dim, run.before, run.after)
    assert lost == "forward/right: only 5 % of the nominal light reaches the CCD"
    (bright,) = render_job_module._warnings(run.experiment, nominal, run.photons_after, run.before, full)
    assert bright.startswith("saturated pixels in the spots backward/left (after)")


# --- verdicts reach warnings, JSON and the exit code of --strict ------------------------------------------------------


GOLDEN = Path(__file__).resolve().parents[1] / "golden"
WARNED_ELSEWHERE = {
    # verdicts without a warning in their record -> where it is made, or why there is none
    ("Sensitivity to a factor", "rbd_fast_agrees"): "twin.study.report.study_analysis",
    ("Content of block.json", "agrees"): "twin.orbit.block.block_report",
    ("Results with the loop closed and open", "stable"): "that of margins_hold",
    ("course.json", "sigma_holds"): "twin.monitor.time_series, and twin.main_job.systematics for single times",
    ("Coverage in random states", "sigma_agrees"): "twin.uncertainty.uncertainty_report",
    ("focus.json of a measured series", "curves_agree"): "twin.laboratory.focus_report",
    ("turntable.json", "heldout_agrees"): "twin.laboratory.turntable_report",
    ("Angles of one pass", "resection_agrees"): "twin.orbit.angle.angle_report",
    ("Heights with values smoothed from the measurements at one interval", "agrees"): "a candidate",
    ("Heights with values smoothed from the measurements at one interval", "shifts_agree"): "a candidate",
    ("One start of the search and its result", "converged"): "a candidate",
    ("asbuilt.json", "settled"): "a number",
}
PER_SI = {
    "mas": 206264806.24709636,
    "arcsec": 206264.80624709636,
    "arcmin": 3437.746770784939,
    "deg": 57.29577951308232,
}
PER_SI |= {"pm": 1e12, "nm": 1e9, "um": 1e6, "mm": 1e3, "km": 1e-3, "us": 1e6, "ms": 1e3, "mK": 1e3, "mW": 1e3}
PER_SI |= {"percent": 1e2, "ppm": 1e6, "urad": 1e6, "mrad": 1e3}
"""How many of a unit are one of SI, by the definition of the second of arc; 1 of all others."""
STRICT = [(True, ["--strict"], 0), (False, ["--strict"], 3), (False, [], 0)]
CONVERTED_BY_HAND = frozenset("ground_um phase_margin_deg shim_changes_um shim_um shims_um".split())
"""Keys whose sources are in the unit already."""


@cache
def records() -> tuple[Record, ...]:
    """Return every record that a module of the program declares."""
    found: dict[int, Record] = {}
    for module in pkgutil.walk_packages(twin.__path__, "twin."):
        if not module.name.endswith("__main__") and ".validation" not in module.name:
            for value in vars(importlib.import_module(module.name)).values():
                if isinstance(value, Record):
                    found[id(value)] = value
    return tuple(found.values())


@pytest.mark.second
def test_every_verdict_of_a_record_has_its_warning() -> None:
    silent = {
        (re.split(r"[.,:]( |$)", record.meaning)[0], one.key)
        for record in records()
        for one in record
        if VERDICT.search(one.key) and one.warning is None
    }
    assert silent == set(WARNED_ELSEWHERE)


@pytest.mark.second
@pytest.mark.parametrize("file", sorted(GOLDEN.glob("*.json")), ids=lambda file: file.stem)
def test_a_result_with_a_negative_verdict_warns(file: Path) -> None:
    """The results of all commands: their files and what --json prints."""
    run = json.loads(file.read_text("utf-8"))["run"]
    manifest = run.get("manifest.json", {}).get("warnings", [])
    results = [(name, content) for name, content in run.items() if name.endswith("json")]
    for name, condensed in [*results, *(("stdout", one) for one in run["stdout"])]:
        content = expanded(condensed)
        if name in ("manifest.json", "validation.json") or not isinstance(content, dict) or "validat" in file.stem:
            continue
        if name.startswith("served/"):  # what a page shows beside the record's own alarms
            continue
        negative = negative_verdicts(content)
        assert not negative or manifest, (name, negative)
        # warnings of course.json are in recovered.json beside it, those of study.json in statistics.json
        assert not negative or name in ("course.json", "study.json") or content["warnings"], (name, negative)


def test_warnings_of_records_within_records() -> None:
    below: Record[tuple] = Record("", Quantity("agrees", lambda s: s[1], warning=lambda s: f"{s[0]} does not agree"))
    source = {"one": ("a", True), "named": {"x": ("b", False), "y": {"z": ("c", False)}}, "row": [("d", False)]}
    record: Record[dict] = Record(
        "",
        Quantity("one", lambda s: {"only": s["one"]}, record=below),
        Quantity("named", lambda s: s["named"], record=below),
        Quantity("row", lambda s: s["row"], record=below),
        Quantity("rows", lambda s: tuple(s["row"]), record=below),
        Quantity("none", lambda s: None, record=below),
        Quantity("holds", lambda s: np.bool_(False), warning=lambda s: "it does not hold"),
        Quantity("settled", lambda s: None, warning=lambda s: "not judged"),
    )
    told = [f"{name} does not agree" for name in "bcdd"]
    assert list(record.warnings(source)) == [*told, "it does not hold"]
    paths = ["named.x.agrees", "named.y.z.agrees", "row[0].agrees", "rows[0].agrees", "holds"]
    assert negative_verdicts(record(source)) == paths


def test_which_verdicts_are_negative() -> None:
    numbers = {
        "sigma_holds": [True, False],
        "shifts_agree": True,
        "smoothing": {"agrees": True, "intervals": [{"agrees": False}]},
        "starts": [{"converged": False}],
        "settled": 1e-9,
        "withholds": False,
        "fit": {"agrees": None, "curves_agree": False},
    }
    assert negative_verdicts(numbers) == ["sigma_holds", "fit.curves_agree"]


@pytest.mark.parametrize(("good", "options", "code"), STRICT)
def test_strict_ends_with_a_code_of_its_own(
    good: bool, options: list[str], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also with --quiet, where the warnings stand in JSON; the run folder is complete."""
    app = program(monkeypatch, numbers=lambda run: {**LEVEL.numbers(run), "fit": {"agrees": good}})
    (tmp_path / "level.yaml").write_text(FILE, "utf-8")
    done = invoke(app, "level", tmp_path / "level.yaml", "--out", tmp_path / "run", "--quiet", *options)
    assert done.exit_code == code, done.stderr
    assert ("fit.agrees" in done.stderr) == bool(code)
    assert json.loads((tmp_path / "run" / "level.json").read_text("utf-8"))["warnings"] == ["a toy"]


def course(folder: Path, size: float) -> Path:
    """A camera that turns to and fro from minute to minute, where the prior says that it drifts over hours."""
    turns = ", ".join(f"[0 arcsec, {(-1) ** k * size} arcsec, 0 arcsec]" for k in range(3))
    text = "instrument: gf7_pair\ncourse:\n  times: [0 min, 1 min, 2 min]\n  detail: 1 min\n  motion:\n"
    file = folder / f"course_{size}.yaml"
    file.write_text(text + f"    base/forward: {{rotate: [{turns}]}}\nrender: {{frames: 2, seed: 7}}\n", "utf-8")
    return file


def test_a_course_that_contradicts_its_prior_says_so(tmp_path: Path, backend) -> None:
    """The prior's camera mounts turn by 0.7", and 20 h of drift let them turn by 0.7" sqrt(2 / 1200) = 0.03" a minute:
    each time agrees, the turns of 1" between them do not.
    """
    run = render_job(resolve(course(tmp_path, 0.5)), backend)
    assert isinstance(run, RenderRun)
    assert run.series is not None
    assert run.series.agrees.all()
    numbers, told = recovered_numbers(run), judge(run)
    found = run.series.to_dict()
    assert not found["disturbances"]["agrees"]
    assert found["sigma_holds"] == [False] * 3
    assert not numbers["sigma_holds"]
    (doubt,) = numbers["doubts"]
    assert doubt.startswith("the series contradicts the prior orbit or its time laws: chi-square ")
    assert doubt in told.warnings
    assert numbers["warnings"] == list(told.warnings)
    assert told.verdict.startswith("The course contradicts the prior orbit or its time laws")


@pytest.mark.second
def test_a_course_that_keeps_to_its_prior_is_quiet(tmp_path: Path, backend) -> None:
    quiet = render_job(resolve(course(tmp_path, 0.0)), backend)
    assert isinstance(quiet, RenderRun)
    numbers = recovered_numbers(quiet)
    assert numbers["sigma_holds"]
    assert not numbers["doubts"]
    assert negative_verdicts({"recovered": numbers, "course": quiet.series.to_dict()}) == []
    # one time whose shifts are beyond the prior by themselves is no time at which sigma holds
    shaken = replace(quiet, series=replace(quiet.series, agrees=np.array([True, False, True])))
    assert shaken.series.to_dict()["sigma_holds"] == [True, False, True]


@pytest.mark.second
def test_every_number_has_the_unit_that_its_key_says() -> None:
    """One of SI as the source of every quantity of every record gives as many of the unit as there are in one of SI."""
    by_hand = set()
    for record in records():
        for one in record:
            words = [word for word in one.key.split("_")[1:] if word in UNITS or word.rstrip("2") in UNITS]
            if not words or words[-1] == "px2" or "per" in one.key.split("_") or one.below is not None:
                continue
            power = 2 if words[-1].endswith("2") else 1
            expected = PER_SI.get(words[-1].rstrip("2"), 1.0) ** power
            assert one.unit, one.key
            if one.converted:
                told = Quantity(one.key, lambda _: np.array([1.0])).value(None)
                assert told[0] == pytest.approx(expected, rel=1e-14), one.key
            elif expected != 1.0:
                by_hand.add(one.key)
    assert by_hand == CONVERTED_BY_HAND


@pytest.mark.second
def test_no_key_of_a_result_hides_its_unit() -> None:
    """In the results of all commands a key with the word of a unit is known to be in that unit."""
    for file in GOLDEN.glob("*.json"):
        for name, content in golden_fields(file.stem).items():
            for key in content.get("fields", {}):
                for part in re.split(r"[.\[\]{}|]+", key):
                    words = part.split("_")
                    if set(words[1:]) & set(UNITS) - {"s", "m", "K", "W"} and "per" not in words and " " not in part:
                        assert unit_of((part,)), f"{file.stem}: {name}: {key}"
