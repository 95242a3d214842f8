"""What is fuzzed beside YAML: tables, images, meshes, files of a pass, prescriptions and measured frames."""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import meshlane
import numpy as np
import tifffile
from astropy.io import fits

from analysis.mtf.__main__ import app as mtf
from scenes.lens.__main__ import app as lens
from scenes.yaml.yaml_file import dump_yaml
from tests.robustness.case import Case, edited, job_of, text_of
from tests.scenes.lens.files import AGF, BATOID, CODEV, SINGLET, TMA
from tests.scenes.monitor_layouts import hollow_pair, two_beams
from tests.scenes.monitor_layouts import text_of as layout_text
from tests.twin import orbit_file_bench as bench
from twin.lab import app as lab
from twin.orbit.__main__ import app as orbit
from twin.recover.__main__ import app as recover
from twin.render import app as render

Files = Mapping[str, bytes]


def file_cases() -> Iterator[Case]:
    """All of them."""
    yield from _job_tables()
    yield from _measured_laboratory()
    yield from _measured_passes()
    yield from _pass_files()
    yield from _frames()
    yield from _prescriptions()
    yield from _pictures()


def _made(write: Callable[[Path], object], name: str = "file") -> bytes:
    """The bytes of a file that a function writes."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def _job_tables() -> Iterator[Case]:
    """Layouts of monitors and tables that jobs name."""
    quick: dict[str, Any] = {"options": ("--frames", "1")}
    for name, layout in (("two-beams", two_beams()), ("hollow", hollow_pair())):
        own = {"job.yaml": b"instrument: ./own.yaml\n", "own.yaml": layout_text(layout).encode()}
        yield Case(f"render-{name}", "layout of monitors", render, (), own, "own.yaml", **quick)
    single = {"single.yaml": job_of("single.yaml")}

    def case(name: str, kind: str, job: bytes, table: str, content: bytes, **more: Any) -> Case:
        return Case(name, kind, render, (), {"job.yaml": job, table: content, **single}, table, **quick, **more)

    nodes, heat = job_of("m2_nodes.csv"), job_of("prism_heat.csv")
    # a tenth of the nodes say as much, and are read ten times as fast
    nodes = b"\n".join(line for k, line in enumerate(nodes.split(b"\n")) if k == 0 or k % 2 == 1)
    yield case("table-deformation", "displaced nodes", job_of("deformed.yaml"), "m2_nodes.csv", nodes, whole=40)
    warmed = b"instrument: single.yaml\nperturb:\n  base/one/monitor/left/prism_180: {temperature: prism_heat.csv}\n"
    yield case("table-temperature", "nodes with temperatures", warmed, "prism_heat.csv", heat)
    rows = np.array([[float(one) for one in line.split(b",")[1:]] for line in nodes.split(b"\n")[1:] if line])
    warm = np.array([[float(one) for one in line.split(b",")[1:]] for line in heat.split(b"\n")[1:] if line])
    job = b"instrument: single.yaml\nperturb:\n  base/one/M2: {deformation: {table: m2.%s, unit: mm, field: U}}\n"
    for ending in ("vtu", "vtk", "msh", "med"):
        content = _made(partial(_mesh, rows[:, :3], {"U": 1e-3 * rows[:, 3:]}), f"m2.{ending}")
        yield case(f"table-mesh-{ending}", "mesh", job % ending.encode(), f"m2.{ending}", content, weight=0.4)
    job = (
        b"instrument: single.yaml\nperturb:\n  base/one/monitor/left/prism_180: {temperature: {table: h.vtu, unit: mm, "
    )
    content = _made(partial(_mesh, warm[:, :3], {"T": warm[:, 3] - 20.0}), "h.vtu")
    yield case("table-mesh-heat", "mesh with temperatures", job + b"values: K}}\n", "h.vtu", content, weight=0.4)
    finishes = b"instrument: single.yaml\nrender: {frames: 1, stray: {paths: 10000, finishes: {%s}}}\n"
    yield case("table-bsdf", "BSDF", finishes % b"black: paint.bsdf", "paint.bsdf", job_of("paint.bsdf"), whole=40)
    yield case("table-coating", "coating", finishes % b"coated: ar.csv", "ar.csv", job_of("ar.csv"), whole=40)
    heads = "time [min],base/forward shift z [um],base/one rotate x [arcsec],base/one temperature [K]\n"
    course = heads.replace("base/forward", "base/one") + "".join(
        f"{k * 10},{k},{0.5 * k},{0.1 * k}\n" for k in range(6)
    )
    text = b"instrument: single.yaml\ncourse: {table: course.csv}\nrender: {frames: 1, seed: 1}\n"
    yield case("table-course", "table of a course", text, "course.csv", course.encode(), whole=40)


def _mesh(places: np.ndarray, data: dict[str, np.ndarray], path: Path) -> None:
    cells = [("tetra", np.array([[0, 1, 2, 3]]))]
    how = {"file_format": "gmsh"} if path.suffix == ".msh" else {}
    meshlane.write(path, meshlane.Mesh(places, cells, point_data=data), **how)


def _measured_laboratory() -> Iterator[Case]:
    """Tests of the laboratory on measurements, and their tables."""
    tables = {
        f"{stem}.csv": text_of(f"lab/measured/{stem}.csv") for stem in ("comparisons", "held_out", "mtf", "spots")
    }
    for test, targets, whole in (
        ("focus", ("mtf.csv",), 4),
        ("distortion", ("spots.csv", "comparisons.csv"), 40),
        ("turntable", ("comparisons.csv", "held_out.csv"), 40),
    ):
        files = {f"{test}.yaml": text_of(f"lab/measured/{test}.yaml"), **tables}
        for target in (f"{test}.yaml", *targets):
            kind = f"measured {test}" if target.endswith("yaml") else f"table {target}"
            name = f"lab-measured-{test}-{Path(target).stem}"
            yield Case(name, kind, lab, (test,), files, target, whole=whole, weight=0.7)
    # edges through focus at three places
    rows, images = ["file,page,band,x [mm],y [mm],edge,shift [um]"], {}
    for place, y in (("a", -100), ("b", 0), ("c", 100)):
        pages = np.stack([_edge(1.0 + 0.03 * k * k) for k in range(-4, 5)])
        images[f"{place}.tiff"] = _made(
            lambda path, pages=pages: tifffile.imwrite(path, pages, photometric="minisblack")
        )
        rows += [f"{place}.tiff,{k},P,{5 * (y == 0)},{y},along,{30 * (k - 4)}" for k in range(9)]
    text = edited(text_of("lab/measured/focus.yaml"), ("mtf: mtf.csv", "images: images.csv"))
    files = {"focus.yaml": text, "images.csv": "\n".join(rows).encode(), **images}
    for target, kind in (("images.csv", "table of images"), ("a.tiff", "TIFF image")):
        yield Case(f"lab-measured-images-{Path(target).stem}", kind, lab, ("focus",), files, target, whole=2)


def _edge(blur: float, size: int = 64) -> np.ndarray:
    """A slanted edge with even noise, 16 bits."""
    rows, columns = np.mgrid[0:size, 0:size]
    across = columns - 0.5 * size + 0.4 - np.tan(np.radians(5.0)) * (rows - size // 2)
    light = 4000.0 + 20000.0 * (1.0 + np.tanh(across / blur))
    return (np.rint(light) + np.random.default_rng(1).integers(-60, 61, light.shape)).astype(np.uint16)


def _measured_passes() -> Iterator[Case]:
    """Tests in orbit on measurements, their tables and what says how to read these; one pass."""
    folder = "orbit/measured"
    data = text_of(f"{folder}/data.yaml").decode()
    data = data[: data.index("  Anhui:")].replace("Beijing/", "")
    tables = {
        f"{k}.csv": text_of(f"{folder}/Beijing/{k}.csv")
        for k in ("orbit", "attitude", "lines", "ground", "image_points")
    }
    calibrate = edited(text_of(f"{folder}/calibrate.yaml"), ("  - [Beijing, Anhui]\n", ""))
    kinds = {"test.yaml": "measured calibration", "data.yaml": "measurements of passes"}
    for command, text in (("calibrate", calibrate), ("angle", text_of(f"{folder}/angle.yaml"))):
        own = {"test.yaml": text, "data.yaml": data.encode(), **tables}
        for target in own if command == "calibrate" else ("test.yaml",):
            kind = kinds.get(target, f"table {target} of a pass") if command == "calibrate" else "measured angles"
            yield Case(
                f"measured-{command}-{Path(target).stem}", kind, orbit, (command,), own, target, weight=0.5, whole=30
            )


def _pass_files() -> Iterator[Case]:
    """Files of a pass, as a check of its conventions reads them."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        spec = bench.check_files(folder, 8)
        bench.orbit_csv(folder / "orbit.csv", step=6.0)
        bench.attitude_csv(folder / "attitude.csv", step=3.0)
        files = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
        bench.sp3(folder / "pass.sp3", step=6.0)
        bench.oem(folder / "pass.oem", step=6.0)
        bench.aem(folder / "pass.aem", step=3.0)
        foreign = {name: (folder / name).read_bytes() for name in ("pass.sp3", "pass.oem", "pass.aem")}
    for target in files:
        own = {"check.yaml": dump_yaml(spec).encode(), **files}
        yield Case(f"check-{Path(target).stem}", f"file {target} of a pass", orbit, ("check",), own, target, whole=30)
    yield Case("check", "check of a pass", orbit, ("check",), own, "check.yaml", whole=30)

    def case(name: str, kind: str, target: str, content: bytes, more: Files, **changes: Any) -> Case:
        changed = json.loads(json.dumps(spec))
        for key, value in changes.items():
            part, _, rest = key.partition("__")
            if rest:
                changed[part][rest] = value
            else:
                changed[part] = value
        own = {"check.yaml": dump_yaml(changed).encode(), **files, **more, target: content}
        return Case(name, kind, orbit, ("check",), own, target, whole=30)

    days = [f"{day},-0.15{k:02d},0.001{k},0.323{k},0.11,-0.19" for k, day in enumerate(range(55620, 55632))]
    eop = ("mjd,ut1_utc [s],x_pole [arcsec],y_pole [arcsec],dx [mas],dy [mas]\n" + "\n".join(days)).encode()
    earth = {"attitude": spec["platform"]["attitude"], "earth_orientation": "eop.csv"}
    sp3 = {**earth, "orbit": {"file": "pass.sp3", "satellite": "L51"}}
    oem = {**earth, "orbit": {"file": "pass.oem"}}
    aem = {**oem, "attitude": {"file": "pass.aem", "body_axes": bench.AXES}}
    more = {"eop.csv": eop, **foreign}
    yield case("check-sp3", "SP3", "pass.sp3", foreign["pass.sp3"], more, platform=sp3)
    yield case("check-oem", "OEM", "pass.oem", foreign["pass.oem"], more, platform=oem)
    yield case("check-aem", "AEM", "pass.aem", foreign["pass.aem"], more, platform=aem)
    yield case("check-eop", "Earth orientation", "eop.csv", eop, more, platform=oem)
    points = [line.split(",") for line in files["ground.csv"].decode().split("\n")[1:] if line]
    gcp = "\n".join(
        f"{name} {lat} {lon} {height} 0.5 0.5 1.0 nadir.tif 55{k} 103{k} 0.3 0.3"
        for k, (name, lat, lon, height) in enumerate(points)
    )
    ground = {"file": "points.gcp", "crs": "EPSG:4979"}
    yield case("check-gcp", "GCP", "points.gcp", gcp.encode(), {}, ground=ground)
    sigmas = {"sigma_east": 0.5, "sigma_north": 0.5, "sigma_up": 1.0, "role": "control"}
    features = [
        {
            "type": "Feature",
            "id": name,
            "geometry": {"type": "Point", "coordinates": [float(lon), float(lat), float(height)]},
            "properties": sigmas,
        }
        for name, lat, lon, height in points
    ]
    text = json.dumps({"type": "FeatureCollection", "features": features}, indent=1)
    yield case("check-geojson", "GeoJSON", "points.geojson", text.encode(), {}, ground={"file": "points.geojson"})


# --- measured frames of a monitor


def _spots(frames: int, light: int, mark: int = 0) -> np.ndarray:
    """Small frames of a spot; those of other marks, and each of a file, differ in a pixel: a copy would be refused."""
    one = np.full((32, 32), 100, np.uint16)
    one[13:20, 13:20] += 256 * light
    out = np.stack([one] * frames)
    for k in range(frames):
        out[k].flat[4 * mark + k] += 1
    return out


def _written(frames: np.ndarray, ending: str) -> bytes:
    """Frames as a file."""
    out = io.BytesIO()
    if ending == "fits":
        fits.PrimaryHDU(frames.astype(np.int16)).writeto(out)
    elif ending == "tiff":
        tifffile.imwrite(out, frames, photometric="minisblack", compression="lzw")
    else:
        return bytes(cv2.imencode(f".{ending}", frames[0])[1])
    return out.getvalue()


def _frames() -> Iterator[Case]:
    """Measured frames of a monitor, and their files."""
    folder = {
        f"images/{camera}_{side}_{when}.fits": _written(_spots(1, 8, mark), "fits")
        for mark, (camera, side, when) in enumerate(
            product(("forward", "backward"), ("left", "right"), ("before", "after"))
        )
    }
    text = edited(text_of("examples/measured_frames.yaml"), ("../../runs/first/images", "./images"))
    own = {"frames.yaml": text, **folder}
    yield Case("frames-model", "measurement", recover, (), own, "frames.yaml", whole=50)
    geometry = """template: measured
detector: ./ccd.yaml
exposure: 10 ms
geometry:
  one:
    {principal_distance: 5.5 m, separation: 235 mm, pitch: 12 um, look: 26 deg, field: 1.2 deg,
     principal_distance_across: 5.6 m}
bad_pixels: {one/left: bad.fits, one/right: [bad.fits]}
dark: dark.fits
flat: {all: [flat.fits]}
photon_transfer: measured
corrections: automatic
vibration: fitted
analysis: {centroid: ml}
"""
    listed = """times: [0 min, 0.5 h]
frames:
  one/left: {before: [a.fits, b.tiff], after: [c.fits, [d.fits, e.png]], offset: [4, 2], offset_after: [0, 0]}
  one/right: {before: f.fits, after: [g.fits, h.fits]}
"""
    endings = {"b": "tiff", "e": "png"}
    names = {name: f"{name}.{endings.get(name, 'fits')}" for name in "abcdefghij"}
    spots = {
        file: _written(_spots(3 if name == "a" else 1, 8 + mark % 2, mark), endings.get(name, "fits"))
        for mark, (name, file) in enumerate(names.items())
    }
    # dark and flat frames need noise: two grey values in turns
    turns = (np.arange(2 * 32 * 32) ** 2 // 7 + np.arange(2 * 32 * 32) // 1024).reshape(2, 32, 32) % 2
    noisy = {"dark.fits": _written(100 + turns, "fits"), "flat.fits": _written(8000 + 25 * turns, "fits")}
    bad = {"bad.fits": _written(np.where(np.arange(1024).reshape(1, 32, 32) == 77, 1, 0), "fits")}
    files = {"ccd.yaml": text_of("library/detectors/monitor_ccd.yaml"), **spots, **bad, **noisy}
    own = {"frames.yaml": (geometry + listed).encode(), **files}
    kinds = {
        **{"frames.yaml": "measurement", "ccd.yaml": "detector", "a.fits": "FITS image", "flat.fits": "FITS image"},
        **{"b.tiff": "TIFF image", "e.png": "PNG image", "bad.fits": "FITS image"},
    }
    for target, kind in kinds.items():
        yield Case(f"frames-{Path(target).stem}", kind, recover, (), own, target, whole=30)
    table = "channel,time [min],file,row,column\n" + "".join(
        f"one/{side},{when},{names[name]},4,2\n"
        for side, letters in (("left", "abcde"), ("right", "fghij"))
        for when, name in zip(("before", "before", "0", "30.5", "30.5"), letters, strict=True)
    )
    own = {**own, "frames.yaml": (geometry + "frames: frames.csv\n").encode(), "frames.csv": table.encode()}
    yield Case("frames-table", "table of frames", recover, (), own, "frames.csv", whole=30)


# --- prescriptions and pictures


def _prescriptions() -> Iterator[Case]:
    """Files of other optical programs."""

    def case(name: str, kind: str, file: str, content: bytes, *options: str, **more: Any) -> Case:
        files = {file: content, **more}
        return Case(name, kind, lens, ("read",), files, file, options, out="out/camera.yaml", whole=1, weight=0.6)

    glasses = ("--glasses", "{here}/glass.agf")
    for name, text in (("wide", TMA.encode("utf-16")), ("tma", TMA.encode()), ("singlet", SINGLET.encode())):
        yield case(f"lens-zemax-{name}", "Zemax", "a.zmx", text)
    for name, coding in (("plain", "utf-8"), ("wide", "utf-16-le")):
        yield case(f"lens-codev-{name}", "CODE V", "a.seq", CODEV.encode(coding))
    yield case(
        "lens-batoid",
        "batoid",
        "a.yaml",
        BATOID.encode(),
        "--wavelength",
        "650 nm",
        "--field",
        "0.2 deg",
        "--pupil",
        "2 m",
    )
    for name, coding in (("plain", "utf-8"), ("wide", "utf-16")):
        own = {"a.zmx": SINGLET.encode(), "glass.agf": AGF.encode(coding)}
        more: dict[str, Any] = {"out": "out/camera.yaml", "whole": 1, "weight": 0.6}
        yield Case(f"lens-glasses-{name}", "glass catalogue", lens, ("read",), own, "glass.agf", glasses, **more)
    own = {"gf7.yaml": text_of("library/cameras/gf7.yaml")}
    yield Case("lens-write", "camera", lens, ("write",), own, "gf7.yaml", out="out/camera.zmx", whole=1)


def _pictures() -> Iterator[Case]:
    """Images of an edge and of bars."""
    edge = np.stack([_edge(1.3), _edge(1.3)])
    rows, columns = np.mgrid[0:64, 0:96]
    wave = 0.5 + 0.3 * np.sin(2.0 * np.pi * (columns + 0.05 * rows) / 4.0)
    wave = np.where(columns >= 80, 1.0, np.where(columns >= 64, 0.0, wave))
    bars = np.rint(2000.0 + 40000.0 * wave).astype(np.uint16)
    words = ("--pitch", "7 um", "--roi")
    of_bars = (*words, "4,4,48,48", "--bars", "0.25 cycles/pixel", "--dark", "4,66,48,12", "--bright", "4,82,48,12")
    curve = ("--csv", "{here}/out/curve.csv", "--plot", "{here}/out/curve.svg")
    for ending, kind in (("tiff", "TIFF image"), ("fits", "FITS image"), ("png", "PNG image"), ("jpg", "JPEG image")):
        frames = edge if ending != "jpg" else (edge >> 8).astype(np.uint8)
        frames = frames // 2 if ending == "fits" else frames
        file = f"edge.{ending}"
        options = (*words, "2,2,60,60", *(curve if ending in ("tiff", "png") else ()))
        yield Case(f"mtf-{ending}", kind, mtf, (), {file: _written(frames, ending)}, file, options, out="", whole=1)
    yield Case(
        "mtf-bars", "TIFF image", mtf, (), {"b.tiff": _written(bars[None], "tiff")}, "b.tiff", of_bars, out="", whole=1
    )
