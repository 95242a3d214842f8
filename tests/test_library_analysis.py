"""Public functions of analysis: beside other people's programs, their documented arguments, and what they refuse."""

import inspect
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import fourier_shift, gaussian_filter

import analysis

FUNCTIONS = [name for name in analysis.__all__ if not isinstance(getattr(analysis, name), type)]
DOCS = Path(__file__).resolve().parent.parent / "docs"
NOISE = analysis.NoiseModel()
DRIFT = analysis.Disturbances.of([[1.0]], [[1.0]], [analysis.TimeLaw(drift_s=10.0)])


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_documented_arguments_are_those_of_the_function(name: str) -> None:
    function = getattr(analysis, name)
    text = inspect.getdoc(function).partition("Parameters\n----------\n")[2].partition("\n\nReturns\n")[0]
    documented = [each for line in re.findall(r"^([\w, ]+) : ", text, re.M) for each in line.split(", ")]
    assert sorted(documented) == sorted(inspect.signature(function).parameters)


def test_the_pages_list_every_name() -> None:
    for page in ("library_analysis.md", "site/pages/reference/analysis.md"):
        text = (DOCS / page).read_text("utf-8")
        assert [name for name in analysis.__all__ if not re.search(rf"`{name}`|analysis\.{name}$", text, re.M)] == []


@pytest.mark.oracle
def test_spot_centres_are_those_of_photutils() -> None:
    """Both fit a Gaussian: photutils over the image, which is crossed by a slope of a thousandth of the peak."""
    centroids = pytest.importorskip("photutils.centroids")
    row, column = np.mgrid[:41, :41]
    rng = np.random.default_rng(1)
    for centre in rng.uniform(18.0, 22.0, (4, 2)):
        image = 50.0 + 5000.0 * np.exp(-0.5 * ((row - centre[0]) ** 2 + (column - centre[1]) ** 2) / 1.7**2)
        fit = analysis.fit_spot(rng.poisson(image), NOISE, radius=8.0)
        theirs = centroids.centroid_2dg(rng.poisson(image) - 50.0)
        assert np.all(np.abs([fit.row - theirs[1], fit.column - theirs[0]]) < 4.0 * np.hypot(fit.sigma, fit.sigma))


@pytest.mark.oracle
def test_shifts_of_windows_are_those_of_scikit_image() -> None:
    registration = pytest.importorskip("skimage.registration")
    rng = np.random.default_rng(2)
    first = 1000.0 + 800.0 * gaussian_filter(rng.standard_normal((160, 160)), 2.0, mode="wrap")
    for shift in ((0.3, -0.7), (-1.45, 0.2)):
        second = np.fft.ifft2(fourier_shift(np.fft.fft2(first), shift)).real + rng.standard_normal(first.shape)
        places = np.array([[r, c] for r in (40, 80, 120) for c in (40, 80, 120)])
        windows = np.stack([first[r - 15 : r + 16, c - 15 : c + 16] for r, c in places])
        matches = analysis.match_windows(second, windows, places, search_radius=4)
        ours = np.mean((matches.position - places)[matches.accepted], axis=0)
        theirs = -registration.phase_cross_correlation(first, second, upsample_factor=100, normalization=None)[0]
        assert matches.accepted.sum() > 5
        assert np.max(np.abs(ours - theirs)) < 0.015


@pytest.mark.oracle
def test_terms_of_a_map_are_those_of_poppy() -> None:
    """poppy makes the map, with x to the right and y upwards on the disk that fills its array."""
    zernike = pytest.importorskip("poppy.zernike")
    coefficients = np.random.default_rng(3).normal(size=15) * 1e-8
    opd = zernike.opd_from_zernikes(coefficients, npix=128, basis=zernike.zernike_basis_faster, outside=np.nan)
    fit = analysis.fit_wavefront_map(opd, range(1, 16), analysis.Pupil(63.5, 63.5, 63.5))
    assert np.max(np.abs(fit.coefficients - coefficients)) < 2e-10


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: analysis.fit_spot(np.zeros(9), NOISE), r"image must be \(H, W\)"),
        (lambda: analysis.fit_spot(np.zeros((31, 31)), NOISE, method="moment"), "gaussian, energy, ml"),
        (lambda: analysis.fit_rpc(np.zeros((9, 2)), np.zeros((9, 2))), r"ground \(N, 3\)"),
        (lambda: analysis.fit_rpc(np.full((9, 2), np.nan), np.zeros((9, 3))), "must be finite"),
        (lambda: analysis.fit_rpc(np.zeros((9, 2)), np.zeros((9, 3))), "at least 39"),
        (lambda: analysis.fit_rpc(np.zeros((99, 2)), np.zeros((99, 3))), "line is constant"),
        (lambda: analysis.intersect_rays([0, 0], [0, 1], [0, 1], [1, 0]), r"\(n, 3\)"),
        (lambda: analysis.intersect_rays([0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 0, 1]), "parallel"),
        (lambda: analysis.find_jitter([0, 1], [0, 1, 2], 1.0, 0.1, 1.0), r"times \(n,\)"),
        (lambda: analysis.make_block({}, {}, [0, 0, 0], image_sigma=1, attitude_sigma=1, station_sigma=1,
                                     camera_sigma=np.ones(4)), r"points \(m, 3\)"),
        (lambda: analysis.make_block({}, {}, [[0, 0, 0]], control_sigma=[-1], image_sigma=1, attitude_sigma=1,
                                     station_sigma=1, camera_sigma=np.ones(4)), "1 positive sigmas"),
        (lambda: analysis.smooth_series(DRIFT, [0, 1], [0, 1], np.eye(1), [0]), r"need values \(2, 1\)"),
        (lambda: analysis.smooth_series(DRIFT, [0, 1], [[0], [np.nan]], np.eye(1), [0]), "must be finite"),
        (lambda: analysis.detect_jumps(DRIFT, [0, 1], [[0], [1]], np.eye(2)), r"covariance \(1, 1\)"),
        (lambda: analysis.TimeLaw(drift_s=-1.0), "drift_s must be positive"),
        (lambda: analysis.NoiseModel(saturation_dn=np.nan), "saturation_dn must be finite"),
        (lambda: analysis.fit_wavefront_map(np.zeros((9, 9, 3)), [1]), "real numbers"),
        (lambda: analysis.linear_error(1.0, 1.5), "between 0 and 1"),
        (lambda: analysis.proportion_interval(4, 3, 0.9), "successes <= trials"),
        (lambda: analysis.robust_sigma([]), "at least one"),
        (lambda: analysis.nm_to_noll(2, 1), "n - m even"),
        (lambda: analysis.chauvenet([]), "at least one"),
        (lambda: analysis.fit_interior_orientation([-0.1, 0.1], [-0.1, 0.1], 1e-6, ["principal_distance"]).sigma("f"),
         "the terms are constant, principal_distance"),
    ],
)  # fmt: skip
def test_input_that_cannot_be_used_is_refused(call, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        call()
