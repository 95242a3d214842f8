"""A simulated block of images with rational polynomials: its truth, its files, and the noise of its image points.

Each image is a central projection of the ground from 600 km, on which rational polynomials are exact to rounding. The
positions that a user measures are those by the polynomials, plus a correction that the polynomials do not have, plus
noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from analysis.orbit.rational_polynomial import RationalPolynomial, fit_rpc
from scenes.yaml.yaml_file import dump_yaml
from twin.orbit.export.rational_polynomial import PolynomialImage
from twin.orbit.flight.earth import Earth

PLACE = (43.0, 5.5)
"""Latitude and longitude of the block's middle, degrees."""
HEIGHT = 300.0
"""Half range of the heights about their mean, 400 m, in metres."""
SIDE = 2000
"""Lines and samples of an image of 0.5 m."""
HALF = 0.5 * (SIDE - 1.0)


@cache
def polynomial(look: tuple[float, float], aside: tuple[float, float] = (0.0, 0.0)) -> RationalPolynomial:
    """Rational polynomials of an image whose line of sight has these tangents to the north and east, and whose middle
    is this many metres north and east of the block's.
    """
    rng = np.random.default_rng(7)
    place = rng.uniform(-1.0, 1.0, (1500, 3)) * [900.0, 900.0, HEIGHT] + [*aside, 0.0]
    drop = (6e5 - place[:, 2]) / 6e5
    north, east = (place[:, k] - aside[k] + look[k] * place[:, 2] for k in (0, 1))
    image = HALF + 2.0 * np.column_stack([-north, east]) / drop[:, None]
    return fit_rpc(image, degrees(place))


def degrees(place: np.ndarray) -> np.ndarray:
    """Latitude, longitude (degrees) and height above the ellipsoid of metres north, east and up (n, 3)."""
    metres = np.array([111_100.0, 111_300.0 * np.cos(np.radians(PLACE[0]))])
    return np.column_stack([np.array(PLACE) + place[:, :2] / metres, 400.0 + place[:, 2]])


@dataclass(frozen=True, eq=False)
class Bench:
    """Truth of a block and what was measured of it."""

    images: dict[str, PolynomialImage]
    correction: dict[str, np.ndarray]
    """(2, K) coefficients of the correction of line and sample, in pixels."""
    ground: np.ndarray
    """True points, ITRS."""
    places: dict[str, np.ndarray]
    """Image -> (n, 3): point, line, sample."""
    sigma: float

    def write(self, folder: Path, errors: dict, control: int = 0, **keys) -> Path:
        """Write polynomials, tables and the file of an adjustment; return the path of the file."""
        rows = ["point,image,line,sample,line_sigma,sample_sigma"]
        for name, values in self.places.items():
            (folder / f"{name}_RPC.TXT").write_text(self.images[name].polynomial.text())
            rows += [
                f"p{int(k)},{name},{line!r},{sample!r},{self.sigma},{self.sigma}" for k, line, sample in values.tolist()
            ]
        (folder / "points.csv").write_text("\n".join(rows) + "\n")
        text = {"name": "block", "images": {name: {"rpc": f"{name}_RPC.TXT"} for name in self.images}, **keys}
        text |= {"image_points": "points.csv", "errors": errors}
        if control:
            heads = "point,x [m],y [m],z [m],sigma [m]\n"
            known = [f"p{k},{x!r},{y!r},{z!r},0.05" for k, (x, y, z) in enumerate(self.ground[:control].tolist())]
            (folder / "ground.csv").write_text(heads + "\n".join(known) + "\n")
            text["ground"] = {"file": "ground.csv", "crs": "EPSG:4978"}
        (folder / "block.yaml").write_text(dump_yaml(text))
        return folder / "block.yaml"


LOOKS = {"first": (0.25, 0.05), "second": (0.0, -0.1), "third": (-0.3, 0.02)}


def bench(sigma: dict[str, float], points: int = 60, noise: float = 0.2, seed: int = 1) -> Bench:
    """A block of three images of the same ground, with corrections drawn with these sigmas (px)."""
    rng = np.random.default_rng(seed)
    images = {name: PolynomialImage.of(polynomial(look)) for name, look in LOOKS.items()}
    place = rng.uniform(-1.0, 1.0, (points, 3)) * [420.0, 420.0, 0.8 * HEIGHT]
    latitude, longitude, height = degrees(place).T
    ground = Earth().ecef(np.radians(longitude), np.radians(latitude), height)
    correction, places = {}, {}
    for name, image in images.items():
        correction[name] = np.stack([rng.standard_normal(2) * size for size in sigma.values()], axis=1)
        position, _ = image.seen(ground)
        scaled = (position - image.middle) / image.size
        basis = np.column_stack([np.ones(points), scaled])[:, : len(sigma)]
        measured = position + basis @ correction[name].T + noise * rng.standard_normal((points, 2))
        places[name] = np.column_stack([np.arange(points), measured])
    return Bench(images, correction, ground, places, noise)
