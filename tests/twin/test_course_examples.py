"""The courses of scenes/examples: an orbit, a launch, a heat soak. They are what their heads say, and can be read."""

import math

import numpy as np
import pytest

from scenes.specs.course import CourseSpec
from scenes.specs.load import EXAMPLES
from scenes.specs.resolved import resolve
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.time_series import run_series, series_states

HOUR, MINUTE = 3600.0, 60.0
DRYING = 480.0 * HOUR
"""Time constant of the slowest part of the diffusion of moisture in launch.yaml."""


def test_the_example_is_an_orbit() -> None:
    resolved = resolve(EXAMPLES / "orbit.yaml")
    course = resolved.job.course
    assert isinstance(course, CourseSpec)
    assert (len(course.times), course.times[-1]) == (21, 6000.0)
    first, last = course.fields(0), course.fields(20)
    assert first == last  # a whole period


def dried(time: float) -> float:
    """Share of the moisture that has left a plate through both faces."""
    odd = [2 * n + 1 for n in range(400)]
    return 1.0 - sum(8.0 / (math.pi * k) ** 2 * math.exp(-(k**2) * time / DRYING) for k in odd)


def test_the_example_of_a_launch_is_what_its_head_says() -> None:
    """Drying, creep and cooling by the laws that the file states, to the digits that it prints; and what launch leaves
    stays within three of the standard deviations that it states.
    """
    resolved = resolve(EXAMPLES / "launch.yaml")
    job = resolved.job
    course = job.course
    assert isinstance(course, CourseSpec)
    assert (course.times[0], course.times[-1], course.shown) == (2 * HOUR, 720 * HOUR, 0)
    constants = {"base": 20, "base/forward": 12, "base/backward": 14, "base/central_prism": 3}
    constants |= {path: 4 for path in course.temperature if path.endswith("focal_plane")}
    constants |= {
        path: 5 if "prism_0" in path else 8 if "forward" in path else 9
        for path in course.temperature
        if "/prism_" in path
    }
    assert set(constants) == set(course.temperature)
    for path, hours in constants.items():
        changes = [course.fields(k)[path].change for k in range(len(course.times))]
        for time, change in zip(course.times, changes, strict=True):
            # after 30 days all has been reached; printed to a millikelvin
            assert change == pytest.approx(changes[-1] * -math.expm1(-time / (hours * HOUR)), abs=1.1e-3)
    for path, shrunk in (("base/forward", -21e-6), ("base/backward", -18e-6)):
        moves = [course.motions(k)[path] for k in range(len(course.times))]
        for time, move in zip(course.times, moves, strict=True):
            assert move.scale == pytest.approx(shrunk * dried(time), abs=0.51e-8)
            share = -math.expm1(-time / (72 * HOUR))
            assert move.rotate == pytest.approx([share * angle for angle in moves[-1].rotate], abs=2.5e-9 * 2)
    assert resolved.disturbances is not None
    mounts = resolved.disturbances.causes["mirror_mounts"]
    assert mounts.shift is not None
    for path, what in job.perturb.items():
        if path[-2:] in ("M1", "M2", "M3"):
            assert all(abs(one) <= 3.0 * sigma for one, sigma in zip(what.shift, mounts.shift, strict=True))


@pytest.mark.second
def test_an_example_is_read_within_its_sigmas(backend) -> None:
    """At all times: no light is lost, no spot nears its edge, shifts agree with what is stated, and every change is
    within 3.5 of its total sigmas. Errors of one course go together, so that it is one draw of nine numbers and not of
    two hundred: false alarm 0.4 %, of a draw that the files fix.
    """
    resolved = resolve(EXAMPLES / "launch.yaml")
    experiment = MonitorExperiment(resolved, backend)
    series = run_series(experiment, resolved, series_states(experiment, resolved.job))
    assert series.warnings == ()
    assert series.smoothed is not None
    assert series.smoothed.consistency.agrees
    for row in series.readings.of("posterior"):
        assert row.group == "ground" or np.abs(row.error / row.sigma).max() < 3.5
    angle = series.readings.row("intersection_angle", "change_arcsec", "posterior")
    # it is about something: what moves is many times what the noise hides
    assert np.ptp(angle.true) > 100.0 * angle.noise.max()
