"""python -m twin.recover: the closed loop through files, other kinds of files, series, geometry, refusals.

Filter and smoother of a series are those of the main job's course.
"""

import errno
import shutil
import struct
import zlib
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import tifffile
from astropy.io import fits
from PIL import Image

from analysis.images.image_file import recording_origin
from analysis.spots.noise import NoiseModel
from analysis.spots.spot_image import SpotError
from optics.geometry.tree import State
from scenes.specs.job import JobSpec
from scenes.specs.monitor_frames import MeasurementSetup
from scenes.specs.resolved import ResolvedJob, resolve, resolve_job
from scenes.yaml.errors import InputError, Issue
from tests.tiers import quick
from tests.twin.commands import invoke
from tests.twin.study_bench import REFUSED, ROOT
from twin.framework.data_files import FrameFacts, tiff
from twin.main_job.monitor_reading import rounded
from twin.main_job.render_job import render_job
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.time_series import TimeSeries, run_series, series_states
from twin.recover import measured_frames, recover_run
from twin.recover.__main__ import app
from twin.recover.channel_measurement import ChannelMeasurement
from twin.recover.measured_frames import ChannelFrames, StateFrames, order_warnings
from twin.recover.recover_report import recover_report
from twin.recover.recover_run import RecoverRun, recover_numbers, run_recover

JOB = ROOT / "scenes/examples/perturb.yaml"
HEAD = "instrument: gf7_pair\ndisturbances: launch\n"


@pytest.fixture(scope="module")
def run(backend):
    return render_job(resolve(JOB), backend)


@pytest.fixture(scope="module")
def images(run, tmp_path_factory):
    """A folder of frames as twin.render writes them."""
    folder = tmp_path_factory.mktemp("run") / "images"
    folder.mkdir()
    for i, channel in enumerate(run.experiment.path.channels):
        for when, frames in (("before", run.before[i]), ("after", run.after[i])):
            (folder / f"{channel.camera}_{channel.name}_{when}.tiff").write_bytes(tiff(frames, FrameFacts()))
    return folder


def measured(folder, text, backend, run, name="measurement.yaml"):
    """Of the instrument that the run has built."""
    file = folder / name
    file.write_text(text)
    return run_recover(MeasurementSetup.read(file), backend, experiment=run.experiment)


def test_rendered_frames_give_the_main_jobs_numbers_to_the_last_digit(run, images, backend):
    found = measured(images.parent, HEAD + "frames: images\n", backend, run)
    assert all(spot.clean for channel in found.channels for _, spot in channel.states())
    numbers, expected = recover_numbers(found), rounded(run.recovered_dict())
    assert {key: numbers[key] for key in expected} == expected
    assert found.last.recovered_dict() == run.recovered_dict()
    assert "The frames are clean." in recover_report(found).lead


@pytest.mark.second
def test_crops_other_counts_and_a_series(run, images, backend, tmp_path):
    """Parts of the CCD with their offsets, fewer frames after, three times of which the middle one is the state before:
    shifts agree with those of the whole frames within what the left out rings and frames say.
    """
    text = HEAD + "times: [0 min, 10 min, 20 min]\nframes:\n"
    for channel in run.experiment.path.channels:
        key = f"{channel.camera}_{channel.name}"
        before, after = (tifffile.imread(images / f"{key}_{when}.tiff") for when in ("before", "after"))
        tifffile.imwrite(tmp_path / f"{key}_b.tif", before[:, 10:86, 8:90], photometric="minisblack")
        for name, frames in (("a0", after[:4]), ("a1", before), ("a2", after[4:])):
            tifffile.imwrite(tmp_path / f"{key}_{name}.tif", frames[:, 6:92, 4:92], photometric="minisblack")
        files = ", ".join(f"{key}_{name}.tif" for name in ("a0", "a1", "a2"))
        text += f"  {channel.key}: {{before: {key}_b.tif, after: [{files}], offset: [10, 8], offset_after: [6, 4]}}\n"
    found = measured(tmp_path, text, backend, run)
    assert found.times == (0.0, 600.0, 1200.0)
    whole = run.recovery
    for k, frames in ((0, 4), (2, 5)):
        r = found.readings[k].recovery
        # the frames are the same or some of them: what differs is at most the noise of one measurement
        np.testing.assert_array_less(np.abs(r.after - whole.after), 4.0 * whole.sigma_after)
        assert np.all(r.sigma_after > 0.999 * whole.sigma_after)
        assert found.readings[k].frames == frames
    middle = found.readings[1].recovery
    np.testing.assert_allclose(middle.shift, 0.0, atol=2e-3)
    assert recover_numbers(found)["times_s"] == [0.0, 600.0, 1200.0]
    assert len(recover_numbers(found)["series"]) == 3


@pytest.mark.second
def test_frames_of_different_sizes_say_where_they_begin(run, images, backend, tmp_path):
    """Frames before and after that begin at other pixels of the CCD read as a shift of the spot; so do the times of a
    series with one offset.
    """
    small, channel = tmp_path / "small.tif", run.experiment.path.channels[0]
    key = f"{channel.camera}_{channel.name}"
    after = tifffile.imread(images / f"{key}_after.tiff")
    tifffile.imwrite(small, after[:, 8:88, 8:88], photometric="minisblack")
    names = {c.key: f"{images}/{c.camera}_{c.name}" for c in run.experiment.path.channels[1:]}
    others = "".join(f"  {k}: {{before: {n}_before.tiff, after: {n}_after.tiff}}\n" for k, n in names.items())
    before = f"{images}/{key}_before.tiff"

    def text(more, files="small.tif"):
        return f"{HEAD}frames:\n  {channel.key}: {{before: {before}, after: {files}{more}}}\n{others}"

    for more in ("", ", offset: [0, 0]"):
        with pytest.raises(InputError, match="their offset is not specified"):
            measured(tmp_path, text(more), backend, run)
    found = measured(tmp_path, text(", offset_after: [8, 8]"), backend, run)
    np.testing.assert_allclose(found.last.recovery.after, run.recovery.after, atol=0.01)


@pytest.mark.second
def test_without_an_instrument_its_geometry_and_a_learnt_shape_will_do(run, images, backend):
    """The formulas with the three numbers that a data sheet has, and the spot's shape from its own frames."""
    text = "template: measured\ndetector: monitor_ccd\nexposure: 10 ms\nframes: images\ngeometry:\n"
    for name, camera in run.experiment.cameras.items():
        g = camera.geometry
        look = np.degrees(camera.look_rad)
        text += (
            f"  {name}: {{principal_distance: {g.principal_distance_m:.9f} m, separation: {g.separation_m:.9f} m, "
            f"pitch: 12 um, look: {look:.6f} deg, field: {np.degrees(g.field_beta_rad):.6f} deg}}\n"
        )
    found = measured(images.parent, text, backend, run, "geometry.yaml")
    whole, r = run.recovery, found.last.recovery
    shift, sigma = r.shift - whole.shift, np.sqrt(np.diagonal(whole.shift_covariance, axis1=1, axis2=2))
    # both shifts are of the same frames; that of the learnt shape has less to go by, the noise of one image more
    np.testing.assert_array_less(np.abs(shift), 3.0 * sigma)
    own = np.sqrt(np.diagonal(r.shift_covariance, axis1=1, axis2=2))
    np.testing.assert_array_less(sigma, 1.2 * own)
    np.testing.assert_array_less(own, 1.5 * sigma)
    assert list(found.last.estimators) == ["paper_single", "paper_joint", "derived", "model"]
    # motions of the prisms look like changes of the cameras: many sigmas of noise beside the truth
    numbers, report = recover_numbers(found), recover_report(found)
    assert numbers["sigma_holds"] is False
    assert "motions of the monitor's own parts" in numbers["doubts"][0]
    assert sum("motions of the monitor's own parts" in text for text in report.warnings) == 1
    assert "exceed" not in report.verdict
    assert "in σ" not in report.summary.heads
    for name in run.experiment.cameras:
        one, other = whole.parameters[name]["paper_single"], r.parameters[name]["paper_single"]
        np.testing.assert_array_less(np.abs(one.vector - other.vector), 3.0 * np.sqrt(2.0) * one.sigma_noise)


@pytest.mark.second
def test_dark_and_flat_frames_take_the_pattern_off(run, images, backend, tmp_path):
    """Corrected frames of spots that moved by many pixels have less noise of pattern; photon transfer gives the data
    sheet.
    """
    detector, seed = run.experiment.detector, run.seed
    pattern = run.experiment.pattern(seed)
    exposure = run.experiment.exposure
    shape = (len(run.experiment.path.channels), *run.experiment.path.shape)
    dark = detector.expose(np.zeros(shape), pattern, 40, exposure, 71)
    level = 0.5 * detector.full_well_e / detector.quantum_efficiency
    flat = detector.expose(np.full(shape, level), pattern, 40, exposure, 72)
    text = HEAD + f"frames: {images}\nphoton_transfer: measured\n"
    for what, frames in (("dark", dark), ("flat", flat)):
        text += f"{what}:\n"
        for i, channel in enumerate(run.experiment.path.channels):
            name = f"{what}_{channel.camera}_{channel.name}.fits"
            fits.PrimaryHDU(frames[i]).writeto(tmp_path / name)
            text += f"  {channel.key}: {name}\n"
    found = measured(tmp_path, text, backend, run)
    sheet = detector
    for result in found.channels:
        t = result.channel.transfer
        # 4.5 sigma: once in 1e4 for 16 numbers
        assert abs(t.gain_dn_per_e - sheet.system_gain_dn_per_e) < 4.5 * t.gain_sigma
        dark_noise = np.hypot(sheet.dark_noise_e, np.sqrt(sheet.dark_current_e_per_s * exposure))
        assert abs(t.dark_noise_e - dark_noise) < 4.5 * t.dark_noise_sigma
        assert abs(t.prnu - sheet.prnu) < 4.5 * t.prnu_sigma
        assert abs(t.dsnu_e - sheet.dsnu_e) < 4.5 * t.dsnu_sigma
        assert t.gain_sigma < 0.01 * t.gain_dn_per_e
    moved = slice(4, 8)  # the backward camera's spots moved by 10 pixels
    own = np.sqrt(np.diagonal(found.last.recovery.shift_covariance[0]))[moved]
    without = np.sqrt(np.diagonal(run.recovery.shift_covariance[0]))[moved]
    assert np.all(own < 0.9 * without)
    # their difference is at most the pattern's part, which the corrected ones are free of
    away = np.abs(found.last.recovery.shift - run.recovery.shift)[0, moved]
    assert np.all(away < 4.0 * np.sqrt(without**2 - own**2) + own)


def spoilt(folder, images, name, change):
    """A copy of the frames with one file changed."""
    shutil.copytree(images, folder / "images")
    path = folder / "images" / name
    frames = tifffile.imread(path)
    changed = change(frames.copy())
    tifffile.imwrite(path, changed, photometric="rgb" if changed.ndim > 3 else "minisblack")


def no_spot(frames):
    frames[:] = 100
    return frames


def at_the_edge(frames):
    return np.roll(frames, -34, axis=2)


def half_dark(frames):
    frames[:6] = 100
    return frames


def burnt(frames):
    """Ten thousand times the light: shot noise of the data sheet's gain, a well that is full at 16100."""
    light = 1e4 * np.maximum(frames.mean(axis=0) - 100.0, 0.0)
    level = 100.0 + np.random.default_rng(1).normal(light, np.sqrt(0.16 * light + 4.0), frames.shape)
    return np.clip(level, 0, 16100).astype(np.uint16)


@pytest.mark.parametrize(
    ("change", "problem", "remedy"),
    quick(
        9,
        [
            (no_spot, "no spot", "the correct file, with the light on"),
            (at_the_edge, "too near the edge", "at least 10 pixels from the edge"),
            (half_dark, "6 of 9 frames contain less than half of the light", "with the light on"),
            (burnt, "too much of the spot is missing (saturation", "less light"),
            (lambda f: f[:, :20], "frames of 20 x 96 pixels", "at least 24 rows and columns"),
            (
                lambda f: np.pad(f, ((0, 0), (0, 9), (0, 0))),
                "do not lie on the CCD of 96 x 96 pixels",
                "with its offset",
            ),
            (
                lambda f: f[:, 16:, 16:],
                "frames of 80 x 80 pixels are not of the size of",
                "offset_after: [ROW, COLUMN]",
            ),
            (lambda f: f * 4, "all multiples of 4; the converter of monitor_ccd", "divided by 4"),
            (lambda f: np.where(f == f.max(), 16384, f), "grey values up to 16384", "the correct `detector`"),
            (lambda f: np.stack([f, f, f], -1), "colours", "raw frames of a CCD"),
            (lambda f: np.where(f == f.max(), 1e30, f), "grey values up to 1e+30", "at most 4.29497e+09"),
        ],
    ),
)
def test_frames_that_cannot_be_used_are_refused_by_name(run, images, backend, tmp_path, change, problem, remedy):
    spoilt(tmp_path, images, "backward_right_after.tiff", change)
    with pytest.raises(InputError) as error:
        measured(tmp_path, HEAD + "frames: images\n", backend, run)
    told = str(error.value)
    assert problem in told
    assert remedy in told
    assert "backward_right_after.tiff" in told
    assert "measurement.yaml:3: frames.backward/right.after" in told


def test_dark_and_flat_frames_that_cannot_be_used(run, images, backend, tmp_path):
    for name, size in (("small", 20), ("even", 96)):
        tifffile.imwrite(tmp_path / f"{name}.tif", np.full((2, size, size), 100, np.uint16), photometric="minisblack")
    for more, problem in (
        ("dark: small.tif", "dark.all: .*small.tif has frames of 20 x 20 pixels"),
        ("dark: even.tif\nflat: even.tif", "flat: the flat frames are only 0 DN brighter than the dark ones"),
    ):
        with pytest.raises(InputError, match=problem):
            measured(tmp_path, f"{HEAD}frames: {images}\n{more}\n", backend, run)


def test_copies_are_refused_with_the_frames_that_they_are_of(run, images, backend, tmp_path):
    """The frames before as those after, in a file of another type, too, gave 0 +- sigma without a word; so does a frame
    that stands twice in one state, whose noise would count as two.
    """
    before = tifffile.imread(images / "backward_right_before.tiff")
    folder = tmp_path / "images"
    shutil.copytree(images, folder)
    (folder / "backward_right_after.tiff").unlink()
    fits.PrimaryHDU(before[3:].astype(np.float32)).writeto(folder / "backward_right_after.fits")
    words = r"yaml:3: frames.backward/right.after: frame 1 of \S+ in \S+after.fits is frame 4 of \S+before.tiff"
    with pytest.raises(InputError, match=words):
        measured(tmp_path, HEAD + "frames: images\n", backend, run)
    spoilt(tmp_path / "twice", images, "forward_left_before.tiff", lambda f: np.concatenate([f, f[4:5]]))
    with pytest.raises(InputError, match=r"frame 10 of forward/left in \S+ is frame 5 of"):
        measured(tmp_path / "twice", HEAD + "frames: images\n", backend, run)


def states(tmp_path, dates, **more):
    """One channel, its states before and after with files of these dates; nothing in them is measured."""
    found = []
    for k, date in enumerate(dates):
        unit = fits.PrimaryHDU(np.zeros((2, 24, 24), np.uint16))
        unit.header.update({"DATE-OBS": date, **(more if "T" not in date else {})})
        path = tmp_path / f"{k}.fits"
        unit.writeto(path, overwrite=True)
        found.append(StateFrames((str(path),), unit.data, (0, 0), ("frames",), (recording_origin(path),)))
    noise = NoiseModel(0.16, 12.0, 0.0, 100.0, 0.0, 0.0, 16000.0)
    return ChannelFrames("forward/left", (24, 24), found[0], tuple(found[1:]), None, None, None, noise, noise)


@pytest.mark.parametrize(
    ("dates", "told"),
    [
        (["2026-03-01T10:00:00", "2026-03-01T10:30:00.5"], ""),
        (["2026-03-02T00:10:00", "2026-03-01T23:50:00"], "before and after seem to be exchanged (forward/left)"),
        (["2026-03-02", "2026-03-01"], ""),  # the day alone
        (["2026-03-01T10:00:00", "2026-03-01T10:30:00", "2026-03-01T11:00:00"], ""),
        (["2026-03-01T10:00:00", "2026-03-01T11:00:00", "2026-03-01T10:30:00"], "an order that differs from `times`"),
        (["2026-03-01T12:00:00", "2026-03-01T10:00:00", "2026-03-01T11:00:00"], "exchanged"),
        (["2026-03-01T10:30:00", "2026-03-01T10:00:00", "2026-03-01T11:00:00"], ""),  # a nominal state between others
    ],
)
def test_another_order_is_told_where_the_files_say_when_they_were_recorded(tmp_path, dates, told):
    times = None if len(dates) == 2 else (0.0, 1800.0)
    found = order_warnings([states(tmp_path, dates)], times)
    assert len(found) == bool(told)
    assert told in "".join(found)


def test_one_file_without_a_time_says_nothing(tmp_path):
    channel = states(tmp_path, ["2026-03-02T00:10:00", "2026-03-01T23:50:00"])
    silent = replace(channel.before, origin=(*channel.before.origin, (None, "")))
    assert order_warnings([replace(channel, before=silent)], None) == ()
    # files of the main job say which they are
    late, early = (replace(channel.before, origin=((None, note),)) for note in ("perturbed", "nominal"))
    (warning,) = order_warnings([replace(channel, before=late, after=(early,))], None)
    assert "before and after seem to be exchanged" in warning
    assert order_warnings([replace(channel, before=early, after=(late,))], None) == ()
    # two keywords of older files
    dated = states(tmp_path, ["2026-03-02", "2026-03-01"], **{"TIME-OBS": "08:00:00"})
    assert len(order_warnings([dated], None)) == 1


def test_a_tiff_says_when_it_was_recorded_in_exif(tmp_path):
    """As cameras write it; the time at which a file was written says nothing."""
    path = tmp_path / "frame.tif"
    image = Image.fromarray(np.full((24, 24), 7, np.uint16))
    image.save(path, tiffinfo={306: "2026:03:01 10:00:00"})
    assert recording_origin(path) == (None, "")
    image.save(path, tiffinfo={34665: {36867: "2026:03:01 10:00:07", 37521: "25"}})
    assert recording_origin(path)[0] == datetime(2026, 3, 1, 10, 0, 7, 250000, tzinfo=UTC)
    path.write_bytes(tiff(np.full((2, 24, 24), 7, np.uint16), FrameFacts(note="nominal")))
    assert recording_origin(path) == (None, "nominal")


call = partial(invoke, app, terminal_width=200)


PLAIN = "forward/left: {before: a.tif, after: b.tif}"


@pytest.mark.parametrize(("text", "told"), REFUSED["measurement_files"])
def test_bad_measurement_files(images, tmp_path, text, told):
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad.csv").write_text("channel,when,file\nforward/lft,before,x.tif\n")
    (tmp_path / "heads.csv").write_text("channel,wen,file\n")
    (tmp_path / "images").symlink_to(images)
    (tmp_path / "measurement.yaml").write_text(text.replace("HEAD\n", HEAD))
    result = call(tmp_path / "measurement.yaml", "--out", tmp_path / "out")
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    for part in told:
        assert part in result.stderr
    assert not (tmp_path / "out").exists()
    assert "Traceback" not in result.stderr


def test_a_missing_file_is_missing_though_there_is_a_picture_of_it(images, tmp_path):
    """The preview beside the frames holds eight bits of a stretched mean; a PNG with 16 bits is frames."""
    folder = tmp_path / "images"
    shutil.copytree(images, folder)
    for file in folder.glob("forward_left_after.*"):
        file.unlink()
    cv2.imwrite(str(folder / "forward_left_after.png"), np.full((32, 32), 7, np.uint8))
    (tmp_path / "measurement.yaml").write_text(HEAD + "frames: images\n")
    with pytest.raises(InputError) as caught:
        MeasurementSetup.read(tmp_path / "measurement.yaml")
    told = str(caught.value)
    assert "no frames of forward/left after" in told
    assert "forward_left_after.png is an 8-bit preview" in told
    assert "forward_left_after.tiff" in told
    cv2.imwrite(str(folder / "forward_left_after.png"), np.full((32, 32), 7, np.uint16))
    setup = MeasurementSetup.read(tmp_path / "measurement.yaml")
    assert setup.test.frames["forward/left"].after[0][0].endswith("forward_left_after.png")


def test_a_job_is_told_from_a_measurement(images, tmp_path):
    result = call(JOB, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert "this is a job of the monitor, which twin.recover does not read; python -m twin.render" in result.stderr


def test_files_that_are_no_raw_frames_are_refused(tmp_path):
    """Frames of two sizes in one state, an image that is stored turned, and a file that is not there."""
    for name, size in (("a", 30), ("b", 32)):
        tifffile.imwrite(tmp_path / f"{name}.tif", np.zeros((size, 30), np.uint16), photometric="minisblack")
    Image.fromarray(np.full((24, 24), 7, np.uint16)).save(tmp_path / "turned.tif", tiffinfo={274: 3})
    cv2.imwrite(str(tmp_path / "coded.png"), np.full((24, 24), 7, np.uint16))
    data = (tmp_path / "coded.png").read_bytes()
    chunk = b"sRGB\0"
    tone = struct.pack(">I", 1) + chunk + struct.pack(">I", zlib.crc32(chunk))
    (tmp_path / "coded.png").write_bytes(data[:33] + tone + data[33:])
    test = SimpleNamespace(error=lambda text, key, allowed=None: InputError(Issue(text, allowed=allowed)))
    for names, told in (
        (("a.tif", "b.tif"), "have frames of different sizes, 30 x 30 and 32 x 30"),
        (("turned.tif",), "is stored rotated or mirrored"),
        (("none.tif",), "there is no image"),
        (("coded.png",), "it is marked as sRGB, which is not linear in light"),
    ):
        with pytest.raises(InputError, match=told):
            measured_frames._stacked(test, tuple(str(tmp_path / name) for name in names), ("frames",))


@pytest.mark.parametrize("plain", [True, False])
def test_spots_that_cannot_be_measured_name_their_frames(run, images, backend, monkeypatch, plain):
    """Clean frames are measured together, state by state; others channel by channel."""

    def lost(*words, **how):
        raise SpotError({1 if plain else 0: "it is dark"})

    monkeypatch.setattr(recover_run, "recover_monitor", lost)
    monkeypatch.setattr(ChannelMeasurement, "_position", lost)
    monkeypatch.setattr(ChannelMeasurement, "plain", plain)
    with pytest.raises(InputError, match="it is dark") as caught:
        measured(images.parent, HEAD + "frames: images\n", backend, run)
    keys = [channel.key for channel in run.experiment.path.channels]
    issues = caught.value.issues
    expected = [keys[1]] if plain else [key for key in keys for _ in range(2)]
    assert [issue.problem.split()[3] for issue in issues] == expected
    assert all(issue.allowed and "images" in issue.problem for issue in issues)


def test_a_file_that_the_disk_does_not_give_is_told(tmp_path, monkeypatch):
    def broken(image):
        raise OSError(errno.EIO, "Input/output error")

    tifffile.imwrite(tmp_path / "a.tif", np.zeros((30, 30), np.uint16), photometric="minisblack")
    test = SimpleNamespace(error=lambda text, key, allowed=None: InputError(Issue(text, allowed=allowed)))
    measured_frames._stacked(test, (str(tmp_path / "a.tif"),), ("frames",))
    monkeypatch.setattr(measured_frames.ImageFile, "pages", broken)
    with pytest.raises(InputError, match=r"a\.tif: Input/output error; allowed: a readable file"):
        measured_frames._stacked(test, (str(tmp_path / "a.tif"),), ("frames",))


TIMES = ("0 min", "12 min", "0.5 h", "50 min")
FRAMES, SEED = 3, 7
COURSE = {
    "instrument": "gf7_pair",
    "disturbances": "orbit",
    "course": {
        "times": list(TIMES),
        "detail": "12 min",
        "temperature": {"base/forward": {"change": ["0 K", "0.08 K", "0.15 K", "0.05 K"]}},
        "motion": {
            "base/forward/M2": {
                "shift": [[f"{x} um", "0 um", f"{z} um"] for x, z in ((0, 0), (0.1, 0.2), (0.2, 0.3), (0.1, 0))]
            }
        },
    },
    "render": {"frames": FRAMES, "seed": SEED},
}


@dataclass
class Course:
    """The main job's course, and the frames that it was measured in as files."""

    job: ResolvedJob
    experiment: MonitorExperiment
    series: TimeSeries
    states: list[State]
    folder: Path

    def measured(self, backend, text: str, name: str = "series.yaml") -> RecoverRun:
        file = self.folder / name
        file.write_text(text)
        return run_recover(MeasurementSetup.read(file), backend, experiment=self.experiment)

    def text(self, times=TIMES, which=None, **other: str) -> str:
        """A measurement's file; other: channel -> file in place of that of the second time."""
        out = f"instrument: gf7_pair\ndisturbances: orbit\ntimes: [{', '.join(times)}]\nframes:\n"
        for channel in self.experiment.path.channels:
            stem = f"{channel.camera}_{channel.name}"
            files = [f"{stem}_{k}.tiff" for k in (range(len(times)) if which is None else which)]
            if stem in other:
                files[1] = other[stem]
            out += f"  {channel.key}: {{before: {stem}_before.tiff, after: [{', '.join(files)}]}}\n"
        return out


@pytest.fixture(scope="module")
def course(experiment, tmp_path_factory) -> Course:
    job = resolve_job(JobSpec.model_validate(COURSE))
    pair = experiment("gf7_pair").stating(job)
    states = series_states(pair, job.job)
    series = run_series(pair, job, states)
    folder = tmp_path_factory.mktemp("series")
    before = pair.frames_before(FRAMES, SEED)
    after = pair.frames_after(pair.path.expected_photons(states), FRAMES, SEED)
    for i, channel in enumerate(pair.path.channels):
        stem = f"{channel.camera}_{channel.name}"
        for name, frames in (("before", before[i]), *((k, after[k, i]) for k in range(len(states)))):
            tifffile.imwrite(folder / f"{stem}_{name}.tiff", frames, photometric="minisblack", compression="lzw")
    return Course(job, pair, series, states, folder)


def dicts(run_or_series) -> tuple:
    """All that the smoother says."""
    found = run_or_series.smoothed
    return found.changes.groups(), found.between_dict(), found.to_dict()


@pytest.mark.second
def test_the_smoothed_series_is_the_main_jobs_to_the_last_bit(course, backend):
    found = course.measured(backend, course.text())
    assert dicts(found) == dicts(course.series)
    for k, reading in enumerate(found.readings):
        np.testing.assert_array_equal(reading.recovery.shift[0], course.series.shift[k])
        np.testing.assert_array_equal(reading.recovery.shift_covariance[0], course.series.shift_covariance[k])
    numbers = recover_numbers(found)
    written = course.series.to_dict()
    for name, every in numbers["smoothed"]["cameras"].items():
        for estimator in ("filtered", "smoothed"):
            assert every[estimator] == written["cameras"][name][estimator]
    assert numbers["smoothed"]["between"] == written["between"]
    assert numbers["smoothed"]["disturbances"] == written["disturbances"]
    # from the last time on nothing comes, so that both are one
    filtered, smoothed = (found.smoothed.changes.of(name)[:4] for name in ("filtered", "smoothed"))
    assert [row.value[-1] for row in filtered] == pytest.approx([row.value[-1] for row in smoothed], rel=1e-9)
    assert all(b.sigma[0] <= a.sigma[0] * (1.0 + 1e-9) for a, b in zip(filtered, smoothed, strict=True))
    assert recover_report(found).warnings == ()


@pytest.mark.second
def test_the_worst_time_is_told_wherever_it_is(course, backend):
    """The frames of the second time are those of a spot that nothing stated could have moved so."""
    frames = tifffile.imread(course.folder / "forward_left_1.tiff")
    tifffile.imwrite(course.folder / "moved.tiff", np.roll(frames, 14, axis=1), photometric="minisblack")
    found = course.measured(backend, course.text(forward_left="moved.tiff"))
    assert found.last.consistency.agrees
    assert found.worst[0] == 1
    told = " ".join(recover_report(found).warnings)
    assert "orbit at 12 min, the worst of 4 times" in told
    assert "for the series" in told
    assert not found.smoothed.consistency.agrees


@pytest.mark.second
def test_a_single_time_and_one_without_statements_are_not_smoothed(course, backend):
    alone = course.measured(backend, course.text(TIMES[:1]))
    assert alone.smoothed is None
    assert "smoothed" not in recover_numbers(alone)
    text = course.text().replace("disturbances: orbit", "disturbances: none")
    (course.folder / "none.yaml").write_text(text)
    plain = run_recover(MeasurementSetup.read(course.folder / "none.yaml"), backend)
    assert plain.smoothed is None
    assert recover_report(plain).sections[0].text == ()
