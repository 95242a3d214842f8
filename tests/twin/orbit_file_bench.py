"""A pass in files of several formats, written here from the simulation's orbit, for the tests of their readers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scenes.specs.orbit.flight import OrbitSpec
from scenes.yaml.yaml_file import read_yaml
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.trajectory import Attitude, Trajectory

EPOCH = "2011-03-05T03:05:00Z"
LEAP = 34.0
"""TAI - UTC in 2011, seconds."""
UTC_TO = {"UTC": 0.0, "GPS": LEAP - 19.0, "TAI": LEAP, "TT": LEAP + 32.184, "BDT": LEAP - 33.0}
"""Scale -> what its clock shows more than a UTC clock on that day."""
EARTH = Earth(-0.1523, (0.1 / 206264.8, 0.35 / 206264.8))


@cache
def trajectory() -> Trajectory:
    spec = OrbitSpec.model_validate(
        {
            "epoch": EPOCH,
            "before": "60 s",
            "after": "60 s",
            "passing": {"longitude": "116 deg", "latitude": "40 deg", "altitude": "500 km", "direction": "descending"},
        }
    )
    return Trajectory(propagate(spec, EARTH), Attitude(yaw_steering=True, offset=(1e-4, -2e-4, 5e-5)))


def calendar(seconds: float, scale: str = "UTC", digits: int = 6) -> str:
    moment = datetime.fromisoformat(EPOCH[:-1]) + timedelta(seconds=round(float(seconds) + UTC_TO[scale], digits))
    return moment.strftime("%Y-%m-%dT%H:%M:%S.%f")


@dataclass(frozen=True)
class Sampled:
    """Times and states of the pass in one frame."""

    seconds: np.ndarray
    position: np.ndarray
    velocity: np.ndarray


def sampled(frame: str = "ITRS", step: float = 1.0) -> Sampled:
    path = trajectory()
    t = np.arange(-60.0, 60.0 + 1e-9, step)
    if frame == "GCRS":
        return Sampled(t, *path.orbit.gcrs(t))
    return Sampled(t, path.position(t), path.velocity(t))


def quaternions(seconds: np.ndarray, frame: str = "ITRS", order: str = "xyzw", inverse: bool = False) -> np.ndarray:
    path = trajectory()
    matrix = path.body_to_itrs(seconds)
    if frame == "GCRS":
        matrix = np.swapaxes(path.orbit.rotation.matrix(seconds), -1, -2) @ matrix
    q = Rotation.from_matrix(matrix).as_quat(canonical=True)
    if inverse:
        q[:, :3] *= -1.0
    return q if order == "xyzw" else np.roll(q, 1, axis=1)


def csv(path: Path, heads: Sequence[str], *columns: Sequence[object]) -> Path:
    rows = [",".join(heads), *(",".join(map(str, row)) for row in zip(*columns, strict=True))]
    path.write_text("\n".join(rows) + "\n", "utf-8")
    return path


def orbit_csv(path: Path, frame: str = "ITRS", scale: str = "UTC", step: float = 1.0) -> Path:
    s = sampled(frame, step)
    texts = [calendar(t, scale) for t in s.seconds]
    heads = ("date_time", "x [m]", "y [m]", "z [m]", "vx [m/s]", "vy [m/s]", "vz [m/s]")
    return csv(
        path,
        heads,
        texts,
        *(map(repr, c) for c in s.position.T.tolist()),
        *(map(repr, c) for c in s.velocity.T.tolist()),
    )


def attitude_csv(
    path: Path, frame: str = "ITRS", scale: str = "UTC", order: str = "xyzw", inverse: bool = False, step: float = 0.25
) -> Path:
    t = np.arange(-60.0, 60.0 + 1e-9, step)
    q = quaternions(t, frame, order, inverse)
    return csv(path, ("date_time", "q1", "q2", "q3", "q4"), [calendar(s, scale) for s in t], *q.T.tolist())


def oem(path: Path, frame: str = "GCRF", scale: str = "UTC", step: float = 1.0, satellite: str = "2010-040A") -> Path:
    s = sampled("ITRS" if frame.startswith("ITRF") else "GCRS", step)
    lines = f"""CCSDS_OEM_VERS = 2.0
CREATION_DATE = 2011-03-06T00:00:00
ORIGINATOR = HERE
META_START
OBJECT_NAME = PASS\nOBJECT_ID = {satellite}\nCENTER_NAME = EARTH\nREF_FRAME = {frame}\nTIME_SYSTEM = {scale}
START_TIME = {calendar(s.seconds[0], scale)}\nSTOP_TIME = {calendar(s.seconds[-1], scale)}
META_STOP
COMMENT states""".splitlines()
    for t, r, v in zip(s.seconds, s.position / 1e3, s.velocity / 1e3, strict=True):
        lines.append(f"{calendar(t, scale)} " + " ".join(repr(float(x)) for x in (*r, *v)))
    path.write_text("\n".join(lines) + "\n", "utf-8")
    return path


def oem_xml(path: Path) -> None:
    s = sampled("GCRS", 10.0)
    states = "\n".join(
        f"<stateVector><EPOCH>{calendar(t)}</EPOCH>"
        + "".join(f"<{n}>{float(v)!r}</{n}>" for n, v in zip("XYZ", r / 1e3, strict=True))
        + "".join(f"<{n}_DOT>{float(v)!r}</{n}_DOT>" for n, v in zip("XYZ", w / 1e3, strict=True))
        + "</stateVector>"
        for t, r, w in zip(s.seconds, s.position, s.velocity, strict=True)
    )
    meta = "<OBJECT_ID>A</OBJECT_ID><CENTER_NAME>EARTH</CENTER_NAME><REF_FRAME>GCRF</REF_FRAME>"
    path.write_text(
        f'<?xml version="1.0"?><oem id="CCSDS_OEM_VERS" version="2.0"><body><segment><metadata>{meta}'
        f"<TIME_SYSTEM>UTC</TIME_SYSTEM></metadata><data>{states}</data></segment></body></oem>"
    )


def aem(path: Path, scale: str = "UTC", direction: str = "A2B", first: bool = False, step: float = 0.25) -> Path:
    t = np.arange(-60.0, 60.0 + 1e-9, step)
    inverse = direction == "B2A"
    q = quaternions(t, "GCRS", "wxyz" if first else "xyzw", inverse)
    rows = [f"{calendar(s, scale)} " + " ".join(f"{float(x):.15f}" for x in row) for s, row in zip(t, q, strict=True)]
    lines = f"""CCSDS_AEM_VERS = 1.0
CREATION_DATE = 2011-03-06T00:00:00
ORIGINATOR = HERE
META_START
OBJECT_NAME = PASS\nOBJECT_ID = 2010-040A\nREF_FRAME_A = ICRF\nREF_FRAME_B = SC_BODY_1\nATTITUDE_DIR = {direction}
TIME_SYSTEM = {scale}\nSTART_TIME = {calendar(t[0], scale)}\nSTOP_TIME = {calendar(t[-1], scale)}
ATTITUDE_TYPE = QUATERNION\nQUATERNION_TYPE = {"FIRST" if first else "LAST"}
META_STOP
DATA_START""".splitlines()
    lines += [*rows, "DATA_STOP"]
    path.write_text("\n".join(lines) + "\n", "utf-8")
    return path


def sp3(path: Path, scale: str = "GPS", step: float = 1.0, version: str = "d", speeds: bool = True) -> Path:
    s = sampled("ITRS", step)
    first = datetime.fromisoformat(calendar(s.seconds[0], scale))
    mode = "V" if speeds else "P"
    lines = [
        f"#{version}{mode}{first:%Y} {first.month:2d} {first.day:2d} {first.hour:2d} {first.minute:2d} "
        f"{first.second + first.microsecond * 1e-6:11.8f} {len(s.seconds):7d} ORBIT IGS20 HLM  IGS",
        f"## 1626 529500.00000000 {step:14.8f} 55625 0.1284722222222",
        "+    2   G01L51" + "  0" * 15,
        "++         0  0" + "  0" * 15,
        f"%c M  cc {scale:<3} ccc cccc cccc cccc cccc ccccc ccccc ccccc ccccc",
        "%c cc cc ccc ccc cccc cccc cccc cccc ccccc ccccc ccccc ccccc",
        "%f  1.2500000  1.025000000  0.00000000000  0.000000000000000",
        "%i    0    0    0    0      0      0      0      0         0",
        "/* a pass",
    ]
    for t, r, v in zip(s.seconds, s.position / 1e3, s.velocity * 10.0, strict=True):
        now = datetime.fromisoformat(calendar(t, scale))
        second = now.second + now.microsecond * 1e-6
        lines.append(f"*  {now:%Y} {now.month:2d} {now.day:2d} {now.hour:2d} {now.minute:2d} {second:11.8f}")
        for name, scale_of in (("G01", 3.86), ("L51", 1.0)):
            lines.append(f"P{name}" + "".join(f"{x * scale_of:14.6f}" for x in r) + f"{999999.999999:14.6f}")
            if speeds:
                lines.append(f"V{name}" + "".join(f"{x * scale_of:14.6f}" for x in v) + f"{999999.999999:14.6f}")
    path.write_text("\n".join([*lines, "EOF"]) + "\n", "utf-8")
    return path


AXES = ["forward", "right", "down"]
LINE_TIME = 0.7e-3
LINES = 9000
FIRST = -3.0
"""Of every line's image: its first line's time, seconds, and so many lines."""


def interior_and_bias() -> tuple[np.ndarray, float]:
    """What the camera and platform really are wrong by: a rotation vector, and pixels along each line."""
    return np.array([-25.0, 32.0, 40.0]) / 206264.8, 12.0


def measured_points(seed: int, count: int, wrong: float = 0.0) -> tuple[list[list[object]], list[list[object]]]:
    """Rows of ground points and image points of th1's lines, with noise of 0.2 px and 1 m, all a little wrong."""
    from optics.geometry.pose import rotation_matrix
    from scenes.specs.orbit.setup import load_three_line_camera
    from twin.orbit.flight.line_camera import line_cameras
    from twin.orbit.flight.sensor import Sensor

    class Biased:
        def __init__(self) -> None:
            self.path = trajectory()
            self.position, self.inertial_velocity = self.path.position, self.path.inertial_velocity

        def body_to_itrs(self, seconds):
            return self.path.body_to_itrs(seconds) @ rotation_matrix(interior_and_bias()[0])

    rng = np.random.default_rng(seed)
    cameras = line_cameras(load_three_line_camera("th1"))
    ground, images = [], []
    for name, start in (("forward", FIRST), ("nadir", FIRST), ("backward", FIRST)):
        camera = cameras[name]
        sensor = Sensor(camera, Biased(), EARTH, LINE_TIME, start, LINES)
        line, pixel = rng.uniform(50, LINES - 50, count), rng.uniform(50, camera.pixels - 50, count)
        height = rng.uniform(100.0, 900.0, count)
        itrs = sensor.ground(line, pixel, height)
        lon, lat, h = EARTH.geodetic(itrs + rng.normal(0.0, 1.0, itrs.shape))
        line = line + rng.normal(0.0, 0.2, count)
        pixel = pixel + rng.normal(0.0, 0.2, count) + interior_and_bias()[1] * 0.1
        gross = rng.uniform(size=count) < wrong
        line[gross] += rng.uniform(10.0, 40.0, int(gross.sum()))
        for k in range(count):
            key = f"{name}{k}"
            ground.append([key, repr(float(np.degrees(lat[k]))), repr(float(np.degrees(lon[k]))), repr(float(h[k]))])
            images.append([key, name, float(line[k]), float(pixel[k]), 0.2, 0.2])
    return ground, images


def check_files(
    folder: Path, count: int = 20, seed: int = 1, wrong: float = 0.0, **platform: object
) -> dict[str, object]:
    """Files of the pass as a check reads them, and its specification as it stands in YAML."""
    orbit_csv(folder / "orbit.csv")
    attitude_csv(folder / "attitude.csv")
    ground, images = measured_points(seed, count, wrong)
    csv(folder / "ground.csv", ("point", "latitude [deg]", "longitude [deg]", "height [m]"), *zip(*ground, strict=True))
    heads = ("point", "camera", "line", "pixel", "line_sigma", "pixel_sigma")
    csv(folder / "image_points.csv", heads, *zip(*images, strict=True))
    times = [
        (name, k, calendar(FIRST + k * LINE_TIME, digits=9))
        for name in ("forward", "nadir", "backward")
        for k in (0, LINES - 1)
    ]
    csv(folder / "lines.csv", ("camera", "line", "date_time"), *zip(*times, strict=True))
    return specification("check")


def match_files(folder: Path, flown: Any) -> dict[str, object]:
    """Files of a simulated pass as `match` reads them, and its specification as it stands in YAML."""
    from twin.framework.data_files import FrameFacts, tiff
    from twin.orbit.flight.platform_table import PlatformTable
    from twin.orbit.images.simulate_report import map_facts
    from twin.orbit.measured.measurement_tables import csv_text

    table = PlatformTable.sampled(flown.measured, 1.0, 0.125)
    orbit = {"time [s]": table.orbit_time, **dict(zip(("x [m]", "y [m]", "z [m]"), table.position.T, strict=True))}
    orbit |= dict(zip(("vx [m/s]", "vy [m/s]", "vz [m/s]"), table.velocity.T, strict=True))
    attitude = {"time [s]": table.attitude_time, **dict(zip(("q1", "q2", "q3", "q4"), table.quaternion.T, strict=True))}
    (folder / "orbit.csv").write_text(csv_text(orbit))
    (folder / "attitude.csv").write_text(csv_text(attitude))
    rows, images = [], {}
    for name, image in flown.patch.images.items():
        window = image.window
        numbers = np.array([window.first_line, window.first_line + window.lines - 1])
        first, last = map(float, image.measured.time(numbers))
        rows += [(name, 0, repr(first)), (name, window.lines - 1, repr(last))]
        (folder / f"{name}.tiff").write_bytes(tiff(image.frame[None], FrameFacts()))
        images[name] = {"file": f"{name}.tiff", "first_pixel": window.first_pixel, "first_pixel_sees": "right"}
    csv(folder / "lines.csv", ("camera", "line", "time [s]"), *zip(*rows, strict=True))
    control = flown.patch.control
    (folder / "photo.tiff").write_bytes(tiff(control.orthophoto.values[None], map_facts(control.orthophoto, "")))
    (folder / "dem.tiff").write_bytes(tiff(control.dem.values[None], map_facts(control.dem, "", heights=True)))
    return {**specification("match"), "images": images}


def specification(kind: str) -> dict[str, Any]:
    return dict(read_yaml(Path(__file__).with_name("orbit_passes.yaml")).data[kind])
