"""Do the sigmas of an estimated instrument hold, for cameras of another law than the estimator's?"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

from analysis.arrays import ARCSEC
from analysis.instrument_state.state_estimate import combinations
from analysis.monitor.recovery import recover_monitor
from optics.geometry.tree import Motion, compose
from optics.numerics.backend import Backend
from scenes.specs.asbuilt import AsBuiltSetup
from scenes.specs.job import JobSpec
from scenes.specs.resolved import resolve_job
from scenes.yaml.yaml_file import dump_yaml
from tests.twin.study_bench import TEXTS
from twin.asbuilt.asbuilt_bench import AsBuiltBench
from twin.asbuilt.asbuilt_run import run_asbuilt
from twin.asbuilt.built_instrument import CORRELATION, instrument_text, posterior_files
from twin.asbuilt.measured_kinds import View
from twin.monitor.monitor_experiment import MonitorExperiment

pytestmark = pytest.mark.second

NINE = [[x, y] for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)]
DRAWS = 200


def coverage_bench(backend: Backend, folder: Path) -> AsBuiltBench:
    """gf7 after its assembly; wavefronts with 5 nm noise, best focus and the line of sight."""
    wavefront = {"kind": "wavefront", "at_most": 0.07, "fields": NINE}
    data = TEXTS["assembled"] | {"merits": {"wavefront": wavefront, **TEXTS["assembled"]["merits"]}}
    path = folder / "asbuilt.yaml"
    path.write_text(dump_yaml(data))
    return AsBuiltBench(AsBuiltSetup.read(path), backend)


def judged(bench: AsBuiltBench, rng: np.random.Generator, count: int, unknown_figure: float = 0.0) -> tuple:
    """Draw cameras of a uniform law, measure and estimate each, and see where the truth lies among the draws.

    Args:
        bench: the instrument.
        rng: source of all that is drawn.
        count: number of cameras.
        unknown_figure: rms of figure errors Z12 to Z20 of each mirror, metres, of which the estimator knows nothing.

    Returns:
        Whether the truth lies within 68 and 95 % of the draws, (count, N, 2), and whether the measurements agree.
    """
    bodies = {body.path: body for body in bench.experiment.instrument.assembly.tree.bodies}
    inside, agree = [], []
    for _ in range(count):
        true = bench.draw(rng, "uniform")
        figures = {
            f"base/gf7/M{k}": Motion(figure=dict(enumerate(unknown_figure / 3.0 * rng.standard_normal(9), start=12)))
            for k in (1, 2, 3)
        }
        (state,) = bench.parameters.states(true[None], None)
        state = compose(state, figures, bodies) if unknown_figure else state
        view = View(true[None], [state], None)
        found = bench.estimate([kind.drawn(kind.predict(view)[0], rng) for kind in bench.kinds])
        agree.append(found.whole.passes() and not found.excluded)
        draws = found.draw(rng, DRAWS)
        parts, exact = bench.merit_parts(draws, None), bench.merits.parts_of([state])[0]
        pairs = []
        for merit in bench.merits.merits:
            if merit.spec.kind == "wavefront":
                pairs += list(zip(exact[merit.parts], parts[:, merit.parts].T, strict=True))
            else:
                pairs.append((merit.values(exact), merit.values(parts)))
        scale, mean = found.prior.sigma, found.prior.mean
        pairs += [(one.of(true, scale, mean), one.of(draws, scale, mean)) for one in combinations(found, 8)]
        ends = [np.quantile(possible, [0.16, 0.84, 0.025, 0.975]) for _, possible in pairs]
        inside.append([(a <= t <= b, c <= t <= d) for (t, _), (a, b, c, d) in zip(pairs, ends, strict=True)])
    return np.array(inside), np.array(agree)


def test_sigmas_hold_for_some_cameras(backend, tmp_path) -> None:
    """Wavefronts at nine fields, line of sight, principal distance and the eight best known combinations of twelve
    cameras: each is covered as often as a binomial distribution lets it be, one of all fails once in a thousand times.
    """
    inside, agree = judged(coverage_bench(backend, tmp_path), np.random.default_rng(3), 12)
    looks = 2 * inside.shape[1]
    for k, share in enumerate((0.68, 0.95)):
        hits = inside[:, :, k].sum(axis=0)
        # quantiles of 200 draws spread by some 3 and 1 %, which widens the shares' own spread by a tenth
        assert np.all(hits >= binom.ppf(5e-4 / looks, 12, share) - 1.5), (share, hits)
        assert np.all(hits <= binom.isf(5e-4 / looks, 12, share) + 1.5), (share, hits)
    # over all of them together, of which some ten are independent
    near, far = inside.mean(axis=(0, 1))
    assert 0.68 - 4.5 * np.sqrt(0.68 * 0.32 / 120) < near < 0.68 + 4.5 * np.sqrt(0.68 * 0.32 / 120)
    assert far > 0.95 - 4.5 * np.sqrt(0.95 * 0.05 / 120)
    assert agree.sum() >= binom.ppf(1e-4, 12, 0.99)


def test_figures_that_the_prior_does_not_have_are_detected(backend, tmp_path) -> None:
    """40 nm of figure in terms beyond the prior's: the chi-square of every camera says so."""
    _, agree = judged(coverage_bench(backend, tmp_path), np.random.default_rng(2), 3, 40e-9)
    assert not agree.any()


FRAMES = 9


def test_the_bias_of_the_drawings_model_goes_away(backend, tmp_path, record_property) -> None:
    """An instrument is drawn, measured at delivery (its spots, wavefronts and line of sight) and moved in orbit.

    Frames recorded then are judged against spots as the drawing has them, and as the estimated instrument has them.
    The drawing's reading is off by what the parts were off by, arcseconds; with the instrument as built what is left is
    the noise of the spots: below a hundredth of that, and below 0.1 arcsec.
    """
    (tmp_path / "mounts.yaml").write_text(dump_yaml(TEXTS["mounts"]))
    file = tmp_path / "asbuilt.yaml"
    file.write_text(dump_yaml(TEXTS["delivered"]))
    run = run_asbuilt(AsBuiltSetup.read(file), backend)
    (tmp_path / "instrument.yaml").write_text(instrument_text(run))
    posterior, table = posterior_files(run)
    (tmp_path / "posterior.yaml").write_text(posterior)
    (tmp_path / f"{CORRELATION}.csv").write_text(table or "")

    design = run.bench.experiment
    job = JobSpec.model_validate({"instrument": str(tmp_path / "instrument.yaml")})
    built = MonitorExperiment(resolve_job(job), backend)
    # states drawn from the posterior's file have the posterior's covariance
    stated = built.prior
    assert stated is not None
    own = {one.name: k for k, one in enumerate(run.bench.parameters.components)}
    places = [own[one.name] for one in stated.components]
    scale = np.outer(stated.sigma, stated.sigma)
    np.testing.assert_allclose(
        stated.covariance / scale, run.estimate.covariance[np.ix_(places, places)] / scale, atol=1e-9
    )

    tree = {body.path: body for body in design.instrument.assembly.tree.bodies}
    assert run.true is not None
    true = run.bench.parameters.states(run.true[None], None)[0]
    later = {"base/forward": Motion(rotate=(0.5 * ARCSEC, 0.8 * ARCSEC, 4.0 * ARCSEC))}
    now = compose(true, later, tree)
    detector, channels = design.detector, len(design.path.channels)
    pattern = detector.fixed_pattern((channels, *design.path.shape), 1)

    def frames(experiment, state, seed):
        photons = experiment.path.expected_photons([state])[0]
        return detector.expose(photons, pattern, FRAMES, experiment.exposure, seed)

    after = frames(design, now, 3)[None]
    moved = design.sight.truth([true, now]).vector("forward")
    wanted = (moved[1] - moved[0])[:2] / ARCSEC
    bias = {}
    for name, experiment in (("drawing", design), ("as built", built)):
        found = recover_monitor(frames(experiment, {}, 2), after, experiment.calibration)
        read = found.parameters["forward"]["model"].vector[0][:2] / ARCSEC
        bias[name] = float(np.max(np.abs(read - wanted)))
        record_property(f"bias with the model of the {name}, arcsec", bias[name])
    assert bias["drawing"] > 1.0
    assert bias["as built"] < 0.1
    assert bias["as built"] < 0.05 * bias["drawing"]
