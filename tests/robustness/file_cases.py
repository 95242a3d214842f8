"""Files of the fuzzer's cases that are made: meshes, images, layouts, prescriptions; and the files of a pass."""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import meshlane
import numpy as np
import tifffile
import typer
from astropy.io import fits

from scenes.yaml.yaml_file import dump_yaml
from tests.robustness.case import Case, file_of
from tests.scenes.lens.files import AGF, BATOID, CODEV, SINGLET, TMA
from tests.scenes.monitor_layouts import hollow_pair, text_of, two_beams
from tests.twin import orbit_file_bench as bench


def _mesh(ending: str, heat: bool = False) -> bytes:
    """Return the displaced nodes of M2, or the warm ones of a prism, as a mesh."""
    text = file_of("prism_heat.csv") if heat else _nodes()
    rows = np.array([line.split(b",")[1:] for line in text.split(b"\n")[1:] if line]).astype(float)
    data = {"T": rows[:, 3] - 20.0} if heat else {"U": 1e-3 * rows[:, 3:]}
    mesh = meshlane.Mesh(rows[:, :3], [("tetra", np.array([[0, 1, 2, 3]]))], point_data=data)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a.{ending}"
        meshlane.write(path, mesh, **({"file_format": "gmsh"} if ending == "msh" else {}))
        return path.read_bytes()


def _nodes() -> bytes:
    """Return every second node, which says as much and is read faster."""
    return b"\n".join(file_of("m2_nodes.csv").split(b"\n")[:1] + file_of("m2_nodes.csv").split(b"\n")[1::2])


def _image(frames: np.ndarray, ending: str) -> bytes:
    out = io.BytesIO()
    if ending == "fits":
        fits.PrimaryHDU(frames.astype(np.int16)).writeto(out)
    elif ending == "tiff":
        tifffile.imwrite(out, frames, photometric="minisblack", compression="lzw")
    else:
        return bytes(cv2.imencode(f".{ending}", frames[0])[1])
    return out.getvalue()


def _edge(blur: float, size: int = 64) -> np.ndarray:
    """Return a slanted edge with even noise, 15 bits."""
    rows, columns = np.mgrid[0:size, 0:size]
    across = columns - 0.5 * size + 0.4 - np.tan(np.radians(5.0)) * (rows - size // 2)
    light = 2000.0 + 10000.0 * (1.0 + np.tanh(across / blur))
    return (np.rint(light) + np.random.default_rng(1).integers(-30, 31, light.shape)).astype(np.uint16)


def _edges(ending: str) -> bytes:
    frames = np.stack([_edge(1.3), _edge(1.3)])
    return _image(frames if ending != "jpg" else (frames >> 7).astype(np.uint8), ending)


def _bars() -> bytes:
    rows, columns = np.mgrid[0:64, 0:96]
    wave = 0.5 + 0.3 * np.sin(2.0 * np.pi * (columns + 0.05 * rows) / 4.0)
    wave = np.where(columns >= 80, 1.0, np.where(columns >= 64, 0.0, wave))
    return _image(np.rint(2000.0 + 40000.0 * wave).astype(np.uint16)[None], "tiff")


def _edge_table() -> bytes:
    """Return the table of edges through focus at three places."""
    rows = ["file,page,band,x [mm],y [mm],edge,shift [um]"]
    for place, y in (("a", -100), ("b", 0), ("c", 100)):
        rows += [f"{place}.tiff,{k},P,{5 * (y == 0)},{y},along,{30 * (k - 4)}" for k in range(9)]
    return "\n".join(rows).encode()


def _spot(mark: int, ending: str = "fits", frames: int = 1) -> bytes:
    """Return small frames of a spot; those of other marks, and each of a file, differ: a copy would be refused."""
    out = np.full((frames, 32, 32), 100, np.uint16)
    out[:, 13:20, 13:20] += 256 * (8 + mark % 2)
    for k in range(frames):
        out[k].flat[4 * mark + k] += 1
    return _image(out, ending)


def _turns(level: int, step: int) -> bytes:
    """Return two frames with noise: two grey values in turns."""
    turns = (np.arange(2 * 32 * 32) ** 2 // 7 + np.arange(2 * 32 * 32) // 1024).reshape(2, 32, 32) % 2
    return _image(level + step * turns, "fits")


MADE: Mapping[str, Callable[[], bytes]] = {
    "two beams": lambda: text_of(two_beams()).encode(),
    "hollow prisms": lambda: text_of(hollow_pair()).encode(),
    "nodes": _nodes,
    **{f"mesh {ending}": partial(_mesh, ending) for ending in ("vtu", "vtk", "msh", "med")},
    "mesh with temperatures": lambda: _mesh("vtu", True),
    "table of edges": _edge_table,
    "edges through focus": lambda: _image(np.stack([_edge(1.0 + 0.03 * k * k) for k in range(-4, 5)]), "tiff"),
    "data of one pass": lambda: file_of("orbit/measured/data.yaml").partition(b"  Anhui:")[0].replace(b"Beijing/", b""),
    **{f"edge {ending}": partial(_edges, ending) for ending in ("tiff", "fits", "png", "jpg")},
    "bars": _bars,
    "TMA": lambda: TMA.encode(),
    "TMA wide": lambda: TMA.encode("utf-16"),
    "singlet": lambda: SINGLET.encode(),
    "CODE V": lambda: CODEV.encode(),
    "CODE V wide": lambda: CODEV.encode("utf-16-le"),
    "batoid": lambda: BATOID.encode(),
    "glasses wide": lambda: AGF.encode("utf-16"),
    **{f"spot {mark}": partial(_spot, mark) for mark in range(10)},
    "three spots": lambda: _spot(0, frames=3),
    "spot tiff": lambda: _spot(1, "tiff"),
    "spot png": lambda: _spot(4, "png"),
    "dark frames": lambda: _turns(100, 1),
    "flat frames": lambda: _turns(8000, 25),
    "bad pixels": lambda: _image(np.where(np.arange(1024).reshape(1, 32, 32) == 77, 1, 0), "fits"),
}
"""Name in cases.yaml -> content of the file."""


def pass_cases(orbit: typer.Typer) -> Iterator[Case]:
    """Yield files of a pass, also those of other programs, as a check of its conventions reads them."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        spec = bench.check_files(folder, 8)
        bench.orbit_csv(folder / "orbit.csv", step=6.0)
        bench.attitude_csv(folder / "attitude.csv", step=3.0)
        files = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
        bench.sp3(folder / "pass.sp3", step=6.0)
        bench.oem(folder / "pass.oem", step=6.0)
        bench.aem(folder / "pass.aem", step=3.0)
        files |= {name: (folder / name).read_bytes() for name in ("pass.sp3", "pass.oem", "pass.aem")}
    days = [f"{day},-0.15{k:02d},0.001{k},0.323{k},0.11,-0.19" for k, day in enumerate(range(55620, 55632))]
    files["eop.csv"] = (
        "mjd,ut1_utc [s],x_pole [arcsec],y_pole [arcsec],dx [mas],dy [mas]\n" + "\n".join(days)
    ).encode()
    points = [line.split(",") for line in files["ground.csv"].decode().split("\n")[1:] if line]
    files["points.gcp"] = "\n".join(
        f"{name} {lat} {lon} {height} 0.5 0.5 1.0 nadir.tif 55{k} 103{k} 0.3 0.3"
        for k, (name, lat, lon, height) in enumerate(points)
    ).encode()
    sigmas = {"sigma_east": 0.5, "sigma_north": 0.5, "sigma_up": 1.0, "role": "control"}
    features = [
        {
            "type": "Feature",
            "id": name,
            "geometry": {"type": "Point", "coordinates": list(map(float, (lon, lat, height)))},
            "properties": sigmas,
        }
        for name, lat, lon, height in points
    ]
    files["points.geojson"] = json.dumps({"type": "FeatureCollection", "features": features}, indent=1).encode()
    earth = {"attitude": spec["platform"]["attitude"], "earth_orientation": "eop.csv"}  # type: ignore[index]
    oem = {**earth, "orbit": {"file": "pass.oem"}}
    changes: dict[str, dict[str, Any]] = {
        "pass.sp3": {"platform": {**earth, "orbit": {"file": "pass.sp3", "satellite": "L51"}}},
        "pass.aem": {"platform": {**oem, "attitude": {"file": "pass.aem", "body_axes": bench.AXES}}},
        "pass.oem": {"platform": oem},
        "eop.csv": {"platform": oem},
        "points.gcp": {"ground": {"file": "points.gcp", "crs": "EPSG:4979"}},
        "points.geojson": {"ground": {"file": "points.geojson"}},
    }
    for target in ("check.yaml", *files):
        own = {"check.yaml": dump_yaml({**spec, **changes.get(target, {})}).encode(), **files}
        kind = f"file {target} of a pass"
        yield Case(f"check-{Path(target).name}", kind, orbit, ("check",), own, target, whole=30)
