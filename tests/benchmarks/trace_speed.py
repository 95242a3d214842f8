"""Sequential trace, with apertures and path lengths, beside batoid and optiland.

batoid takes as many threads as OMP_NUM_THREADS says, one if it says nothing, and so do its users; optiland on NumPy
takes one. The twin takes all cores.
"""

from __future__ import annotations

import warnings
from typing import Any

import drjit as dr
import numpy as np

from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.models.camera_model import LINE_AXIS, CameraModel, collimated, field_direction
from tests.benchmarks.workbench import Number, Speed, Spent, Work, Workbench, absent, in_turns, installed
from tests.oracles.peers import batoid_camera, batoid_rays, optiland_camera, optiland_rays

CAMERAS = ("gf7", "gf7_conic")
SURFACES = 4
RAYS, QUICK_RAYS = 1_000_000, 50_000
ROUNDS, REPEATS = 9, 5


def launch(bench: Workbench, model: CameraModel, rays: int) -> tuple[np.ndarray, np.ndarray]:
    """A beam on the axis of the field, a little wider than the pupil, so that the apertures have work to do."""
    direction = field_direction(model.spec, 0.0, 0.0)
    to_stop = assemble(model.bare_assembly(False), [model.mirrors[:2]])
    middle = collimated(bench.backend, to_stop, direction[None], np.zeros((1, 2)))[0, 0]
    place = np.random.default_rng(0).uniform(-0.3, 0.3, (rays, 2))
    return middle + place @ np.stack([LINE_AXIS, np.cross(direction, LINE_AXIS)]), direction


def works(bench: Workbench, model: CameraModel, rays: int) -> dict[str, Work]:
    """The same beam through the same camera in each software."""
    position, direction = launch(bench, model, rays)
    system = assemble(model.bare_assembly(), ["imaging"]).upload(bench.backend)
    beam = make_rays(bench.backend, position, direction)

    def twin(_: Any) -> Any:
        out = trace(bench.backend, system, beam)
        dr.sync_thread()
        return out

    out = {"twin": Work(twin, repeats=REPEATS)}
    if installed("batoid"):
        peer = batoid_camera(model, apertures=True)
        out["batoid"] = Work(peer.trace, lambda: batoid_rays(position, direction))
    if installed("optiland"):
        optic = optiland_camera(model, apertures=True)

        def optiland(given: Any) -> Any:
            optic.surfaces.trace(given, record=False)
            return given

        optiland(optiland_rays(position[:100], direction))  # compiles
        out["optiland"] = Work(optiland, lambda: optiland_rays(position, direction))
    twin(None)
    return out


def check_same_work(spent: dict[str, Spent]) -> None:
    """The comparison is one of equals: the same rays stopped, the same path lengths.

    Raises:
        AssertionError: they are not.
    """
    _, _, path, valid = (array[0] for array in spent["twin"].result.numpy())
    assert 0.7 < valid.mean() < 0.9, valid.mean()
    if "batoid" in spent:
        theirs = spent["batoid"].result
        assert np.array_equal(valid, ~theirs.vignetted)
        np.testing.assert_allclose(theirs.t[valid], path[valid], rtol=0, atol=1e-12)
    if "optiland" in spent:
        others = spent["optiland"].result
        assert np.array_equal(valid, others.i > 0)
        np.testing.assert_allclose(others.opd[valid], path[valid], rtol=0, atol=1e-5)  # its asphere stops early


def measure(bench: Workbench, quick: bool) -> Speed:
    """Ray-surfaces per second, and how many times those of the others."""
    numbers: list[Number] = []
    notes = [absent(peer) for peer in ("batoid", "optiland") if not installed(peer)]
    rays = QUICK_RAYS if quick else RAYS
    for name in CAMERAS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numba's remarks on optiland's code
            spent = in_turns(works(bench, bench.camera(name), rays), 1 if quick else ROUNDS)
        check_same_work(spent)
        key = "" if name == CAMERAS[0] else f"{name}_"
        twin = spent["twin"]
        rate = rays * SURFACES / twin.wall_s
        each = 1e9 * twin.cpu_s / (rays * SURFACES)
        numbers += [
            Number(f"{key}ray_surfaces_per_s", rate, f"trace of {name}", "ray-surfaces/s"),
            Number(f"{key}cpu_ns", each, "  processor time of a ray at a surface", "ns"),
        ]
        numbers.append(Number(f"{key}threads", twin.threads, "  threads at work"))
        for peer in spent.keys() - {"twin"}:
            ratio = spent[peer].wall_s / twin.wall_s
            numbers.append(Number(f"{key}ratio_{peer}", ratio, f"  times {peer}"))
    return Speed(tuple(numbers), tuple(notes))
