"""The crosstalk table is first order by derivatives of the trace; here it must be what rendered images say."""

import numpy as np
import pytest

from analysis.monitor.monitoring import PER_SI
from analysis.monitor.recovery import measure_spots
from tests.tiers import quick
from twin.monitor.crosstalk import crosstalk
from twin.monitor.truth import trace_truth

PIXEL_NOISE = (1e-3) ** 2 * np.eye(8)  # px^2, weighs all coordinates alike


@pytest.fixture(scope="module", params=quick(1, ["gf7_pair", "monitor_pair"]))
def table(request, experiment):
    setup = experiment(request.param)
    return setup, crosstalk(setup, PIXEL_NOISE)


def row(cameras, camera, label):
    found = cameras[camera]
    return found, [m.label for m in found.motions].index(label)


@pytest.mark.second
def test_table_is_what_the_images_say(table, backend):
    """Every motion rendered at a size that moves a spot by some 5 px: spots and truth within 1% of the table."""
    setup, cameras = table
    calibration = setup.calibration
    first = measure_spots(setup.expected_frames(setup.nominal_photons), 9, calibration).position
    for k, (name, found) in enumerate(cameras.items()):
        strongest = np.max(np.abs(found.spot_shift), axis=0)
        units = np.clip(5.0 / np.maximum(strongest, 1e-9), 0.0, 50.0)
        states = [m.state(n * m.unit_size) for m, n in zip(found.motions, units, strict=True)]
        photons = setup.path.expected_photons(states)
        images = setup.expected_frames(photons).reshape(-1, *photons.shape[2:])
        position = measure_spots(images, 9, calibration, threads=2).position.reshape(len(states), -1, 2)
        shift = (position - first)[:, 2 * k : 2 * k + 2].reshape(-1, 4).T / units
        change = trace_truth(setup.instrument, backend, states).cameras[name]
        true = np.stack([change.d_alpha, change.d_beta, change.d_gamma, change.d_f]) * PER_SI[:, None] / units
        assert len(states) == 49
        # second order of a motion: 1% of its own effect; 2e-5 px: interpolation of the template, over the units. Coma
        # in the monitor's aperture changes the spot's shape, and a fit of the calibrated shape is not the mean ray: 3%
        share = np.array([0.03 if m.kind == "figure" else 0.01 for m in found.motions])
        assert np.all(np.abs(shift - found.spot_shift) < share * strongest + 2e-5 / units)
        camera = setup.calibration.cameras[name]
        per_pixel = np.abs(camera.parameter_jacobian @ np.linalg.inv(camera.spot_jacobian)).sum(axis=1) * PER_SI
        floor = 0.01 * per_pixel[:, None] * strongest + 2e-8  # um or arcsec: rounding of the differenced truth
        assert np.all(np.abs(true - found.true) < 0.01 * np.abs(found.true) + floor)


@pytest.mark.second
def test_factors_of_the_printed_formulas(table):
    setup, cameras = table
    for name, found in cameras.items():
        factors = {(f.estimator, f.parameter): f for f in found.factors}
        assert len(factors) == 8
        for estimator in ("paper_single", "paper_joint"):
            assert factors[estimator, "d_gamma_arcsec"].by_model == pytest.approx(2.0, abs=2e-3)
            assert factors[estimator, "d_alpha_arcsec"].by_model == pytest.approx(1.0, abs=2e-3)
        assert factors["paper_single", "d_f_um"].by_model == pytest.approx(1.0, abs=4e-3)
        assert factors["paper_joint", "d_f_um"].by_model == pytest.approx(0.5, abs=2e-3)
        # against the truth the anamorphism of a field-biased camera comes on top
        geometry = setup.geometry(name)
        stretch = geometry.principal_distance_across_m / geometry.principal_distance_m
        assert stretch > 1.02
        assert factors["paper_single", "d_gamma_arcsec"].by_truth == pytest.approx(2.0 * stretch, rel=5e-3)


@pytest.mark.second
def test_reference_rotation_cannot_be_told_from_the_cameras(table):
    """A turn of the central prism reads as an opposite turn of the camera; the report has to name it."""
    _, cameras = table
    for name in cameras:
        found, k = row(cameras, name, "central prism about Y")
        assert np.all(np.abs(found.true[:, k]) < 1e-6)
        assert found.readings["model"][0, k] == pytest.approx(-1.0, rel=0.02)
        assert found.observability.rank == 4
        statements = found.principal_distance_statements()
        assert any("whole camera scaled" in s and "the spots see it." in s for s in statements)
        assert any("(piston)" in s and "the spots see it wrongly" in s for s in statements)
        assert any(
            s.startswith("central prism about Y") and "not separable" in s for s in found.observability.statements
        )
