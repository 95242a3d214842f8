"""The detector against the EMVA 1288 model that it claims to be, its Poisson numbers, and frames that lie in a file.

Every statistical limit is a two-sided chi-square (or normal) quantile with a false-alarm rate of 1e-6 per test.
"""

from __future__ import annotations

import re
from contextlib import nullcontext

import numpy as np
import pytest
import yaml
from scipy import stats
from scipy.special import gammainc, gammaincc

import twin.sensors.poisson_numbers as module
from analysis.spots.centroid import mean_frames
from scenes.specs.camera import BandSpec
from scenes.specs.detector import DetectorSpec
from scenes.specs.job import JobSpec
from scenes.specs.load import LIBRARY, load_detector
from scenes.specs.resolved import resolve_job
from scenes.yaml.errors import InputError
from tests.tiers import quick
from tests.twin.commands import invoke
from tests.twin.study_bench import REFUSED
from twin.framework import frame_store
from twin.framework.data_files import FrameFacts, preview_png, tiff
from twin.framework.frame_store import allocate_frames, in_file, largest_of, mean_of, release_memory, resident_bytes
from twin.main_job.render_job import render_job
from twin.render import app
from twin.sensors import area_detector
from twin.sensors.area_detector import (
    EmvaDetector,
    FixedOffsets,
    FixedPattern,
    ReadNoise,
    coarse_step_warnings,
    coarse_warnings,
)
from twin.sensors.line_ccd import Collection, LineCcd, Motion
from twin.sensors.poisson_numbers import SERIES_END, TABLE_END, poisson_pieces

FALSE_ALARM = 1e-6
SHEET = {
    "quantum_efficiency": 0.6,
    "system_gain_dn_per_e": 0.06,
    "dark_noise_e": 8.0,
    "dark_current_e_per_s": 20.0,
    "full_well_e": 60000.0,
    "prnu": 0.01,
    "dsnu_e": 5.0,
    "bit_depth": 12,
    "offset_dn": 64.0,
}


def detector(**changes):
    return EmvaDetector(**{**SHEET, **changes})


def counter(**changes):
    """A detector that writes down its electrons: one DN per electron, nothing else."""
    ideal = {"system_gain_dn_per_e": 1.0, "dark_noise_e": 0.0, "dark_current_e_per_s": 0.0, "offset_dn": 0.0}
    return detector(**{**ideal, "prnu": 0.0, "dsnu_e": 0.0, "bit_depth": 16, **changes})


def uniform(*shape):
    return FixedPattern(np.ones(shape), np.zeros(shape))


@pytest.mark.parametrize("photons", [0.0, 500.0, 60000.0])
def test_photon_transfer(photons):
    """Temporal mean and variance at three points of the photon transfer line, quantisation included.

    Read noise of 1 DN, so that 1/12 DN^2 for the quantisation holds to exp(-2 pi^2) = 3e-9 and not only to per cent.
    """
    sensor = detector(prnu=0.0, dsnu_e=0.0, dark_noise_e=16.0)
    frames = sensor.expose(np.full((48, 48), photons), uniform(48, 48), 200, 0.5, seed=5).astype(float)
    noise = sensor.noise_model(0.5)
    mean = sensor.expected_dn(np.full((1, 1), photons), 0.5)[0, 0]
    variance = noise.temporal_variance_dn2(mean, 1)
    count = frames.size
    assert abs(frames.mean() - mean) < stats.norm.isf(FALSE_ALARM / 2) * np.sqrt(variance / count)
    ratio = np.sum((frames - mean) ** 2) / variance
    assert stats.chi2.ppf(FALSE_ALARM / 2, count) < ratio < stats.chi2.isf(FALSE_ALARM / 2, count)


def test_the_response_differs_for_light_and_not_for_dark_current():
    """PRNU of 20%: a strong dark signal is even over the pixels, and no wider than its shot noise; light is not."""
    sensor = detector(dark_current_e_per_s=20000.0, prnu=0.2, dsnu_e=0.0, full_well_e=65000.0)
    pattern, nothing, exposure = sensor.fixed_pattern((64, 64), 2), np.zeros((64, 64)), 1.0
    assert np.ptp(sensor.expected_dn(nothing, exposure, pattern)) == 0.0
    noise = sensor.noise_model(exposure)
    dark = sensor.expose(nothing, pattern, 50, exposure, seed=4).astype(float).mean(axis=0)
    expected = 64.0 + 0.06 * 20000.0
    chi2 = np.sum((dark - expected) ** 2) / noise.temporal_variance_dn2(expected, 50)
    assert FALSE_ALARM / 2 < stats.chi2.sf(chi2, dark.size) < 1 - FALSE_ALARM / 2
    # light adds the pattern times the light alone, whatever the dark current
    lit = sensor.expose(nothing + 20000.0, pattern, 50, exposure, seed=5).astype(float).mean(axis=0)
    mean = expected + 0.06 * 0.6 * 20000.0 * pattern.gain
    chi2 = np.sum((lit - mean) ** 2 / noise.temporal_variance_dn2(mean, 50))
    assert FALSE_ALARM / 2 < stats.chi2.sf(chi2, lit.size) < 1 - FALSE_ALARM / 2


def test_same_seed_same_bits_whatever_the_threads_and_the_company():
    sensor = detector()
    photons = np.random.default_rng(0).uniform(0, 3e4, (3, 2, 40, 30))
    pattern = sensor.fixed_pattern((2, 40, 30), 1)
    one = sensor.expose(photons, pattern, 5, 0.1, seed=7, threads=1)
    assert one.shape == (3, 2, 5, 40, 30)
    assert one.dtype == np.uint16
    assert np.array_equal(one, sensor.expose(photons, pattern, 5, 0.1, seed=7, threads=3))
    assert np.array_equal(one[:1], sensor.expose(photons[:1], pattern, 5, 0.1, seed=7))
    assert np.array_equal(one, sensor.expose(photons, pattern, 5, 0.1, seed=np.random.SeedSequence(7)))
    other = sensor.expose(photons, pattern, 5, 0.1, seed=8)
    assert np.mean(one != other) > 0.9
    assert np.mean(one[:, :, 0] != one[:, :, 1]) > 0.9
    assert np.array_equal(sensor.fixed_pattern((2, 9, 9), 4).gain, sensor.fixed_pattern((2, 9, 9), 4).gain)


@pytest.mark.parametrize(
    ("full_well", "noise"),
    [(30_000.5, ()), (2e5, (FixedOffsets(2.0),)), (2e5, (ReadNoise(3.0),)), (2e5, (ReadNoise(3.0), ReadNoise(1.0)))],
)
def test_many_frames_in_pieces_have_the_same_bits(full_well, noise, monkeypatch):
    """Memory is bounded by drawing the noise of some frames after the other, of each term from a stream of its own."""
    ccd = detector(full_well_e=full_well, noise=noise)
    photons = np.geomspace(1.0, 4e5, 240).reshape(1, 12, 20)  # below, in and beyond the tables of Poisson numbers
    pattern = ccd.fixed_pattern((1, 12, 20), 3)
    whole = ccd.expose(photons, pattern, 7, 0.01, 5)
    assert ccd.frames_at_once(7, 240) == 7
    monkeypatch.setattr(area_detector, "_PIXELS_AT_ONCE", 500)
    monkeypatch.setattr(module, "_ROOM", 500)
    assert ccd.frames_at_once(7, 240) == 2
    np.testing.assert_array_equal(ccd.expose(photons, pattern, 7, 0.01, 5), whole)


def test_exposures_of_several_seeds_are_those_of_one_after_the_other() -> None:
    """Also where means beyond the expansion draw numbers in between, and whatever shares a seed."""
    ccd = detector(full_well_e=2e5, system_gain_dn_per_e=0.3)
    dim, huge = (np.geomspace(1e-3, high, 3 * 41 * 31).reshape(3, 41, 31) for high in (4e3, 4e5))
    photons, seeds = np.stack([dim, huge, 1.1 * dim, huge]), [5, 5, 6, 6]
    pattern = ccd.fixed_pattern((3, 41, 31), 3)
    alone = [ccd.expose(light, pattern, 7, 0.01, seed) for light, seed in zip(photons, seeds, strict=True)]
    np.testing.assert_array_equal(ccd.expose(photons, pattern, 7, 0.01, seeds), alone)
    with pytest.raises(ValueError, match="4 seeds for 3 exposures"):
        ccd.expose(photons[:3], pattern, 7, 0.01, seeds)


def test_well_and_converter_clip():
    full = counter(full_well_e=1000.0)
    frames = full.expose(np.full((32, 32), 1e5), uniform(32, 32), 2, 0.0, seed=1)
    assert np.all(frames == 1000)
    assert full.saturated(frames).pixels == 32 * 32
    narrow = detector(bit_depth=8, full_well_e=1e6)
    frames = narrow.expose(np.full((2, 32, 32), [[[1e5]], [[100.0]]]), uniform(32, 32), 2, 0.0, seed=1)
    assert np.all(frames[0] == 255)
    report = narrow.saturated(frames)
    assert report.pixels.tolist() == [1024, 0]
    assert report.any
    assert narrow.saturation_dn == 255
    # a pixel may be full four standard deviations of the noise below the well
    level = counter(full_well_e=1e4, dark_noise_e=100.0).saturated(np.zeros((2, 4, 4), np.uint16)).level_dn
    assert level == pytest.approx(counter().offset_dn + counter().system_gain_dn_per_e * (1e4 - 400.0))
    # dark noise below zero grey values is clipped, not wrapped around
    dark = detector(offset_dn=0.0, dark_noise_e=100.0).expose(np.zeros((32, 32)), uniform(32, 32), 2, 0.0, seed=1)
    assert dark.min() == 0
    assert dark.max() < 100


def test_expected_dn_by_hand():
    value = detector().expected_dn(np.array([[1000.0]]), 2.0)
    assert value[0, 0] == pytest.approx(64 + 0.06 * (600 + 40), rel=1e-14)


@pytest.mark.parametrize(("field", "value"), REFUSED["data_sheets"])
def test_impossible_data_sheets_name_the_field(field, value):
    with pytest.raises(ValueError, match=field):
        detector(**{field: value})


@pytest.mark.parametrize(("full_well", "first"), [(50000.0, "well"), (90000.0, "converter")])
def test_detector_and_data_sheet_saturate_at_one_level(full_well, first):
    one = detector(full_well_e=full_well)
    sheet = one._sheet
    assert one.saturation_dn == sheet.saturation_dn
    assert one.max_dn == sheet.max_dn == 4095
    assert (one.saturation_dn == one.max_dn) is (first == "converter")
    # in grey values and in electrons, to rounding
    assert one.offset_dn + one.system_gain_dn_per_e * sheet.saturation_e == pytest.approx(one.saturation_dn, rel=1e-15)
    # a dark current just above fills the pixels, and one just below does not
    for factor, fills in ((1.001, True), (0.999, False)):
        dark = sheet.model_copy(update={"dark_current_e_per_s": factor * sheet.saturation_e / 0.1})
        level = detector(full_well_e=full_well, dark_current_e_per_s=dark.dark_current_e_per_s)
        assert (level.expected_dn(np.zeros((1, 1)), 0.1)[0, 0] >= one.saturation_dn) == fills
        with pytest.raises(InputError, match="saturates") if fills else nullcontext():
            dark.check_exposure(0.1)


def test_impossible_exposures_are_explained() -> None:
    dark, even, sensor = np.zeros((4, 4)), uniform(4, 4), detector()
    for call, words in (
        (lambda: sensor.expose(dark - 1.0, even, 1, 0.1, 1), "photons"),
        (lambda: sensor.expose(np.full((4, 4), np.nan), even, 1, 0.1, 1), "photons"),
        (lambda: sensor.expose(np.full((4, 4), 1e13), even, 1, 0.1, 1), "photons"),
        (lambda: sensor.expose(np.zeros(4), even, 1, 0.1, 1), r"photons must be \(..., H, W\)"),
        (lambda: sensor.expose(np.zeros((5, 4)), even, 1, 0.1, 1), r"fixed pattern \(4, 4\) does not fit"),
        (lambda: sensor.expose(dark, even, 0, 0.1, 1), "frames must be an integer >= 1"),
        (lambda: sensor.expose(dark, even, 1, -0.1, 1), "exposure_s"),
        (lambda: sensor.expose(dark, even, 1, 0.1, -1), "seed must be an integer >= 0"),
        (lambda: sensor.expose(dark, even, 1, 0.1, 1, threads=0), "threads must be >= 1"),
        (lambda: sensor.saturated(np.zeros((4, 4), np.uint16)), r"frames must be \(..., frames, H, W\)"),
        (lambda: sensor.fixed_pattern((4,), 1), "shape must be"),
        (lambda: FixedPattern(np.ones((2, 2)), np.zeros((2, 3))), "must have one shape"),
        (lambda: FixedPattern(-np.ones((2, 2)), np.zeros((2, 2))), "gain must be finite and >= 0"),
        (lambda: Collection(0, 1e-3), "a collection needs one step or more"),
        (lambda: Motion.of([(0.0, 1.0)]), "oscillations have frequencies above zero"),
        (lambda: Motion.of(bands=[(2.0, 1.0, 1.0)]), "bands extend from a frequency to a higher one"),
    ):
        with pytest.raises(ValueError, match=words):
            call()


@pytest.mark.second
@pytest.mark.parametrize(("part", "key", "value", "message"), REFUSED["detectors_in_files"])
def test_detectors_that_cannot_work_are_told_by_file_and_line(tmp_path, part, key, value, message):
    """They were tracebacks, some of them after minutes."""
    files = {
        name: yaml.safe_load((LIBRARY / f"{name}.yaml").read_text())
        for name in ("instruments/gf7_pair", "detectors/monitor_ccd", "cameras/gf7")
    }
    instrument, sheet, camera = files.values()
    ccd = instrument["monitor"]["area_ccd"]
    {"area_ccd": ccd, "sheet": sheet, "band": camera["bands"]["P"]}[part][key] = value
    ccd["detector"] = "sheet.yaml"
    instrument["cameras"]["forward"]["camera"] = "camera.yaml"
    for name, data in (("instrument", instrument), ("sheet", sheet), ("camera", camera)):
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(data))
    (tmp_path / "job.yaml").write_text("instrument: instrument.yaml\n")
    done = invoke(app, tmp_path / "job.yaml", "--out", tmp_path / "run")
    assert done.exit_code == 2
    place = {"area_ccd": "instrument", "sheet": "sheet", "band": "camera"}[part]
    assert message in " ".join(done.output.split())
    assert re.search(rf"{place}\.yaml:\d+: ", done.output)
    assert not (tmp_path / "run").exists()


def test_a_line_ccd_knows_its_exposure():
    """32 stages of 0.35 ms: 11.2 ms; the data sheet's dark current may fill the well in no less."""
    band = {"pixels": 64, "pitch": "7 um", "spectrum": ["650 nm", "650 nm"], "detector": "any", "tdi": {"stages": 32}}
    spec = BandSpec.model_validate(band)
    assert spec.exposure == pytest.approx(11.2e-3)
    room = min(60000.0, (4095.0 - 64.0) / 0.06)
    sheet = DetectorSpec.model_validate({"name": "any", **SHEET, "dark_current_e_per_s": 0.99 * room / 11.2e-3})
    ccd, seed = LineCcd.from_specs(spec, sheet), np.random.SeedSequence(1)
    assert ccd.noise.dark_signal_e == pytest.approx(0.99 * room)
    with pytest.raises(ValueError, match="columns 60 to 67 reach beyond a line of 64 pixels"):
        ccd.expose(np.zeros((1, 8)), 60, ccd.pattern(seed), 1, seed)
    full = DetectorSpec.model_validate({"name": "any", **SHEET, "dark_current_e_per_s": 1.01 * room / 11.2e-3})
    with pytest.raises(InputError, match="dark current alone saturates"):
        LineCcd.from_specs(spec, full)


@pytest.mark.second
def test_coarse_grey_values_are_warned_of(backend):
    """By the data sheet alone: every one of the library is fine, 8 bits of the monitor's CCD are not."""
    for path in sorted((LIBRARY / "detectors").glob("*.yaml")):
        assert (
            coarse_step_warnings(EmvaDetector.from_sheet(load_detector(path.stem), 0.01).noise_model(0.01), "it") == ()
        )
    fine = resolve_job(JobSpec(instrument="gf7_pair"))
    assert coarse_warnings(fine) == ()
    few_bits = {"system_gain_dn_per_e": 0.0025, "bit_depth": 8, "offset_dn": 3.0}
    coarse = fine.model_copy(update={"detector": fine.detector.model_copy(update=few_bits)})
    (text,) = coarse_warnings(coarse)
    assert "area CCD monitor_ccd has coarse grey values: its noise is 0.092 DN" in text
    assert text in render_job(coarse, backend).warnings
    assert coarse_warnings(fine.detector) == ()


LAST = np.uint64(2**64 - 1)


def generator(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.SFC64(seed))


def words(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.integers(0, LAST, shape, dtype=np.uint64, endpoint=True)


def poisson_quantile(mean: np.ndarray, word: np.ndarray) -> np.ndarray:
    out = np.empty(word.shape)
    module._Plan.of(mean).fill(out, word)
    return out


def is_quantile(number: np.ndarray, mean: np.ndarray, word: np.ndarray) -> np.ndarray:
    """Whether F(n - 1) < u <= F(n), by SciPy's functions alone; the upper half of u by the upper tail."""
    upper = word > np.uint64(2**63 - 1)
    tail = (np.where(upper, LAST - word, word).astype(float) + 0.5) / 2.0**64

    def reached(k: np.ndarray) -> np.ndarray:
        return np.where(upper, gammainc(k + 1.0, mean) <= tail, gammaincc(k + 1.0, mean) >= tail)

    return reached(number) & ((number == 0.0) | ~reached(np.maximum(number - 1.0, 0.0)))


@pytest.mark.second
@pytest.mark.parametrize(
    ("low", "high"), quick(2, [(0.5, 8.0), (TABLE_END, 300.0), (1e-6, 0.5), (8.0, TABLE_END), (300.0, SERIES_END)])
)
def test_every_number_is_the_quantile(low, high) -> None:
    """Table, interpolation and expansion never decide otherwise than the distribution function, out to u = 2^-60."""
    rng = np.random.default_rng(3)
    mean = np.minimum(low * (high / low) ** rng.random(20_000), np.nextafter(high, 0.0))
    word = words(rng, (9, mean.size))
    for k, shift in enumerate((10, 20, 30, 40)):
        word[2 * k] >>= np.uint64(shift)
        word[2 * k + 1] = LAST - (word[2 * k + 1] >> np.uint64(shift))
    number = poisson_quantile(mean, word)
    assert np.array_equal(number, np.floor(number))
    assert is_quantile(number, mean, word).all()
    # the check sees a number that is one off
    assert not is_quantile(number + 1.0, mean, word).any()


def test_edges_of_the_cells() -> None:
    """Means on the table's own, just below and above, u at the first and last of each of its cells."""
    steps = np.concatenate([np.arange(0, 33) / 32.0, np.arange(1, 33), [TABLE_END, 1000.0, SERIES_END - 1.0]])
    mean = np.concatenate([steps, np.nextafter(steps, 1e9), np.nextafter(steps[1:], 0.0)])
    edge = np.arange(1024, dtype=np.uint64) << np.uint64(54)
    word = np.concatenate([edge, edge + np.uint64(2**54 - 1)])[:, None].repeat(mean.size, axis=1)
    number = poisson_quantile(mean, word)
    assert is_quantile(number, mean, word).all()
    assert np.all(np.diff(number[np.argsort(word[:, 0], kind="stable")], axis=0) >= 0)
    assert np.all(np.diff(number[:, np.argsort(mean, kind="stable")], axis=1) >= 0)
    assert np.all(number[:, mean == 0.0] == 0.0)


@pytest.mark.parametrize("kind", [np.random.SFC64, np.random.MT19937])
def test_mixed_means_are_independent_and_each_has_its_own(kind) -> None:
    """All ways of one call, also of a generator whose words have 32 bits: means, variances, and neighbours, frames and
    means that do not know of each other."""
    mean = np.array([0.0, 1e-4, 0.5, 7.0, 31.0, 33.0, 900.0, 7e4, 3e5])
    (number,) = poisson_pieces(mean, 200_000, np.random.Generator(kind(2)), 200_000)
    assert np.all(number[:, 0] == 0.0)
    assert 3 <= np.count_nonzero(number[:, 1]) <= 48  # of 20: 1e-6 on either side
    scaled = (number[:, 2:] - mean[2:]) / np.sqrt(mean[2:])
    within = 5.0 / np.sqrt(len(scaled))  # 6e-7 for each of the 42 numbers
    assert np.all(np.abs(scaled.mean(axis=0)) < within)
    between = scaled.T @ scaled / len(scaled)
    assert np.all(np.abs(np.diag(between) - 1.0) < within * np.sqrt(2.0 + 1.0 / mean[2:]))
    assert np.all(np.abs(between - np.diag(np.diag(between))) < within)
    later = scaled[1:].T @ scaled[:-1] / (len(scaled) - 1)
    assert np.all(np.abs(later) < within)


SENSOR = detector()


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hardly anything is kept in memory."""
    monkeypatch.setattr(frame_store, "IN_MEMORY", 1000)
    monkeypatch.setattr(frame_store, "PART", 20_000)


def exposed(frames: int, threads: int | None = None, images: int = 3) -> np.ndarray:
    light = np.random.default_rng(2).uniform(0.0, 4000.0, (images, 24, 32))
    pattern = SENSOR.fixed_pattern((images, 24, 32), 5)
    return SENSOR.expose(light, pattern, frames, 0.1, 7, threads)


def test_frames_in_a_file_are_those_in_memory(small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = 43
    stored = exposed(frames)
    monkeypatch.setattr(frame_store, "IN_MEMORY", 1 << 28)
    kept = exposed(frames)
    assert in_file(stored)
    assert in_file(stored[1, 3])
    assert not in_file(kept)
    release_memory(stored)
    release_memory(kept)
    np.testing.assert_array_equal(stored, kept)
    np.testing.assert_array_equal(mean_of(stored), mean_frames(kept))
    np.testing.assert_array_equal(mean_of(stored), kept.mean(axis=-3))  # as pictures have it: all sums are exact
    np.testing.assert_array_equal(largest_of(stored), kept.max(axis=-3))
    np.testing.assert_array_equal(SENSOR.saturated(stored).pixels, SENSOR.saturated(kept).pixels)
    facts = FrameFacts("a camera", 5e-6, 1e-3)
    assert bytes(tiff(stored[1], facts)) == tiff(kept[1], facts)
    assert preview_png(stored[2]) == preview_png(kept[2])


def test_a_full_disk_is_said_before(small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(file: int, start: int, size: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(frame_store.os, "posix_fallocate", full)
    with pytest.raises(OSError, match="GB of frames do not fit on the disk"):
        allocate_frames((2, 100, 30, 30))


def test_what_lies_in_a_file_takes_no_memory() -> None:
    assert resident_bytes(1e6) == 1e6
    assert resident_bytes(1e12) == resident_bytes(5e9) < 0.2e9
