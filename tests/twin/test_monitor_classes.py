"""Classes of pupil nodes by where the spots fall, the prediction of the aim, and results that repeat to the byte."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import brentq

from optics.geometry.tree import Motion, State
from optics.numerics import quadrature
from optics.raytrace.aim import aim
from optics.waves.diffraction import image
from scenes.specs.instrument import BASE
from twin.monitor import monitor_beams
from twin.monitor.monitor_beams import SPOT_RANGES, UncertainImageError
from twin.monitor.monitor_path import MonitorPath

ROOT = Path(__file__).resolve().parents[2]
ACCURACY = 1e-6  # of the peak: what the nodes are chosen for
SINGLE = 1e-6  # of the peak: sums in single precision


def shifted(path: MonitorPath, by: float) -> State:
    return {f"{BASE}/forward/focal_plane": Motion(shift=(by, by, 0.0))}


def off_middle(path: MonitorPath, wanted: float) -> State:
    """A shift along the diagonal that brings the farthest pixel of the worst spot to ``wanted`` half diagonals of the
    CCD from it."""
    half = 0.5 * np.array(path.shape)

    def excess(by: float) -> float:
        place = path.coarse_trace([shifted(path, by)]).centre
        return float(np.max(np.linalg.norm(np.abs(place) + half, axis=-1)) / np.linalg.norm(half) - wanted)

    return shifted(path, brentq(excess, 0.0, 0.5 * path.pitch * half[0] * wanted, xtol=1e-11))


@pytest.fixture(scope="module", params=["gf7_pair", "monitor_pair"])
def setup(request, experiment):
    return experiment(request.param)


@pytest.mark.second
@pytest.mark.parametrize("number", range(len(SPOT_RANGES) - 1))
def test_both_classes_are_right_at_their_border(setup, number: int) -> None:
    path = setup.path
    inner, outer = (off_middle(path, 1.0 + SPOT_RANGES[number] + side * 2e-5) for side in (-1, 1))
    chosen = path.class_of(path.coarse_trace([inner, outer]))
    assert chosen.tolist() == [number, number + 1]
    assert path.class_beams(number).nodes.count < 0.85 * path.class_beams(number + 1).nodes.count
    fine = MonitorPath(path.instrument, path.backend, quadrature.disk(30, 120))
    want = fine.expected_photons([inner, outer], single=False)
    peak = want.max(axis=(-2, -1), keepdims=True)
    got = path.expected_photons([inner, outer], single=False)
    assert np.max(np.abs(got - want) / peak) < ACCURACY
    single = path.expected_photons([inner, outer])
    assert np.max(np.abs(single - want) / peak) < ACCURACY + SINGLE
    # one and the same state in both classes: no step where they meet
    steps = [
        path.light_per_pixel[:, None, None]
        * path.response.apply(
            image(one.fields([inner]), *(path.grid(axis, path.response.half_width) for axis in (1, 0)))
        )
        for one in (path.class_beams(number), path.class_beams(number + 1))
    ]
    assert np.max(np.abs(steps[0] - steps[1])[:, None] / peak[0][:, None]) < ACCURACY


def test_beams_that_are_too_wide_for_the_pixels_are_refused(setup) -> None:
    wide = SimpleNamespace(aperture=np.array([10.0 * setup.path.numerical_aperture]))
    with pytest.raises(UncertainImageError, match="beams have 10 times the designed aperture: "):
        setup.path._response_of(wide)


def test_margin_counts_as_distance(setup) -> None:
    place = np.zeros((4, 1, 2))
    half = 0.5 * setup.path.shape[0]
    classes = setup.path.node_classes
    found = [int(classes.class_of(place, margin)[0]) for margin in (0, int(0.4 * half), int(0.7 * half))]
    assert found == [0, 1, 2]


def test_predicted_rays_meet_the_aimed_ones(setup, monkeypatch) -> None:
    """Rays turned as the few coarse ones say, against rays that are aimed one by one from the nominal ones."""
    states = [{f"{BASE}/forward/M2": Motion(shift=(2e-6, -3e-6, 4e-6), rotate=(3e-6, 1e-6, 0.0), pivot="centre")}]
    path = setup.path
    known = path.coarse_trace(states)
    path.rays(states, known)  # nominal rays are aimed before calls are counted
    calls = []

    def counted(*arguments):
        calls.append(arguments)
        return aim(*arguments)

    monkeypatch.setattr(monitor_beams, "aim", counted)
    predicted = path.rays(states, known)
    assert not calls
    aimed = path.rays(states, replace(known, aim_change=np.zeros_like(known.aim_change)))
    assert len(calls) == 1
    # a nanometre off its node on the face, a ray is off by that part of the aperture in direction
    limit = 2.0 * monitor_beams.AIM_TOLERANCE / path.face_radius.min() * path.numerical_aperture
    assert np.max(np.abs(predicted.direction - aimed.direction)) < limit
    assert np.max(np.abs(predicted.position - aimed.position)) < 2.0 * monitor_beams.AIM_TOLERANCE


SCRIPT = """
import hashlib
import numpy as np
from optics.numerics.backend import load_backend
from optics.geometry.tree import Motion
from scenes.specs.job import JobSpec
from scenes.specs.resolved import resolve_job
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import ObservationOptions, observe, shared_detector
setup = MonitorExperiment(resolve_job(JobSpec(instrument="gf7_pair")), load_backend("llvm"))
rng = np.random.default_rng(5)
states = [{"base/forward/focal_plane": Motion(shift=tuple(3e-5 * rng.normal(size=3)))} for _ in range(7)]
digest = hashlib.sha256()
for seen in observe(setup, states, ObservationOptions(shared_detector(setup, 3, 1), chunk=4, use_prior=False)):
    found = seen.recovery
    for array in (found.after, found.shift_covariance, found.parameters["forward"]["model"].vector):
        digest.update(np.ascontiguousarray(array).tobytes())
print(digest.hexdigest())
"""


def digest(processors: set[int]) -> str:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        preexec_fn=lambda: os.sched_setaffinity(0, processors),
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    return done.stdout


@pytest.mark.second
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system cannot bind a process to processors")
def test_same_bytes_on_one_processor_and_on_all() -> None:
    every = os.sched_getaffinity(0)
    assert digest({min(every)}) == digest(every) != ""


def one_by_one(setup) -> list[State]:
    """Every body of an instrument moved, turned, grown and with another index, alone."""
    small = Motion(rotate=(2e-6, 1e-6, -1e-6), shift=(1e-7, -2e-7, 1e-7), scale=1e-7, index=1e-8)
    return [{body.path: small} for body in setup.instrument.assembly.tree.bodies]


@pytest.mark.second
def test_cameras_whose_light_a_body_changes(setup) -> None:
    """To the bit: of the others not even the last digit of a spot's place moves, and of these some spot does."""
    path, states = setup.path, one_by_one(setup)
    places = path.coarse_trace([{}, *states]).centre
    moved = [path.moved_cameras(state) for state in states]
    for s, (state, cameras) in enumerate(zip(states, moved, strict=True), 1):
        for channel, place in zip(path.channels, places, strict=True):
            if channel.camera not in cameras:
                np.testing.assert_array_equal(place[s], place[0], str(state))
    assert path.moved_cameras({}) == ()
    names = set(setup.instrument.cameras)
    assert {f"{BASE}/{name}/M2" for name in names} == {next(iter(s)) for s in states if "/M2" in next(iter(s))}
    for state, cameras in zip(states, moved, strict=True):
        body = next(iter(state))
        if body in {f"{BASE}/{name}/{part}" for name in names for part in ("M1", "M2", "focal_plane")}:
            assert cameras == (body.split("/")[1],), body
    assert moved[[next(iter(s)) for s in states].index(BASE)] == tuple(setup.instrument.cameras)


@pytest.mark.second
def test_channels_left_alone_are_rendered_once_and_alike(setup) -> None:
    """Photons of one state are those of ``expected_photons`` to the bit, whichever channels were kept."""
    path = setup.path
    first = next(iter(setup.instrument.cameras))
    small = Motion(rotate=(2e-6, 1e-6, -1e-6))
    far = Motion(shift=(0.2 * path.pitch * path.shape[0], 0.0, 0.0))  # in another class of nodes
    for state in ({}, {f"{BASE}/{first}/M2": small}, {BASE: small}, {f"{BASE}/{first}/focal_plane": far}):
        kept = path.photons_of(state)
        np.testing.assert_array_equal(kept, path.expected_photons([state], single=False)[0])
        kept[:] = 0.0  # the caller's own
