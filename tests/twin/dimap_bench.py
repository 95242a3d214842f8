"""DIMAP files of passes that never were, written by hand in the format, and the format's model anew.

The oracle shares nothing with the program: its own XML parser, Lagrange's polynomial of eight points, and the ellipsoid
of constant height by a root.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from datetime import date, timedelta
from pathlib import Path

import numpy as np
from scipy.interpolate import BarycentricInterpolator
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from analysis.orbit.rational_polynomial import RationalPolynomial

MU, OMEGA = 3.986004418e14, 7.292115e-5
A, F = 6378137.0, 1.0 / 298.257223563


@dataclass(frozen=True)
class Scene:
    """What a file is written of.

    Attributes:
        profile, version: of the product.
        lines, pixels: of the image.
        period: from line to line, seconds.
        start: second of the day of the first line.
        day: of it.
        ephemeris: seconds between points of the orbit; how many.
        pitch, roll: of the look, rad; `rate` of them, rad/s.
        first_column: of the image in the swath.
        xlos, ylos: tangents.
        attitude: ``polynomial`` or ``samples``, with their interval.
    """

    profile: str = "PHR_SENSOR"
    version: str = "2.15"
    lines: int = 12_000
    pixels: int = 20_000
    period: float = 0.0735e-3
    start: float = 38_312.125
    day: str = "2017-09-28"
    ephemeris: tuple[float, int] = (30.0, 10)
    pitch: float = 0.2
    roll: float = -0.1
    rate: tuple[float, float] = (4e-3, -2e-3)
    first_column: int = 1
    xlos: tuple[float, ...] = (-0.0100, 1.0e-6)
    ylos: tuple[float, ...] = (-2.5e-4,)
    attitude: str = "polynomial"
    interval: float = 0.03
    bands: tuple[str, ...] = ()
    settings: dict[str, str] = field(default_factory=dict)

    def orbit(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity, Earth-fixed (N, 3), at seconds of the day: a circle at 694 km, 98 deg."""
        radius = A + 694e3
        n, inclination = np.sqrt(MU / radius**3), np.radians(98.2)
        u = 2.3 + n * (seconds - self.start)
        place = radius * np.stack([np.cos(u), np.sin(u) * np.cos(inclination), np.sin(u) * np.sin(inclination)], -1)
        speed = (
            radius * n * np.stack([-np.sin(u), np.cos(u) * np.cos(inclination), np.cos(u) * np.sin(inclination)], -1)
        )
        turned = Rotation.from_rotvec(np.outer(seconds - self.start, [0.0, 0.0, -OMEGA]))
        fixed, speed = turned.apply(place), turned.apply(speed)
        return fixed, speed - np.cross([0.0, 0.0, OMEGA], fixed)

    def quaternions(self, seconds: np.ndarray) -> np.ndarray:
        """(N, 4) scalar first, body to Earth-fixed, neighbours on one side."""
        place, speed = self.orbit(seconds)
        down = -place / np.linalg.norm(place, axis=1, keepdims=True)
        right = np.cross(down, speed)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        level = Rotation.from_matrix(np.stack([np.cross(right, down), right, down], axis=-1))
        look = np.array([self.pitch, self.roll]) + np.outer(seconds - self.start, self.rate)
        found = np.roll((level * Rotation.from_euler("YX", look)).as_quat(), 1, axis=1)
        return found * np.sign(found @ found[0])[:, None]


def clock(scene: Scene, second: float) -> str:
    """UTC text of a second of the scene's day, or of the next."""
    days, second = divmod(second, 86_400.0)
    day = date.fromisoformat(scene.day) + timedelta(days=int(days))
    hour, rest = divmod(second, 3600.0)
    minute, rest = divmod(rest, 60.0)
    return f"{day}T{int(hour):02d}:{int(minute):02d}:{rest:012.9f}Z"


def dimap(scene: Scene) -> str:
    """A product's file."""
    last = scene.start + (scene.lines - 1) * scene.period
    step, count = scene.ephemeris
    # the image lies between the middle points
    fixes = scene.start + step * (np.arange(count) - count // 2 + 0.4)
    place, speed = scene.orbit(fixes)
    points = "\n".join(
        f"""<Point><LOCATION_XYZ unit="m">{" ".join(map(repr, p.tolist()))}</LOCATION_XYZ>
            <VELOCITY_XYZ unit="m/s">{" ".join(map(repr, v.tolist()))}</VELOCITY_XYZ>
            <TIME>{clock(scene, t)}</TIME></Point>"""
        for t, p, v in zip(fixes, place, speed, strict=True)
    )
    looks = "".join(
        f"<{name}_{k}>{value!r}</{name}_{k}>"
        for name, terms in (("XLOS", scene.xlos), ("YLOS", scene.ylos))
        for k, value in enumerate(terms)
    )
    looks = f"<Polynomial_Look_Angles>{looks}</Polynomial_Look_Angles>"
    if scene.bands:
        each = "".join(f"<Band_Calibration><BAND_ID>{b}</BAND_ID>{looks}</Band_Calibration>" for b in scene.bands)
        looks = f"<Band_Calibration_List>{each}</Band_Calibration_List>"
    settings = "".join(f"<{name}>{value}</{name}>" for name, value in scene.settings.items())
    unit = "microsecond" if scene.version.startswith("3") else "ms"
    period = scene.period * (1e6 if unit == "microsecond" else 1e3)
    text = Path(__file__).with_name("dimap_scene.xml").read_text("utf-8")
    ends = {"start": clock(scene, scene.start), "end": clock(scene, last)}
    more = {"last_column": scene.first_column + scene.pixels - 1, "attitude": _attitude(scene, last)}
    return text.format(
        scene=scene, settings=settings, unit=unit, period=period, points=points, looks=looks, **ends, **more
    )


def _attitude(scene: Scene, last: float) -> str:
    if scene.attitude == "samples":
        times = np.arange(scene.start - 4.0 * scene.interval, last + 4.0 * scene.interval, scene.interval)
        return (
            "<Quaternion_List>"
            + "\n".join(
                "<Quaternion>"
                + "".join(f"<Q{k}>{value!r}</Q{k}>" for k, value in enumerate(q.tolist()))
                + f"<TIME>{clock(scene, t)}</TIME></Quaternion>"
                for t, q in zip(times, scene.quaternions(times), strict=True)
            )
            + "</Quaternion_List>"
        )
    offset, scale = 0.5 * (scene.start + last), 0.5 * (last - scene.start)
    u = np.linspace(-1.0, 1.0, 41)
    parts = np.polynomial.polynomial.polyfit(u, scene.quaternions(offset + scale * u), 3)
    rows = "\n".join(
        f"<Q{k}><DEGREE>3</DEGREE><COEFFICIENTS>{' '.join(map(repr, parts[:, k].tolist()))}</COEFFICIENTS></Q{k}>"
        for k in range(4)
    )
    return (
        f"<Polynomial_Quaternions><OFFSET>{offset!r}</OFFSET><SCALE>{scale!r}</SCALE>\n{rows}</Polynomial_Quaternions>"
    )


def rpc(model: RationalPolynomial, version: str = "2.15") -> str:
    """The file of a product's rational polynomials."""
    one = 1.0 if version.startswith("2") else 0.0
    ground = "Inverse_Model" if one else "GroundtoImage_Values"
    parts = {
        "SAMP_NUM": model.sample_numerator,
        "SAMP_DEN": model.sample_denominator,
        "LINE_NUM": model.line_numerator,
        "LINE_DEN": model.line_denominator,
    }
    rows = "".join(
        f"        <{name}_COEFF_{k + 1}>{value!r}</{name}_COEFF_{k + 1}>\n"
        for name, part in parts.items()
        for k, value in enumerate(part.tolist())
    )
    sizes = "".join(
        f"        <{name}_SCALE>{scale!r}</{name}_SCALE>\n        <{name}_OFF>{offset!r}</{name}_OFF>\n"
        for name, scale, offset in zip(
            ("LINE", "SAMP", "LAT", "LONG", "HEIGHT"),
            model.scale.tolist(),
            [a + b for a, b in zip(model.offset.tolist(), (one, one, 0.0, 0.0, 0.0), strict=True)],
            strict=True,
        )
    )
    text = Path(__file__).with_name("dimap_rpc.xml").read_text("utf-8")
    return text.format(version=version, ground=ground, rows=rows, sizes=sizes)


def write(folder: Path, scene: Scene, name: str = "DIM_SCENE.XML") -> Path:
    """The file of a scene in a folder."""
    path = folder / name
    path.write_text(dimap(scene))
    return path


class Oracle:
    """The rigorous model of a file, row and column counted from 0."""

    def __init__(self, path: Path) -> None:
        root = ET.parse(path).getroot()
        model = root.find("Geometric_Data/Refined_Model")
        points = model.findall("Ephemeris/Point_List/Point")
        self.time = np.array([self._second(p.findtext("TIME")) for p in points])
        self.place = np.array([[float(v) for v in p.findtext("LOCATION_XYZ").split()] for p in points])
        self.start = self._second(model.findtext("Time/Time_Range/START"))
        stamp = model.find("Time/Time_Stamp/LINE_PERIOD")
        self.period = float(stamp.text) * {"ms": 1e-3, "microsecond": 1e-6}[stamp.get("unit")]
        polynomial = model.find("Attitudes/Polynomial_Quaternions")
        self.samples = None
        if polynomial is None:
            listed = model.findall("Attitudes/Quaternion_List/Quaternion")
            self.samples = (
                np.array([self._second(q.findtext("TIME")) for q in listed]),
                np.array([[float(q.findtext(f"Q{k}")) for k in range(4)] for q in listed]),
            )
        else:
            self.offset, self.scale = float(polynomial.findtext("OFFSET")), float(polynomial.findtext("SCALE"))
            self.parts = [[float(v) for v in polynomial.findtext(f"Q{k}/COEFFICIENTS").split()] for k in range(4)]
        angles = next(model.iter("Polynomial_Look_Angles"))
        self.xlos, self.ylos = (
            [float(one.text) for one in angles if one.tag.startswith(name)] for name in ("XLOS", "YLOS")
        )
        self.first = int(next(model.iter("FIRST_COL")).text)

    @staticmethod
    def _second(text: str) -> float:
        hour, minute, second = text.rstrip("Z").split("T")[1].split(":")
        return 3600.0 * int(hour) + 60.0 * int(minute) + float(second)

    def _lagrange(self, t: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        k = int(np.clip(np.searchsorted(x, t) - 4, 0, max(len(x) - 8, 0)))
        return np.asarray(BarycentricInterpolator(x[k : k + 8], y[k : k + 8])(t))

    def ground(self, row: float, column: float, height: float) -> np.ndarray:
        """Where a pixel sees the ground, Earth-fixed, metres."""
        t = self.start + row * self.period
        if self.samples is None:
            u = (t - self.offset) / self.scale
            q = np.array([sum(c * u**n for n, c in enumerate(part)) for part in self.parts])
        else:
            q = self._lagrange(t, *self.samples)
        turn = Rotation.from_quat(np.roll(q, -1)).as_matrix()
        c = column + self.first - 1
        psi = [sum(a * c**n for n, a in enumerate(terms)) for terms in (self.xlos, self.ylos)]
        look = turn @ np.array([psi[1], -psi[0], 1.0])
        station = self._lagrange(t, self.time, self.place)
        look = look / np.linalg.norm(look)
        # the nearer crossing of the surface of this height lies before the point of closest approach
        ends = 0.0, min(1.2e6, -station @ look)
        away = brentq(lambda d: _height(station + d * look) - height, *ends, xtol=1e-9)
        return station + away * look


def _height(point: np.ndarray) -> float:
    """Geodetic height by fixed-point steps on the latitude."""
    e2 = F * (2.0 - F)
    across = np.hypot(point[0], point[1])
    latitude = np.arctan2(point[2], across * (1.0 - e2))
    for _ in range(12):
        normal = A / np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(point[2] + e2 * normal * np.sin(latitude), across)
    normal = A / np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
    # good at all latitudes, where across / cos(latitude) is not
    return float(across * np.cos(latitude) + point[2] * np.sin(latitude) - A**2 / normal)
