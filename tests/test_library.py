"""The public names of optics and analysis: examples, pages, docstrings, import."""

import doctest
import importlib
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
        (lambda: optics.Camera(optics.OpticalSurface(**M1), 550e-9), "at least one OpticalSurface"),
        (lambda: optics.Camera([optics.OpticalSurface(**M1)], 550), "1e-9 to 1e-2, in metres"),
        (lambda: optics.OpticalSurface(**M1, figure={0: 1e-9}), "Noll index 0 is outside"),
        (lambda: optics.OpticalSurface(**M1, figure={2.5: 1e-9}), "Noll index 2.5 is outside"),
        (lambda: optics.OpticalSurface(**M1, figure={4: float("nan")}), "term 4 must be finite"),
        (lambda: optics.OpticalSurface(**M1, vanes=[0.008, 0.0]), "pairs of a width"),
        (lambda: optics.noll_to_nm(2.5), "Noll index 2.5 is outside"),
    ],
)
def test_numbers_that_make_no_camera_are_refused(call: Callable[[], object], words: str) -> None:
    """In nanometres for metres, a flat list for pairs: each would silently give another camera."""
    with pytest.raises(ValueError, match=words):
        call()
