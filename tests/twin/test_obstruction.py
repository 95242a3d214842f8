"""Shadows of bodies in pupils: against rays that meet triangles, rasters of the pupil, and one way against another."""

import re
from dataclasses import replace

import numpy as np
import pytest

from optics.geometry.aperture import Rectangle
from optics.geometry.pose import Pose
from optics.geometry.solid import solid_mesh
from optics.geometry.tree import Motion
from optics.numerics import quadrature
from optics.raytrace.trace import make_rays, trace
from optics.waves.imaging import imaging_rays
from optics.waves.optical_transfer import polychromatic_transfer
from scenes.models.camera_model import derive_camera
from scenes.models.obstruction import moved_into_beams
from scenes.models.shadow import ImagingShadows, Shadows, TracedBeams
from scenes.specs.baffle import Plate
from scenes.specs.job import JobSpec
from scenes.specs.load import CAMERAS, LIBRARY, library_names, load_band_detectors, load_camera
from scenes.specs.resolved import resolve_job
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import YamlFile
from twin.camera.first_order_data import obscuration, unmodelled_obscuration
from twin.main_job.render_job import render_job
from twin.monitor.image_quality import image_quality
from twin.sensors.line_ccd import LineCcd, band_wavelengths
from twin.targets.target_path import TargetPath

CAMERA, ROOT = "forward", "base/forward"
PRISM = f"{ROOT}/monitor/left/prism_180"
MOVED = {
    PRISM: Motion(shift=(4e-3, 15e-3, 0.0), rotate=(0.0, 0.0, 0.05)),
    f"{ROOT}/M2": Motion(shift=(2e-5, 1e-5, -2e-5)),
}
SPIRAL = 40_000


def path_of(instrument, backend, obstructed: bool = True) -> TargetPath:
    shadows = ImagingShadows(instrument, CAMERA, backend) if obstructed else None
    return TargetPath(instrument.assembly, CAMERA, ROOT, instrument.cameras[CAMERA], backend, shadows=shadows)


def places_of(instrument) -> np.ndarray:
    line = instrument.cameras[CAMERA].spec.line
    return np.array([[side * 0.5 * line.pixels * line.pitch, 0.0] for side in (1.0, 0.0, -1.0)])


def rays_of(path: TargetPath, state, directions: np.ndarray, nodes):
    placed = path.assembly.place([state])
    systems, to_stop = path._systems(state, len(directions), placed)
    launch = path._launch(directions)
    rays = imaging_rays(path.backend, systems, to_stop, directions, launch, path.stop, nodes, path._axes[:, 1])
    return placed, systems, rays


def shadows_of(path: TargetPath, state, directions: np.ndarray):
    placed, systems, rays = rays_of(path, state, directions, path.nodes)
    owner = np.zeros(len(directions), int)
    return path.shadows.cast(TracedBeams(path.assembly, placed, owner, systems, rays, directions, path.nodes))


def spiral() -> quadrature.PupilNodes:
    """Points evenly spread over the disk."""
    k = np.arange(SPIRAL)
    r, angle = np.sqrt((k + 0.5) / SPIRAL), np.pi * (3.0 - np.sqrt(5.0)) * k
    return quadrature.PupilNodes(r * np.cos(angle), r * np.sin(angle), np.full(SPIRAL, np.pi / SPIRAL))


def meets(triangles: np.ndarray, start: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Which rays from points (N, 3) along one direction meet any of the triangles (Moeller and Trumbore)."""
    found = np.zeros(len(start), bool)
    for a, b, c in triangles:
        p = np.cross(way, c - a)
        scale = (b - a) @ p
        if scale == 0.0:
            continue  # seen on edge
        u = (start - a) @ p / scale
        q = np.cross(start - a, b - a)
        v = q @ way / scale
        found |= (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
    return found


@pytest.mark.second
@pytest.mark.parametrize("state", [{}, MOVED], ids=["nominal", "moved"])
def test_share_of_the_prisms_against_rays_and_triangles(gf7_pair, backend, state) -> None:
    """Points of a spiral miss a boundary of length L of the unit disk by some L / sqrt(N) in N^(1/2) points: 3e-5 of
    the disk rms were seen, 1.5e-4 is five times that.
    """
    path = path_of(gf7_pair, backend)
    directions = path.directions(places_of(gf7_pair))
    placed, _, rays = rays_of(path, state, directions, spiral())
    shadows = shadows_of(path, state, directions)
    shares = shadows.shares()
    total = np.zeros((len(directions), SPIRAL), bool)
    for solid in gf7_pair.solids:
        own = solid_mesh(solid, gf7_pair.assembly.place()).mesh
        triangles = placed.pose(solid.path).apply(own.vertices[own.faces].reshape(-1, 3)).reshape(-1, 3, 3)
        taken = np.array([meets(triangles, r - 50.0 * d, d) for r, d in zip(rays.launched, directions, strict=True)])
        np.testing.assert_allclose(shares.get(solid.path, 0.0), taken.mean(axis=-1), atol=1.5e-4)
        total |= taken
    assert set(shares) == {PRISM, PRISM.replace("left", "right")}
    np.testing.assert_allclose(np.sum(shadows.areas, axis=-1) / np.pi, total.mean(axis=-1), atol=1.5e-4)
    assert np.all(np.sum(shadows.areas, axis=-1) / np.pi > 0.05)


@pytest.mark.parametrize("chord", [-0.5, 0.1, 0.62, 0.97])
def test_shadows_on_the_stop_end_at_its_edge(chord: float) -> None:
    """A straight body that reaches over the edge takes the segment beyond its chord: area and moment about x = 0."""
    outline = np.array([[[chord, -1.2], [1.2, -1.2], [1.2, 1.2], [chord, 1.2]]])
    angle = np.arccos(chord)
    area, moment = angle - np.sin(angle) * np.cos(angle), 2.0 / 3.0 * np.sin(angle) ** 3
    for turn in np.exp(1j * np.array([0.0, 0.3, 2.0])):
        corners = (outline[..., 0] + 1j * outline[..., 1]) * turn
        shadows = Shadows.of([("plate", np.stack([corners.real, corners.imag], axis=-1))], 1)
        assert shadows.shares()["plate"][0] == pytest.approx(area / np.pi, abs=1e-8)  # arcs by Gauss' rule
        assert np.sum(shadows.weights * (shadows.points / turn).real) == pytest.approx(moment, abs=1e-8)


@pytest.mark.second
def test_batch_and_single_pupils_agree(gf7_pair, backend) -> None:
    """MTF of ``image_quality`` and of a target's path, with shadows, among states with other shadows or none."""
    model = gf7_pair.cameras[CAMERA]
    band = model.spec.bands["P"]
    places = np.array([[side * 0.5 * band.pixels * band.pitch, band.offset] for side in (1.0, 0.0)])
    gone, large = {PRISM: Motion(shift=(0.0, 1.0, 0.0))}, {PRISM: Motion(scale=1.1, rotate=(0.0, 0.0, 0.5))}
    quality = image_quality(gf7_pair, backend, [gone, large, {}, MOVED], (1.0, 0.0)).cameras[CAMERA]
    free = image_quality(gf7_pair, backend, [{}, MOVED], (1.0, 0.0), obstruction=False).cameras[CAMERA]
    path = path_of(gf7_pair, backend)
    directions = path.directions(places)
    frequency = 0.5 / band.pitch * np.eye(2)
    ccd = LineCcd.from_specs(band, load_band_detectors(model.spec)[band.detector])
    for k, pupil in enumerate(path.pupils({}, directions, path.positions({}, directions))):
        found = polychromatic_transfer(pupil, frequency, *band_wavelengths(band), np.zeros(1))[0]
        want = np.abs(found * ccd.transfer(*frequency.T))
        # wavelengths are others; kinks of shadows' overlaps over the band leave some 1e-5
        assert quality.mtf_along_line[2, k] == pytest.approx(want[0], abs=1e-4)
        assert quality.mtf_along_track[2, k] == pytest.approx(want[1], abs=1e-4)
        assert quality.light_lost[2, k] == pytest.approx(1.0 - pupil.light, abs=1e-5)
    assert np.all(free.light_lost == 0.0)
    assert not free.bodies
    assert np.all(free.mtf_along_track - quality.mtf_along_track[2:] > 0.01)


def with_plate(instrument, plate: Plate):
    return replace(instrument, baffles=(*instrument.baffles, plate))


def test_a_plate_between_two_mirrors(gf7_pair, backend) -> None:
    """Against the rays themselves: which of them go through the plate on their way from the first to the second."""
    path = path_of(gf7_pair, backend)
    directions = path.directions(places_of(gf7_pair))
    nodes = spiral()
    placed, systems, rays = rays_of(path, {}, directions, nodes)
    way = np.broadcast_to(directions[:, None], rays.launched.shape)
    chain = path.assembly.sequences[f"{CAMERA}/imaging"]
    traced = trace(backend, systems, make_rays(backend, rays.launched, way), keep=range(len(chain)))
    start, end = (
        np.stack([placed.pose(path.assembly.elements[chain[k]].body).apply(hit) for hit in traced.hit(k)])
        for k in (0, 1)
    )
    middle = 0.5 * (start[1] + end[1])
    size = np.ptp(middle, axis=0).max()
    along = (end - start)[1].mean(axis=0)
    z = along / np.linalg.norm(along)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    pose = Pose(np.stack([x, np.cross(z, x), z], axis=-1), middle.mean(axis=0) + 0.1 * size * x)
    outline = Rectangle(0.1 * size, 0.07 * size)
    own = path_of(with_plate(gf7_pair, Plate("plate", "base", pose, outline)), backend)
    shares = shadows_of(own, {}, directions).shares()
    into = pose.inverse()
    for k in range(len(directions)):
        a, b = into.apply(start[k]), into.apply(end[k])
        share = a[:, 2] / (a[:, 2] - b[:, 2])
        at = a + share[:, None] * (b - a)
        taken = outline.contains(at[:, 0], at[:, 1]) & (share > 0.0) & (share < 1.0)
        assert 0.005 < taken.mean() < 0.2
        assert shares["plate"][k] == pytest.approx(taken.mean(), abs=2e-4)


# --- shadows that images do not hold are told with their cause --------------------------------------------------------


RC = "ritchey_chretien"


def without_edges(folder) -> str:
    """The library's telescope in a file that says nothing of its secondary mirror's shadow."""
    text = (LIBRARY / CAMERAS / f"{RC}.yaml").read_text("utf-8")
    text = re.sub(r"  spider:\n(    .*\n)+", "", text).replace(", edges: [{blocks: circle, radius: 60 mm}]", "")
    assert "blocks" not in text
    (folder / "bare.yaml").write_text(text, "utf-8")
    return str(folder / "bare.yaml")


@pytest.mark.parametrize("name", library_names("cameras"))
def test_cameras_of_the_library_state_their_shadows(name: str, backend) -> None:
    model = derive_camera(load_camera(name), backend)
    found = obscuration(model, backend)
    assert not unmodelled_obscuration(model, found)
    # a mirror about its axis is round, and within the round shadow that its file states but for its margin: of korsch,
    # whose field is beside the axis, (79.9^2 - 75^2) / (250^2 - 75^2) mm^2 = 1.33 %; the corners of a square would take
    # 3 %
    assert max(found.shares.values(), default=0.0) < (0.015 if name == "korsch" else 0.01)


@pytest.mark.second
def test_a_mirror_in_the_beam_that_no_edge_states_is_told(tmp_path, backend) -> None:
    data = {"instrument": without_edges(tmp_path), "perturb": ["M2 shift z 5 um"]}
    run = render_job(resolve_job(validate(JobSpec, YamlFile("", data, {}))), backend)
    (told,) = (text for text in run.warnings if "the file does not model this obscuration" in text)
    # the round mirror of 0.3 of the diameter, the field and the margin about it, by 4000 rays
    share = float(re.search(r"M2 blocks ([\d.]+) %", told)[1])
    beam, field, margin = 0.3 * 0.5, 2.0 * 1.05 * 0.00264, 0.01
    assert share == pytest.approx(100.0 * (beam + field + margin) ** 2 / 0.5**2, abs=0.2)
    assert "a pupil without that shadow" in told
    run = render_job(resolve_job(validate(JobSpec, YamlFile("", {**data, "instrument": RC}, {}))), backend)
    assert not any("does not model this obscuration" in text for text in run.warnings)


def test_what_has_moved_into_a_monitors_beam_is_told(gf7_pair, backend) -> None:
    """A housing that its camera carries through the beams; the motions that jobs are about take nothing."""
    found = moved_into_beams(gf7_pair, backend, {"base/backward": Motion(shift=(0.05, 0.0, 0.0))})
    assert [text.partition(":")[0] for text in found] == ["backward/left", "backward/right"]
    assert all("backward_housing has moved into the beam" in text for text in found)
    small = {
        "base/forward/M2": Motion(shift=(5e-6, 5e-6, 40e-6), rotate=(1e-5, 0.0, 0.0)),
        "base/forward/focal_plane": Motion(rotate=(1e-5, 1e-5, 5e-5)),
        "base/forward": Motion(expansion=1e-4),
        "base/forward/monitor/left/prism_180/exit": Motion(figure={4: 1e-6}),
    }
    known = {body.path for body in gf7_pair.assembly.tree.bodies}
    assert moved_into_beams(gf7_pair, backend, {path: one for path, one in small.items() if path in known}) == ()
    assert moved_into_beams(gf7_pair, backend, {}) == ()
