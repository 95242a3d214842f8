"""Frames of the area detector through the reference implementation of EMVA Standard 1288: it returns the data sheet.

The files are written as a run folder has them and read by that program's own reader. Our photon transfer is given the
same dark and flat frames.
"""

import logging
import math
from importlib.util import find_spec

import numpy as np
import pytest
import tifffile

from analysis.spots.photon_transfer import photon_transfer
from scenes.specs.load import load_detector
from twin.framework.data_files import FrameFacts, tiff
from twin.sensors.area_detector import EmvaDetector

# not imported here: each process that runs tests collects this file
pytestmark = [
    pytest.mark.oracle,
    pytest.mark.skipif(find_spec("emva1288") is None, reason="emva1288 not installed (extra `oracles`)"),
]

SIDE, EXPOSURE, STACK = 192, 0.01, 24
PIXELS = SIDE * SIDE


@pytest.fixture(scope="module")
def detector():
    return EmvaDetector.from_sheet(load_detector("monitor_ccd"), EXPOSURE)


@pytest.fixture(scope="module")
def campaign(detector, tmp_path_factory):
    """File names by kind, exposure and photons, and the stacks in the dark and at half of the full well."""
    folder = tmp_path_factory.mktemp("emva")
    pattern = detector.fixed_pattern((SIDE, SIDE), 3)
    full = detector.full_well_e / detector.quantum_efficiency
    images = {"temporal": {EXPOSURE: {}}, "spatial": {EXPOSURE: {}}}

    def record(kind, photons, frames, seed):
        light = np.full((SIDE, SIDE), photons)
        names = []
        for k, frame in enumerate(detector.expose(light, pattern, frames, EXPOSURE, seed)):
            path = folder / f"{kind}_{photons:.0f}_{k}.tif"
            path.write_bytes(tiff(frame[None], FrameFacts()))
            names.append(str(path))
        images[kind][EXPOSURE][float(photons)] = names

    # one level beyond saturation, where the variance falls: by that the standard finds it. That program looks from the
    # last level back to the first local maximum, and of several that are saturated one is larger by their noise
    for k, share in enumerate(np.linspace(0.0, 1.05, 22)):
        record("temporal", round(share * full), 2, 10 + k)
    record("spatial", 0.0, STACK, 100)
    record("spatial", round(0.5 * full), STACK, 101)
    return images


@pytest.fixture(scope="module")
def standard(campaign):
    with pytest.MonkeyPatch.context() as patch:
        # a name that NumPy 2 no longer has, and this program still calls
        patch.setattr(np, "asfarray", lambda a, dtype=np.float64: np.asarray(a, dtype), raising=False)
        yield of_the_standard(campaign)


def of_the_standard(campaign):
    """Its results, which it works out when they are asked for."""
    from emva1288.process.data import Data1288
    from emva1288.process.loader import LoadImageData
    from emva1288.process.results import Results1288

    quiet = {"loglevel": logging.ERROR}
    loaded = LoadImageData(campaign, **quiet)
    return Results1288(Data1288(loaded.data, **quiet).data, **quiet)


@pytest.mark.second
def test_the_reference_implementation_returns_the_data_sheet(detector, standard):
    # a variance from two frames of P pixels is known to sqrt(2 / P); five sigma of it, with some 15 levels in the fits
    # known better than one
    one = math.sqrt(2.0 / PIXELS)
    assert standard.K == pytest.approx(detector.system_gain_dn_per_e, rel=5 * one)
    assert standard.QE / 100.0 == pytest.approx(detector.quantum_efficiency, rel=5 * one)
    dark = math.hypot(detector.dark_noise_e, math.sqrt(detector.dark_current_e_per_s * EXPOSURE))
    assert standard.sigma_d == pytest.approx(dark, rel=5 * (0.5 * one + one))
    spread = 5 * math.sqrt(0.5 / PIXELS)
    assert standard.PRNU1288 / 100.0 == pytest.approx(detector.prnu, rel=spread * 2.0 + 5 * one)
    assert standard.DSNU1288 == pytest.approx(detector.dsnu_e, rel=spread * 2.0 + 5 * one)
    # the well is clipped at its capacity: saturation is the level of the largest variance, the last or the last but one
    # below it
    assert standard.u_e_sat == pytest.approx(detector.full_well_e, rel=2.0 * 1.05 / 21)


def test_our_photon_transfer_agrees_with_it_and_with_the_sheet(detector, campaign, standard):
    spatial = campaign["spatial"][EXPOSURE]
    dark, flat = (np.stack([tifffile.imread(name) for name in spatial[level]]) for level in sorted(spatial))
    found = photon_transfer(dark, flat)
    noise = math.hypot(detector.dark_noise_e, math.sqrt(detector.dark_current_e_per_s * EXPOSURE))
    for value, sigma, true in (
        (found.gain_dn_per_e, found.gain_sigma, detector.system_gain_dn_per_e),
        (found.dark_noise_e, found.dark_noise_sigma, noise),
        (found.prnu, found.prnu_sigma, detector.prnu),
        (found.dsnu_e, found.dsnu_sigma, detector.dsnu_e),
    ):
        # 4 sigma: once in 4000 for four numbers
        assert abs(value - true) < 4.0 * sigma
        assert sigma < 0.02 * true
    one = math.sqrt(2.0 / PIXELS)
    assert found.gain_dn_per_e == pytest.approx(standard.K, rel=6 * one)
    # the same stacks, and the same definitions but for the surface that ours takes off
    assert found.prnu == pytest.approx(standard.PRNU1288 / 100.0, rel=0.02)
    assert found.dsnu_e == pytest.approx(standard.DSNU1288, rel=0.02 + 5 * one)
