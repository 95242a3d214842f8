"""What turns and errors of the prisms do to the monitor's spots, in traced beams and in images.

A channel's prisms map directions from the camera to the facet by M = -(1 + [V]) (180-deg prism, M = -1 without errors)
or 1 + [V] (rhomboid); the way back is the transpose. The camera sees the facet's normal m as (1 - [V]) m, so that an
error has the effect of turning the facet by -V, and a spot moves by twice that times the focal length.
"""

import numpy as np
import pytest

from optics.geometry.tree import Motion
from optics.materials.glass import glass
from scenes.models.instrument_builder import build_instrument
from scenes.specs.load import load_camera
from tests.scenes.prism_errors import seen_outside, turn_by_mirrors
from tests.twin.commands import invoke
from twin.monitor.monitor_path import MonitorPath
from twin.render import app

ARCSEC = np.pi / 648000.0
NAMES = ("gf7_pair", "monitor_pair")
PRISMS = ("prism_180", "prism_0")
STILL = 1e-3
"""Pixels. A turned prism still displaces the beam, which passes a slightly other part of the camera's aberrations."""
FACES = [
    (prism, face)
    for prism, faces in (
        ("prism_180", ("window", "mirror", "roof_a", "roof_b")),
        ("prism_0", ("entry", "mirror_a", "mirror_b", "exit")),
    )
    for face in faces
]

SIGNS = {face: -1.0 if face in ("mirror_b", "exit") else 1.0 for _, face in FACES}
"""Of the errors of an imperfect prism: equal ones of a rhomboid's faces would cancel."""


@pytest.fixture(scope="module", params=NAMES)
def path(request, instrument, backend) -> MonitorPath:
    return MonitorPath(instrument(request.param), backend)


def spots(path: MonitorPath, states) -> np.ndarray:
    """Means of the traced beams on the CCDs, x and y in pixels from their middles, (C, S, 2)."""
    rays = path.coarse.rays(states)
    assert rays.valid.all()
    mean = np.einsum("n,bnk->bk", path.coarse.nodes.share, rays.position[..., :2]) / path.pitch
    return mean.reshape(len(path.channels), len(states), 2)


def on_prisms(path: MonitorPath, prism: str, vector, face: str = ""):
    """The same turn, arcseconds, of a prism or of one face in every channel."""
    turn = tuple(ARCSEC * np.asarray(vector, float))
    return {c.prism_body(prism) + (f"/{face}" if face else ""): Motion(rotate=turn) for c in path.channels}


def seen_turn(path: MonitorPath, channel, prism: str, face: str, vector) -> np.ndarray:
    """V in the world for a face turned by a vector (radians, its own axes), from nominal normals only."""
    placed = path.instrument.assembly.place()
    root = channel.prism_body(prism)
    pose = {name: placed.pose(f"{root}/{name}").rotation for _, name in FACES if _ == prism}
    up = placed.pose(root).rotation[:, 2]
    turn = pose[face] @ vector
    index = glass("fused silica").vacuum_index(path.wavelength)
    if face in ("window", "entry", "exit"):
        sign = {"window": 0.0, "entry": 1.0, "exit": -1.0}[face]  # a window that is passed twice cancels
        return sign * (index - 1.0) * turn
    mirrors = [name for name in pose if name not in ("window", "entry", "exit")]
    turns = [turn if name == face else np.zeros(3) for name in mirrors]
    return seen_outside(turn_by_mirrors([pose[name][:, 2] for name in mirrors], turns), up, index)


def facets_turned(path: MonitorPath, vectors):
    """A state in which every channel's facet is turned by its vector, world, radians."""
    placed = path.instrument.assembly.place()
    return {
        c.face_body: Motion(rotate=tuple(placed.pose(c.face_body).rotation.T @ v))
        for c, v in zip(path.channels, vectors, strict=True)
    }


@pytest.mark.second
def test_nominal_beams(path) -> None:
    """All of every beam comes back to the CCD's middle: facets are squared by the middle rays, and over an aperture of
    50 mm coma moves the mean of a beam by some 0.01 px.
    """
    assert path.rays([{}]).valid.all()
    assert np.abs(spots(path, [{}])).max() < 0.03


@pytest.mark.parametrize("prism", PRISMS)
def test_perfect_prisms_may_turn(path, prism) -> None:
    turns = [on_prisms(path, prism, 10.0 * np.eye(3)[axis]) for axis in range(3)]
    moved = spots(path, [{}, *turns])
    assert np.abs(moved[:, 1:] - moved[:, :1]).max() < STILL


def test_prisms_may_move(path) -> None:
    """A rhomboid that moves displaces nothing; a 180-deg prism displaces the beam by twice its shift: 0.01 px/mm."""
    states = [
        {c.prism_body(p): Motion(shift=tuple(1e-3 * e)) for c in path.channels} for p in PRISMS for e in np.eye(3)
    ]
    moved = spots(path, [{}, *states])
    change = np.abs(moved[:, 1:] - moved[:, :1])
    assert change[:, 3:].max() < 1e-9
    assert 1e-3 < change[:, :3].max() < 0.02


@pytest.mark.second
@pytest.mark.parametrize(("prism", "face"), FACES)
@pytest.mark.parametrize("axis", [0, 1])
def test_an_angle_error_is_a_turn_of_the_facet(path, prism, face, axis) -> None:
    """One arcsecond on a face against a facet turned as the first order says: equal within 2e-3 px of up to 19 px.

    What is left comes from the beam's walk along the 2 m to the facet and from products of angles of 1e-5.
    """
    vectors = [-seen_turn(path, c, prism, face, ARCSEC * np.eye(3)[axis]) for c in path.channels]
    moved = spots(path, [{}, on_prisms(path, prism, np.eye(3)[axis], face), facets_turned(path, vectors)])
    by_face, by_facet = moved[:, 1] - moved[:, 0], moved[:, 2] - moved[:, 0]
    assert np.abs(by_face - by_facet).max() < 2e-3
    size = np.linalg.norm(by_face, axis=-1)
    focal = np.array([path.instrument.cameras[c.camera].line_principal_distance for c in path.channels])
    # twice the turn of the facet times the focal length; across the line that is 3 % longer, distortion adds as much
    ups = [path.instrument.assembly.nominal_pose(c.face_body).rotation[:, 2] for c in path.channels]
    want = [
        2.0 * f * np.linalg.norm(np.cross(v, up)) / path.pitch for f, v, up in zip(focal, vectors, ups, strict=True)
    ]
    if face == "window":
        assert size.max() < STILL
    else:
        assert size == pytest.approx(want, rel=0.07)
        assert size.min() > 1.0


@pytest.fixture(scope="module")
def imperfect(backend, instrument) -> MonitorPath:
    """The monitor pair with one arcsecond on every face of every prism, facets squared for that."""
    spec = instrument("monitor_pair").spec
    errors = {prism: {face: (SIGNS[face] * ARCSEC,) * 2 for p, face in FACES if p == prism} for prism in PRISMS}
    monitor = spec.monitor.model_copy(
        update={p: getattr(spec.monitor, p).model_copy(update={"angle_errors": errors[p]}) for p in PRISMS}
    )
    spec = spec.model_copy(update={"monitor": monitor})
    cameras = {site.camera: load_camera(site.camera) for site in spec.cameras.values()}
    return MonitorPath(build_instrument(spec, cameras, backend), backend)


@pytest.mark.second
def test_squared_facets_absorb_the_errors(imperfect) -> None:
    """As made, the spots stand on the CCDs' middles again."""
    assert np.abs(spots(imperfect, [{}])).max() < 0.05


@pytest.mark.second
def test_a_beam_that_misses_its_prism_is_told_by_name(tmp_path):
    job = tmp_path / "job.yaml"
    prism = "base/forward/monitor/left/prism_180"
    job.write_text(f"instrument: gf7_pair\nperturb:\n  {prism}: {{shift: [0 mm, 60 mm, 0 mm]}}\n")
    done = invoke(app, job, "--out", tmp_path / "run")
    assert done.exit_code == 2
    assert f"misses forward/left/prism_180/entry on {prism}/window/entry" in done.stderr
    assert not (tmp_path / "run").exists()
