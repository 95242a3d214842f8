"""Solids, scene, still image, page and dimensions of a camera, against volumes and lengths by hand."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
import trimesh
from markupsafe import Markup
from matplotlib.image import imread

from optics.geometry.aperture import Circle
from optics.geometry.surface import Surface
from scenes.models.camera_model import derive_camera
from scenes.models.instrument_builder import build_instrument
from scenes.models.meshes import THICKNESS, lens_mesh, mirror_mesh
from scenes.specs.instrument import InstrumentSpec
from scenes.specs.load import load_camera
from tests.scenes.lens.colour_cameras import colour_camera
from tests.twin.policed_page import breaches
from twin.camera.camera_view import dimensions
from twin.pictures.light_paths import trace_light_paths
from twin.pictures.picture_scene import still_png
from twin.pictures.scene_file import scene_bytes, viewer_page


@pytest.mark.parametrize("inner", [0.0, 0.03, 0.15])
@pytest.mark.parametrize("back", [1.0, -1.0])
def test_a_flat_mirror_with_a_hole_is_a_ring(inner: float, back: float) -> None:
    """Chords of the outer circle, 96, and of the hole, 48, take 0.07 and 0.3 % of their areas."""
    mesh = mirror_mesh(Surface(0.0), Circle(0.2, inner=inner), back)
    expected = np.pi * (0.2**2 - inner**2) * THICKNESS * 0.4
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(expected, rel=5e-3)
    middle = mesh.triangles_center[np.hypot(*mesh.triangles_center[:, :2].T) < 0.95 * inner]
    assert not len(middle)


def test_a_lens_is_the_solid_between_its_faces(backend) -> None:
    model = derive_camera(colour_camera("achromat"), backend)
    mesh = lens_mesh(model, "L1", "L2")
    radius = model.apertures["L1"].bounds[1]
    assert model.apertures["L2"].bounds[1] == pytest.approx(radius, rel=0.05)
    caps = np.pi * radius**4 / 4.0 * (1.0 / 0.6 + 1.0 / 0.44)  # to second order
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(np.pi * radius**2 * 0.015 - caps, rel=0.03)


@pytest.mark.parametrize("name", ["achromat", "ritchey_chretien"])
def test_scene_still_and_page_of_a_camera(backend, name: str) -> None:
    camera = colour_camera(name) if name == "achromat" else load_camera(name)
    instrument = build_instrument(InstrumentSpec.of_camera(name, name), {name: camera}, backend)
    paths = trace_light_paths(instrument, backend, {}, 1.0)
    scene = trimesh.load(BytesIO(glb := scene_bytes(instrument, {}, paths, 5e-4)), file_type="glb")
    drawn = {node.rpartition("/")[2] for node in scene.graph.nodes_geometry}
    parts = {"L1", "L3"} if name == "achromat" else {"M1", "M2"}
    assert parts <= drawn
    assert not {"L2", "L4", "spider"} & drawn
    image = imread(BytesIO(png := still_png(instrument, paths)))
    opaque = np.mean(image[..., 3] > 0.0)
    assert image.shape[1:] == (2200, 4)
    assert 0.01 < opaque < 0.5
    assert not np.any(image[:20, :, 3])
    assert png == still_png(instrument, paths)
    page = viewer_page("a <b>", glb, "nothing", Markup("<p>still</p>"))
    assert breaches(page) == []
    assert "a &lt;b&gt;" in page


def test_dimensions_are_those_of_the_file(backend) -> None:
    spec = load_camera("ritchey_chretien")
    model = derive_camera(spec, backend)
    sizes = {(start, end): size for start, end, size in dimensions(model)}
    places = [*(mirror.z for mirror in spec.mirrors.values()), spec.image.z]
    names = [*spec.mirrors, "focal plane"]
    for a, b, gap in zip(names, names[1:], np.abs(np.diff(places)), strict=False):
        assert sizes[a, b] == pytest.approx(gap, abs=1e-12)
    assert sizes["overall", "height, y"] == pytest.approx(sizes["overall", "width, x"], rel=1e-9)
    bodies = [mirror.z for mirror in spec.mirrors.values() if mirror.light is None] + [spec.image.z]
    assert sizes["overall", "length"] == pytest.approx(max(bodies) - min(bodies), rel=0.02)  # and the depth of M2
