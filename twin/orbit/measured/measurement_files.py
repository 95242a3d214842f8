"""Passes as files that `twin.orbit.measured.measurement_tables` reads back to the same bits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from scenes.specs.measured.orbit_data_setup import DATA_FILE
from scenes.yaml.yaml_file import dump_yaml
from twin.orbit.measured.pass_measurements import GroundPoints, ImagePoints, PassMeasurements

CONVENTIONS: Mapping[str, Any] = {
    "frame": "itrs",
    "quaternion": {"scalar": "last", "turns": "body_to_frame"},
    "body_axes": ["forward", "right", "down"],
    "time_scale": "utc",
    "line_moment": "middle",
    "centre": "integer",
    "first_pixel": 0,
    "first_pixel_sees": "right",
}
"""Of the files that are written: the project's own."""
CAMERA_FILE = "camera.yaml"


def campaign_files(passes: Sequence[PassMeasurements], camera: Mapping[str, Any]) -> dict[str, str]:
    """Path -> text of a folder of measurements: ``data.yaml``, the tables of each pass, the camera.

    Args:
        passes: with different names.
        camera: of the payload's file, plain data.
    """
    files, listed = {CAMERA_FILE: dump_yaml(camera)}, {}
    for one in passes:
        tables = pass_tables(one)
        files |= {f"{one.name}/{key}.csv": text for key, text in tables.items()}
        listed[one.name] = {"epoch": one.platform.epoch, **{key: f"{one.name}/{key}.csv" for key in tables}}
    files[DATA_FILE] = dump_yaml({"conventions": dict(CONVENTIONS), "passes": listed})
    return files


def pass_tables(one: PassMeasurements) -> dict[str, str]:
    """Key of a pass -> text of its table, with all digits."""
    platform = one.platform
    orbit = {"time [s]": platform.orbit_time, **_columns(("x [m]", "y [m]", "z [m]"), platform.position)}
    if platform.velocity is not None:
        orbit |= _columns(("vx [m/s]", "vy [m/s]", "vz [m/s]"), platform.velocity)
    attitude = {"time [s]": platform.attitude_time, **_columns(("q1", "q2", "q3", "q4"), platform.quaternion)}
    lines: dict[str, Any] = {"camera": [], "line": [], "time [s]": []}
    for name, times in one.line_times.items():
        lines["camera"] += [name] * len(times.line)
        lines["line"] += times.line.tolist()
        lines["time [s]"] += times.time.tolist()
    given = one.ground.role != "tie"
    tables = {
        "orbit": _csv(orbit),
        "attitude": _csv(attitude),
        "lines": _csv(lines),
        "ground": _csv(_ground(one.ground.taken(given))),
        "image_points": _csv(_images(one.images, one.ground, given)),
    }
    if np.any(~given):
        tables["tie_points"] = _csv(_images(one.images, one.ground, ~given))
    return tables


def _ground(points: GroundPoints) -> dict[str, Any]:
    sigma = np.sqrt(np.diagonal(points.covariance, axis1=1, axis2=2))
    found: dict[str, Any] = {
        "point": points.ids,
        "role": points.role,
        **_columns(("x [m]", "y [m]", "z [m]"), points.itrs),
    }
    alike = np.array_equal(points.covariance, sigma[:, 0, None, None] ** 2 * np.eye(3))
    if alike:
        return found | {"sigma [m]": sigma[:, 0]}
    found |= _columns(("sigma_x [m]", "sigma_y [m]", "sigma_z [m]"), sigma)
    scale = np.where(sigma > 0.0, sigma, 1.0)
    like = points.covariance / scale[:, :, None] / scale[:, None, :]
    pairs = {"correlation_xy": (0, 1), "correlation_xz": (0, 2), "correlation_yz": (1, 2)}
    return found | {name: like[:, i, j] for name, (i, j) in pairs.items()}


def _images(images: Mapping[str, ImagePoints], ground: GroundPoints, chosen: np.ndarray) -> dict[str, Any]:
    heads = ("point", "camera", "line", "pixel", "sigma_line", "sigma_pixel", "correlation")
    found: dict[str, Any] = {head: [] for head in heads}
    for name, row in images.items():
        some = row.taken(chosen[row.point])
        a, b = np.sqrt(some.covariance[:, 0, 0]), np.sqrt(some.covariance[:, 1, 1])
        values = (
            ground.ids[some.point],
            [name] * len(a),
            some.line,
            some.pixel,
            a,
            b,
            some.covariance[:, 0, 1] / a / b,
        )
        for head, value in zip(heads, values, strict=True):
            found[head] += np.asarray(value, dtype=object).tolist()
    if not any(found["correlation"]):
        del found["correlation"]
    return found


def _columns(names: Sequence[str], values: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(names, values.T, strict=True))


def _csv(columns: Mapping[str, Any]) -> str:
    """Text of a table; the shortest digits that read back to the same bits."""
    cells = [[str(v) for v in np.asarray(c, dtype=object).tolist()] for c in columns.values()]
    rows = [", ".join(columns), *map(",".join, zip(*cells, strict=True))]
    return "\n".join(rows) + "\n"
