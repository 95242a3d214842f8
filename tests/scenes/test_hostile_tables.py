"""Spoilt tables and meshes of every kind: read, or refused with the file, and the line where there are lines; never
another exception, never long.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from pathlib import Path

import meshio
import numpy as np
import pytest

from scenes.yaml.bsdf_file import read_bsdf
from scenes.yaml.coating_file import read_coating
from scenes.yaml.errors import InputError
from scenes.yaml.node_table import read_nodes, read_temperatures
from tests.scenes.test_finish_tables import bsdf_text
from tests.twin.commands import invoke
from twin.render import app

LONGEST = 20.0
"""Seconds for one file of some kilobytes, on a busy machine."""
_BITS = (
    b"<!-- \x00 9e99,;\n",
    b"1e400",
    b"-",
    b"nan",
    b"\n\n",
    b"99999999999999999999",
    b",",
    b"\xff\xfe",
    b'"',
    b"'",
    b"#",
)


def _points() -> np.ndarray:
    x, y, z = np.meshgrid(np.linspace(-0.4, 0.4, 7), np.linspace(-0.3, 0.3, 6), np.linspace(0.0, 0.1, 3))
    return np.stack([x.ravel(), y.ravel(), z.ravel()], axis=-1)


def _csv(place: Path, heads: str, columns: np.ndarray) -> None:
    place.write_text("\n".join([heads, *(",".join(f"{v:.9g}" for v in row) for row in columns)]) + "\n")


def _mesh(place: Path, data: dict[str, np.ndarray]) -> None:
    mesh = meshio.Mesh(_points(), [("tetra", np.array([[0, 1, 9, 30]]))], point_data=data)
    mesh.write(place, **({"file_format": "gmsh"} if place.suffix == ".msh" else {}))


def _coating(place: Path) -> None:
    rows = [(w, a, 0.3 + 0.01 * a, 99.0 - 0.02 * a) for w in (600, 650, 700) for a in range(0, 90, 10)]
    _csv(place, "wavelength [nm],angle [deg],R [percent],T [percent]", np.array(rows))


MOVES, HEAT = "x [mm],y [mm],z [mm],dx [um],dy [um],dz [um]", "x [mm],y [mm],z [mm],T [degC]"
KINDS: dict[str, tuple[str, Callable[[Path], None], Callable[[Path], object]]] = {
    "nodes.csv": ("csv", lambda p: _csv(p, MOVES, np.hstack([_points(), _points()])), read_nodes),
    "heat.csv": ("csv", lambda p: _csv(p, HEAT, np.hstack([_points(), 20.0 + _points()[:, :1]])), read_temperatures),
    "bsdf": ("bsdf", lambda p: p.write_text(bsdf_text()) and None, read_bsdf),
    "coating.csv": ("csv", _coating, read_coating),
    **{
        f"nodes.{e}": (e, lambda p: _mesh(p, {"U": 1e-6 * _points()}), lambda p: read_nodes(p, "m"))
        for e in ("vtu", "vtk", "msh", "med")
    },
    **{
        f"heat.{e}": (
            e,
            lambda p: _mesh(p, {"T": 1.0 + _points()[:, 0]}),
            lambda p: read_temperatures(p, "m", None, "K"),
        )
        for e in ("vtu", "vtk", "msh", "med")
    },
}


def _spoilt(content: bytes, rng: np.random.Generator) -> bytes:
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 4))):
        if not data:
            break
        at = int(rng.integers(0, len(data)))
        match int(rng.integers(0, 6)):
            case 0:
                data[at] = int(rng.integers(0, 256))
            case 1:
                del data[at : at + int(rng.integers(1, 200))]
            case 2:
                data[at:at] = _BITS[int(rng.integers(0, len(_BITS)))]
            case 3:
                data = data[: at + 1]
            case 4:
                end = at + int(rng.integers(1, 400))
                data[at:at] = data[at:end]
            case _:
                # a digit that becomes another: counts that are not those of the file
                digits = [k for k in range(at, min(at + 80, len(data))) if 48 <= data[k] < 58]
                for k in digits[:1]:
                    data[k] = 48 + int(rng.integers(0, 10))
    return bytes(data)


def _try(tmp_path: Path, kind: str, count: int, seed: int) -> None:
    ending, write, read = KINDS[kind]
    place = tmp_path / f"table.{ending}"
    write(place)
    content = place.read_bytes()
    read(place)
    rng = np.random.default_rng(seed)
    refused = without_line = 0
    for number in range(count):
        place.write_bytes(_spoilt(content, rng))
        begun = time.perf_counter()
        caught = None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # meshio's readers through NumPy
                read(place)
        except InputError as error:
            caught = error.issues[0]
        if caught is not None:
            refused += 1
            without_line += caught.line is None
            assert caught.file == str(place), (kind, number)
        assert time.perf_counter() - begun < LONGEST, (kind, number)
    assert refused > 0.2 * count
    if ending in ("csv", "bsdf"):
        assert without_line == 0


@pytest.mark.parametrize("kind", ["nodes.csv", "heat.csv", "bsdf", "coating.csv", "heat.vtu"])
def test_some_spoilt_files(tmp_path, kind: str) -> None:
    _try(tmp_path, kind, 25, 1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_two_thousand_spoilt_files(tmp_path, kind: str) -> None:
    _try(tmp_path, kind, 2000, 2)


@pytest.mark.parametrize("kind", ["heat.csv", "bsdf"])
def test_a_command_ends_with_two_and_names_file_and_line(tmp_path, kind: str) -> None:
    ending, write, _ = KINDS[kind]
    place = tmp_path / f"table.{ending}"
    write(place)
    place.write_bytes(place.read_bytes()[:-30])
    heat = "perturb: {base/forward/M1: {temperature: table.csv}}\n"
    stray = "render: {stray: {finishes: {black: table.bsdf}}}\n"
    (tmp_path / "job.yaml").write_text("instrument: gf7_pair\n" + (heat if kind == "heat.csv" else stray))
    place.write_text(place.read_text().rstrip() + ("x" if kind == "heat.csv" else ""))
    ended = invoke(app, tmp_path / "job.yaml", "--out", tmp_path / "out")
    assert ended.exit_code == 2
    assert f"{place.name}:{len(place.read_text().splitlines())}" in ended.stderr.replace("\n", "")
    assert "Traceback" not in ended.stderr
    assert not (tmp_path / "out").exists()
