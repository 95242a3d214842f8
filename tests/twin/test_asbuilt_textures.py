"""Focus from two images of one unknown textured scene; the images are made by exact rays and summed plane waves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from analysis.mtf.mtf_ratio import mtf_ratio
from analysis.spots.noise import NoiseModel
from optics.geometry.tree import Motion, State, compose_each
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.system import assemble
from optics.waves.diffraction import Grid, image
from optics.waves.edge_shadow import IlluminatedStop
from optics.waves.imaging import imaging_rays, pupil_field
from scenes.specs.asbuilt import AsBuiltSetup
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml
from tests.twin.star_bench import PRIOR
from twin.asbuilt.asbuilt_bench import AsBuiltBench
from twin.asbuilt.mtf_readings import MtfReadings

THREE = [[-0.9, 0], [0, 0], [0.9, 0]]
FREQUENCY, PITCH, DEFOCUS = 12.0, 7e-6, (-0.4e-3, 0.4e-3)
NOISE = NoiseModel(dark_noise_e=20.0)
FINE, KERNEL, MARGIN = 2, 64, 32
"""Samples along a pixel of the scene, pixels along the image of a point, and pixels of the scene beside an image."""
RINGS, SHADOW = 80, 40
"""Rings over the stop and nodes along a shadow, for waves over the image of a point; 40 and 20 are wrong by 1 %."""
PAIR = {"frequency": FREQUENCY, "reference_defocus": "-0.4 mm", "defocus": "0.4 mm"}


def bench_of(backend, folder: Path, measurements: dict, prior: dict) -> AsBuiltBench:
    """gf7 with some measurements at three fields."""
    (folder / "plane.yaml").write_text(dump_yaml(prior))
    data = {"instrument": "gf7", "prior": "./plane.yaml", "merits": {"w": {"kind": "wavefront", "at_most": 0.07}}}
    data["measurements"] = {kind: {"name": {"fields": THREE, **spec}} for kind, spec in measurements.items()}
    if not any("pair" in spec for spec in measurements.values()):
        data["simulate"] = {}
    (folder / "textures.yaml").write_text(dump_yaml(data))
    return AsBuiltBench(AsBuiltSetup.read(folder / "textures.yaml"), backend)


PLANE = {**PRIOR, "causes": {"plane": PRIOR["causes"]["plane"]}}


def scene(rng: np.random.Generator, pixels: int) -> np.ndarray:
    """Random scene of power 1/f^2 with a mean of 1 and a contrast of 0.2 rms, fine samples."""
    side = FINE * (pixels + 2 * MARGIN)
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.rfftfreq(side), indexing="ij"))
    f[0, 0] = np.inf
    texture = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((side, side))) / f, (side, side))
    return np.maximum(1.0 + 0.2 * texture / np.std(texture), 0.0)


def kernel(beams, number: int, state: State) -> np.ndarray:
    """Image of a point on fine samples, summed plane waves of exact rays, (k, k)."""
    path = beams.optics.path
    stop = IlluminatedStop.of(beams.pieces[number : number + 1], RINGS, SHADOW)
    nodes = PupilNodes(*(np.concatenate([[0.0], part[0]]) for part in (stop.x, stop.y, stop.weight)))
    systems = [assemble(path.assembly, [f"{path.name}/{part}"], [state]) for part in ("imaging", "to_stop")]
    rays = imaging_rays(beams.backend, *systems, beams.directions[number], beams.start[number], path.stop, nodes)
    field = pupil_field(rays, beams.wavelength, rays.position[0, 0])
    step, count = PITCH / FINE, KERNEL * FINE
    axis = np.abs(np.arange(count) - count // 2) / (count // 2)
    # an image that ends abruptly has an MTF with ripples of some thousandths
    edge = np.cos(0.5 * np.pi * np.clip(2.0 * axis - 1.0, 0.0, 1.0)) ** 2
    grid = Grid(-(count // 2) * step, step, count)
    return image(field, grid, grid)[0].T * np.outer(edge, edge)


def imaged(fine: np.ndarray, point: np.ndarray, rng: np.random.Generator, electrons: float = 1e4) -> np.ndarray:
    """Image of a scene with pixels of full area, shot noise and read noise."""
    side, middle = len(fine), len(point) // 2
    padded = np.zeros((side, side))
    padded[: len(point), : len(point)] = point / np.sum(point)
    axis = np.sinc(FINE * np.fft.fftfreq(side))
    transfer = np.fft.fft2(np.roll(padded, (-middle, -middle), (0, 1))) * np.outer(axis, axis)
    light = np.fft.ifft2(np.fft.fft2(fine) * transfer).real[::FINE, ::FINE][MARGIN:-MARGIN, MARGIN:-MARGIN]
    return rng.poisson(np.maximum(electrons * light, 0.0)) + rng.normal(0.0, NOISE.dark_noise_e, light.shape)


def pairs(bench: AsBuiltBench, true: np.ndarray, rng: np.random.Generator, pixels: int, scenes=scene) -> list:
    """Two images of another scene at each of three fields, of a camera in a true state."""
    beams = bench.beams(bench.kinds[0].spec.fields, planes=True)
    (state,) = bench.parameters.states(true[None], None)
    bodies = {body.path: body for body in bench.experiment.instrument.assembly.tree.bodies}
    shifts = [{"base/gf7/focal_plane": Motion(shift=(0.0, 0.0, defocus))} for defocus in DEFOCUS]
    shifted = compose_each([(state, shift) for shift in shifts], bodies)
    out = []
    for number in range(len(THREE)):
        fine = scenes(rng, pixels)
        out.append([imaged(fine, kernel(beams, number, moved), rng) for moved in shifted])
    return out


def benches(backend, folder: Path, prior: dict) -> tuple[AsBuiltBench, AsBuiltBench]:
    """A bench that reads pairs of images, and one that predicts the foci."""
    for name in ("before.tif", "after.tif"):
        (folder / name).touch()
    exact = bench_of(backend, folder, {"focus": {"sigma": "1 um"}}, prior)
    return bench_of(backend, folder, {"mtf": {**PAIR, "pair": ["before.tif", "after.tif"]}}, prior), exact


def drawn(bench: AsBuiltBench, exact: AsBuiltBench, rng: np.random.Generator, pixels: int, scenes=scene) -> tuple:
    """Errors of the foci of a drawn camera over their sigmas, errors, sigmas, and whitened errors of the readings."""
    (kind,) = bench.kinds
    assert isinstance(kind, MtfReadings)
    true = bench.draw(rng, "normal")
    images = pairs(bench, true, rng, pixels, scenes)
    ratios = [mtf_ratio(*pair, FREQUENCY * 1e3 * PITCH, noise=NOISE) for pair in images]
    kind.__dict__["_ratios"] = ratios
    data = kind.read()
    found = bench.estimate([data])
    errors = exact.predict(found.mean[None])[0] - exact.predict(true[None])[0]
    sigmas = np.std(exact.predict(found.draw(rng, 200)), axis=0)
    white = np.linalg.solve(np.linalg.cholesky(kind.covariance()), data - bench.predict(true[None])[0])
    return errors / sigmas, errors, sigmas, white


@pytest.mark.second
def test_foci_of_drawn_cameras(backend, tmp_path):
    """Three cameras with three fields each: all within 4 sigma, of 1 um at most; the prior has 0.1 mm."""
    bench, exact = benches(backend, tmp_path, PLANE)
    rng = np.random.default_rng(1)
    results = [drawn(bench, exact, rng, 512) for _ in range(3)]
    pulls, _, sigmas, white = (np.stack(part) for part in zip(*results, strict=True))
    assert np.max(np.abs(pulls)) < 4.0
    assert np.max(sigmas) < 1.5e-6
    assert np.sum(white**2) < 42.3, "1 in 1000 for 18 ratios"


@pytest.mark.second
def test_files_of_pairs(backend, tmp_path):
    """Pages of two TIFF files give the readings of the arrays, with a further sigma; wrong files are refused."""
    rng = np.random.default_rng(7)
    spec = {**PAIR, "pair": ["a.tif", "b.tif"], "gain": 0.5, "read_noise": 20.0, "black_level": 100.0, "sigma": 0.01}
    bench, _ = benches(backend, tmp_path, PLANE)
    images = pairs(bench, np.zeros(len(bench.parameters.labels)), rng, 384)
    grey = np.rint(np.stack(images, axis=1) / 0.5 + 100.0).astype(np.uint16)
    for name, pages in zip("ab", grey, strict=True):
        tifffile.imwrite(tmp_path / f"{name}.tif", pages, photometric="minisblack")
    kind = bench_of(backend, tmp_path, {"mtf": spec}, PLANE).kinds[0]
    noise = NoiseModel(2.0, 20.0, offset_dn=100.0)
    ratios = [mtf_ratio(*two, FREQUENCY * 1e3 * PITCH, noise=noise) for two in np.moveaxis(grey, 1, 0)]
    np.testing.assert_allclose(kind.read(), np.log(np.ravel([ratio.ratio[0] for ratio in ratios])))
    np.testing.assert_allclose(kind.covariance()[:2, :2], ratios[0].log_covariance[0] + 1e-4 * np.eye(2))
    assert kind.labels[1] == "(-0.9, 0) track ln ratio"
    tifffile.imwrite(tmp_path / "b.tif", grey[1][:2], photometric="minisblack")
    for more, message in (
        ({}, "2 pages in the file, 3 fields in the test"),
        ({"pair": ["a.tif", "missing.tif"]}, "missing.tif"),
        ({"pair": ["a.tif", "a.tif"], "black_level": 60000.0}, "field (-0.9, 0): MTF ratio: an image has no light"),
        ({"reference_defocus": "0.4 mm"}, "both images have the same defocus"),
        ({"frequency": None}, "a ratio of images needs a frequency"),
        ({"reference_defocus": None}, "the focus of the first image is missing"),
        ({"pair": None, "sigma": None}, "'sigma' is missing"),
        ({"pair": None, "along_line": [0.5] * 3, "along_track": [0.5] * 3}, "values of one image with a reference"),
        (
            {"pair": None, "reference_defocus": None, "along_line": [0.5] * 3, "along_track": [0.5] * 3},
            "MTF have no gain",
        ),
    ):
        changed = {key: value for key, value in (spec | more).items() if value is not None}
        with pytest.raises(InputError) as caught:
            bench_of(backend, tmp_path, {"mtf": changed}, PLANE).kinds[0].read()
        assert message in str(caught.value)
