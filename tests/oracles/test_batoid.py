"""Ray positions and path lengths against batoid, for the reference cameras, nominal and with moved mirrors."""

from importlib.util import find_spec

import numpy as np
import pytest

from optics.geometry.pose import rotation_matrix
from optics.geometry.tree import Motion, State
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.models.camera_model import IMAGE, collimated, field_direction
from tests.oracles.peers import batoid_camera, batoid_rays
from tests.tiers import quick

# not imported here: each process that runs tests collects this file
pytestmark = [
    pytest.mark.oracle,
    pytest.mark.skipif(find_spec("batoid") is None, reason="batoid not installed (extra `oracles`)"),
]

ARCSEC = np.pi / 180 / 3600
TOLERANCE = 1e-12
FIELDS = [(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)]
RAYS = 1500
STATES: dict[str, State] = {
    "nominal": {},
    "moved": {
        "M1": Motion(rotate=(10 * ARCSEC, -20 * ARCSEC, 60 * ARCSEC), shift=(30e-6, -20e-6, 50e-6)),
        "M2": Motion(rotate=(-60 * ARCSEC, 40 * ARCSEC, 0.0), shift=(-100e-6, 80e-6, 30e-6)),
        "M3": Motion(rotate=(30 * ARCSEC, 30 * ARCSEC, -100 * ARCSEC), shift=(0.0, 50e-6, -40e-6)),
    },
    "moved far": {
        "M2": Motion(rotate=(1e-3, -2e-3, 5e-3), shift=(1e-3, -2e-3, 1e-3)),
        "M3": Motion(rotate=(-1e-3, 1e-3, 0.0), shift=(-1e-3, 1e-3, 2e-3)),
        IMAGE: Motion(rotate=(1e-3, 0.0, 0.1), shift=(1e-3, 0.0, -1e-3)),
    },
}


@pytest.mark.second
@pytest.mark.parametrize("state", quick(1, ["moved far", "moved", "nominal"]))
@pytest.mark.parametrize("name", ["gf7", "monitor", "gf7_conic"])
def test_rays_are_where_batoid_puts_them(backend, camera, name: str, state: str) -> None:
    model = camera(name)
    spec, motions = model.spec, STATES[state]
    bare = model.bare_assembly(apertures=False)
    to_stop = assemble(bare, [model.mirrors[:2]])
    system = assemble(bare, ["imaging"], [motions])

    peer = batoid_camera(model)
    for body, motion in motions.items():
        # batoid turns about the vertex, in the optic's frame; shift first, while its axes are still the global ones
        peer = peer.withGloballyShiftedOptic(body, motion.shift)
        peer = peer.withLocallyRotatedOptic(body, rotation_matrix(motion.rotate))
    detector = peer.itemDict[f"{spec.name}.{IMAGE}"].coordSys

    rng = np.random.default_rng(5)
    radius = model.apertures[spec.stop].radius
    r, t = radius * np.sqrt(rng.uniform(size=RAYS)), rng.uniform(0, 2 * np.pi, RAYS)
    stop = np.stack([r * np.cos(t), r * np.sin(t)], axis=-1)
    compared, worst = 0, {"position": 0.0, "direction": 0.0, "path": 0.0}
    for x, y in FIELDS:
        direction = field_direction(spec, x * spec.field.x, y * spec.field.y)
        launch = collimated(backend, to_stop, direction[None], stop)[0]
        position, leaving, path, valid = (
            a[0] for a in trace(backend, system, make_rays(backend, launch, direction)).numpy()
        )
        rays = batoid_rays(launch, direction)
        peer.trace(rays)
        rays.toCoordSys(detector)
        assert valid.all()
        assert not rays.failed.any()
        worst["position"] = max(worst["position"], np.max(np.abs(rays.r - position)))
        worst["direction"] = max(worst["direction"], np.max(np.abs(rays.v - leaving)))
        worst["path"] = max(worst["path"], np.max(np.abs(rays.t - path)))
        compared += len(path)
    assert compared >= 10_000
    assert len(FIELDS) == 9
    assert max(worst.values()) < TOLERANCE, worst


@pytest.mark.parametrize("name", ["gf7", "gf7_conic"])
def test_the_same_rays_are_stopped(backend, camera, name: str) -> None:
    model = camera(name)
    rng = np.random.default_rng(6)
    direction = field_direction(model.spec, 0.0, 0.0)
    to_stop = assemble(model.bare_assembly(False), [model.mirrors[:2]])
    middle = collimated(backend, to_stop, direction[None], np.zeros((1, 2)))[0, 0]
    launch = middle + np.column_stack([rng.uniform(-0.45, 0.45, (5000, 2)), np.zeros(5000)])
    system = assemble(model.bare_assembly(), ["imaging"])
    valid = trace(backend, system, make_rays(backend, launch, direction)).numpy()[3][0]
    rays = batoid_rays(launch, direction)
    batoid_camera(model, apertures=True).trace(rays)
    np.testing.assert_array_equal(valid, ~(rays.vignetted | rays.failed))
    assert 1000 < valid.sum() < 4500
