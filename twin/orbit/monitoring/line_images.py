"""Pairs of line images rendered at some moments of a loop: matched, and intersected to heights.

The lens of a line is round and evenly lit, with the camera's f-number and the moment's traced defocus as its wavefront;
detector and band are those of the camera. Points of the second camera's image are sought in the first one's and
intersected by the lines that the user knows, on the measured trajectory.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.orbit.forward_intersection import check_errors, intersect_pair
from scenes.specs.orbit.scene import ControlSpec, LineImageSpec
from scenes.specs.resolved import target_band
from twin.orbit.flight.light_effects import NO_EFFECTS
from twin.orbit.flight.line_camera import LineCamera, corrected_line
from twin.orbit.flight.sensor import Sensor
from twin.orbit.images.image_points import POINTS_REMEDY, PointsError, tie_points
from twin.orbit.images.line_optics import LineOptics
from twin.orbit.images.patch import PatchError, fly_patch, imaged_lines
from twin.orbit.monitoring.pair_flight import HALF_SPAN, Flown, PairFlight, second_view, sightings
from twin.run.procedure import BenchError
from twin.run.random_streams import stream

if TYPE_CHECKING:
    from scenes.specs.orbit.setup import MonitorSetup


@dataclass(frozen=True, eq=False)
class ImagedPair:
    """Points that were matched in one pair of images, and intersected.

    Attributes:
        moment: number of the reading after which they are taken.
        errors: (n, 3) of the points that were matched: found minus true, east, north, up, metres.
        misplaced: (n, 2) found minus true place in the first camera's image, lines and pixels.
        sigma: (2,) that matching states of it, median, lines and pixels.
        sought: points that were sought.
    """

    moment: int
    errors: np.ndarray
    misplaced: np.ndarray
    sigma: np.ndarray
    sought: int

    @property
    def height(self) -> tuple[float, float]:
        """Mean error in height, and its standard deviation by the scatter of the points, metres."""
        up = self.errors[:, 2]
        return float(up.mean()), float(up.std(ddof=1) / np.sqrt(len(up)))

    @property
    def matching(self) -> np.ndarray:
        """(2,) RMS of ``misplaced``, lines and pixels."""
        return np.sqrt(np.mean(self.misplaced**2, axis=0))


def imaged_pair(
    setup: MonitorSetup,
    flight: PairFlight,
    moment: int,
    nominal: Mapping[str, LineCamera],
    changes: Mapping[str, np.ndarray],
    foci: Mapping[str, float],
    flown: Flown,
    seed: np.random.SeedSequence,
) -> ImagedPair:
    """Render, match and intersect.

    Args:
        setup: the loop.
        flight: lines as they truly are, and as calibrated in the analysis's form.
        moment: number of the reading.
        nominal: camera -> its line as it was calibrated.
        changes: camera -> (4,) what the processing takes for its change.
        foci: camera -> its defocus, metres.
        flown: orbit and attitude.
        seed: of ground and frames.

    Raises:
        BenchError: a patch that a line cannot image, or too few points in it.
    """
    spec, pair, images = setup.test, setup.pair, setup.test.loop.images
    assert images is not None
    time, lines, known = spec.times[moment], flight.lines[moment], flight.calibrated
    begin, count = time - HALF_SPAN, int(2.0 * HALF_SPAN / spec.line_time)

    def sensor(line: LineCamera, measured: bool) -> Sensor:
        trajectory = flown.measured if measured else flown.true
        return Sensor(line, trajectory, flown.earth, spec.line_time, begin, count, NO_EFFECTS)

    true = {name: sensor(lines[name], False) for name in pair}
    users = {name: sensor(corrected_line(nominal[name], known[name], changes[name]), True) for name in pair}
    optics = {name: _optics(setup, name, foci[name]) for name in pair}
    middle = 0.5 * (spec.ground.first + spec.ground.last)
    height = images.ground.terrain.height
    at = second_view([true[name] for name in pair], time, middle, height)
    point = true[pair[1]].ground(np.array([(at - begin) / spec.line_time]), np.array([middle]), height)
    longitude, latitude, _ = flown.earth.geodetic(point[0])
    recording = imaged_lines(true, users, optics, stream(seed, 0))
    try:
        place, size = (float(longitude), float(latitude)), (images.side, images.side)
        patch = fly_patch(recording, place, size, images.ground, ControlSpec(), stream(seed, 1))
        ties = tie_points(patch, images.points, source=pair[1])
    except (PatchError, PointsError) as error:
        raise BenchError(f"line images: {error}", ("mechanisms", "images"), POINTS_REMEDY) from error
    good = ties.in_all
    if np.count_nonzero(good) < _FEWEST:
        problem = f"line images: only {np.count_nonzero(good)} of {len(good)} points were matched"
        raise BenchError(problem, ("mechanisms", "images"), POINTS_REMEDY)
    ground = patch.true_point(pair[1], *ties.lines[pair[1]].place[good].T)
    should = np.stack(true[pair[0]].image(ground), axis=1)
    one, two = ((known[name].corrected(changes[name]), ties.lines[name].image[good]) for name in pair)
    first, second = (
        sightings(users[name], users[name].trajectory, *places.T)
        for name, (_, places) in zip(pair, (one, two), strict=True)
    )
    errors = check_errors(intersect_pair(one[0], two[0], first, second).ground, ground).error
    return ImagedPair(moment, errors, one[1] - should, ties.lines[pair[0]].usual_sigma, len(good))


_FEWEST = 8
"""Points, of which a mean height and its scatter are told."""
_TRANSMISSION = 0.8
"""Transmission of a lens, mean over the spectrum: that of payloads that say none."""


def _optics(setup: MonitorSetup, name: str, defocus: float) -> LineOptics:
    camera = setup.cameras[setup.instrument.cameras[name].camera]
    band = camera.bands[target_band(camera)]
    f_number = camera.focal_length / camera.entrance_pupil
    # rms of the focus term of a defocus over a round pupil
    image = LineImageSpec.model_construct(
        f_number=f_number,
        transmission=_TRANSMISSION,
        wavefront={"Z4": defocus / (16.0 * np.sqrt(3.0) * f_number**2)},
        obstruction=(),
        spectrum=band.spectrum.ends,
        detector=band.detector,
        diffusion=band.diffusion,
        tdi=band.tdi,
    )
    assert setup.line_detectors is not None
    sheet = setup.line_detectors[setup.instrument.cameras[name].camera]
    return LineOptics.from_specs(image, band.pixels, band.pitch, setup.test.line_time, sheet)
