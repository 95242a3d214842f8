"""Tables and meshes of displaced nodes: units and orders, and what is wrong with them, by line and column."""

from __future__ import annotations

from pathlib import Path

import meshlane
import numpy as np
import pytest

from scenes.models.nodal_bodies import deformed_face
from scenes.specs.job_tables import DeformationSpec
from scenes.specs.load import load_job
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError
from scenes.yaml.node_table import read_nodes

BODY = "base/forward/M1"
JOB = "instrument: gf7_pair\nperturb:\n  base/forward/M1: {deformation: %s}\n"
HEADS = ("x", "y", "z", "dx", "dy", "dz")
TURN, SHIFT = np.array([2e-6, -3e-6, 1e-6]), np.array([1e-6, -2e-6, 3e-6])


@pytest.fixture(scope="module")
def nodes(gf7_pair) -> np.ndarray:
    """Nodes of M1 and their displacements, (N, 6), metres."""
    element = gf7_pair.assembly.elements["forward/M1"]
    x0, x1, y0, y1 = element.aperture.bounds
    x, y = (
        a.ravel() for a in np.meshgrid(np.linspace(x0 - 0.01, x1 + 0.01, 24), np.linspace(y0 - 0.01, y1 + 0.01, 20))
    )
    points = np.stack([x, y, element.surface.sag(x, y)], axis=-1)
    bump = 2e-8 * np.sin(9.0 * x) * np.cos(7.0 * y)
    moves = np.cross(TURN, points) + SHIFT + np.stack([0 * x, 0 * x, bump], axis=-1)
    return np.hstack([points, moves])


def table(
    place: Path, nodes: np.ndarray, units: tuple[str, str] = ("mm", "um"), order: tuple[int, ...] = tuple(range(6))
) -> Path:
    """A CSV file with these units of places and displacements, columns in an order."""
    per = {"m": 1.0, "mm": 1e3, "um": 1e6, "nm": 1e9}
    factors = np.array([per[units[0]]] * 3 + [per[units[1]]] * 3)
    heads = [f"{HEADS[k]} [{units[k // 3]}]" for k in order]
    rows = [",".join(repr(float(v)) for v in row[list(order)]) for row in nodes * factors]
    place.write_text("\n".join([",".join(heads), *rows]) + "\n")
    return place


def job(folder: Path, deformation: str) -> Path:
    place = folder / "job.yaml"
    place.write_text(JOB % deformation)
    return place


def spec(path: Path, **more) -> DeformationSpec:
    return DeformationSpec(table=str(path), **more)


def test_units_and_order_of_rows_and_columns_do_not_matter(tmp_path, nodes, gf7_pair) -> None:
    a = table(tmp_path / "a.csv", nodes)
    shuffled = np.random.default_rng(1).permutation(nodes)
    b = table(tmp_path / "b.csv", shuffled, ("m", "nm"), (5, 1, 3, 0, 2, 4))
    one, two = (deformed_face(gf7_pair, load_job(job(tmp_path, p.name)), BODY, spec(p)) for p in (a, b))
    # rounding of 1 um in 1 nm: 1e-16 of the coordinates, some times over in sums of 500 nodes
    np.testing.assert_allclose(one.rotate, two.rotate, rtol=0, atol=1e-14)
    np.testing.assert_allclose(one.shift, two.shift, rtol=0, atol=1e-14)
    assert one.rms(one.change) == pytest.approx(two.rms(two.change), abs=1e-14)
    assert one.grid is not None
    assert two.grid is not None
    x, y = one.places[one.weight > 0.0].T
    np.testing.assert_allclose(one.grid.sag(x, y), two.grid.sag(x, y), rtol=0, atol=1e-13)
    assert np.max(np.abs(one.grid.sag(x, y))) > 1e-11


def test_nodes_in_another_frame(tmp_path, nodes, gf7_pair) -> None:
    placed = gf7_pair.assembly.place()
    pose = placed.pose("base").inverse() @ placed.pose(BODY)
    elsewhere = np.hstack([pose.apply(nodes[:, :3]), nodes[:, 3:] @ pose.rotation.T])
    own, base = (table(tmp_path / f"{k}.csv", n) for k, n in enumerate((nodes, elsewhere)))
    read = load_job(job(tmp_path, own.name))
    one, two = (
        deformed_face(gf7_pair, read, BODY, spec(own)),
        deformed_face(gf7_pair, read, BODY, spec(base, frame="base")),
    )
    np.testing.assert_allclose(one.rotate, two.rotate, rtol=0, atol=1e-13)
    np.testing.assert_allclose(one.shift, two.shift, rtol=0, atol=1e-13)
    with pytest.raises(InputError, match="stand on the clear aperture"):
        deformed_face(gf7_pair, read, BODY, spec(base))
    with pytest.raises(InputError, match="no such node"):
        deformed_face(gf7_pair, read, BODY, spec(base, frame="base/forwrd"))


@pytest.mark.parametrize("ending", ["vtu", "vtk", "msh", "med"])
def test_a_mesh_says_what_a_table_says(tmp_path, nodes, gf7_pair, ending: str) -> None:
    place = tmp_path / f"m1.{ending}"
    cells = [("triangle", np.array([[0, 1, 24], [1, 25, 24]]))]
    mesh = meshlane.Mesh(1e3 * nodes[:, :3], cells, point_data={"U": 1e3 * nodes[:, 3:]})
    mesh.write(place, **({"file_format": "gmsh"} if ending == "msh" else {}))
    read = read_nodes(place, unit="mm")
    np.testing.assert_allclose(read.points, nodes[:, :3], rtol=1e-15)
    np.testing.assert_allclose(read.moves, nodes[:, 3:], rtol=1e-15)
    with pytest.raises(InputError, match="does not say its unit"):
        load_job(job(tmp_path, place.name))
    with pytest.raises(InputError, match="no such vectors"):
        read_nodes(place, unit="mm", field="displacement")


def test_the_job_knows_the_table_that_it_was_read_with(tmp_path, nodes) -> None:
    place = table(tmp_path / "m1.csv", nodes)
    resolved = resolve(job(tmp_path, place.name))
    given = resolved.job.perturb[BODY].deformation
    assert given is not None
    assert given.table == str(place)
    assert resolved.job.perturb[BODY].uses() == ("deformation",)
    config = tmp_path / "config.yaml"
    config.write_text(resolved.to_yaml())
    assert resolve(config) == resolved
    place.write_text(place.read_text().replace("e-", "e-0", 1) + "# changed\n")
    with pytest.raises(InputError, match="checksum is another"):
        resolve(config)
