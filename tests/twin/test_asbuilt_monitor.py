"""Frames of a monitor judged with the drawing's model and with that of the instrument as built."""

from __future__ import annotations

import numpy as np
import pytest

from analysis.monitor.recovery import recover
from analysis.units import ARCSEC
from optics.geometry.tree import Motion, compose
from scenes.specs.asbuilt import resolve_asbuilt
from scenes.specs.job import JobSpec
from scenes.specs.resolved import resolve_job
from scenes.yaml.yaml_file import dump_yaml
from twin.asbuilt.asbuilt_run import run_asbuilt
from twin.asbuilt.built_instrument import CORRELATION, instrument_text, posterior_files
from twin.monitor.monitor_experiment import MonitorExperiment

PRIOR = {
    "name": "mounts",
    "causes": {
        "mirrors": {"bodies": "base/forward/M?", "shift": "4 um", "rotate": "0.7 arcsec", "reason": "a test"},
        "plane": {"bodies": "base/forward/focal_plane", "shift": "8 um", "rotate": "1 arcsec", "reason": "a test"},
    },
}
FIVE = [[x, 0.0] for x in (-1.0, -0.5, 0.0, 0.5, 1.0)]
FRAMES = 9


@pytest.mark.second
def test_the_bias_of_the_drawings_model_goes_away(backend, tmp_path, record_property) -> None:
    """An instrument is drawn, measured at delivery (its spots, wavefronts and line of sight) and moved in orbit.

    Frames recorded then are judged against spots as the drawing has them, and as the estimated instrument has them.
    The drawing's reading is off by what the parts were off by, arcseconds; with the instrument as built what is left is
    the noise of the spots: below a hundredth of that, and below 0.1 arcsec.
    """
    (tmp_path / "mounts.yaml").write_text(dump_yaml(PRIOR))
    data = {
        "instrument": "gf7_pair",
        "camera": "forward",
        "prior": "./mounts.yaml",
        "measurements": {
            "spots": {"monitor": {"sigma": 0.01}},
            "wavefronts": {"interferometer": {"fields": FIVE, "sigma": "3 nm"}},
            "sight": {"theodolite": {"sigma_alpha": "0.5 arcsec", "sigma_beta": "0.5 arcsec"}},
        },
        "merits": {"wavefront": {"kind": "wavefront", "at_most": 0.0714}},
        "draws": 20,
        "simulate": {"seed": 5},
    }
    file = tmp_path / "asbuilt.yaml"
    file.write_text(dump_yaml(data))
    run = run_asbuilt(resolve_asbuilt(file), backend)
    (tmp_path / "instrument.yaml").write_text(instrument_text(run))
    posterior, table = posterior_files(run)
    (tmp_path / "posterior.yaml").write_text(posterior)
    (tmp_path / f"{CORRELATION}.csv").write_text(table or "")

    design = run.bench.experiment
    job = JobSpec.model_validate({"instrument": str(tmp_path / "instrument.yaml")})
    built = MonitorExperiment(resolve_job(job), backend)
    # states drawn from the posterior's file have the posterior's covariance
    stated = built.stated
    assert stated is not None
    own = {one.name: k for k, one in enumerate(run.bench.parameters.components)}
    places = [own[one.name] for one in stated.components]
    scale = np.outer(stated.sigma, stated.sigma)
    np.testing.assert_allclose(
        stated.covariance / scale, run.found.covariance[np.ix_(places, places)] / scale, atol=1e-9
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
        found = recover(frames(experiment, {}, 2), after, experiment.calibration)
        read = found.parameters["forward"]["model"].vector[0][:2] / ARCSEC
        bias[name] = float(np.max(np.abs(read - wanted)))
        record_property(f"bias with the model of the {name}, arcsec", bias[name])
    assert bias["drawing"] > 1.0
    assert bias["as built"] < 0.1
    assert bias["as built"] < 0.05 * bias["drawing"]
