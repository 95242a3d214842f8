"""Refusals of input that cannot be used, in tables: what is given, and the words by which it is refused."""

import os
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import tifffile
from astropy.io import fits
from scipy import sparse

from analysis.arrays import UndeterminedError
from analysis.block import block_adjustment, reweighting
from analysis.block.block import JointCameraPrior, Term
from analysis.block.block_adjustment import adjust_block, pruned
from analysis.block.error_processes import BlockError, Law
from analysis.calibration import normal_equations, strip_adjustment
from analysis.calibration.adjustment import adjust
from analysis.calibration.strip_adjustment import adjust_strip
from analysis.images.image_file import ImageError, ImageFile, Region, fits_cards
from analysis.matching.correlation import MatchOptions, distinct_points, resampled
from analysis.monitor import limits
from analysis.monitor.estimators import ESTIMATORS, Posterior, Shifts
from analysis.monitor.filter_state import Observed
from analysis.monitor.kalman_filter import SeriesFilter
from analysis.monitor.model_fit import gain, observability
from analysis.monitor.monitor_formulas import CameraParameters, GroundGeometry, MonitorGeometry
from analysis.monitor.recovery import measure_spots, recover_monitor
from analysis.monitor.state_space import StateSpace
from analysis.mtf.edge_location import EdgeError
from analysis.mtf.edge_pages import measure_pages
from analysis.orbit import forward_intersection, jitter
from analysis.orbit.calibration_parameters import CalibrationError
from analysis.orbit.forward_intersection import (
    CalibratedLine,
    IntersectionError,
    Sightings,
    check_errors,
    intersect,
    intersect_pair,
)
from analysis.orbit.jitter import JitterError, Observations, fit_spline, periodogram
from analysis.orbit.rational_polynomial import image_correction
from analysis.orientation.interior import OrientationError, fit_interior_orientation, line_orientation
from analysis.spots.centroid import energy_centroid, gaussian_fit
from analysis.spots.frame_screening import FramesError
from analysis.spots.likelihood import maximum_likelihood_fit
from analysis.spots.noise import NoiseModel
from analysis.spots.photon_transfer import photon_transfer, pixel_correction
from analysis.spots.spot_image import difference_covariance, noise_parts
from analysis.spots.spot_template import SpotTemplate
from analysis.turntable.dividing_error import CalibrationSeries, cross_validate, fit_dividing_error
from tests.analysis import test_adjustment
from tests.analysis.drawn_blocks import Plan, draw
from tests.analysis.refusals import refuses
from tests.analysis.stated_motions import TimeLaw, disturbances
from tests.analysis.test_jitter_lines import of_disparities
from tests.analysis.test_monitor_limits import some_cameras
from tests.analysis.test_spot_centroids import NOISE, SHAPE, airy
from tests.analysis.test_three_line_model import SEEN, cameras, make_rays


def test_blocks():
    bias = (Term(Law("bias", "constant", (1e-5,) * 3), "tracker"),)
    block = draw(Plan(ties=4, control=2, check=1, footprints=0, attitude=bias), np.random.default_rng(1)).block
    adjust_block(block)
    first, points = block.scenes[0], block.points
    nowhere = np.where(np.arange(len(points.ids))[:, None] == 3, np.nan, points.start)
    some = {name: replace(k, covariance=k.covariance[:4, :4]) for name, k in block.known.items()}
    still = {name: replace(k, covariance=0.0 * k.covariance) for name, k in block.known.items()}
    white = (Term(Law("attitude", "white", (1e-6,) * 3, 0.5)),)
    unwatched = JointCameraPrior((), np.zeros((0, 2, 4)), np.eye(0))

    def scene(**changes):
        return {"scenes": (replace(first, **changes), *block.scenes[1:])}

    for said, changes in {
        "no observations": {"scenes": ()},
        "two passes or two scenes have the same name": {"scenes": (first, *block.scenes)},
        "no pass is called 'other'": scene(of="other"),
        "camera 'other' has no model or no prior": scene(camera="other"),
        "its image points have no times": scene(rays=replace(first.rays, time=None)),
        "the sigma of image points must be positive, found 0": {"image": 0.0},
        "a coordinate is not finite": {"points": replace(points, start=nowhere)},
        "must be positive definite": {"points": replace(points, covariance=0.0 * points.covariance)},
        r"covariance \(4, 4\) does not match 2 passes": {"known": some},
        "needs a standard deviation above zero": {"known": still, "monitored": None},
        "needs a constant error of each of them": {"attitude": white},
        "the monitor has no reading of camera 'fore'": {"monitored": unwatched},
    }.items():
        refuses(BlockError, said, adjust_block, replace(block, **changes))
    refuses(BlockError, "no sensor is called 'radar'; there are", block.without, "radar")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(block_adjustment, "_STEPS", 1)
        refuses(BlockError, "no convergence in 1 steps", adjust_block, block)
    lonely = replace(block.without("control"), scenes=(first,), terrain=None)
    refuses(BlockError, "no point is seen by two scenes, and none is control", pruned, lonely)


def test_normal_equations_that_cannot_be_solved(monkeypatch):
    """Of an indefinite matrix neither a dense nor a sparse factor leads to a covariance."""
    indefinite = sparse.csc_matrix([[1.0, 2.0], [2.0, 1.0]])
    refuses(BlockError, "singular", block_adjustment._Factor, indefinite)
    monkeypatch.setattr(block_adjustment, "_DENSE", 0)
    refuses(BlockError, "singular", block_adjustment._Factor(indefinite).inverse)
    refuses(CalibrationError, "cannot be estimated", normal_equations._inverse, indefinite.toarray())


@pytest.mark.second
@pytest.mark.parametrize("cut", ["block", "rounds", "calibration", "strip", "intersection", "half widths"])
def test_what_does_not_converge_is_no_result(monkeypatch, cut):
    """Each iteration is cut short; what it would return is where it stands, which no sigma covers."""
    rng, noise, line = np.random.default_rng(1), replace(test_adjustment.NOISE, attitude_interval=0.125), cameras()
    block, rays = draw(Plan(ties=4, control=2, check=1, footprints=0), rng).block, make_rays(SEEN, rng, noise)
    field, how = test_adjustment.measured(test_adjustment.VIEW, rng), {"gauge": test_adjustment.HOLD_X}
    module, name, error, said, call = {
        "block": (block_adjustment, "_MOST", BlockError, "are adjusted at once", partial(adjust_block, block)),
        "rounds": (reweighting, "_ROUNDS", BlockError, "do not converge", partial(adjust_block, block, robust="huber")),
        "calibration": (
            reweighting,
            "_ROUNDS",
            CalibrationError,
            "do not converge",
            partial(adjust, [field], test_adjustment.LABORATORY, test_adjustment.NOISE, **how, robust="huber"),
        ),
        "strip": (strip_adjustment, "_STEPS", CalibrationError, "", partial(adjust_strip, rays, line, noise)),
        "intersection": (forward_intersection, "_STEPS", CalibrationError, "", partial(intersect, rays, line, noise)),
        "half widths": (
            limits,
            "_STEPS",
            ArithmeticError,
            "does not converge",
            partial(limits._half_widths, np.ones((2, 1)), 0.95),
        ),
    }[cut]
    call()
    monkeypatch.setattr(module, name, 1)
    refuses(error, said or "no convergence", call)


def test_images(tmp_path, monkeypatch):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((2, 3, 8, 9), np.uint16), photometric="minisblack")
    refuses(ImageError, "page 9 does not exist", ImageFile.open, path, None, 9, "")
    os.mkfifo(tmp_path / "pipe")
    refuses(ImageError, "a device, a pipe or a socket", ImageFile.open, tmp_path / "pipe")
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((8, 9), np.uint8))
    data = (tmp_path / "a.png").read_bytes()
    cv2.imwrite(str(tmp_path / "a.jpg"), np.zeros((80, 90), np.uint8))
    # without a header, without an end
    for spoilt in (data[:8] + data[33:], data[:-12], (tmp_path / "a.jpg").read_bytes()[:100]):
        (tmp_path / "b.png").write_bytes(spoilt)
        refuses(ImageError, "cut off or damaged", ImageFile.open, tmp_path / "b.png")
    refuses(ImageError, "page 9 does not exist", ImageFile.open, tmp_path / "a.png", None, 9, "")
    with monkeypatch.context() as patched:
        patched.setattr(ImageFile, "_stored", lambda self: iter([np.zeros((9, 8), np.uint8)]))
        refuses(ImageError, "another number of rows or columns", ImageFile.open(tmp_path / "a.png").read, {})
    tifffile.imwrite(path, np.zeros((3, 8, 9)), photometric="minisblack", volumetric=True, tile=(16, 16, 16))
    refuses(ImageError, "pages of rows and columns are needed", ImageFile.open, path)
    tifffile.imwrite(path, shape=(40, 4000, 4000), dtype=np.uint16, photometric="minisblack")
    whole = {"--roi": Region(0, 0, 2000, 2000)}
    refuses(ImageError, "in all fit into memory", ImageFile.open(path).read, whole)
    fits.PrimaryHDU(np.zeros((8, 9)), fits.Header({"OBSERVER": "one"})).writeto(tmp_path / "a.fits")
    assert fits_cards(tmp_path / "a.fits", 0)["OBSERVER"] == "one"
    data = (tmp_path / "a.fits").read_bytes().replace(b"'one     '", b"'one      ")
    (tmp_path / "a.fits").write_bytes(data)
    refuses(ImageError, "its header is damaged", fits_cards, tmp_path / "a.fits", 0)


def test_matching():
    image = np.random.default_rng(1).uniform(0.0, 1.0, (60, 60))
    for count, spacing, border in ((0, 5, 5), (5, 0, 5), (5, 5, -1)):
        more = {"spacing": spacing, "border": border}
        refuses(ValueError, "count and spacing must be 1 or more", distinct_points, image, count, **more)
    for name in ("least_correlation", "largest_ratio", "largest_risk"):
        refuses(ValueError, f"{name} must not exceed 1", MatchOptions, **{name: 1.1})
    grid = np.mgrid[20:30.0, 20:30.0]
    for smoothing in (-1.0, np.inf):
        refuses(ValueError, "smoothing must be 0 or a positive", resampled, image, *grid, smoothing=smoothing)


def test_monitor():
    laws, see = (TimeLaw(), TimeLaw(white=True)), np.ones((4, 2))
    stated, eye = disturbances(laws, see, see), np.eye(4)
    for changes in ({"sigmas": np.ones(3)}, {"spots": np.ones((4, 3))}, {"correlation": np.eye(3)}):
        refuses(ValueError, "for 2 motions, found", replace, stated, **changes)
    refuses(ValueError, "2 motions need as many bodies", replace, stated, laws=laws[:1])
    mixed = replace(stated, correlation=np.array([[1.0, 0.5], [0.5, 1.0]]))
    refuses(ValueError, "motions with different laws in time cannot be correlated", StateSpace, mixed)
    still = np.zeros((1, 2, 2))
    refuses(ValueError, "needs a prior of disturbances", Posterior().gain, Shifts(still, still, eye[None], {}, None))
    for looks, said in (((1.3, 0.0), "looks past the Earth"), ((0.1, 0.1), "lines of sight are parallel")):
        refuses(UndeterminedError, said, GroundGeometry, 5e5, ("a", "b"), looks, (0.01, 0.01))
    for family in ([], [0, 0], [5]):
        refuses(ValueError, "family must be", observability, list("ab"), see, see, [1, 1], eye, family)
    refuses(UndeterminedError, "not positive definite", observability, list("ab"), see, see, [1, 1], 0 * eye, [0])
    refuses(ValueError, "Jacobians must be finite", gain, eye, np.nan * see, see)
    for value, said in ((np.nan, "must be finite"), (-1.0, "finite and > 0")):
        refuses(ValueError, said, MonitorGeometry, value, 0.7, 7e-6)
    refuses(ValueError, "d_f_per_alpha_m must be finite", MonitorGeometry, 5.5, 0.7, 7e-6, d_f_per_alpha_m=np.inf)
    odd = replace(some_cameras()["c0"], channels=("up", "down"))
    refuses(ValueError, "called left and right, found up, down", ESTIMATORS["paper_single"].camera_gain, odd, eye)
    how = SeriesFilter(disturbances(laws[:1], see[:, :1], see[:, :1]))
    refuses(UndeterminedError, "need noise", how.update, how.start(0.0), Observed(0.0, np.zeros(4), 0.0 * eye))
    refuses(ValueError, "no centroid 'mean'; there are", measure_spots, np.zeros((1, 9, 9)), 1, None, "mean", 1)
    frames, two = np.zeros((1, 3, 2, 8, 8)), SimpleNamespace(spots=2)
    refuses(ValueError, "has 2 spots, the images 3", recover_monitor, frames[0], frames, two, "ml", 1)
    refuses(ValueError, r"need \(..., 4\) and \(..., 4, 4\)", CameraParameters.from_vector, np.zeros(3), eye)


def test_orbit():
    points = SEEN.points
    refuses(CalibrationError, "finite coordinates", check_errors, points, points[:3])
    refuses(CalibrationError, "none was intersected", check_errors, np.nan * points, points)
    one = CalibratedLine(1, np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 3)), np.eye(3), 0.65)
    refuses(ValueError, "principal distance must stay positive", one.corrected, [0.0, 0.0, 0.0, -1.0])
    refuses(ValueError, "four finite numbers", one.corrected, [0.0, 0.0, np.nan, 0.0])
    seen = [Sightings(np.zeros(n), np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1))) for n in (1, 2)]
    refuses(IntersectionError, "must see the same points", intersect_pair, one, one, *seen)
    place = np.zeros((4, 2))
    refuses(ValueError, "must be", image_correction, place, place[:3], np.tile(np.eye(2), (4, 1, 1)), "shift")


def test_jitter(monkeypatch):
    time = np.linspace(0.0, 10.0, 200)
    given = of_disparities(time, time + 0.1, 0.0 * time, 0.1, 0 * time)
    parts = given.value, given.group, given.time, given.weight, given.nuisance
    refuses(JitterError, "do not match", Observations.of, given.value[:9], *parts[1:])
    refuses(JitterError, "their groups are mixed", Observations.of, given.value, given.group[::-1], *parts[2:])
    refuses(JitterError, "do not match mixtures", Observations.of, *parts, mix=np.ones((9, 2, 1)))
    refuses(JitterError, "needs distinct times", fit_spline, given, 0.0, 1.0)
    once = of_disparities(0.0 * time, 0.0 * time, 0.0 * time, 0.1, 0 * time, degree=0)
    refuses(JitterError, "all observations have the same time", periodogram, once, 0.5, 6.0)
    refuses(JitterError, "has no effect on the observations", jitter._fitted, given, np.array([2.0]), np.zeros(1))
    periodogram(given, 0.5, 2.0)
    monkeypatch.setattr(jitter, "BLIND", 2.0)
    refuses(JitterError, "all frequencies between 0.5 and 2 Hz are blind", periodogram, given, 0.5, 2.0)


def test_edges_and_angles():
    refuses(EdgeError, "pages must be planes of real grey values", measure_pages, np.zeros((40, 40)))
    angle = np.linspace(-0.02, 0.02, 20)
    three = ("constant", "principal_distance", "principal_point")
    found = fit_interior_orientation(np.tan(angle), angle, 1e-6, three)
    refuses(OrientationError, "do not determine the line model", line_orientation, found)
    wide = 15.0 * angle
    for bent in (-50.0, 500.0):
        found = fit_interior_orientation(5.5 * np.tan(wide) + bent * np.tan(wide) ** 3, wide, 1e-6, (*three, "radial3"))
        refuses(OrientationError, "do not converge", line_orientation, found)
    refuses(ValueError, "take 2 or more", cross_validate, "polynomial", angle, angle, 1.0, folds=1)
    refuses(ValueError, "must be", fit_dividing_error, angle, angle[:3], 1.0, "polynomial")
    present = np.arange(60).reshape(20, 3) > 2
    refuses(ValueError, "needs two comparisons or more", CalibrationSeries, angle, np.zeros((20, 3)), 0.0, present)


def test_spots():
    image = 64.0 + 3000.0 * airy(47.2, 48.1)[None]
    for call, said in ((energy_centroid, "energy centroid: radius_px"), (gaussian_fit, "gaussian fit: radius_px")):
        refuses(ValueError, said, call, image, 9, NOISE, 99.0)
    for call in (energy_centroid, gaussian_fit):
        refuses(ValueError, "at least 6 x 6 px", call, image[:, :5], 9, NOISE)
    template = SpotTemplate.from_image(airy(73.7, 73.2, (148, 148)), 73.7, 73.2, SHAPE)
    refuses(ValueError, "must be >= 1", maximum_likelihood_fit, image, 9, NOISE, template, threads=0)
    two, three = (gaussian_fit(np.repeat(image, n, axis=0), 9, NOISE) for n in (2, 3))
    refuses(ValueError, "does not fit after", difference_covariance, two, three, NOISE)
    bare = maximum_likelihood_fit(image, 9, NOISE, template, keep_maps=False)
    refuses(ValueError, "need their gain maps", noise_parts, bare, NOISE)
    square = airy(40, 40, (80, 80))
    for said, place, options in (
        ("oversampling must be a whole number", (40, 40), {"oversampling": 1.5}),
        ("lies outside the image", (99, 40), {}),
        ("tolerance must be in", (40, 40), {"tolerance": 0.5}),
    ):
        refuses(ValueError, said, SpotTemplate.from_image, square, *place, (48, 48), **options)
    refuses(ValueError, "nothing to stack", SpotTemplate.stack, [])
    small = SpotTemplate.from_image(square, 40, 40, (48, 48))
    refuses(ValueError, "template 1 has another shape", SpotTemplate.stack, [template, small])
    refuses(ValueError, r"must all be \(B,\)", template.evaluate, [47.0], [47.0, 48.0])


def test_photon_transfer():
    rng, noise = np.random.default_rng(2), NoiseModel(0.5, 6.0, 0.0, 64.0, 0.0, 0.0, 4095.0)
    dark, flat = (np.rint(level + 4.0 * rng.standard_normal((4, 32, 32))) for level in (64.0, 900.0))
    for first, second, said in (
        (dark[:1], flat, "1 dark frame: its noise cannot be measured"),
        (dark, np.where(flat > 905.0, np.nan, flat), "flat frames contain values that are not finite"),
        (dark, flat[:, :30], "different sizes"),
        (dark, dark + 1.0, "DN brighter than the dark ones"),
    ):
        refuses(FramesError, said, photon_transfer, first, second)
        refuses(FramesError, said, pixel_correction, noise, first, second)
    refuses(FramesError, "not noisier than the dark ones", photon_transfer, dark, flat)
