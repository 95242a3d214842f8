"""Lenses and telescopes about their axis, with the stop anywhere: before the power, in it and behind it. Focal lengths,
pupils are held against matrices of textbooks, and the stop's size against the marginal ray by NumPy alone.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from optics.numerics.backend import Backend
from scenes.models.camera_model import derive_camera
from scenes.specs.camera import CameraSpec
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from tests.hunt.hunt import RIGHT, WRONG_NUMBER, Outcome, failed
from tests.own_trace import OwnCamera
from twin.camera.camera_optics import CameraOptics
from twin.camera.first_order_data import FIRST_ORDER, first_order_data

LARGEST = 1e-6
"""Relative error of a number; of a distance, relative to the focal length and the distance."""


def stops(first: int, cases: int, backend: Backend) -> Iterator[Outcome]:
    """Outcomes of so many systems from a number on."""
    for number in range(first, first + cases):
        text = drawn(np.random.default_rng([50, number]))
        try:
            yield _judged(f"stop {number}", text, backend)
        except Exception as error:
            yield failed(f"stop {number}", error, text)


def drawn(rng: np.random.Generator) -> str:
    """Return the text of a camera's file with lenses or two mirrors and a stop anywhere among them."""
    width = 10.0 ** rng.uniform(-2.0, -0.3)
    rows: list[tuple[float, str]] = []
    if rng.uniform() < 0.5:
        z = 0.0
        for k in range(int(rng.integers(1, 4))):
            front, back = width * rng.uniform(2.5, 9.0, 2) * rng.choice([-1.0, 1.0], 2)
            thick = width * rng.uniform(0.1, 0.4)
            index = rng.uniform(1.45, 1.85)
            rows.append((z, f"A{k}: {{z: {z!r} m, radius: {front!r} m, light: refracts, index: {index!r}}}"))
            z += thick
            rows.append((z, f"B{k}: {{z: {z!r} m, radius: {back!r} m, light: refracts, index: 1}}"))
            z += width * rng.uniform(0.2, 1.5)
        image = z + width * rng.uniform(1.0, 6.0)
    else:
        f1 = width * rng.uniform(2.0, 5.0)
        away = f1 * rng.uniform(0.6, 0.9)
        second, k1, k2 = 2.0 * (f1 - away) * rng.uniform(1.2, 1.6), rng.uniform(-1.2, 0.0), rng.uniform(-4.0, 0.0)
        rows = [
            (0.0, f"M1: {{z: 0 m, radius: {-2.0 * f1!r} m, conic: {k1!r}}}"),
            (-away, f"M2: {{z: {-away!r} m, radius: {-second!r} m, conic: {k2!r}}}"),
        ]
        image = f1 * rng.uniform(0.1, 0.6)
    names = [row.split(":")[0] for _, row in rows]
    stop = str(rng.choice([*names, "STOP", "STOP"]))
    if stop == "STOP":
        at, near = int(rng.integers(0, len(rows) + 1)), [*(z for z, _ in rows), image]
        # never in glass, which a plane between the faces of a lens would be
        at -= at % 2 if "B0" in names else 0
        low = near[at - 1] if at else near[0] - 2.0 * width
        rows.insert(at, (0.0, f"STOP: {{z: {float(low + rng.uniform(0.2, 0.8) * (near[at] - low))!r} m, radius: flat, "
                              "light: passes}"))  # fmt: skip
    body = "\n".join(f"  {row}" for _, row in rows)
    return f"""
name: drawn
focal_length: 1 m
entrance_pupil: {width * rng.uniform(0.05, 0.5)!r} m
field_bias: {rng.choice([0.0, 0.2]) * rng.uniform()!r} deg
field: {{x: 0.02 deg, y: 0.02 deg}}
wavelength: 600 nm
stop: {stop}
mirrors:
{body}
image: {{z: {float(image)!r} m}}
line: {{pixels: 20, pitch: 7 um}}
edge_margin: 0.1 mm
""".replace("np.float64(", "").replace(")", "")


def _judged(case: str, text: str, backend: Backend) -> Outcome:
    model = derive_camera(validate(CameraSpec, parse_yaml(text)), backend, check_stated=False)
    told = FIRST_ORDER(first_order_data(CameraOptics.alone(model, backend)))
    spec, pupil = model.spec, model.spec.entrance_pupil
    matrices, used, toward = _matrices(spec)
    (a, _), (c, _) = matrix = matrices[-1]
    stop = matrices[list(spec.mirrors).index(spec.stop)]
    share = -stop[0, 1] / stop[0, 0]
    chief, turn = matrix @ [share, 1.0]
    focal, away = abs(1.0 / c), chief / turn
    wanted = {
        "focal_length_m": focal,
        "back_focal_length_m": toward * (spec.image.z - a / c - used[-1]),
        "entrance_pupil_before_first_mirror_m": share + used[0],
        "entrance_pupil_m": pupil,
        "f_number": focal / pupil,
        "exit_pupil_before_image_m": toward * away,
        "exit_pupil_m": pupil * abs(a - away * c),
    }
    worst = {
        key: abs(told[key] - value) / (max(abs(value), focal) if "before" in key or "back" in key else abs(value))
        for key, value in wanted.items()
        if told[key] is not None
    }
    marginal = np.array([[0.0, 0.5 * pupil, min(mirror.z for mirror in spec.mirrors.values()) - 1.0]])
    radius = float(np.hypot(*OwnCamera(spec).trace(marginal, np.array([0.0, 0.0, 1.0])).stop[0]))
    worst["stop"] = abs(model.apertures[spec.stop].bounds[1] / radius - 1.0)
    key = max(worst, key=lambda one: worst[one])
    if not worst[key] <= LARGEST:
        return Outcome(case, WRONG_NUMBER, f"{text}\n  {key} is {told.get(key)}, {wanted.get(key, radius)} by hand")
    return Outcome(case, RIGHT, text)


def _matrices(spec: CameraSpec) -> tuple[list[np.ndarray], list[float], float]:
    """Return paraxial matrices from the plane z = 0 before the first surface to each surface, before it acts, and to
    the image; the places of those that act; and along which way the light arrives. A mirror turns the index's sign.
    """
    out, used, matrix, z, index, way = [], [], np.eye(2), 0.0, 1.0, 1.0
    for mirror in spec.mirrors.values():
        matrix, z = np.array([[1.0, mirror.z - z], [0.0, 1.0]]) @ matrix, mirror.z
        out.append(matrix)
        if mirror.light == "passes":
            continue
        used.append(z)
        way = way if mirror.light else -way
        behind = way * (mirror.index if mirror.light else abs(index))
        matrix = np.array([[1.0, 0.0], [-(behind - index) / (mirror.radius * behind), index / behind]]) @ matrix
        index = behind
    out.append(np.array([[1.0, spec.image.z - z], [0.0, 1.0]]) @ matrix)
    return out, used, way
