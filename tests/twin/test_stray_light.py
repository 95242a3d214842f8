"""Power, ghosts and stray light of the reference instruments.

Statistical tests use fixed seeds; each states its false-alarm rate.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.stats import chi2, norm, t

from optics.geometry.tree import Motion
from optics.materials.fresnel_scatter import MIRROR, Finish
from scenes.models.instrument_builder import build_instrument
from scenes.models.scenery import Finishes, build_scenery
from scenes.specs.baffle import BaffleSpec
from scenes.specs.job import JobSpec
from scenes.specs.load import LIBRARY
from scenes.specs.resolved import resolve_job
from scenes.yaml.errors import InputError
from tests.twin.commands import invoke
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.path_tracing.path_result import GHOST, NOMINAL, STRAY
from twin.path_tracing.stray_light import (
    SPREAD_PX,
    NominalPathLost,
    StrayResult,
    diffraction_spots,
    ghost_warnings,
    monitor_families,
    pinhole,
    stray_light,
    trace_stray,
)
from twin.path_tracing.tracer import FAINT, PathTracer, Sampling
from twin.render import app

CCD = "forward/left/area_ccd"


@pytest.mark.second
@pytest.mark.parametrize(
    "sampling", [FAINT, Sampling(roulette=0.5), Sampling(floor=0.2)], ids=["faint", "roulette", "floor"]
)
def test_roulette_and_floors_are_unbiased(backend, gf7_pair, sampling: Sampling) -> None:
    """Mean error of the balance over 24 seeds within its standard error by Student's t; false alarm 1e-3."""
    scenery = build_scenery(gf7_pair, {}, Finishes(mirror=Finish(reflectance=0.9, scatter=MIRROR.scatter)))
    families = monitor_families(scenery, gf7_pair)
    source = pinhole(gf7_pair, backend, {}, gf7_pair.channels[0])
    tracer = PathTracer(backend, scenery, families, sampling)
    runs = [tracer.run(source, 20_000, seed) for seed in range(24)]
    errors = np.array([run.balance.error for run in runs])
    assert errors.std() > 1e-6  # it is switched on
    assert abs(errors.mean()) < t.ppf(1.0 - 5e-4, 23) * errors.std(ddof=1) / np.sqrt(24)
    energy = np.array([run.nominal(CCD).energy for run in runs])
    exact = PathTracer(backend, scenery, families).run(source, 400_000, 99).nominal(CCD)
    error = np.hypot(energy.std(ddof=1) / np.sqrt(24), exact.error)
    assert abs(energy.mean() - exact.energy) < norm.ppf(1.0 - 5e-4) * error


@pytest.mark.second
def test_families_scatter_as_their_sigma_says(backend, gf7_pair) -> None:
    """Ghosts' shares of the nominal light over 16 seeds, 15 to 40 paths in each: chi-square about their mean, two-sided
    limits of 1e-6; the sigma of a run goes with its own paths, which makes it a little uneven.
    """
    scenery, channel = build_scenery(gf7_pair, {}), gf7_pair.channels[0]
    tracer = PathTracer(backend, scenery, monitor_families(scenery, gf7_pair), FAINT)
    source = pinhole(gf7_pair, backend, {}, channel)
    found: dict[str, list[tuple[float, float]]] = {}
    for seed in range(16):
        run = tracer.run(source, 20_000, seed)
        for one in StrayResult({}, {channel.key: run}, {}).relative(channel.key):
            if one.family.kind == "ghost":
                found.setdefault(f"{one.family.detector} {one.family.text}", []).append((one.share, one.sigma))
    total, degrees = 0.0, 0
    for every in found.values():
        if len(every) == 16:
            share, sigma = np.array(every).T
            total += float(np.sum((share - share.mean()) ** 2) / np.mean(sigma**2))
            degrees += 15
    assert degrees >= 60
    assert chi2.ppf(1e-6, degrees) < total < chi2.isf(1e-6, degrees)


def test_stray_light_in_photons(backend, gf7_pair) -> None:
    stray = trace_stray(gf7_pair, backend, {}, 100_000, 1, channels=gf7_pair.channels[:1])
    run = stray.runs["forward/left"]
    photons = gf7_pair.spec.monitor.reticle.photons_per_frame
    scale = stray.photons_per_power["forward/left"]
    assert scale * run.nominal(CCD).energy == pytest.approx(photons, rel=1e-12)
    assert scale * run.images[CCD][NOMINAL].sum() == pytest.approx(photons, rel=1e-9)
    ghosts = sum(one.share for one in stray.relative("forward/left") if one.family.detector == CCD)
    assert stray.photons[CCD].sum() == pytest.approx(ghosts * photons, rel=1e-9)
    assert set(stray.photons) == {f"{c.key}/area_ccd" for c in gf7_pair.channels}
    image = run.images[CCD]
    np.testing.assert_allclose(stray.photons[CCD], scale * (image[GHOST] + image[STRAY]), rtol=1e-9)


def test_a_lost_beam_is_said_so(backend, gf7_pair) -> None:
    state = {"base/forward/M1": Motion(rotate=(0.2, 0.0, 0.0), pivot="centre")}
    with pytest.raises(NominalPathLost, match="forward/left returned"):
        trace_stray(gf7_pair, backend, state, 1000, 0, channels=gf7_pair.channels[:1])


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
    assert spots.shape[1:] == (2 * SPREAD_PX + 1, 2 * SPREAD_PX + 1)
    np.testing.assert_allclose(spots.sum(axis=(1, 2)), 1.0, rtol=1e-12)
    assert np.unravel_index(np.argmax(spots[0]), spots[0].shape) == (SPREAD_PX, SPREAD_PX)


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
    with pytest.raises(
        InputError, match=r"baffles\.lid: a plate of lid blocks 145 of 145 rays of the beam forward/left"
    ):
        build_instrument(spec, resolved.cameras, backend)
    free, lids = experiment("gf7_pair").instrument, lid.plates("lid")
    with pytest.raises(NominalPathLost, match="forward/left"):
        trace_stray(free, backend, {}, PATHS, 1, [channel], baffles=lids)
    run = trace_stray(free, backend, {}, PATHS, 1, free.channels[1:2], baffles=lids).runs["forward/right"]
    assert run.nominal("forward/right/area_ccd").count > 1000
