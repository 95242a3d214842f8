"""Tolerances of cameras with lenses in light of several wavelengths, against a trace of our own of altered glasses."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import Backend
from scenes.models.camera_model import CameraModel
from scenes.specs.camera import CameraSpec
from scenes.specs.tolerance import ToleranceSetup
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml
from tests.own_trace import OwnCamera, Traced
from tests.scenes.lens.colour_cameras import colour_camera
from tests.twin import study_bench
from tests.twin.study_bench import TEXTS
from twin.camera.camera_optics import CameraOptics
from twin.camera.varied_beams import CutError, RoughError
from twin.tolerance import tolerance_bench
from twin.tolerance.tolerance_bench import ToleranceBench
from twin.tolerance.tolerance_run import TOLERANCE, run_tolerance
from twin.tolerance.variations import states_of

D_LINE = 587.5618e-9
FIELDS = [[0.0, 0.0], [1.0, 0.0]]
WAVEFRONT = {"wavefront": {"kind": "wavefront", "at_most": 0.2, "fields": [[0.0, 0.0]]}}


def budget(folder: Path, camera: CameraSpec | None = None, **changes: Any) -> ToleranceSetup:
    """The budget of a camera, an achromat by default, with other keys at its top."""
    (folder / "lens.yaml").write_text(dump_yaml((camera or colour_camera("achromat")).plain()), "utf-8")
    return study_bench.budget(folder, "lens", **changes)


@pytest.fixture(scope="module")
def bench(backend: Backend, tmp_path_factory: pytest.TempPathFactory) -> ToleranceBench:
    return ToleranceBench(budget(tmp_path_factory.mktemp("light")), backend)


class OwnTrace:
    """The achromat in plain NumPy: the wavefronts of all lines about one point.

    Of the twin it takes the prescription, the catalogue's indices, the stop's radius and the exit pupil's distance.
    """

    def __init__(self, model: CameraModel, stop: float) -> None:
        self.spec, self.stop = model.spec, stop
        self.radius = float(model.first_order.exit_pupil_distance[0])
        s, w = np.polynomial.legendre.leggauss(7)
        angle = 2.0 * np.pi * (np.arange(31) + 0.3) / 31
        r = np.sqrt(0.5 * (1.0 + s))[:, None]
        inner = np.stack([(r * np.cos(angle)).ravel(), (r * np.sin(angle)).ravel()], axis=-1)
        self.points, self.share = np.concatenate([np.zeros((1, 2)), inner]), np.repeat(w / w.sum() / 31, 31)

    def _beam(self, field: list[float], line: float, errors: Mapping[str, float], focus: float) -> Traced:
        """Rays of one wavelength through lenses of another Abbe number and another index, and decentred ones."""
        mirrors = {}
        for name, one in self.spec.mirrors.items():
            new: dict[str, Any] = {"decentre": (errors.get("decentre", 0.0) if name in ("L3", "L4") else 0.0, 0.0)}
            if one.glass is not None:
                at_d, here = one.glass.index(D_LINE, "air"), one.glass.index(line, "air")
                behind = at_d + (here - at_d) / (1.0 + errors.get(f"{name} abbe", 0.0))
                new |= {"glass": None, "index": behind + errors.get(f"{name} index", 0.0)}
            mirrors[name] = one.model_copy(update=new)
        image = self.spec.image.model_copy(update={"z": self.spec.image.z + focus})
        camera = OwnCamera(self.spec.model_copy(update={"mirrors": mirrors, "image": image}))
        radius, (x, y) = self.spec.mirrors["L1"].radius, self.stop * self.points.T
        start = np.stack([x, y, radius - np.sqrt(radius**2 - x**2 - y**2)], axis=-1)
        return camera.trace(start, camera.heading(field[0] * self.spec.field.x, field[1] * self.spec.field.y))

    def square(self, field: list[float], errors: Mapping[str, float], focus: float) -> float:
        """Mean square error over the light, waves of the design wavelength: piston is taken out of every line by
        itself, tilt out of all together.
        """
        assert self.spec.spectrum is not None
        lines, weights = self.spec.spectrum.rule(1)
        beams = [self._beam(field, float(line), errors, focus) for line in lines]
        middle = np.sum([w * beam.place[0] for w, beam in zip(weights, beams, strict=True)], axis=0)
        rows, right, each = [], [], []
        for k, beam in enumerate(beams):
            offset = beam.place - middle
            along = np.sum(beam.way * offset, axis=-1)
            # back along the ray to the sphere about the middle
            back = along + np.sqrt(along**2 + self.radius**2 - np.sum(offset**2, axis=-1)) - self.radius
            error = (beam.path - back)[1:] / self.spec.wavelength
            rows.append(np.column_stack([np.eye(len(lines))[np.full(len(error), k)], self.points[1:]]))
            right.append(error - error.mean())
            each.append(weights[k] * self.share)
        table, value, weight = np.concatenate(rows), np.concatenate(right), np.concatenate(each)
        root = np.sqrt(weight)
        fit, *_ = np.linalg.lstsq(table * root[:, None], value * root, rcond=None)
        return float(weight @ (value - table @ fit) ** 2)

    def adjusted(self, errors: Mapping[str, float]) -> tuple[float, list[float]]:
        """Focus that makes the sum over the fields least, metres along z, and their mean squares."""
        found = minimize_scalar(
            lambda focus: sum(self.square(field, errors, focus) for field in FIELDS),
            bracket=(-1e-4, 1e-4),
            options={"xtol": 1e-9},
        )
        return float(found.x), [self.square(field, errors, float(found.x)) for field in FIELDS]


ALTERED: dict[str, tuple[dict[str, float], dict[str, float]]] = {
    "as designed": ({}, {}),
    "crown of another Abbe number": ({"crown_abbe": 1.0}, {"L1 abbe": 0.01}),
    "flint of another Abbe number": ({"flint_abbe": -1.0}, {"L3 abbe": -0.008}),
    "flint of another index": ({"flint_index": 1.0}, {"L3 index": 5e-4}),
    "all, decentred": (
        {"crown_abbe": -0.7, "flint_abbe": 0.9, "flint_index": -0.5, "decentre": 1.0},
        {"L1 abbe": -0.007, "L3 abbe": 0.0072, "L3 index": -2.5e-4, "decentre": 50e-6},
    ),
}


@pytest.mark.second
@pytest.mark.parametrize("case", ALTERED)
def test_wavefronts_over_the_light_are_those_of_our_own_trace(case: str, bench: ToleranceBench) -> None:
    """With focus refound. A lens that is moved along the camera's x moves along the line."""
    drawn, errors = ALTERED[case]
    x = np.array([[drawn.get(number.name, 0.0) for number in bench.numbers]])
    tried = bench.try_out(x * bench.sizes)
    model = bench.optics.model
    turned = {key: value for key, value in errors.items() if key != "decentre"}
    if "decentre" in errors:
        body = bench.instrument.assembly.nominal_pose(f"{bench.optics.path.root}/L3").rotation[:, 0]
        root = bench.instrument.assembly.nominal_pose(bench.optics.path.root).rotation
        way = model.camera_frame.rotation @ root.T @ body
        np.testing.assert_allclose(np.abs(way), [1.0, 0.0, 0.0], atol=1e-12)
        turned["decentre"] = float(way[0]) * errors["decentre"]
    focus, squares = OwnTrace(model, bench.optics.path.stop.radius).adjusted(turned)
    # rays aimed to 1e-8 m, wavefronts by polynomials that leave a thousandth of a wave at most
    np.testing.assert_allclose(np.sqrt(tried.parts[0, :2]), np.sqrt(squares), rtol=2e-4)
    assert abs(abs(tried.moves[0, 0]) - abs(focus)) < 2e-6


@pytest.mark.second
def test_an_abbe_number_acts_at_a_design_wavelength_beside_the_d_line(backend: Backend, tmp_path: Path) -> None:
    """The camera of one line, C, is one whose crown has another index there."""
    red = colour_camera("achromat").model_copy(update={"wavelength": 656.2725e-9, "spectrum": None})
    own, twin_index = red.index_behind("L1"), red.index_behind("L1", D_LINE)
    change = (own - twin_index) * (1.0 / 1.01 - 1.0)
    merits = {"wavefront": TEXTS["lens"]["merits"]["wavefront"]}
    tolerances = {
        "abbe": {"motion": "L1 abbe", "limit": "1 percent"},
        "index": {"motion": "L1 index", "limit": abs(change)},
    }
    one = ToleranceBench(budget(tmp_path, red, merits=merits, tolerances=tolerances, compensators={}), backend)
    both = one.try_out(np.array([[1.0, 0.0], [0.0, np.sign(change)], [0.0, 0.0]]) * one.sizes).parts
    np.testing.assert_allclose(both[0], both[1], rtol=1e-9)
    assert np.max(np.abs(both[0] - both[2])) > 1e-3


@pytest.mark.second
def test_mtfs_over_the_light_are_those_of_the_camera_program(bench: ToleranceBench) -> None:
    x = np.array([[0.0] * 4, [0.8, -0.9, 0.0, 1.0], [0.8, -0.9, 0.6, 1.0]])
    tried = bench.try_out(x * bench.sizes)
    values = bench.values(tried.parts)[:, 1]
    states = states_of((*bench.numbers, *bench.compensators), np.concatenate([x * bench.sizes, tried.moves], axis=1))
    frequency = np.array([0.0, 30e3])
    # the last has another focal length by 4e-4, and with it another cut-off, which a tolerance run leaves as designed
    for state, value, close in zip(states, values, (1e-7, 2e-5, 4e-4), strict=True):
        mtfs = bench.optics.in_state(state).mtfs(bench.fields, frequency, bench.colours, bench.shares)
        assert value == pytest.approx(min(float(np.min(mtf.values[:, 1])) for mtf in mtfs), abs=close)
    assert values[1] < values[0] - 0.01


def test_light_of_a_band_takes_as_many_wavelengths_as_it_needs(backend: Backend, tmp_path: Path) -> None:
    camera = colour_camera("achromat", "[500 nm, 640 nm]")
    band = ToleranceBench(budget(tmp_path, camera, merits=WAVEFRONT), backend)
    values = band.values(band.try_out(np.zeros((1, 4))).parts)[0]
    assert len(band.colours) > 3
    assert camera.light is not None
    band._prepare_in(*camera.light.rule(2 * len(band.colours)))
    fine = band.values(band.try_out(np.zeros((1, 4))).parts)[0]
    np.testing.assert_allclose(values, fine, rtol=0, atol=5e-4)
    design = ToleranceBench(budget(tmp_path, camera, merits=WAVEFRONT, light="design"), backend)
    assert design.colours.tolist() == [D_LINE]
    alone = design.values(design.try_out(np.zeros((1, 4))).parts)[0]
    assert alone[0] < 0.8 * values[0]


@pytest.mark.parametrize(
    ("changes", "why"), [({"spectrum": "[400 nm, 1000 nm]"}, ""), ({"image": "300 mm"}, ": a transfer function takes")]
)
def test_a_blurred_camera_has_no_mtf_for_tolerances(backend: Backend, tmp_path: Path, changes: dict, why: str) -> None:
    with pytest.raises(InputError, match=rf"merits\.mtf: the MTF of the designed camera is not settled{why}"):
        ToleranceBench(budget(tmp_path, colour_camera("achromat", **changes)), backend)


def test_colours_too_far_apart_for_a_sum_are_told_at_the_light(backend: Backend, tmp_path: Path) -> None:
    camera = colour_camera("achromat", "[350 nm, 2000 nm]")
    with pytest.raises(InputError, match=r"light: merits over .* colours stand too far apart.*light: design"):
        ToleranceBench(budget(tmp_path, camera, merits=WAVEFRONT), backend)


@pytest.mark.parametrize(
    ("place", "name", "error", "words"),
    [
        (tolerance_bench, "VariedBeams", CutError("cut"), "merits: cut.*fields whose light comes through whole"),
        (tolerance_bench, "VariedBeams", RoughError("rough"), "merits: rough.*a sharper camera"),
        (CameraOptics, "colour_pupils", UnphysicalError("more light"), r"merits\.mtf: .* has no MTF: more light"),
    ],
)
def test_light_that_no_merit_is_told_of_is_refused(place, name, error, words, backend, tmp_path, monkeypatch) -> None:
    def refuse(*_: object) -> None:
        raise error

    monkeypatch.setattr(place, name, refuse)
    with pytest.raises(InputError, match=words):
        ToleranceBench(budget(tmp_path), backend)


@pytest.mark.second
def test_a_run_tells_its_light(backend: Backend, tmp_path: Path) -> None:
    told = TOLERANCE(run_tolerance(budget(tmp_path), backend))
    assert told["wavelengths_nm"] == pytest.approx([486.1327, 587.5618, 656.2725])
    assert told["weights"] == pytest.approx([0.25, 0.5, 0.25])
    shares = told["merits"]["wavefront"]["variance_shares"]
    assert shares["crown_abbe"] > 0.01
