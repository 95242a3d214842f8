"""Power, ghosts and stray light of the reference instruments.

Statistical tests use fixed seeds; each states its false-alarm rate.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, norm, t

from optics.geometry.tree import Motion
from optics.materials.finish import MIRROR, Finish
from optics.materials.scatter import total_scatter
from scenes.models.scenery import build_scenery
from scenes.models.scenery_parts import Finishes
from twin.path_tracing.families import Event
from twin.path_tracing.path_result import Family
from twin.path_tracing.sinks import GHOST, NOMINAL, STRAY
from twin.path_tracing.stray_light import NominalPathLost, StrayResult, monitor_families, pinhole, trace_stray
from twin.path_tracing.tracer import FAINT, PathTracer, Sampling

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


def share_of(family: Family, finishes: Finishes) -> float:
    """What reflections and transmissions leave of a family that no edge cuts."""
    assert finishes.mirror.scatter is not None
    mirror = finishes.mirror.reflectance * (1.0 - total_scatter(finishes.mirror.scatter))
    share = 1.0
    for touch in family.touches:
        face = touch.part.rpartition("/")[2]
        if touch.event is Event.TRANSMIT:
            share *= finishes.coated.transmission
        elif face in ("window", "entry", "exit"):
            share *= finishes.coated.reflectance
        elif not face.startswith(("roof", "mirror_")):  # these reflect totally
            share *= mirror
    return share


@pytest.mark.second
def test_ghosts_name_what_the_light_met_and_have_its_losses(backend, gf7_pair) -> None:
    """The prisms are tilted: on the CCD are left pairs of residual reflections, each R^2 of the nominal spot."""
    run = trace_stray(gf7_pair, backend, {}, 400_000, 1, channels=gf7_pair.channels[:1]).runs["forward/left"]
    nominal = run.nominal(CCD)
    sequence = gf7_pair.assembly.sequences["forward/left/monitor"][:-1]
    assert len(nominal.touches) == len(sequence) == 25
    assert [touch.part.split("/")[-1] for touch in nominal.touches[:4]] == ["M3", "M2", "M1", "window"]
    strong = [f for f in run.of(CCD, "ghost") if f.count > 100]
    assert len(strong) >= 3
    for family in strong:
        assert len(family.touches) > 25
        assert not any(touch.outside for touch in family.touches)
        expected = share_of(family, Finishes()) / share_of(nominal, Finishes())
        assert expected < 1e-5
        # false alarm 1e-4
        assert abs(family.energy / nominal.energy - expected) < 3.89 * family.error / nominal.energy
    for family in run.families:
        assert (family.kind == "stray") == any(touch.event >= Event.DIFFUSE for touch in family.touches)


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
    with pytest.raises(NominalPathLost, match="forward/left came back"):
        trace_stray(gf7_pair, backend, state, 1000, 0, channels=gf7_pair.channels[:1])
