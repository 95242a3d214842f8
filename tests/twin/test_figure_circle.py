"""Figure errors: the circle over which terms are, the clear aperture over which a drawn error has its rms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from optics.geometry.aperture import Circle, Edge, Ellipse, Rectangle
from optics.geometry.surface import plane
from optics.raytrace.assembly import Element, Interaction
from scenes.models.camera_model import derive_camera
from scenes.specs.load import load_camera
from scenes.specs.tolerance import ToleranceSetup
from scenes.yaml.yaml_file import dump_yaml
from twin.tolerance.tolerance_bench import ToleranceBench
from twin.tolerance.variations import spectrum_over, states_of

# a classical Cassegrain: F/2.5 primary of 0.6 m, secondary at 0.25 of its focal length before the focus, m = 4
F1, SHARE, M, HALF, MARGIN = 1.5, 0.25, 4.0, 0.15, 0.004
BEFORE = F1 * (1.0 - SHARE)
BY_HAND = 0.3 * SHARE + BEFORE * np.tan(np.deg2rad(HALF)) * np.sqrt(2.0) + MARGIN
"""Radius of the secondary by similar triangles, metres: axial beam, chief rays of the field's corners, margin."""
CASSEGRAIN: dict[str, Any] = {
    "name": "round",
    "focal_length": f"{F1 * M} m",
    "entrance_pupil": "0.6 m",
    "field_bias": "0 deg",
    "field": {"x": f"{HALF} deg", "y": f"{HALF} deg"},
    "wavelength": "600 nm",
    "stop": "M1",
    "mirrors": {
        "M1": {"z": "0 m", "radius": f"{-2.0 * F1} m", "conic": -1},
        "M2": {
            "z": f"{-BEFORE} m",
            "radius": f"{-2.0 * SHARE * F1 * M / (M - 1.0)} m",
            "conic": -(((M + 1.0) / (M - 1.0)) ** 2),
        },
    },
    "image": {"z": f"{SHARE * F1 * M - BEFORE} m"},
    "line": {"pixels": 1000, "pitch": "7 um"},
    "edge_margin": f"{1e3 * MARGIN} mm",
}


def file_with(folder: Path, **of_m2: Any) -> Path:
    """The Cassegrain's file, with further keys of its secondary."""
    mirrors = {**CASSEGRAIN["mirrors"], "M2": {**CASSEGRAIN["mirrors"]["M2"], **of_m2}}
    path = folder / "round.yaml"
    path.write_text(dump_yaml({**CASSEGRAIN, "mirrors": mirrors}), "utf-8")
    return path


def bench_of(folder: Path, instrument: str, backend, **motions: str) -> ToleranceBench:
    """A budget of motions with a limit of 30 nm each, whole figures of seven terms."""
    limits = {name: {"motion": motion, "limit": "30 nm"} for name, motion in motions.items()}
    whole = {name: {**one, "terms": ["Z5", "Z11"]} for name, one in limits.items() if one["motion"].endswith("figure")}
    budget = {
        "instrument": instrument,
        "tolerances": limits | whole,
        "merits": {"wavefront": {"kind": "wavefront", "at_most": 0.3, "fields": [[0.0, 0.0]]}},
        "samples": 20,
    }
    path = folder / "budget.yaml"
    path.write_text(dump_yaml(budget), "utf-8")
    return ToleranceBench(ToleranceSetup.read(path), backend)


def test_a_mirror_about_its_axis_is_round(backend, tmp_path) -> None:
    """The radius by hand is paraxial, and the secondary's sag of 4 mm makes its beam 1 % smaller at most."""
    model = derive_camera(load_camera(file_with(tmp_path)), backend)
    assert isinstance(model.apertures["M2"], Circle)
    assert model.apertures["M2"].centre == (0.0, 0.0)
    assert model.apertures["M2"].radius == pytest.approx(BY_HAND, rel=0.01)
    # an off-axis mirror of the library is cut to its beams
    assert isinstance(derive_camera(load_camera("gf7"), backend).apertures["M1"], Rectangle)


@pytest.mark.second
def test_terms_on_both_mirrors_of_a_telescope(backend, tmp_path) -> None:
    """Astigmatism of a mirror whose beam is r of its circle wide gives 2 r^2 times its amount, by its formula.

    Less by the square of the cosine of the angle at which light meets it, 0.125 at most: 1.6 % at the rim.
    """
    file_with(tmp_path)
    bench = bench_of(tmp_path, "round.yaml", backend, first="M1 figure Z5", second="M2 figure Z6")
    told = bench.merits[0].values(bench.adjust_cameras(np.diag([30e-9, 30e-9])).parts)
    whole = 2.0 * 30e-9 / 600e-9
    assert told[0] == pytest.approx(whole, rel=0.01)
    assert told[1] == pytest.approx(whole * (0.3 * SHARE / BY_HAND) ** 2, rel=0.02)


@pytest.mark.second
def test_a_stated_edge_comes_before_the_beams(backend, tmp_path) -> None:
    path = file_with(tmp_path, edges=[{"clear": "circle", "radius": "95 mm"}])
    bench = bench_of(tmp_path, path.name, backend, second="M2 figure Z6")
    element = bench.instrument.assembly.face("base/round/M2")
    assert element.figure_disk.radius == pytest.approx(0.095)
    assert element.aperture is not None
    assert element.aperture.enclosing.radius < 0.09


@pytest.mark.second
def test_the_smallest_circle_of_every_shape() -> None:
    """No point of an outline lies outside, and some touch the circle on opposite sides."""
    for shape in (Circle(0.3, (0.1, 0.2), 0.05), Rectangle(0.3, 0.4, (1.0, 0.0)), Ellipse(0.5, 0.2)):
        apart = shape.outline(4001) - shape.enclosing.centre
        far = np.hypot(*apart.T)
        assert np.max(far) == pytest.approx(shape.enclosing.radius, rel=1e-6)
        touching = apart[far > (1.0 - 1e-6) * np.max(far)]
        assert np.min(touching @ touching.T) == pytest.approx(-(np.max(far) ** 2), rel=1e-3)


@pytest.mark.second
def test_a_drawn_figure_has_its_rms_over_the_clear_aperture(backend, tmp_path) -> None:
    """By the sag of each term at points drawn over the rectangle, about each surface's mean.

    300 surfaces of some five terms that matter: their mean square is known to sqrt(2 / 300 / 5), its root to half.
    """
    bench = bench_of(tmp_path, "gf7", backend, first="M1 figure", third="M3 figure")
    rng = np.random.default_rng(8)
    for name, element in bench.figure_faces.items():
        assert isinstance(element.aperture, Rectangle)
        x0, x1, y0, y1 = element.aperture.bounds
        x, y = rng.uniform(x0, x1, 2000), rng.uniform(y0, y1, 2000)
        mine = np.array([number.entry == name for number in bench.numbers])
        unit = states_of(bench.numbers, 1e-9 * np.eye(len(mine))[mine])
        sags = np.array([1e9 * element.figured(state[element.body]).figure.sag(x, y) for state in unit])  # type: ignore[union-attr]
        sizes = np.array([number.size for number in bench.numbers])[mine]
        surfaces = (rng.standard_normal((300, len(sizes))) * sizes) @ sags
        assert np.sqrt(np.mean(np.var(surfaces, axis=1))) == pytest.approx(30e-9, rel=0.05)


def test_a_ring_and_a_disk() -> None:
    """Over the disk terms are orthonormal; defocus, sqrt(3) (2 r^2 - 1), has over a ring the variance (1 - e^2)^2."""
    disk = Element("M", "M", plane(), Interaction.REFLECT, Circle(0.4))
    assert spectrum_over(disk, (4,), 3.0) == pytest.approx([1.0], abs=1e-12)
    hole = (Edge(Circle(0.2), blocks=True),)
    for ring in (replace(disk, aperture=Circle(0.4, inner=0.2)), replace(disk, edges=hole)):
        assert spectrum_over(ring, (4,), 3.0) == pytest.approx([1.0 / (1.0 - 0.25)], rel=2e-3)
