"""The public names of optics and analysis: examples, pages, import, and comparison with other people's programs."""

import doctest
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import analysis
import optics

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = {"optics": optics, "analysis": analysis}
HEAVY = {"scipy", "drjit", "cv2", "matplotlib", "numpy"}
"""None of these is loaded by the import of a package: a program starts at once."""


def documented() -> list[str]:
    """Modules of both packages with examples, by name."""
    paths = [p for name in PACKAGES for p in sorted((ROOT / name).rglob("*.py")) if ">>> " in p.read_text("utf-8")]
    return [".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for p in paths]


def public(package: ModuleType) -> dict[str, object]:
    return {name: getattr(package, name) for name in package.__all__}


def examples(name: str) -> Iterator[doctest.DocTest]:
    names = {**public(PACKAGES[name.partition(".")[0]]), "np": np}
    found = doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(name), extraglobs=names)
    return (one for one in found if one.examples)


@pytest.mark.parametrize("name", documented())
def test_examples_of_docstrings_run(name: str) -> None:
    failed = [one.name for one in examples(name) if doctest.DocTestRunner().run(one).failed]
    assert failed == []


def test_there_are_many_examples() -> None:
    assert sum(len(one.examples) for name in documented() for one in examples(name)) >= 150


@pytest.mark.parametrize("name", PACKAGES)
def test_every_public_name_has_a_docstring_and_an_example(name: str) -> None:
    package = PACKAGES[name]
    assert set(package.__all__) <= set(dir(package))
    for known, value in public(package).items():
        text = value.__doc__ or ""
        first = text.partition("\n")[0].strip()
        assert first.endswith("."), known
        if not isinstance(value, type):
            assert re.search(r"^ *Returns\n *-{7}$", text, re.M), known
            assert ">>> " in text, known
            assert known in package.__doc__, known
    with pytest.raises(AttributeError):
        package.no_such_name  # noqa: B018


@pytest.mark.parametrize("name", PACKAGES)
def test_import_loads_no_large_library(name: str) -> None:
    program = f"import sys, {name}; print(*sys.modules)"
    out = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert HEAVY.isdisjoint(out.split())


@pytest.mark.parametrize("name", PACKAGES)
def test_the_page_of_the_library_runs(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Blocks of Python run one after the other; a block of text after one is what it prints."""
    page = (ROOT / f"docs/library_{name}.md").read_text("utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```\n(?:\n?```text\n(.*?)^```)?", page, re.M | re.S)
    names: dict[str, object] = {}
    assert blocks
    for source, printed in blocks:
        exec(source, names)
        out = capsys.readouterr().out
        if printed:
            assert out == printed


def ritchey_chretien(tilt: float = 0.0, vanes: float = 0.0) -> optics.Camera:
    """A telescope of 0.45 m at F/8 with M2 tilted about x, radians, and four vanes of a width in metres."""
    spider = [(vanes, angle) for angle in np.radians([0.0, 90.0, 180.0, 270.0])] if vanes else []
    m1 = optics.OpticalSurface(-2.4, -0.88, -1.080808, "mirror", diameter=0.45, inner_diameter=0.12, vanes=spider)
    m2 = optics.OpticalSurface(-0.96, 0.96, -5.022727, "mirror", tilt=(tilt, 0.0, 0.0))
    return optics.Camera([m1, m2], wavelength=550e-9)


@pytest.mark.oracle
@pytest.mark.parametrize("vanes", [0.0, 0.0075])
def test_an_obscured_image_is_that_of_poppy(vanes: float) -> None:
    """poppy has a raster in its pupil, on which vanes are 17 cells wide."""
    poppy = pytest.importorskip("poppy")
    count, scale, camera = 64, 550e-9 / 0.45 / 4.0, ritchey_chretien(vanes=vanes)
    ours = optics.psf(camera, scale * camera.focal_length, count)
    system = poppy.OpticalSystem(npix=1024, oversample=1)
    system.add_pupil(poppy.CircularAperture(radius=0.225))
    obscuration = {"n_supports": 4, "support_width": vanes} if vanes else {"n_supports": 0}
    system.add_pupil(poppy.SecondaryObscuration(secondary_radius=0.06, **obscuration))
    system.add_detector(pixelscale=np.degrees(scale) * 3600.0, fov_pixels=count)
    theirs = system.calc_psf(wavelength=550e-9)[0].data
    ours, theirs = ours / ours.sum(), theirs / theirs.sum()
    assert np.max(np.abs(ours - theirs)) < 1e-3 * theirs.max()


@pytest.mark.oracle
def test_an_mtf_is_the_autocorrelation_of_poppys_pupil() -> None:
    poppy = pytest.importorskip("poppy")
    cells, camera = 1024, ritchey_chretien(vanes=0.0075)
    spider = poppy.SecondaryObscuration(secondary_radius=0.06, n_supports=4, support_width=0.0075)
    pupil = poppy.CompoundAnalyticOptic([poppy.CircularAperture(radius=0.225), spider]).sample(
        npix=cells, grid_size=0.45
    )
    overlap = np.fft.ifft2(np.abs(np.fft.fft2(pupil, (2 * cells, 2 * cells))) ** 2).real[0, :cells:64]
    frequency = np.arange(0, cells, 64) * (0.45 / cells) / (camera.wavelength * camera.focal_length)
    assert np.max(np.abs(optics.mtf(camera, frequency) - overlap / overlap[0])) < 2e-3


@pytest.mark.oracle
def test_rays_are_those_of_batoid() -> None:
    """M2 is tilted by 0.5 mrad."""
    batoid = pytest.importorskip("batoid")
    camera, field = ritchey_chretien(tilt=5e-4), (1e-3, -2e-3)
    m1, m2 = (batoid.Quadric(surface.radius, surface.conic) for surface in camera.surfaces)
    turned = batoid.CoordSys([0.0, 0.0, -0.88], batoid.RotX(5e-4))
    image = batoid.CoordSys([0.0, 0.0, 0.08])
    position, direction = optics.launch_rays(camera, field, pupil=[(0.3, 0.2), (-0.9, 0.1), (0.0, 0.0), (0.0, -1.0)])
    ours = optics.trace(camera, position, direction)
    rays = batoid.RayVector(*position.T, *direction.T, 0.0, 550e-9, 1.0)
    m1.reflect(rays)
    m2.reflect(rays, coordSys=turned)
    batoid.Plane().intersect(rays, coordSys=image)
    rays.toCoordSys(batoid.CoordSys())
    assert np.max(np.abs(rays.r - ours.position)) < 1e-12
    assert np.max(np.abs(rays.v - ours.direction)) < 1e-12
    assert np.max(np.abs(rays.t - ours.path)) < 1e-12
    assert ours.valid.tolist() == [True, True, False, True]
