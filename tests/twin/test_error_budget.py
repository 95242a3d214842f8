"""Paper 001's error budget: mechanisms against the exact trace, scaling, and the printed tables."""

from types import SimpleNamespace

import numpy as np
import pytest

from analysis.arrays import ARCSEC
from optics.thermal.heat import Temperature
from scenes.specs.disturbances import JobDisturbancesSpec
from scenes.specs.load import load_disturbances, load_error_budget
from scenes.specs.resolved import resolve_budget
from scenes.yaml.errors import InputError
from twin.monitor import simulated_budget
from twin.monitor.simulated_budget import ErrorBudget, _shifts

TRIALS = 40
LINES = ("centroid", *load_disturbances("paper_001").causes)


def make(backend, seed=3, causes=(), **changes):
    """The library's budget with other numbers; causes: cause -> what its file says otherwise."""
    spec = load_error_budget("monitor_pair").model_copy(update={"trials": TRIALS, "all_together": 60, **changes})
    resolved = resolve_budget(spec)
    other = JobDisturbancesSpec.model_validate({"causes": dict(causes)})
    return ErrorBudget(
        spec, resolved.model_copy(update={"disturbances": resolved.disturbances.changed(other)}), backend, seed
    )


@pytest.fixture(scope="module")
def budget(backend):
    return make(backend)


@pytest.mark.second
def test_images_show_what_the_exact_trace_says(budget):
    """A gradient in one prism moves its own spot by the mean of its traced rays, and no other spot."""
    experiment = budget.experiment
    channel = experiment.instrument.channels[0]
    state = experiment.thermal.state({channel.prism_body("prism_180"): Temperature(0.0, (0.0, 0.05, 0.02))})
    path = experiment.path
    share = path.nodes.share
    places = [np.einsum("n,bnk->bk", share, path.rays([s]).position[..., :2]) for s in ({}, state)]
    traced = (places[1] - places[0])[:, ::-1] / path.pitch  # columns run along x, rows along y
    seen = _shifts(experiment, [state])[0]
    assert np.hypot(*traced[0]) > 0.5
    # the spot is the diffraction image: it follows the mean ray to second order in the small change of its shape
    np.testing.assert_allclose(seen, traced, atol=2e-3)
    assert np.abs(seen[1:]).max() < 1e-6


def test_causes_draw_for_every_prism_by_itself(budget):
    states = budget.states(("prism_180_rotation",), 30, 1)
    turned = {path for state in states for path in state}
    assert turned == {c.prism_body("prism_180") for c in budget.experiment.instrument.channels}
    angles = np.array([[state[path].rotate for path in sorted(turned)] for state in states]).reshape(30, -1)
    correlation = np.corrcoef(angles.T) - np.eye(angles.shape[1])
    # 66 pairs of 30 draws: beyond 5 standard deviations with a chance of 4e-5
    assert np.abs(correlation).max() < 5.0 / np.sqrt(30)


@pytest.mark.second
def test_the_growth_of_a_focal_plane_is_a_true_change_and_no_error(backend, budget):
    """A line CCD that grows with its focal plane sees larger angles in its pixels, by as much as the spots move."""
    true, read = budget.warmed_focal_planes(0.55)
    size = 2.2e-6 * 0.55  # silicon carbide
    # 0.34 %: distortion of the field, over the line and at the area CCDs
    assert true == pytest.approx(-7.7256 * size, rel=5e-3)
    assert read == pytest.approx(true, rel=5e-3)
    # ten times the temperature and a hundredth of all else: what is left of 93 um is that difference, and noise
    small = {
        name: {"temperature": {"gradient": "1 mK/m"}} if name.endswith("thermal") else {"rotate": "0.68 arcsec"}
        for name in LINES[2:]
    }
    warm = {"coordinate_thermal": {"temperature": {"change": "5.5 K"}}}
    together = make(backend, causes=small | warm, photons_per_frame=4e6, all_together=20).together()
    assert together.spot[0] / ARCSEC == pytest.approx(0.18, rel=0.5)
    assert together.parameters["paper_single"]["d_f_m"][0] < 3e-6


def test_the_scatter_of_a_few_frames_is_that_of_many(budget, monkeypatch):
    """Two frames at +1 and -1 have the unbiased variance 2."""
    seen = SimpleNamespace(position=np.repeat([1.0, -1.0], 2 * len(budget.experiment.path.channels)))
    monkeypatch.setattr(budget, "spec", budget.spec.model_copy(update={"trials": 2}))
    monkeypatch.setattr(simulated_budget, "measure_spots", lambda *_: seen)
    np.testing.assert_allclose(budget._centroid_scatter(1.0) ** 2, 2.0)


@pytest.mark.second
def test_half_the_glass_path_halves_the_error(budget):
    before, after, ratio = budget.halved_glass(22.5e-3)
    assert after < 0.6 * before
    assert ratio == pytest.approx(0.5, abs=0.02)


def test_a_line_of_several_numbers_is_told_in_times_of_what_is_stated(backend, budget):
    both = make(backend, causes={"prism_0_rotation": {"shift": "3 um"}})
    assert both.input_of("prism_0_rotation") == (1.0, "times the prior")
    assert (
        both.input_of("prism_180_rotation") == budget.input_of("prism_180_rotation") == (pytest.approx(68.0), "arcsec")
    )
    with pytest.raises(ValueError, match=r"no cause .prism_90..*prism_180_rotation"):
        budget.input_of("prism_90")


@pytest.mark.parametrize(
    ("named", "message"),
    [
        ("none", "an error budget needs disturbances"),
        ("paper_01", "did you mean 'paper_001'"),
        ("./own.yaml", "centroid is the line of the centroid's own noise"),
    ],
)
def test_a_bad_budget_says_where(tmp_path, backend, named, message):
    text = "instrument: monitor_pair\nphotons_per_frame: 1\nangle_errors: {}\n\n"
    (tmp_path / "budget.yaml").write_text(f"{text}disturbances: {named}\n")
    own = "name: own\n\n\ncauses:\n  centroid: {bodies: base/*/M1, shift: 1 um, reason: none}\n"
    (tmp_path / "own.yaml").write_text(own)
    spec = load_error_budget(tmp_path / "budget.yaml")
    with pytest.raises(InputError) as error:
        ErrorBudget(spec, resolve_budget(spec), backend, 1)
    assert ".yaml:5: " in str(error.value)
    assert message in str(error.value)
