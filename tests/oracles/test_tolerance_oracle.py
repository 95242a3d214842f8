"""Tolerances of an off-axis camera against a brute force of our own with batoid, with a focus that is refound."""

import numpy as np
import pytest

from optics.geometry.pose import triple
from optics.geometry.tree import Motion
from optics.numerics.backend import Backend
from scenes.specs.load import load_camera
from scenes.specs.tolerance import ToleranceSetup
from twin.camera.camera_optics import CameraOptics
from twin.camera.varied_beams import VariedBeams
from twin.tolerance.merit_models import Sensitivities, sensitivities
from twin.tolerance.samples import Samples, Workforce, draw_samples
from twin.tolerance.tolerance_bench import ToleranceBench

pytestmark = pytest.mark.oracle

ARCSEC = np.pi / 648_000
UNIFORM, NORMAL = "uniform", "normal"
CLOSE = 0.01
"""Share of a change of the wavefront error, and of its spread over cameras, to which the two are to agree."""
NOTHING = 1e-6
"""Waves. What the twin's focus leaves, which ends where a step would change less than 1e-5; it is a
hundredth of the least change that is compared."""


def _budget() -> dict[str, tuple[tuple[str, str, str], str, float, str]]:
    """Name -> error in the oracle's words, limit in the file's, limit in SI, law."""
    out: dict[str, tuple[tuple[str, str, str], str, float, str]] = {}
    for mirror in ("M1", "M2", "M3"):
        for axis in "xyz":
            out[f"{mirror}_{axis}"] = (mirror, "shift", axis), "20 um", 20e-6, NORMAL
        for axis in "xy":
            out[f"{mirror}_tilt_{axis}"] = (mirror, "rotate", axis), "5 arcsec", 5.0 * ARCSEC, UNIFORM
        out[f"{mirror}_radius"] = (mirror, "radius", ""), "30 ppm", 30e-6, NORMAL
    out["M1_conic"] = ("M1", "conic", ""), "1.0e-4", 1e-4, NORMAL
    out["M2_conic"] = ("M2", "conic", ""), "5.0e-3", 5e-3, NORMAL
    out["M3_conic"] = ("M3", "conic", ""), "1.0e-4", 1e-4, UNIFORM
    out["M3_turn"] = ("M3", "rotate about centre", "y"), "20 arcsec", 20.0 * ARCSEC, UNIFORM
    out["M1_coma"] = ("M1", "figure", "Z7"), "10 nm", 10e-9, NORMAL
    out["M3_trefoil"] = ("M3", "figure", "Z9"), "10 nm", 10e-9, NORMAL
    return out


BUDGET = _budget()
ERRORS = [error for error, _, _, _ in BUDGET.values()]
LIMITS = np.array([limit for _, _, limit, _ in BUDGET.values()])


def motion(error: tuple[str, str, str]) -> str:
    """In the words of a file."""
    body, kind, axis = error
    verb, *about = kind.split(" ", 1)
    return " ".join(part for part in (body, verb, axis, *about) if part)


@pytest.fixture(scope="module")
def setup(tmp_path_factory) -> ToleranceSetup:
    told = (f"  {name}: {{motion: {motion(e)}, limit: {at}, law: {law}}}\n" for name, (e, at, _, law) in BUDGET.items())
    path = tmp_path_factory.mktemp("tolerance") / "budget.yaml"
    focus = "{motion: focal_plane shift z, range: 5 mm}"
    path.write_text(
        f"instrument: gf7\ntolerances:\n{''.join(told)}compensators: {{focus: {focus}}}\n"
        "merits: {wavefront: {kind: wavefront, at_most: 0.0714}}\n",
        "utf-8",
    )
    return ToleranceSetup.read(path)


@pytest.fixture(scope="module")
def bench(setup: ToleranceSetup, backend: Backend) -> ToleranceBench:
    return ToleranceBench(setup, backend)


@pytest.fixture(scope="module")
def alone(bench: ToleranceBench) -> Sensitivities:
    return sensitivities(bench)


@pytest.fixture(scope="module")
def peer(bench: ToleranceBench):
    pytest.importorskip("batoid")
    from tests.oracles.tolerance_peer import BatoidCamera

    return BatoidCamera(bench.optics.model, bench.fields)


@pytest.mark.second
def test_each_tolerance_changes_the_wavefront_as_in_batoid(bench, alone, peer) -> None:
    """At both limits; the worst of nine fields, and all nine, and the focus that is found."""
    assert list(bench.entries) == list(BUDGET)
    assert len(BUDGET) == 24
    np.testing.assert_allclose(bench.sizes, LIMITS, rtol=1e-12)
    nominal = peer.tried({})
    assert alone.nominal[0] == pytest.approx(nominal.worst, abs=NOTHING)
    ends = np.concatenate([-np.diag(LIMITS), np.diag(LIMITS)])
    found = peer.tried_all(ERRORS, ends)
    theirs = np.array([one.worst for one in found]).reshape(2, -1).T - nominal.worst
    ours = alone.values[:, :, 0] - alone.nominal[0]
    assert np.abs(theirs).min() > 100.0 * NOTHING
    np.testing.assert_array_less(np.abs(ours - theirs), CLOSE * np.abs(theirs) + NOTHING)
    # field by field, where the worst of all hides nothing
    fields = np.sqrt(bench.adjust_cameras(ends).parts)
    change = np.sqrt([one.squares for one in found]) - np.sqrt(nominal.squares)
    np.testing.assert_array_less(np.abs(fields - np.sqrt(nominal.squares) - change), CLOSE * np.abs(change) + NOTHING)
    moves = np.array([one.focus for one in found]).reshape(2, -1).T
    # a thousandth of the depth of focus, wavelength times the square of the f-number
    np.testing.assert_allclose(alone.moves[:, :, 0], moves, rtol=0, atol=1e-3 * 650e-9 * 9.2**2)
    assert np.abs(moves).max() > 200e-6


@pytest.fixture(scope="module")
def drawn(setup: ToleranceSetup, bench: ToleranceBench, backend: Backend) -> Samples:
    return draw_samples(setup, bench, backend, 1000, 4, Workforce())


@pytest.mark.second
def test_cameras_are_as_in_batoid_one_by_one(drawn: Samples, peer) -> None:
    """The first 100 of them, to a share of their spread."""
    assert not any(drawn.problems)
    ours, spread = drawn.values[:, 0], float(np.std(drawn.values[:, 0]))
    same = np.array([one.worst for one in peer.tried_all(ERRORS, drawn.x[:100] * LIMITS)])
    assert spread > 0.01
    np.testing.assert_allclose(ours[:100], same, rtol=0, atol=CLOSE * spread)


OFF_AXIS = np.array([(-1.0, 0.0), (0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, -1.0)])
SIZES = {"shift": 1e-6, "rotate": 1e-6, "figure": 1e-9, "radius": 1e-6, "conic": 1e-6}
MOTIONS = [
    *((f"M{k}", "shift", axis) for k in (1, 2, 3) for axis in "xyz"),
    *((f"M{k}", "rotate", axis) for k in (1, 2, 3) for axis in "xy"),
    *((f"M{k}", "radius", "") for k in (1, 2, 3)),
    ("M1", "figure", "Z7"),
    ("M3", "figure", "Z6"),
]


@pytest.mark.second
def test_derivatives_of_an_off_axis_pupil_as_by_batoid_and_an_own_fit(backend) -> None:
    """Rows of gf7's Z4 to Z11 at five fields for 20 motions, to 1e-3 of the largest of each row's motion.

    Batoid traces, and NumPy fits the terms at other nodes by least squares. It tells waves on planes, we on spheres
    about the image with the radius of the exit pupil.
    """
    optics = CameraOptics.alone(load_camera("gf7"), backend)
    beams = VariedBeams(optics, OFF_AXIS)
    rows = beams.zernike_rows(11)[:, 3:]
    pytest.importorskip("batoid")
    from tests.oracles.tolerance_peer import BatoidCamera

    peer = BatoidCamera(optics.model, OFF_AXIS)
    x, y = peer.nodes.points[1:].T
    r2 = x**2 + y**2
    terms = np.stack(
        [
            np.ones_like(x),
            x,
            y,
            np.sqrt(3.0) * (2.0 * r2 - 1.0),
            np.sqrt(6.0) * 2.0 * x * y,
            np.sqrt(6.0) * (x**2 - y**2),
            np.sqrt(8.0) * (3.0 * r2 - 2.0) * y,
            np.sqrt(8.0) * (3.0 * r2 - 2.0) * x,
            np.sqrt(8.0) * (3.0 * x**2 * y - y**3),
            np.sqrt(8.0) * (x**3 - 3.0 * x * y**2),
            np.sqrt(5.0) * (6.0 * r2**2 - 6.0 * r2 + 1.0),
        ],
        axis=-1,
    )
    weighted = terms * peer.nodes.share[:, None]
    fit = np.linalg.solve(terms.T @ weighted, weighted.T)[3:]
    for body, kind, axis in MOTIONS:
        size = SIZES[kind]
        states, theirs = [], []
        for amount in (size, -size):
            along = triple(amount if axis == one else 0.0 for one in "xyz")
            does = {"figure": {int(axis[1:]): amount}} if kind == "figure" else {kind: amount}
            states.append({f"camera/{body}": Motion(**({kind: along} if axis in tuple("xyz") else does))})
            theirs.append(-peer.waves({(body, kind, axis): amount}) @ fit.T)
        paths = beams.light(states).paths
        ours = np.einsum("ftn,sfn->sft", rows, paths)
        found, wanted = (ours[0] - ours[1]) / (2.0 * size), (theirs[0] - theirs[1]) / (2.0 * size)
        assert np.max(np.abs(wanted)) > 0.0
        np.testing.assert_allclose(
            found, wanted, rtol=0, atol=1e-3 * np.max(np.abs(wanted)), err_msg=f"{body} {kind} {axis}"
        )
