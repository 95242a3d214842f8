"""What real frames hold beside the spot is found and corrected, and sigmas hold; clean frames are left as they are."""

import re

import numpy as np
import pytest
from scipy.stats import chi2

from analysis.spots.frame_screening import noise_ratio, screen_frames
from analysis.spots.photon_transfer import pixel_correction
from analysis.spots.screened_fit import single_template
from analysis.spots.spot_image import SpotError
from analysis.spots.static_defects import examine, outlier_pixels
from optics.numerics.backend import one_blas_thread
from scenes.models.disturbances import state_of
from scenes.specs.job import AnalysisSpec, JobSpec
from scenes.specs.resolved import resolve_job
from tests.tiers import quick
from tests.twin import dirty_frames
from tests.twin.dirty_frames import KINDS, Drawn, clean_scene, draw, measurement, record, replace
from twin.recover import channel_measurement

SETS = 30
FALSE_ALARM = 1e-3
STANDING = tuple(kind for kind in KINDS if kind != "movement")
"""All dirt in which sigma is not that of a few frames' scatter."""
TOLD = {
    "bad pixels": ("bad pixels",),
    "cosmic rays": ("cosmic rays",),
    "background": ("uneven background",),
    "other light": (),
    "saturation": ("saturation",),
    "reflection": ("second spot",),
    "vibration": ("smear",),
    "movement": ("movement between frames",),
    "missing frames": ("missing light",),
}
"""Kind of dirt -> what it is called in the findings."""


@pytest.fixture(scope="module")
def bench(experiment):
    """(shape of one spot, detector, noise)."""
    pair = experiment("gf7_pair")
    calibration = pair.calibration
    return single_template(calibration.template, 0, calibration.template.shape), pair.detector, calibration.noise


def squares(bench, kinds, seeds, centroid="ml", learnt=False):
    """Chi-square of every corrected shift against the truth (two coordinates), and the findings of each set."""
    template, detector, noise = bench
    out, told = [], []
    with one_blas_thread():
        for seed in seeds:
            drawn = draw(template, detector, kinds, seed)
            analysis = AnalysisSpec(centroid=centroid)
            shape = None if learnt else template
            work = measurement(drawn, template, noise, "vibration" in kinds, shape, analysis=analysis)
            assert work.search() == []
            assert work.measure() == []
            first, second = work.positions
            error = (second.position - first.position)[0] - drawn.shift
            out.append(float(error @ np.linalg.solve(work.shift_covariance(1)[0], error)))
            result = work.result()
            told.append((result.before, result.after[0]))
    return np.array(out), told


@pytest.mark.parametrize("kind", quick(1, ["all", *KINDS]))
def test_dirt_is_found_and_corrected(bench, kind):
    """One set of each kind."""
    kinds = STANDING if kind == "all" else (kind,)
    count = 1
    found, told = squares(bench, kinds, range(1000, 1000 + count))
    # known from eight degrees of freedom, a movement's sigma has heavier tails: chi-square is divided by nearly F
    limit = chi2.isf(1e-6, 2 * count) * (4.0 if kind == "movement" else 1.0)
    assert found.sum() < limit
    for spots in told:
        names = {finding.kind for spot in spots for finding in spot.findings}
        # with all together light and well may leave nothing saturated
        for one in kinds:
            assert set(TOLD[one]) <= names or (kind == "all" and one == "saturation")


@pytest.mark.second
def test_clean_frames_are_not_touched(bench):
    found, told = squares(bench, (), range(2000, 2005))
    assert found.sum() < chi2.isf(1e-4, 10)
    for spots in told:
        for spot in spots:
            assert spot.clean
            assert spot.cost == 0.0
            assert spot.used.all()


def moved_by(rms):
    """Frames of both states whose spot moves from frame to frame."""

    def movement(scenes, rng, shape):
        for scene in scenes:
            scene.offsets = rms * rng.standard_normal(scene.offsets.shape)

    return movement


@pytest.mark.second
def test_the_noise_of_a_subtracted_level_is_that_of_the_light(bench, monkeypatch):
    """Real numbers whose dark level was subtracted: all that is below the data sheet's level had no shot noise, which
    made sigma 30 % too small and took noise for cosmic rays and bad pixels.
    """
    template, detector, noise = bench
    square, told = 0.0, []
    with one_blas_thread():
        for seed in range(300, 306):
            drawn = draw(template, detector, (), seed)
            low = Drawn(*(one.astype(float) - noise.dark_level_dn for one in (drawn.before, drawn.after)), drawn.shift)
            works = [measurement(frames, template, noise) for frames in (drawn, low)]
            for work in works:
                assert work.search() == work.measure() == []
            own, raw = (work.positions[1].position - work.positions[0].position for work in works[::-1])
            np.testing.assert_allclose(own, raw, atol=1e-4)
            spread, whole = works[1].shift_covariance(1)[0], works[0].shift_covariance(1)[0]
            np.testing.assert_allclose(np.diag(spread), np.diag(whole), rtol=0.01)
            square += float((own[0] - drawn.shift) @ np.linalg.solve(spread, own[0] - drawn.shift))
            told += [finding.kind for finding in works[1].result().before.findings]
            assert works[1].result().before.noise_ratio is None
    assert square < chi2.isf(1e-3, 12)
    assert told == ["subtracted level"] * 6


def test_too_little_of_a_spot_is_refused(bench, monkeypatch):
    """All but its faint flanks is saturated, which makes sigma 2.6 times as large: by a smaller limit too much."""
    template, detector, noise = bench
    drawn = draw(template, detector, (), 5)
    drawn.after[drawn.after > 0.03 * detector.max_dn] = detector.max_dn
    monkeypatch.setattr(channel_measurement, "_MOST_SIGMA_INCREASE", 1.0)
    with one_blas_thread():
        work = measurement(drawn, template, noise)
        assert work.search() == []
        (issue,) = work.measure()
    assert issue.key[-1] == "after"
    assert re.search(r"too much of the spot is missing \(.*saturation.*\): sigma would grow 2\.6-fold", issue.problem)


def test_dark_frames_with_a_level_do_not_go_with_frames_without(bench):
    template, detector, noise = bench
    drawn = draw(template, detector, (), 1)
    night = np.random.default_rng(1).normal(noise.dark_level_dn, 2.0, (4, *template.shape))
    work = measurement(Drawn(drawn.before - 100.0, drawn.after - 100.0, drawn.shift), template, noise)
    work.channel = replace(work.channel, correction=pixel_correction(noise, night, None))
    (issue,) = work.search()
    assert "darker than without light" in str(issue)
    assert "dark frames as they were recorded" in str(issue)


@pytest.mark.parametrize("photons", quick(0, [3e4, 3e3]))
def test_faint_spots_are_not_called_moving(bench, photons, monkeypatch):
    """Light of 1 800 electrons, of which the median is mostly noise, stood still and was called moving in every set,
    with sigmas five times too large (chi-square 0.05).
    """
    monkeypatch.setattr(dirty_frames, "PHOTONS", photons)
    found, told = squares(bench, (), range(500, 506))
    names = {finding.kind for spots in told for spot in spots for finding in spot.findings}
    assert not names & {"movement between frames", "smear", "drifting level", "missing light"}
    # of 12 degrees of freedom
    assert chi2.ppf(1e-4, 12) < found.sum() < chi2.isf(1e-4, 12)


@pytest.mark.parametrize("rms", quick(0, [0.6, 2.0]))
def test_a_spot_that_moves_far_is_no_spoilt_frame(bench, rms, monkeypatch):
    """Each state was refused as dark, or its spot was taken for cosmic rays in each frame."""
    monkeypatch.setitem(KINDS, "far", moved_by(rms))
    found, told = squares(bench, ("far",), range(600, 602))
    # of few frames: chi-square is divided by nearly F
    assert found.sum() < 4.0 * chi2.isf(1e-6, 4)
    for spots in told:
        for spot in spots:
            kinds = [finding.kind for finding in spot.findings]
            assert "movement between frames" in kinds
            assert not {"corrupted frames", "missing light"} & set(kinds)
            size = float(re.search(r"[0-9.]+", spot.findings[kinds.index("movement between frames")].text)[0])
            # both directions together, of nine frames, some larger as so few say
            assert 0.5 * rms < size < 3.5 * rms


@pytest.mark.second
def test_findings_tell_places_on_the_ccd(bench):
    """Of a part of the CCD that was read out, too: a pixel, a column and a reflection have the same places as in all of
    it.
    """
    template, detector, noise = bench
    rng = np.random.default_rng(8)
    scene = clean_scene((47.0, 48.0), template.shape)
    scene.static[30, 21], scene.dead[:, 62], scene.others = 3e4, True, [(60.3, 37.6, 0.03)]
    frames = record(scene, template, detector, detector.fixed_pattern(template.shape, 3), rng)
    part = np.s_[:, 9:93, 6:90]
    with one_blas_thread():
        whole = examine(screen_frames(frames, noise), noise, template)
        cut = examine(screen_frames(frames[part], noise), noise, single_template(template, 0, (84, 84)), first=(9, 6))
    told = [{one.kind: one.text for one in found.findings} for found in (whole, cut)]
    for texts in told:
        assert "(30, 21)" in texts["bad pixels"]
        assert texts["bad columns"].startswith("62 ")
        assert "at row 60.3, column 37.6" in texts["second spot"]


@pytest.mark.parametrize("seed", quick(0, [18, 139, 154]))
def test_dark_rings_of_a_brighter_spot_are_not_taken_for_dead_pixels(bench, seed):
    """Light of 1.4 to 1.5 times what is usual, of which the dark ring is far below the median of the pixels about it: a
    coarse look, before there is a fit, took its darkest pixels in these sets and never gave them back.
    """
    _, told = squares(bench, ("other light",), [seed])
    assert all(spot.clean and spot.used.all() for spots in told for spot in spots)
    drawn = draw(bench[0], bench[1], ("other light",), seed)
    assert not outlier_pixels(screen_frames(drawn.after, bench[2]), bench[2]).any()


@pytest.mark.second
def test_perturbed_instruments_are_not_taken_for_dirt(experiment):
    """Spots of instruments that are as far from nominal as launch leaves them have another shape, and are clean."""
    job = JobSpec.model_validate({"instrument": "gf7_pair", "disturbances": "launch"})
    pair = experiment("gf7_pair").stating(resolve_job(job))
    amounts = pair.prior.draw(np.random.default_rng(4), 6)
    states = [state_of(row, pair.prior.components, pair.thermal) for row in amounts]
    frames = pair.frames_after(pair.path.expected_photons(states), 9, 5)
    template, noise = pair.calibration.template, pair.calibration.noise
    measured = 0
    with one_blas_thread():
        for state in frames:
            for i, spot in enumerate(state):
                try:
                    found = examine(screen_frames(spot, noise), noise, single_template(template, i, spot.shape[1:]))
                except SpotError:
                    continue  # a spot that left the CCD
                assert found.clean, [f"{one.kind}: {one.text}" for one in found.findings]
                measured += 1
    assert measured > 12


@pytest.mark.parametrize("kind", quick(1, ["background", "clean", "bad pixels"]))
def test_a_learnt_shape_is_that_of_the_spot_alone(bench, kind):
    """Without a model the shape is learnt from the frames before: holes in these, a column through the spot among them,
    are filled by the frequencies that optics let through; slopes of the background do not go with the spot.
    """
    seeds = range(28, 32) if kind == "bad pixels" else range(2)
    found, told = squares(bench, () if kind == "clean" else (kind,), seeds, learnt=True)
    assert found.sum() < chi2.isf(1e-6, 2 * len(found))
    # the noise of the shape is no other shape
    assert all(spot.fits for spots in told for spot in spots)


@pytest.mark.second
@pytest.mark.parametrize(("kind", "sets"), [("saturation", 12), ("reflection", 4), ("vibration", 3)])
def test_what_the_frames_before_hold_stands_in_the_sigma_of_a_learnt_shape(bench, kind, sets):
    """Where the middle of a brighter spot is left out the noise of the shape counts for more than that of the image
    that it is from; a reflection or a smear of the frames before goes with the shape, and is missing in those after.
    """
    found, told = squares(bench, (kind,), range(40, 40 + sets), learnt=True)
    assert found.sum() < chi2.isf(1e-4, 2 * sets)
    assert all(spot.fits for spots in told for spot in spots)
    for before, after in told:
        if kind == "reflection":
            assert any("in the frames before but not here" in one.text for one in after.findings)
        if kind == "vibration":
            assert any(one.text.endswith("relative to the frames before") for one in after.findings)
            assert not any(one.kind == "smear" for one in before.findings)


@pytest.mark.second
def test_another_spot_is_told_with_a_learnt_shape_as_well(bench):
    """The test of the core still finds what is no noise: a spot after of 1.1 px more smear."""
    template, detector, noise = bench
    rng = np.random.default_rng(5)
    scenes = [clean_scene((47.0, 48.0), template.shape) for _ in range(2)]
    scenes[1].smear = 1.2 * np.eye(2)
    pattern = detector.fixed_pattern(template.shape, 3)
    before, after = (record(scene, template, detector, pattern, rng) for scene in scenes)
    with one_blas_thread():
        work = measurement(Drawn(before, after, np.zeros(2)), template, noise, shape=None)
        assert work.search() == []
        assert work.measure() == []
    assert not work.result().after[0].fits


@pytest.mark.second
def test_frames_of_another_noise_than_stated_are_told(bench):
    """The ratio is that of the noises beside the spot; the right one is left alone, also with few frames of a small
    part, and dirt is not taken for it.
    """
    template, detector, noise = bench
    drawn = draw(template, detector, (), 4)
    stated = replace(noise, dark_noise_e=0.6 * noise.dark_noise_e)
    own, other = (float(one.temporal_variance_dn2(one.dark_level_dn, 1)) for one in (noise, stated))
    found = noise_ratio(drawn.before, stated)
    # rings have shot noise, which is stated right
    assert found == pytest.approx(np.sqrt(own / other), rel=0.1)
    assert noise_ratio(drawn.before, replace(noise, dark_noise_e=2.0 * noise.dark_noise_e)) < 0.6
    for frames in (drawn.before, drawn.before[:2], drawn.before[:3, 30:66, 30:66], drawn.before[:1]):
        assert noise_ratio(frames, noise) is None
    for kind in KINDS:
        dirty = draw(template, detector, (kind,), 1000)
        assert noise_ratio(dirty.before, noise) is None
        assert noise_ratio(dirty.after, noise) is None


@pytest.mark.second
@pytest.mark.parametrize("learnt", [True, False])
def test_four_times_the_noise_is_noise(bench, learnt):
    """It was refused as frames that are unlike each other, or was told as a spot of another shape: defocus. No frame,
    no pixel and no shape is to blame, and sigma is that of the frames' own noise.
    """
    template, detector, noise = bench
    noisy = replace(detector, dark_noise_e=4.0 * noise.dark_noise_e)
    total, widened = 0.0, []
    with one_blas_thread():
        for seed in range(4):
            drawn = draw(template, noisy, (), seed)
            work = measurement(drawn, template, noise, shape=None if learnt else template)
            assert work.search() == []
            assert work.measure() == []
            assert not work.plain
            for spot in (work.result().before, work.result().after[0]):
                # of all noise, of which that of the light and the converter is as stated
                assert 3.4 < spot.noise_ratio < 4.0
                assert spot.fits
                assert not {finding.kind for finding in spot.findings} & {
                    "cosmic rays",
                    "corrupted frames",
                    "bad pixels",
                }
            error = (work.positions[1].position - work.positions[0].position)[0] - drawn.shift
            total += float(error @ np.linalg.solve(work.shift_covariance(1)[0], error))
            widened.append(work.shift_covariance(1)[0, 0, 0])
    assert total < chi2.isf(1e-6, 8)
    told = replace(noise, dark_noise_e=4.0 * noise.dark_noise_e)
    right = measurement(draw(template, noisy, (), 0), template, told, shape=None if learnt else template)
    assert right.search() == right.measure() == []
    # sigma is that of frames whose noise is stated as it is; these frames tell its square to 2 %: five times that
    assert widened == pytest.approx([right.shift_covariance(1)[0, 0, 0]] * 4, rel=0.1)


# name -> sets of each kind, centroid, whether the shape is learnt, and the kinds
SAMPLES = {
    "known": (6, "ml", False, [(), *((kind,) for kind in STANDING), STANDING]),
    "learnt": (4, "ml", True, [(), *((kind,) for kind in STANDING if kind != "saturation")]),
    "gaussian": (6, "gaussian", False, [(), *((kind,) for kind in ("bad pixels", "background", "reflection"))]),
    "energy": (6, "energy", False, [(), *((kind,) for kind in ("bad pixels", "background", "reflection"))]),
}


@pytest.mark.second
@pytest.mark.parametrize("sample", SAMPLES)
def test_corrected_estimates_hold_their_sigmas(bench, sample):
    """Chi-square of all kinds together within limits of the sample's size, and no set far out; nothing refused."""
    sets, centroid, learnt, every = SAMPLES[sample]
    found = []
    for kinds in every:
        square, told = squares(bench, kinds, range(sets), centroid, learnt)
        found.append(square)
        assert not learnt or all(spot.fits for spots in told for spot in spots), kinds
        assert learnt or set(kinds) - {"other light"} or all(spot.clean for spots in told for spot in spots), kinds
    total = np.concatenate(found)
    low, high = (chi2.isf(p, 2 * len(total)) for p in (1.0 - FALSE_ALARM / 2.0, FALSE_ALARM / 2.0))
    assert low < total.sum() < high, [one.sum() for one in found]
    assert total.max() < chi2.isf(FALSE_ALARM / len(total), 2)


@pytest.mark.second
def test_movement_between_frames_holds_its_sigma(bench):
    """Of a covariance that is known from nine frames the mean square over it is 1, with heavier tails than chi-square:
    Hotelling's T^2 of the sum of two states lies between those of 8 and of 16 degrees of freedom.
    """
    found, _ = squares(bench, ("movement",), range(SETS))
    nu, p = 8, 2
    # mean of T^2 is p nu / (nu - p - 1), which the estimate divides out; variance of F(p, nu - p + 1) scaled likewise
    d2 = nu - p + 1
    relative = 2.0 * (p + d2 - 2) / (p * (d2 - 4))
    sigma = p * np.sqrt(relative / SETS)
    assert abs(found.mean() - p) < 3.3 * sigma
