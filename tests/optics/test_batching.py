"""Many states in one launch, and one compilation for all numbers."""

from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import numpy as np
import pytest

from optics.geometry.tree import Motion, State
from optics.numerics import quadrature
from optics.raytrace import trace as trace_module
from optics.raytrace.aim import AimError, RayFan, aim, transverse_axes
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.models.camera_model import field_direction
from twin.monitor.monitor_path import MonitorPath
from twin.monitor.truth import trace_truth

ARCSEC = np.pi / 180 / 3600


def some_states(count: int, seed: int, bodies: tuple[str, ...]) -> list[State]:
    rng = np.random.default_rng(seed)

    def motion() -> Motion:
        rotate, shift = rng.normal(0, 5 * ARCSEC, 3), rng.normal(0, 5e-6, 3)
        return Motion((rotate[0], rotate[1], rotate[2]), (shift[0], shift[1], shift[2]))

    return [{body: motion() for body in bodies} for _ in range(count)]


def launch(gf7, n: int = 200) -> tuple[np.ndarray, np.ndarray]:
    direction = field_direction(gf7.spec, 0.0, 0.0)
    rng = np.random.default_rng(3)
    axes = transverse_axes(direction, np.array([1.0, 0.0, 0.0]))
    origin = gf7.camera_frame.apply([0.0, 0.0, 2.6])
    return origin + rng.uniform(-0.25, 0.25, (n, 2)) @ axes, direction


def ends(backend, systems, rays, keep=(0, 2), **how) -> list[np.ndarray]:
    found = trace(backend, systems, rays, keep=keep, world=True, **how)
    assert found.world is not None
    return [*found.numpy(), *found.numpy(found.world), *map(found.hit, keep)]


@pytest.mark.second
@pytest.mark.parametrize("section", [2, trace_module.KERNEL_ELEMENTS])
def test_lanes_that_take_one_system_each_trace_the_same(backend, gf7, section: int, monkeypatch) -> None:
    """The same recording serves any number of systems and rays."""
    bare = gf7.bare_assembly()
    monkeypatch.setattr(trace_module, "KERNEL_ELEMENTS", section)
    monkeypatch.setattr(trace_module, "MIN_LANE_RAYS", 1)
    position, direction = launch(gf7, 800)
    for count, size in ((37, 5), (8, 100), (100, 8), (33, 1), (1, 33), (16, 43)):
        states = some_states(count, count, ("M1", "M2", "M3", "image"))
        figure = Motion(figure={4: 1e-8, 6: 2e-8}, scale=1e-5)
        systems = assemble(bare, ["imaging"], [{**state, "M3": figure} for state in states])
        own = position[: count * size].reshape(count, size, 3)
        for start, heading in ((own, np.broadcast_to(direction, own.shape)), (own, direction), (own[0], direction)):
            found = []
            for fewest in (1, 10**9):
                monkeypatch.setattr(trace_module, "MIN_LANE_SYSTEMS", fewest)
                found.append(ends(backend, systems, make_rays(backend, start, heading)))
            for lanes, looked_up in zip(*found, strict=True):
                # the same operations; the compiler may contract other products into fma
                np.testing.assert_allclose(lanes, looked_up, rtol=0, atol=1e-14, err_msg=f"{count} {size}")
            assert np.any(found[0][3])


def test_rays_for_another_number_of_systems_are_refused(backend, gf7) -> None:
    systems = assemble(gf7.bare_assembly(), ["imaging"], some_states(3, 1, ("M2",)))
    position, direction = launch(gf7, 60)
    with pytest.raises(ValueError, match="rays for 2 systems cannot go through 3"):
        trace(backend, systems, make_rays(backend, np.tile(position, (2, 1, 1)), direction))


@pytest.mark.parametrize("order", [(60, 200), (200, 60)], ids=["first fewer rays", "first more rays"])
def test_what_is_recorded_of_a_trace_holds_for_any_number_of_rays_and_systems(backend, gf7, order) -> None:
    """Of each pair the second is launched as the first one was recorded; both are what a new graph gives."""
    trace_module._threads.__dict__.pop("known", None)
    for count, rays in zip((3, 7), order, strict=True):
        systems = assemble(gf7.bare_assembly(), ["imaging"], some_states(count, count, ("M1", "M2", "M3", "image")))
        position, direction = launch(gf7, rays)
        for start in (position, np.tile(position, (count, 1, 1)) + 1e-3 * np.arange(count)[:, None, None]):
            bundle = make_rays(backend, start, direction)
            recorded, fresh = (ends(backend, systems, bundle, (2, 1), evaluate=e) for e in (True, False))
            assert recorded[0].shape == (count, rays, 3)
            for one, other in zip(recorded, fresh, strict=True):
                # the same operations; a kernel of more of them may contract other products into fma
                np.testing.assert_allclose(one, other, rtol=0, atol=1e-14)


def test_threads_have_recordings_of_their_own(backend, gf7) -> None:
    systems = assemble(gf7.bare_assembly(), ["imaging"], some_states(3, 1, ("M2",)))
    bundles = [launch(gf7, n) for n in (50, 60, 70, 80)]

    def positions(bundle) -> list[np.ndarray]:
        return [trace(backend, systems, make_rays(backend, *bundle)).numpy()[0] for _ in range(20)]

    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(positions, bundles))
    for bundle, several in zip(bundles, together, strict=True):
        alone = trace(backend, systems, make_rays(backend, *bundle)).numpy()[0]
        for one in several:
            np.testing.assert_array_equal(one, alone)


def test_sequences_of_other_structure_are_refused(gf7_pair) -> None:
    with pytest.raises(ValueError, match="different lengths"):
        assemble(gf7_pair.assembly, ["forward/imaging", "forward/left/monitor"])
    with pytest.raises(ValueError, match="different kinds"):
        assemble(gf7_pair.assembly, [("forward/M1",), ("forward/M2",)])


def test_aim_reaches_its_points_and_says_when_it_cannot(backend, gf7) -> None:
    bare = gf7.bare_assembly(apertures=False)
    to_stop = assemble(bare, [gf7.mirrors[:2]], some_states(4, 5, ("M1", "M2")))
    nodes = quadrature.disk(3)
    target = 0.1 * np.stack([nodes.x, nodes.y], axis=-1)
    direction = field_direction(gf7.spec, 0.01, 0.001)[None, None]
    fan = RayFan(
        -3.0 * direction, direction, transverse_axes(direction, np.array([[[1.0, 0.0, 0.0]]])), moves_position=True
    )
    q, slope = aim(backend, to_stop, fan, target)
    hit = trace(backend, to_stop, make_rays(backend, *fan.at(q))).numpy()[0][..., :2]
    np.testing.assert_allclose(hit, np.broadcast_to(target, hit.shape), rtol=0, atol=1e-11)
    assert slope.shape == (4, nodes.count, 2, 2)
    again, _ = aim(backend, to_stop, fan, target, start=q, jacobian=slope)
    np.testing.assert_array_equal(again, q)
    with pytest.raises(AimError, match="did not converge"):
        aim(backend, to_stop, fan, np.full((1, 2), np.inf))


def new_kernels(work) -> tuple[int, int]:
    """Kernels launched and kernels compiled while ``work`` runs."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        work()
        dr.sync_thread()
        history = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    return len(history), sum(not k["cache_hit"] for k in history)


def test_other_numbers_compile_no_new_kernel(backend, gf7, gf7_pair) -> None:
    bare = gf7.bare_assembly()
    path = MonitorPath(gf7_pair, backend)
    bodies = ("base/backward/M2", "base/forward/focal_plane", "base/backward/focal_plane")
    to_stop = assemble(bare, [gf7.mirrors[:2]])

    def aimed(x: float) -> None:
        direction = field_direction(gf7.spec, x, 0.3 * x)[None, None]
        fan = RayFan(-3.0 * direction, direction, transverse_axes(direction, np.array([[[1.0, 0.0, 0.0]]])), True)
        aim(backend, to_stop, fan, np.full((1, 2), 1e-3 + x))

    works = {
        "trace": lambda seed: trace(
            backend, assemble(bare, ["imaging"], some_states(2, seed, ("M1", "M2"))), make_rays(backend, *launch(gf7))
        ),
        "aim": lambda seed: aimed(1e-3 * seed),
        "monitor": lambda seed: path.fields(some_states(2, seed, bodies)),
        "truth": lambda seed: trace_truth(gf7_pair, backend, some_states(2, seed, bodies)),
    }
    for name, work in works.items():
        work(1)
        launched, compiled = new_kernels(lambda work=work: work(2))
        assert launched > 0, name
        assert compiled == 0, f"{name} compiled {compiled} of {launched} kernels anew"
