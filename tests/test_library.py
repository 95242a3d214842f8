"""The public names of optics and analysis: examples, pages, docstrings, import."""

import doctest
import importlib
import pickle
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
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


M1 = {"radius": -4.0, "thickness": -2.0, "material": "mirror", "diameter": 0.5}


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: optics.Camera([], 550e-9), "at least one OpticalSurface"),
        (lambda: optics.Camera(optics.OpticalSurface(**M1), 550e-9), "each an OpticalSurface"),
        (lambda: optics.Camera([optics.OpticalSurface(**M1)], 550), "1e-9 to 1e-2, in metres"),
        (lambda: optics.OpticalSurface(**M1, figure={0: 1e-9}), "Noll index 0 is outside"),
        (lambda: optics.OpticalSurface(**M1, figure={2.5: 1e-9}), "figure must be a mapping from a whole number"),
        (lambda: optics.OpticalSurface(**M1, figure={4: float("nan")}), "term 4 must be finite"),
        (lambda: optics.OpticalSurface(**M1, vanes=[0.008, 0.0]), "whose elements are each 2 numbers"),
        (lambda: optics.noll_to_nm(2.5), "noll_to_nm: index must be a whole number, got 2.5"),
    ],
)
def test_numbers_that_make_no_camera_are_refused(call: Callable[[], object], words: str) -> None:
    """In nanometres for metres, a flat list for pairs: each would silently give another camera."""
    with pytest.raises(ValueError, match=words):
        call()


MIRROR = optics.OpticalSurface(**M1)
CAMERA = optics.Camera([MIRROR], 550e-9)
ROW, COLUMN = np.mgrid[:60, :60]
EDGE = 500.0 + 400.0 * np.tanh(COLUMN - 30.2 - 0.09 * ROW) + np.random.default_rng(1).standard_normal(ROW.shape)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: optics.OpticalSurface(radius="2"), "OpticalSurface: radius must be a number, got '2'"),
        (lambda: optics.OpticalSurface(material=None), "material must be text or a number, got None"),
        (lambda: optics.OpticalSurface(**M1, figure=[0.0]), "figure must be a mapping from a whole number to a number"),
        (lambda: optics.OpticalSurface(tilt=(1e-3, 0.0)), r"tilt must be 3 numbers, got \(0.001, 0.0\)"),
        (lambda: optics.OpticalSurface(asphere=1e-9), "asphere must be a sequence of numbers, got 1e-09"),
        (lambda: optics.Camera([None], 550e-9), r"surfaces must be a sequence whose elements are each an OpticalSurf"),
        (lambda: optics.Camera([MIRROR], "550 nm"), "wavelength must be a number, got '550 nm'"),
        (lambda: optics.Camera([MIRROR], 550e-9, medium="water"), "medium must be 'vacuum' or 'air', got 'water'"),
        (lambda: optics.psf(CAMERA, 1e-6, count=64.0), "psf: count must be a whole number, got 64.0"),
        (lambda: optics.psf(CAMERA, 1e-6, count=True), "psf: count must be a whole number, got True"),
        (lambda: optics.wavefront(None), "wavefront: camera must be a Camera, got None"),
        (lambda: optics.wavefront(CAMERA, field=1e-3), "field must be 2 numbers, got 0.001"),
        (lambda: optics.mtf(CAMERA, "50"), "frequency must be an array of numbers, got '50'"),
        (lambda: optics.mtf(CAMERA, [[1.0], [1.0, 2.0]]), "frequency must be an array of numbers"),
        (lambda: optics.mtf(CAMERA, 5e4, spectrum=[1.0]), "spectrum must be a mapping from a number to a number"),
        (lambda: optics.fit_zernikes(3.0, [0.0], [0.0], [0.0]), "fit_zernikes: last must be a whole number, got 3.0"),
        (lambda: optics.refractive_index(None, 550e-9), "refractive_index: glass must be text, got None"),
        (lambda: analysis.fit_spot(np.ones((9, 9)), 5.0), "fit_spot: noise must be a NoiseModel, got 5.0"),
        (lambda: analysis.NoiseModel(gain_dn_per_e="1"), "NoiseModel: gain_dn_per_e must be a number, got '1'"),
        (lambda: analysis.TimeLaw(drift_s="1"), "TimeLaw: drift_s must be a number or None, got '1'"),
        (lambda: analysis.Disturbances.of([[1.0]], [[1.0]], None), "Disturbances.of: laws must be a sequence whose"),
        (lambda: analysis.Pupil("1", 2.0, 3.0), "Pupil: x must be a number, got '1'"),
        (lambda: analysis.MatchOptions(sharpness="x"), "sharpness must be True or False, got 'x'"),
        (lambda: analysis.adjust_block(None), "adjust_block: block must be a Block, got None"),
    ],
)
def test_an_argument_of_a_wrong_kind_is_explained(call: Callable[[], object], words: str) -> None:
    """By one check of annotations for all public names; it is a ValueError, as all errors of the libraries."""
    with pytest.raises(TypeError, match=words) as caught:
        call()
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: optics.airy([0.0, np.nan], 500e-9, 8.0), r"radius must be finite, in metres, got nan \(1 of 2 "),
        (lambda: optics.annular_mtf(np.nan, 500e-9, 8.0), "frequency must be finite, in cycles per metre, got nan"),
        (
            lambda: optics.fit_zernikes(1, [0.0], [0.0], [np.nan]),
            r"values must be finite, .* got nan \(1 of 1 values\)",
        ),
        (lambda: optics.launch_rays(CAMERA, pupil=[(0.0, 2.0)]), "within the stop, at most 1 from its middle"),
        (lambda: optics.OpticalSurface(vanes=[(-1e-3, 0.0)]), "pairs of a positive width"),
        (lambda: analysis.robust_sigma([1.0, np.nan]), "residuals must be finite"),
        (lambda: analysis.slanted_edge_mtf(EDGE).frequency_at(np.nan), "value must be finite"),
    ],
)
def test_numbers_without_a_meaning_are_refused(call: Callable[[], object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        call()


def test_kinds_that_numpy_and_python_share_are_taken() -> None:
    taken = optics.psf(CAMERA, np.float32(1e-6), count=np.int64(8), field=np.zeros(2), spectrum={550e-9: 1})
    assert taken.shape == (8, 8)
    assert optics.zernike(np.int16(4), 0, np.array(0.5)) == optics.zernike(4, 0.0, 0.5)
    # what a package offers has the name that it is offered by, and crosses to another process
    assert optics.fit_zernikes.__name__ == "fit_zernikes"
    assert pickle.loads(pickle.dumps(analysis.fit_spot)) is analysis.fit_spot


def test_the_help_of_a_camera_shows_what_its_page_lists() -> None:
    page = (ROOT / "docs/library_optics.md").read_text("utf-8")
    shown = {name for name in dir(optics.Camera) if not name.startswith("_")}
    fields = {"surfaces", "wavelength", "stop", "image_tilt", "medium"}
    assert {name for name in shown - fields if f"`{name}`" not in page and f"`{name}(" not in page} == set()
