"""The Jacobian of a study: AD against differences, against images, what is written, and what is refused."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from optics.raytrace.aim import AimError
from scenes.yaml.errors import InputError, Issue
from tests.twin.study_bench import TEXTS, refusals, write_study
from twin.study.__main__ import app
from twin.study.gradient import study_gradient
from twin.study.gradient.study_gradient import AD, TRACED, WHOLE
from twin.study.runs.setup import resolve_study

AGREEMENT = 1e-6
"""Differences extrapolated to the fifth power of the step leave 1e-8, rounding of the traces 1e-9 of an entry; entries
are judged down to 1e-3 of the largest."""
RUNNER = CliRunner()


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return write_study(tmp_path_factory.mktemp("gradient"), text=TEXTS["gradient"])


@pytest.fixture(scope="module")
def whole(small):
    """Numbers of the study with all its factors, as the command writes them; a folder that is there is refused."""
    folder = small.parent / "out"
    result = RUNNER.invoke(app, [str(small), "--gradient", "--out", str(folder)])
    assert result.exit_code == 0, result.output
    again = RUNNER.invoke(app, [str(small), "--gradient", "--out", str(folder)])
    assert (again.exit_code, "exists" in again.output) == (2, True)
    return json.loads((folder / "gradient.json").read_text("utf-8"))


@pytest.mark.second
def test_motions_are_exact_and_all_else_is_marked(whole):
    method, ad = np.array(whole["method"]), np.array(whole["ad"], float)
    names = whole["factors"]
    traced = list(range(len(whole["responses"])))
    moving = [names.index(name) for name in ("m2z", "both", "turn", "coma")]
    still = [names.index(name) for name in ("warmth", "exposure")]
    assert np.all(method[np.ix_(traced, moving)] == AD)
    assert np.all(np.isfinite(ad[np.ix_(traced, moving)]))
    assert np.all(method[np.ix_(traced, still)] == TRACED)
    assert np.all(np.isnan(ad[np.ix_(traced, still)]))
    assert whole["worst_relative"] < AGREEMENT
    assert whole["units"][traced[0]][names.index("m2z")] == "px/um"
    # a factor of two places moves the spots of both cameras
    spots = np.abs(ad[:8, names.index("both")])
    assert min(spots[:4].max(), spots[4:].max()) > 0.01


@pytest.mark.second
def test_an_error_is_what_is_recovered_minus_what_is_true(whole):
    rows = {name: np.array(whole["ad"][k], float) for k, name in enumerate(whole["responses"])}
    k = whole["factors"].index("m2z")
    # the model sees a despace of M2 nearly right, so that the error is small beside the change itself, and not zero
    assert 1e-4 < abs(rows["error"][k] / rows["df"][k]) < 0.1


@pytest.mark.second
def test_readings_by_posterior_are_differentiated(tmp_path, backend):
    """By motions through the trace; by what is stated with differences, and so is all that depends on the noise."""
    # about a state that is moved: there a change of what is stated changes the reading
    path = write_study(tmp_path, text=TEXTS["of_stated"])
    job = tmp_path / "job.yaml"
    job.write_text(job.read_text("utf-8") + "perturb: {base/forward/M2: {shift: 0 0 1 um}}\n", "utf-8")
    found = study_gradient.study_gradient(resolve_study(path), backend)
    assert found.method[8:10].tolist() == [[AD, TRACED]] * 2
    assert found.method[10:].tolist() == [[WHOLE] * 2] * 2
    assert found.worst < AGREEMENT
    assert np.all(np.isfinite(found.best))
    # a more likely motion of the mirror takes more of the shifts upon itself
    assert abs(found.best[8, 1]) > 0.0
    assert found.best[10, 1] > 0.0


def test_options_of_runs_are_refused(small):
    for option in (("--workers", "2"), ("--resume",), ("--yes",), ("--scheduler", "tcp://127.0.0.1:1")):
        result = RUNNER.invoke(app, [str(small), "--gradient", *option])
        assert (result.exit_code, f"{option[0]} has no meaning" in result.output) == (2, True), option


@pytest.mark.second
@pytest.mark.parametrize(("old", "new", "words"), refusals("gradient"))
def test_what_has_no_derivative_is_refused(tmp_path, old, new, words):
    coma = "  coma: {key: [job, perturb, base/forward/M1, figure, Z7], uniform: [-10 nm, 10 nm]}\n"
    path = write_study(tmp_path, (old, new), (coma, ""), text=TEXTS["gradient"])
    (tmp_path / "far.yaml").write_text(
        f"{(tmp_path / 'job.yaml').read_text()}perturb: {{base/forward/M2: {{shift: 0 0 9 mm}}}}"
    )
    result = RUNNER.invoke(app, [str(path), "--gradient", "--out", str(tmp_path / "out")])
    assert result.exit_code == 2, result.output
    assert words in result.output
    assert not (tmp_path / "out").exists()


def test_what_a_factor_takes_names_the_factor(tmp_path, monkeypatch):
    """A step beside the base that loses the light, and a base whose motion no body has."""

    def lost(*words):
        raise AimError("no ray")

    def unknown(*words):
        raise InputError(Issue("no such node", key=("job", "perturb", "base/forward/M2", "shift", 2)))

    setup = resolve_study(write_study(tmp_path, text=TEXTS["gradient"]))
    traced = SimpleNamespace(
        setup=setup, maker=SimpleNamespace(base=None), backend=None, _job=lambda factor, step: None, _outcomes=lost
    )
    told = r"study\.yaml:\d+: factors\.warmth: the factor cannot be varied by 0\.5 \S+ about the base: no ray"
    with pytest.raises(InputError, match=told):
        study_gradient._Traced._values(traced, None, study_gradient.GradientFactor.of(setup, "warmth"), 0.5, [])
    monkeypatch.setattr(study_gradient, "MonitorExperiment", lambda *words: None)
    monkeypatch.setattr(study_gradient, "Chain", lambda *words: None)
    monkeypatch.setattr(study_gradient, "_state", unknown)
    with pytest.raises(InputError, match=r"factors\.m2z.*no such node \(at job\.perturb"):
        study_gradient._Traced.fill(traced, None)


@pytest.mark.second
def test_a_factor_whose_step_loses_the_light_is_refused(tmp_path):
    """A sigma needs whole runs, 7.5 mm either side of the base."""
    path = write_study(tmp_path, ("d_f_um], sigma", "d_f_um_sigma], sigma"), ("sigma: 1 um", "sigma: 15 mm"))
    result = RUNNER.invoke(app, [str(path), "--gradient", "--out", str(tmp_path / "out")])
    assert (result.exit_code, "the factor cannot be varied by 7500 um" in result.output) == (2, True), result.output
