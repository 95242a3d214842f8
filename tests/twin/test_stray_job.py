"""Ghosts and stray light in the render job: what is added to the images, and what the prisms' tilt is good for."""

import re

import numpy as np
import pytest

from scenes.models.instrument_builder import build_instrument
from scenes.specs.baffle import BaffleSpec
from scenes.specs.job import JobSpec
from scenes.specs.load import LIBRARY
from scenes.specs.resolved import resolve_job
from scenes.yaml.errors import InputError
from tests.twin.commands import invoke
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.path_tracing.stray_light import (
    REACH,
    NominalPathLost,
    diffraction_spots,
    ghost_warnings,
    stray_light,
    trace_stray,
)
from twin.render import app

PATHS = 20_000


@pytest.fixture(scope="module")
def square_prisms(backend):
    """gf7_pair with prisms whose faces stand square to the beam."""
    resolved = resolve_job(JobSpec(instrument="gf7_pair"))
    monitor = resolved.instrument.monitor
    flat = {p: getattr(monitor, p).model_copy(update={"tilt": (0.0, 0.0)}) for p in ("prism_180", "prism_0")}
    instrument = resolved.instrument.model_copy(update={"monitor": monitor.model_copy(update=flat)})
    return MonitorExperiment(resolved.model_copy(update={"instrument": instrument}), backend)


@pytest.mark.second
def test_the_tilt_keeps_ghosts_off_the_spot(experiment, square_prisms):
    """Square faces throw their reflections onto the spot; 3 arcmin send them past the CCD, and the spot stays."""
    tilted = experiment("gf7_pair")
    shares, told = [], []
    for setup in (tilted, square_prisms):
        light = stray_light(setup, {}, PATHS, 1)
        shares.append(light.share(setup.nominal_photons))
        told.append(ghost_warnings(setup, light))
    # eight passes with a residual reflection each, seen with the light that they let pass: some percent
    assert np.all(shares[1] > 0.02)
    assert np.all(shares[0] < 2e-3 * shares[1])
    assert told[0] == ()
    assert len(told[1]) == 4
    for channel, text in zip(square_prisms.instrument.channels, told[1], strict=True):
        share, strongest = (float(n) for n in re.findall(r"([\d.]+) %", text))
        assert text.startswith(f"ghosts on the area CCD of {channel.key} have")
        assert f"comes from {channel.key} by prism_" in text
        # what lies on the CCD, in the paths that were drawn; scattered light counts in the share, too
        assert share == pytest.approx(100.0 * shares[1][square_prisms.instrument.channels.index(channel)], rel=0.1)
        assert 0.0 < strongest <= share
    for setup in (tilted, square_prisms):
        place = np.einsum("n,bnk->bk", setup.path.nodes.share, setup.path.rays([{}]).position[..., :2])
        assert np.abs(place).max() < 0.05 * setup.path.pitch


@pytest.mark.second
def test_the_spread_keeps_the_light(experiment):
    spots = diffraction_spots(experiment("gf7_pair"))
    assert spots.shape[1:] == (2 * REACH + 1, 2 * REACH + 1)
    np.testing.assert_allclose(spots.sum(axis=(1, 2)), 1.0, rtol=1e-12)
    assert np.unravel_index(np.argmax(spots[0]), spots[0].shape) == (REACH, REACH)


COURSE = "course: {times: [0 s, 60 s], temperature: {base: {change: [0 K, 1 K]}}}"
PLACE = "position: [0 m, 0 m, 0 m]"


def test_bad_stray_light_and_baffles_are_refused(tmp_path):
    job = tmp_path / "job.yaml"
    text = (LIBRARY / "instruments" / "gf7_pair.yaml").read_text().partition("baffles:")[0]
    for render, baffle, says in (
        ("render: {stray: {paths: 10}}", "", "stray.paths"),
        ("render: {stray: maybe}", "", "render.stray"),
        (f"render: {{stray: true}}\n{COURSE}", "", "course"),
        ("", f"{{shape: tube, body: base/forward, {PLACE}, diameter: 1 m}}", "baffles.b.length"),
        ("", f"{{shape: plate, body: base/forwrd, {PLACE}, width: 1 m, height: 1 m}}", "base/forward"),
        ("", f"{{shape: ring, body: base, {PLACE}, hole: 2 m, diameter: 1 m}}", "hole"),
    ):
        own = f"{text}baffles:\n  b: {baffle}\n".replace("name: gf7_pair", "name: own")
        (tmp_path / "own.yaml").write_text(own)
        job.write_text(f"instrument: {'own.yaml' if baffle else 'gf7_pair'}\n{render}\n")
        done = invoke(app, job, "--out", tmp_path / "run")
        assert done.exit_code == 2, says
        assert says in done.stderr
        assert not (tmp_path / "run").exists()


@pytest.mark.second
def test_a_baffle_in_the_way_stops_the_light(experiment, backend):
    """A plate before the central prism's facet of one channel: its nominal light is gone, the others' is not."""
    resolved = resolve_job(JobSpec(instrument="gf7_pair"))
    channel = experiment("gf7_pair").instrument.channels[0]
    plate = {"shape": "plate", "body": channel.face_body, "position": ["0 mm", "0 mm", "50 mm"]}
    lid = BaffleSpec.model_validate({**plate, "width": "80 mm", "height": "80 mm"})
    spec = resolved.instrument.model_copy(update={"baffles": {"lid": lid}})
    with pytest.raises(InputError, match=r"baffles\.lid: a plate of lid stands in the beam forward/left and takes 145"):
        build_instrument(spec, resolved.cameras, backend)
    free, lids = experiment("gf7_pair").instrument, lid.plates("lid")
    with pytest.raises(NominalPathLost, match="forward/left"):
        trace_stray(free, backend, {}, PATHS, 1, [channel], baffles=lids)
    run = trace_stray(free, backend, {}, PATHS, 1, free.channels[1:2], baffles=lids).runs["forward/right"]
    assert run.nominal("forward/right/area_ccd").count > 1000
