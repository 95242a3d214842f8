"""Images of stars as measurements of an instrument: against other models, drawn cameras, files and their refusals."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from scipy.stats import binom

from analysis.instrument_state.state_estimate import MeasuredGroup, StatePrior, estimate_state
from optics.geometry.tree import WAVEFRONT
from optics.numerics.quadrature import disk
from optics.waves.diffraction import Grid, PupilField, airy, image
from optics.waves.star_image import CoarsePupilError, StarImage, StarPupil
from scenes.specs.asbuilt import AsBuiltSetup
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml
from tests.twin.star_bench import PRIOR, TWO, independent_share, judged, measured, star_bench
from twin.asbuilt.asbuilt_bench import AsBuiltBench
from twin.asbuilt.asbuilt_run import _linearity_warnings, _mode_warnings, probabilities, run_asbuilt
from twin.asbuilt.built_instrument import built_motions, instrument_text, unknown
from twin.asbuilt.star_readings import StarFit, StarReading
from twin.validation.real.stars import FILE, RIGID, star_file, star_images

WAVE, APERTURE = 650e-9, 1.0 / 20.0


def ring(inner: float) -> tuple[StarPupil, np.ndarray, np.ndarray]:
    """A round pupil with a hole, its nodes, and the optical path of a defocus of 0.8 mm with coma and astigmatism."""
    nodes = disk(40, 160, inner=inner)
    u, v = APERTURE * nodes.x, APERTURE * nodes.y
    weight = nodes.weight * APERTURE**2
    path = 0.8e-3 * (np.sqrt(1.0 - u**2 - v**2) - 1.0)
    path += 8e-8 * (3.0 * nodes.x**2 - 2.0) * nodes.x + 1e-7 * nodes.x * nodes.y
    return StarPupil(u, v, weight / np.sqrt(np.sum(weight)), WAVE), nodes.weight, path


def test_irradiance_is_the_sum_of_all_waves():
    """Against the matrix Fourier transform from the quadrature's nodes, whose pupil is on no grid: 1e-4 of the peak."""
    pupil, weight, path = ring(0.3)
    star = StarImage(pupil, 8, (24, 24), 7e-6)
    terms = pupil.terms(pupil.u, pupil.v, weight, 8) @ path
    x = star.samples
    grid = Grid(x[0], x[1] - x[0], len(x))
    field = PupilField(pupil.u[None], pupil.v[None], path[None], pupil.weight[None], WAVE)
    exact = image(field, grid, grid)[0]
    assert np.max(np.abs(star.irradiance(terms) - exact)) < 1e-4 * np.max(exact)


def test_a_perfect_star_is_an_airy_disk():
    pupil, _, _ = ring(0.3)
    star = StarImage(pupil, 4, (16, 16), 7e-6)
    found = star.irradiance(np.zeros(15))
    wanted = airy(np.hypot(star.samples, star.samples[:, None]), WAVE, 0.5 / APERTURE, 0.3)
    np.testing.assert_allclose(found / np.max(found), wanted, atol=1e-4)


def test_derivatives_are_those_of_the_pixels():
    pupil, weight, path = ring(0.0)
    star = StarImage(pupil, 8, (20, 22), 7e-6, blur=5e-6)
    terms = pupil.terms(pupil.u, pupil.v, weight, 8) @ path
    direction = np.random.default_rng(0).normal(size=len(terms)) * 1e-9
    light, slope = star.irradiance_slopes(terms, direction[None])
    ahead, behind = (star.irradiance(terms + sign * 1e-3 * direction) for sign in (1.0, -1.0))
    np.testing.assert_allclose(slope[0], (ahead - behind) / 2e-3, atol=1e-6 * np.max(np.abs(slope)))
    at = np.array([0.3, -0.6, 4e-6])
    parts = star.pixel_slopes(light, at[:2], at[2])
    assert parts.shape == (4, 20, 22)
    for k, step in enumerate((1e-4, 1e-4, 1e-9)):
        moved = [at + sign * step * np.eye(3)[k] for sign in (1.0, -1.0)]
        first, second = (star.pixels(light, m[:2], m[2]) for m in moved)
        np.testing.assert_allclose(
            parts[1 + k], (first - second) / (2.0 * step), atol=1e-5 * np.max(np.abs(parts[1 + k]))
        )


def test_a_cut_out_too_large_for_the_pupil_is_refused():
    pupil, _, _ = ring(0.0)
    with pytest.raises(CoarsePupilError, match="use cut-outs of at most"):
        StarImage(pupil, 4, (600, 600), 7e-6).irradiance(np.zeros(15))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("blur", "border"), [(3e-6, False), (None, False), (None, True)])
def test_fit_finds_position_flux_background_and_seeing(blur, border):
    """Of an image without noise, to 1e-4 px; a saturated pixel is not used, nor a border without values."""
    pupil, weight, path = ring(0.3)
    star = StarImage(pupil, 8, (24, 24), 7e-6, blur=8e-6)
    light = star.irradiance(pupil.terms(pupil.u, pupil.v, weight, 8) @ path)
    counts = 2e5 * star.pixels(light, np.array([0.7, -1.2]), 3e-6) + 40.0
    variance = np.full(counts.shape, 100.0)
    variance[12, 12], counts[12, 12] = np.inf, 0.0
    if border:
        variance[[0, -1]] = variance[:, [0, -1]] = np.inf
    first = StarFit(np.zeros(2), 5e-6, 1.0, 0.0, counts, counts)
    found = StarReading(star, blur, first, counts, variance).fit(light)
    np.testing.assert_allclose(found.position, [0.7, -1.2], atol=1e-4)
    assert found.flux == pytest.approx(2e5, rel=1e-5)
    assert found.background == pytest.approx(40.0, abs=1e-2)
    assert found.blur == pytest.approx(3e-6, rel=1e-3)


def test_variances_are_a_diagonal_covariance():
    """The estimate and its tests are those of the matrix, without a matrix of all pixels."""
    rng = np.random.default_rng(1)
    slope, sigma = rng.normal(size=(60, 3)), rng.uniform(0.5, 2.0, 60)
    prior = StatePrior.of("abc", np.diag([1.0, 4.0, 0.5]))
    values = slope @ rng.normal(size=3) + sigma * rng.standard_normal(60)
    names = ("x",) * 60
    groups = [
        MeasuredGroup("g", "images", names, values, covariance, np.zeros((60, 0)), np.zeros(0), names)
        for covariance in (np.diag(sigma**2), sigma**2)
    ]
    dense, sparse = (estimate_state(prior, [g], lambda x: x @ slope.T, lambda x: slope) for g in groups)
    np.testing.assert_allclose(sparse.mean, dense.mean, rtol=1e-12)
    np.testing.assert_allclose(sparse.covariance, dense.covariance, rtol=1e-10)
    assert sparse.measurements[0].chi_square == pytest.approx(dense.measurements[0].chi_square, rel=1e-9)
    assert sparse.measurements[0].degrees == dense.measurements[0].degrees == 60
    fitted = estimate_state(prior, [replace(groups[1], fitted=4)], lambda x: x @ slope.T, lambda x: slope)
    assert fitted.whole.degrees == 56


@pytest.mark.second
@pytest.mark.parametrize(("instrument", "spiral"), [("gf7", 0), ("ritchey_chretien", 0), ("ritchey_chretien", 60_000)])
def test_images_are_those_of_exact_rays(backend, tmp_path, instrument, spiral):
    """Of a drawn camera, by rays of its own directions: 8e-4 of the peak, some of it by the samples in a pixel there.

    With the directions of the nominal camera it would be 2e-3, up to half a sigma of a bright star's focus.

    On a spiral, edges stop rays one by one: 4e-3 with 60 000 of them. A mirrored image would be 0.3 away.
    """
    bench = star_bench(backend, tmp_path, ("-0.6 mm",), instrument)
    true = bench.draw(np.random.default_rng(0), "uniform")
    (state,), kind, place = bench.parameters.states(true[None], None), bench.kinds[0], np.array([0.2, -0.3])
    exact = independent_share(kind, 1, state, place, spiral)
    star, terms = kind.stars[1], kind.traced(bench.view(true[None], None))[0].reshape(2, -1)[1]
    found = star.image.pixels(star.image.irradiance(terms), place)
    assert np.max(np.abs(found - exact)) < (4e-3 if spiral else 8e-4) * np.max(exact)


@pytest.mark.second
def test_derivatives_of_an_instrument_are_those_of_its_images(backend, tmp_path):
    """Of images with what belongs to a star alone fitted again, to Kaufman's approximation: 2 %."""
    bench = star_bench(backend, tmp_path, ("-0.6 mm",), seeing="free")
    true = 0.3 * bench.draw(np.random.default_rng(1), "normal")
    kinds = [kind.about(v) for kind, v in zip(bench.kinds, bench.measured(true, np.random.default_rng(2)), strict=True)]
    slope, sigma = bench.slope(true, kinds, [None]), bench.parameters.prior.sigma
    for k in (0, 5, len(true) - 4):
        step = 0.02 * sigma[k] * np.eye(len(true))[k]
        ahead, behind = bench._predicted(np.stack([true + step, true - step]), kinds, [None])
        wanted = (ahead - behind) / (0.04 * sigma[k])
        np.testing.assert_allclose(slope[:, k], wanted, atol=0.02 * np.max(np.abs(wanted)))


@pytest.mark.second
@pytest.mark.parametrize(("instrument", "defocus"), [("gf7", "0.6 mm"), ("ritchey_chretien", "0.8 mm")])
def test_sigmas_hold_for_some_cameras(backend, tmp_path, instrument, defocus):
    """Three cameras on both sides of focus, by the independent path: wavefronts at nine fields and six combinations.

    All covered shares together, of which some six a camera are independent, lie below the bound once in 1e4 times.
    """
    inside, p_values, modes = judged(star_bench(backend, tmp_path, (f"-{defocus}", defocus), instrument),
                                     np.random.default_rng(7), 3)  # fmt: skip
    for k, share in enumerate((0.68, 0.95)):
        assert inside[:, :, k].mean() >= binom.ppf(1e-4, 18, share) / 18
    assert np.all(p_values > 1e-4)
    assert np.all(modes == 1)


@pytest.mark.second
def test_one_focus_leaves_two_states_and_a_second_one_decides(backend, tmp_path):
    """Faint stars in focus: from the true state and from its mirror image both are found, with the same probabilities.

    The truth is within four sigma (of 22 motions) of one of them. Images on both sides of focus leave one.
    """
    bench = star_bench(backend, tmp_path, ("0 mm",), "ritchey_chretien", flux=2e4)
    rng = np.random.default_rng(0)
    true = bench.draw(rng, "uniform")
    data = measured(bench, true, rng)
    found = bench.estimates(data, true)
    assert len(found) == 2
    again = bench.estimates(data, found[1].mean)
    np.testing.assert_allclose(probabilities(again), probabilities(found), atol=1e-3)
    apart = [np.linalg.norm(np.linalg.lstsq(mode.spread, true - mode.mean, rcond=None)[0]) for mode in found]
    assert min(apart) < np.sqrt(22.0) + 4.0
    assert max(apart) > 10.0
    both = star_bench(backend, tmp_path, ("-0.8 mm", "0.8 mm"), "ritchey_chretien", flux=2e4)
    assert len(both.estimates(measured(both, true, rng))) == 1


def terms_bench(backend, folder: Path, instrument: str, fields: list[list[float]], **more: object) -> AsBuiltBench:
    """A camera whose bodies do not move, with an interferometer and unknown terms of the wavefront."""
    (folder / "rigid.yaml").write_text(dump_yaml(RIGID))
    data = {
        "instrument": instrument,
        "prior": "./rigid.yaml",
        "wavefront": {"constant": {"Z5": "20 nm", "Z8": "30 nm"}, "linear": {"Z7": "10 nm"}},
        "measurements": {"wavefronts": {"fizeau": {"fields": fields, "sigma": "5 nm", "focus": "0 m"}}},
        "merits": {"wavefront": {"kind": "wavefront", "at_most": 0.0714}},
        "draws": 20,
        "simulate": {},
        **more,
    }
    (folder / "terms.yaml").write_text(dump_yaml(data))
    return AsBuiltBench(AsBuiltSetup.read(folder / "terms.yaml"), backend)


@pytest.mark.second
@pytest.mark.parametrize("instrument", ["gf7", "ritchey_chretien"])
def test_terms_of_the_wavefront_are_those_that_are_measured(backend, tmp_path, instrument):
    """Over each field's light, in proportion to the field; their estimate is the closed form of a linear model."""
    fields = [[-1.0, 0.0], [0.5, 0.4], [1.0, -1.0]]
    bench = terms_bench(backend, tmp_path, instrument, fields)
    assert bench.parameters.labels[2:] == ("wavefront along the line Z7", "wavefront along the track Z7")
    amounts = np.array([3e-9, -7e-9, 4e-9, 5e-9])
    nominal, moved = bench.predict(np.stack([np.zeros(4), amounts])).reshape(2, 3, 8)
    wanted = np.zeros((3, 8))
    wanted[:, 1], wanted[:, 4], wanted[:, 3] = 3e-9, -7e-9, np.array(fields) @ [4e-9, 5e-9]
    np.testing.assert_allclose(moved - nominal, wanted, atol=1e-15)
    rng = np.random.default_rng(0)
    true = bench.draw(rng, "normal")
    (data,) = bench.measured(true, rng)
    found = bench.estimate((data,))
    table = np.zeros((3, 8, 4))
    table[:, 1, 0], table[:, 4, 1], table[:, 3, 2:] = 1.0, 1.0, fields
    table = table.reshape(24, 4)
    inverse = table.T @ table / (5e-9) ** 2 + np.diag(1.0 / np.array([20e-9, 30e-9, 10e-9, 10e-9]) ** 2)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(inverse), rtol=1e-6, atol=1e-24)
    mean = np.linalg.solve(inverse, table.T @ (data - nominal.ravel()) / (5e-9) ** 2)
    np.testing.assert_allclose(found.mean, mean, atol=1e-13)


@pytest.mark.second
def test_terms_of_the_wavefront_are_found_in_images(backend, tmp_path):
    """Of two stars on both sides of focus; neither the resulting instrument nor its covariance contains them."""
    stars = {"fields": TWO, "read_noise": 8.0, "pixels": 28}
    images = {side: {**stars, "defocus": defocus} for side, defocus in (("in", "-0.6 mm"), ("out", "0.6 mm"))}
    (tmp_path / "focused.yaml").write_text(dump_yaml(PRIOR))
    bench = terms_bench(backend, tmp_path, "gf7", TWO, measurements={"images": images}, prior="./focused.yaml")
    run = run_asbuilt(bench.setup, backend)
    assert run.true is not None
    terms = slice(-4, None)
    apart = (run.estimate.mean - run.true)[terms] / run.estimate.sigma[terms]
    assert np.max(np.abs(apart)) < 4.0
    assert np.all(run.estimate.sigma[terms] < 0.9 * run.estimate.prior.sigma[terms])
    assert "wavefront" not in instrument_text(run).split("as_built", 1)[1].split("description")[0]
    assert not set(WAVEFRONT) & {component.body for component in unknown(run)[0]}
    assert not set(WAVEFRONT) & set(built_motions(run))


def test_terms_that_are_no_wavefront_are_refused(backend, tmp_path):
    for term in ("Z3", "Z46"):
        with pytest.raises(InputError, match="not a term of a wavefront"):
            terms_bench(backend, tmp_path, "gf7", TWO, wavefront={"constant": {term: "5 nm"}})


def recorded(folder: Path, pages: np.ndarray, **more: object) -> Path:
    """A file of measured images in one focus, and the FITS file that it names."""
    fits.PrimaryHDU(pages).writeto(folder / "stars.fits", overwrite=True)
    (folder / "focused.yaml").write_text(dump_yaml(PRIOR))
    images = {"fields": TWO, "file": "stars.fits", "defocus": "-0.6 mm", "read_noise": 8.0, **more}
    data = {"instrument": "gf7", "prior": "./focused.yaml", "measurements": {"images": {"sky": images}}, "draws": 20}
    (folder / "recorded.yaml").write_text(dump_yaml(data | {"merits": {"w": {"kind": "wavefront", "at_most": 0.07}}}))
    return folder / "recorded.yaml"


@pytest.mark.second
def test_recorded_images_are_read_and_judged(backend, tmp_path):
    """A FITS file with a gain, turned on the sensor, a saturated pixel and a streak: the report says so."""
    bench = star_bench(backend, tmp_path, ("-0.6 mm",))
    true = 0.5 * bench.draw(np.random.default_rng(3), "normal")
    pages = bench.measured(true, np.random.default_rng(4))[0].reshape(2, 28, 28)
    pages[1, 14, 6:20] += 500.0
    pages[0, 15, 15] = 8e4
    turned = np.rot90(pages, -1, axes=(1, 2)) / 2.0
    setup = AsBuiltSetup.read(
        recorded(tmp_path, turned.astype(np.float32), gain=2.0, saturation=3.9e4, orientation="turned 270")
    )
    run = run_asbuilt(setup, backend)
    np.testing.assert_allclose(run.data[0].reshape(2, 28, 28)[1], pages[1], rtol=1e-5)
    text = " ".join(run.warnings)
    assert "the star at (-0.7, 0) has 1 pixels at saturation" in text
    assert "the star at (0.7, 0.5) does not have the predicted image" in text
    assert run.images[0].star.fitted == 4


@pytest.mark.second
def test_a_star_that_contradicts_the_others_is_excluded(backend, tmp_path):
    """One of three stars has the image of another camera: it is named, and the others agree. One of two would stay."""
    fields = [[-0.7, 0], [0, 0], [0.7, 0.5]]
    bench = star_bench(backend, tmp_path, ("-0.6 mm",), fields=fields)
    rng = np.random.default_rng(5)
    true = 0.3 * bench.draw(rng, "normal")
    (data,), (other,) = bench.measured(true, rng), bench.measured(true + 0.5 * bench.draw(rng, "normal"), rng)
    half = 28 * 28
    found = bench.estimate((np.concatenate([data[:half], other[half : 2 * half], data[2 * half :]]),))
    assert [block for _, block, _ in found.excluded] == ["star (0, 0)"]
    assert found.whole.passes()
    assert found.whole.degrees == 2 * (half - 4)


def test_images_of_one_field_are_stars_of_their_own(backend, tmp_path):
    """Each has its own block, so that one bad exposure excludes itself alone, and its own row of the report."""
    pages = np.random.default_rng(0).normal(100.0, 8.0, (3, 16, 16))
    file = recorded(tmp_path, pages, fields=[[-0.7, 0], [0.7, 0.5], [-0.7, 0]])
    kind = AsBuiltBench(AsBuiltSetup.read(file), backend).kinds[0]
    assert dict.fromkeys(kind.blocks).keys() == {"star (-0.7, 0) no. 1", "star (0.7, 0.5)", "star (-0.7, 0) no. 2"}
    assert len(set(kind.labels)) == pages.size
    for wrong in (np.full((2, 16, 16), 100.0), np.full((2, 16, 16), np.nan)):
        with pytest.raises(InputError, match="a page without a star; found page 0"):
            AsBuiltBench(AsBuiltSetup.read(recorded(tmp_path, wrong)), backend)


def test_images_that_do_not_fit_the_file_are_refused(backend, tmp_path):
    file = recorded(tmp_path, np.ones((3, 16, 16), np.float32))
    with pytest.raises(InputError, match="3 pages in the file, 2 fields"):
        AsBuiltBench(AsBuiltSetup.read(file), backend)
    file = recorded(tmp_path, np.ones((2, 16, 16), np.float32), orientation="upside down")
    with pytest.raises(InputError, match="there is no orientation"):
        AsBuiltBench(AsBuiltSetup.read(file), backend)


def test_a_pickled_file_runs_nothing(tmp_path):
    place = tmp_path / FILE
    place.parent.mkdir()
    place.write_bytes(pickle.dumps([[np.ones((6, 6)), np.ones((6, 6))], [1.0]]))
    assert star_file(tmp_path) == place
    np.testing.assert_array_equal(star_images(place)[0], np.full((2, 2), 9.0))
    place.write_bytes(pickle.dumps([print]))
    with pytest.raises(pickle.UnpicklingError, match="print is no array"):
        star_images(place)


@pytest.mark.second
def test_edges_out_of_focus_determine_the_focus_with_its_sign(backend, tmp_path):
    """A shift of the plane is that motion of its body, and best focus is as far upstream; the focus of drawn planes.

    MTF of sigma 0.005 in two directions at three fields, 0.4 mm from focus: nine foci of three cameras, of which the
    prior knows 0.08 mm, are within four sigma, of 10 um.
    """
    fields = [[-0.9, 0], [0, 0], [0.9, 0]]
    edges = {"fields": fields, "sigma": 0.005, "frequency": 12.0}
    page, zero = {"mtf": {"page": {**edges, "defocus": "0.4 mm"}}}, {"mtf": {"zero": edges}}
    focus = {"focus": {"scan": {"fields": fields, "sigma": "1 um"}}}
    plane = {"causes": {"plane": PRIOR["causes"]["plane"]}}
    (tmp_path / "plane.yaml").write_text(dump_yaml({**PRIOR, **plane}))

    def bench_of(measurements: dict) -> AsBuiltBench:
        data = {"instrument": "gf7", "prior": "./plane.yaml", "measurements": measurements, "simulate": {}}
        (tmp_path / "edges.yaml").write_text(
            dump_yaml(data | {"merits": {"w": {"kind": "wavefront", "at_most": 0.07}}})
        )
        return AsBuiltBench(AsBuiltSetup.read(tmp_path / "edges.yaml"), backend)

    bench, exact, paged = (bench_of(part) for part in (zero, focus, page))
    along = [label.endswith("focal_plane shift z") for label in bench.parameters.labels].index(True)
    shifted = 0.4e-3 * np.eye(len(bench.parameters.labels))[along : along + 1]
    np.testing.assert_allclose(bench.predict(shifted), paged.predict(0.0 * shifted), atol=1e-9)
    np.testing.assert_allclose(exact.predict(shifted) - exact.predict(0.0 * shifted), -0.4e-3, rtol=2e-2)
    rng = np.random.default_rng(1)
    for _ in range(3):
        true = paged.draw(rng, "normal")
        data = paged.measured(true, rng)
        found = paged.estimate(data)
        assert not _linearity_warnings(paged.linear_share(data, found))
        apart = exact.predict(found.mean[None])[0] - exact.predict(true[None])[0]
        sigma = np.std(exact.predict(found.draw(rng, 100)), axis=0)
        assert np.max(np.abs(apart) / sigma) < 4.0
        assert np.max(sigma) < 15e-6
    # at a high frequency a wrong focus has nearly this MTF: one start ended 0.1 mm away, with a sigma of 0.02 mm
    fine = bench_of({"mtf": {"page": {"fields": fields, "sigma": 0.005, "defocus": "0.15 mm"}}})
    rng = np.random.default_rng(6)
    true = fine.draw(rng, "normal")
    data = fine.measured(true, rng)
    found = fine.estimate(data)
    assert not _linearity_warnings(fine.linear_share(data, found))
    apart = exact.predict(found.mean[None]) - exact.predict(true[None])
    assert np.max(np.abs(apart)) < 15e-6
    assert not found.excluded
    other = replace(found, unit=found.unit + 9.0 * found.root[0])
    assert any("another focus, explains" in text for text in _mode_warnings((found, other)))
    # with mirrors unknown too, the contrast in focus bends within its posterior
    (tmp_path / "plane.yaml").write_text(dump_yaml(PRIOR))
    sharp = bench_of({"mtf": {"page": {"fields": fields, "sigma": 0.005}}})
    true = sharp.draw(rng, "normal")
    data = sharp.measured(true, rng)
    assert "far from linear" in _linearity_warnings(sharp.linear_share(data, sharp.estimate(data, true)))[0]
