"""Input that cannot be is refused in words, in tables of cases, and doubts of the numerics themselves are raised."""

from dataclasses import replace
from pathlib import Path
from pydoc import locate
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial import QhullError

from optics.geometry.aperture import Edge, Polygon
from optics.geometry.polygon import quadrature as polygon_quadrature
from optics.materials import fresnel_scatter
from optics.materials.fresnel_scatter import ScatterTable
from optics.materials.glass import CatalogueGlass
from optics.numerics import quadrature
from optics.raytrace.trace import _redirect
from optics.thermal import elastic_mesh
from optics.thermal.elastic_mesh import polyhedron_mesh
from optics.thermal.nodal_deformation import NodalTemperature
from optics.waves import optical_transfer, pupil_shadow
from optics.waves.diffraction import PupilField
from optics.waves.edge_shadow import outlines_on_stop
from optics.waves.optical_transfer import TransferTable, with_enough_nodes
from optics.waves.pupil_shadow import PupilShadow
from optics.waves.pupil_stack import PupilFunction, circular_pupil, fit_pupils

NODES = quadrature.disk(12, 48)
CROSSED = Polygon(((0.0, 0.0), (0.5, 0.5), (0.0, 0.5), (0.5, 0.0), (0.3, 0.8), (0.2, -0.3)))
NODE = np.random.default_rng(1).uniform(size=(40, 3))
TABLE = ScatterTable([0.0], [0.0], [0.0, 1.0], [[[0.1, 0.1]]])
BOX = np.array([(x, y, z) for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
BEAM = PupilField(*(0.05 * part[None] for part in (NODES.x, NODES.y, 0.0 * NODES.x, NODES.weight)), 650e-9)


CASES = yaml.load(Path(__file__).with_name("refusals.yaml").read_bytes(), yaml.CSafeLoader)


def made(value: Any) -> Any:
    """Return what an argument of the table stands for."""
    if isinstance(value, dict):
        return locate(value["is"])(**{key: made(one) for key, one in value.items() if key != "is"})
    return tuple(map(made, value)) if isinstance(value, list) else value


@pytest.mark.parametrize("case", CASES, ids=lambda case: case["call"].removeprefix("optics."))
def test_arguments_that_cannot_be_are_refused(case: dict[str, Any]) -> None:
    """Sound arguments pass: what refuses everything would pass all else."""
    made({"is": case["call"], **case["good"]})
    for words, changes in case["refused"].items():
        for change in changes:
            with pytest.raises(ValueError, match=words):
                made({"is": case["call"], **case["good"], **change})


def test_what_cannot_be_is_refused() -> None:
    azimuth, radial = np.linspace(0.0, 2.0 * np.pi, 181), np.linspace(0.0, np.pi, 1001)
    on_stop = np.stack([NODES.x, NODES.y], axis=-1)[None]
    turned = SimpleNamespace(mapping=lambda: SimpleNamespace(detDF=lambda _: np.array([1.0, -1.0])))
    glass = CatalogueGlass("F0", 2, (-5.0, 0.01, 0.0, 0.0, 0.0, 0.0), 400e-9, 700e-9)
    for make, words in (
        (lambda: glass(500e-9), "F0: its dispersion formula gives no valid index at 500 nm"),
        (lambda: ScatterTable([0.0], azimuth, radial, np.zeros((1, 181, 1001))), "1000 x 180 cells are more"),
        (lambda: NodalTemperature(NODE, np.zeros(39)), r"nodes must be \(N, 3\) and temperatures \(N,\)"),
        (lambda: NodalTemperature(NODE, np.full(40, np.nan)), "nodes and temperatures must be finite"),
        (lambda: NodalTemperature(NODE[:2], np.zeros(2)), "2 different nodes"),
        (lambda: elastic_mesh._right_handed(turned), "too steep for its mesh"),
        (lambda: outlines_on_stop(on_stop, [Edge(CROSSED, True)], NODES), "sides of a polygonal edge cross each other"),
        (lambda: fit_pupils(BEAM, NODES, bright=(NODES.x > 0.95)[None]), "too few for a fit"),
    ):
        with pytest.raises(ValueError, match=words):
            make()


def test_numerics_that_do_not_come_out_are_refused(monkeypatch) -> None:
    """Each limit is set so that sound input breaks it; without that the same calls pass."""
    pupil = circular_pupil(9.2)
    square = 0.2 * np.array([[[[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]]])

    def within() -> None:
        pupil_shadow.quadrature_within(square[0], np.ones((1, 1), complex), 5)

    def doubled(*arguments):
        points, weights = polygon_quadrature(*arguments)
        return points, 2.0 * weights

    def cut() -> PupilFunction:
        shadow = PupilShadow.within(square, pupil.edge.harmonics[:, None])
        return with_enough_nodes(replace(pupil, shadow=shadow, finer=1), 650e-9)

    def table() -> TransferTable:
        return TransferTable.build(pupil, np.array([650e-9]), np.ones(1))

    def failing(*_, **__) -> None:
        raise QhullError("QH6154 initial simplex is flat")

    for module, name, value, call, words in (
        (fresnel_scatter, "MOST_CELLS", 1, lambda: replace(TABLE), "cells are more than 1"),
        (elastic_mesh, "ConvexHull", failing, lambda: polyhedron_mesh(BOX, 0.5), "degenerate: QH6154"),
        (elastic_mesh, "_volumes", lambda nodes, t: np.zeros(len(t)), lambda: polyhedron_mesh(BOX, 0.5), "watertight"),
        (pupil_shadow, "_AREA_TOLERANCE", -1.0, within, "is larger than the shadow"),
        (pupil_shadow, "quadrature", doubled, cut, "does not have its area"),
        (optical_transfer, "WORST_TRANSFER", -1.0, cut, "still changes by"),
        (optical_transfer, "_MOST_NODES", 1, table, "too many waves for a table"),
    ):
        call()
        with monkeypatch.context() as patch:
            patch.setattr(module, name, value)
            if module is optical_transfer and name == "_MOST_NODES":
                patch.setattr(module, "TABLE_TAIL", 0.0)
            with pytest.raises(ValueError, match=words):
                call()
    with pytest.raises(ValueError, match="has no part 'dark'"):
        optical_transfer._correlate(pupil, np.zeros(1), np.full(1, 650e-9), np.zeros(1), "dark")


def test_an_interaction_that_the_trace_does_not_know_is_refused(backend) -> None:
    vector = backend.Vector3(0.0, 0.0, 1.0)
    element = SimpleNamespace(surface=SimpleNamespace(), before=SimpleNamespace(), after=SimpleNamespace())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("optics.raytrace.trace.level", lambda *_: (0.0, *vector))
        patch.setattr("optics.raytrace.trace._index_at", lambda *_: 1.0)
        with pytest.raises(ValueError, match="the trace does not support the interaction bend"):
            _redirect(backend, vector, vector, element, "bend", None)
