"""Image points of a field that are measured in rendered images of some patches of its ground, instead of drawn.

Every patch is rendered through the true sensors and measured with what the user has (`twin.orbit.images.image_points`).
The truth enters the record of wrong matches and the true places of check points, which only test.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from optics.numerics.number_tree import FrozenMap
from scenes.yaml.errors import KeyPath
from twin.framework.procedure import Advance, BenchError
from twin.framework.random_streams import stream
from twin.orbit.calibration.observations import FieldPoints, PassData
from twin.orbit.flight.light_effects import LightEffects
from twin.orbit.flight.sensor import Sensor
from twin.orbit.images.image_points import (
    BEYOND,
    POINTS_REMEDY,
    MatchedPoints,
    PatchPoints,
    PointsError,
    measure_points,
)
from twin.orbit.images.line_optics import LineOptics, optics_of
from twin.orbit.images.patch import Patch, PatchError, fly_patch, imaged_lines
from twin.orbit.images.point_judgement import LineJudgement, judged, true_ground
from twin.orbit.measured.pass_measurements import ImagePoints

if TYPE_CHECKING:
    from scenes.specs.orbit.calibration import CalibrationImagesSpec, FieldSpec, PatchPlaceSpec
    from scenes.specs.orbit.scene import GroundSpec
    from scenes.specs.orbit.setup import CalibrationSetup

_OFFSET = 9000.0
"""Metres. As far from the middle of the real terrain model, east and north, a patch may lie; 30 km x 32 km are real."""
_LEAST_CONTROL = 6
"""Control points of a field that must be left; twelve unknowns take three."""
_REMEDIES: Mapping[str, tuple[KeyPath, str]] = FrozenMap(
    {
        "span": (("span",), "a longer pass, or patches nearer to the field's middle"),
        "place": (("images", "patches"), "a patch inside the swath of every line"),
        "size": (("images", "patches"), "a smaller patch, or one farther from the ends of the lines"),
        "terrain": (("images", "ground", "terrain"), "less relief, a larger exponent or larger posts"),
    }
)


@dataclass(frozen=True, eq=False)
class PatchRecord:
    """One patch and how its points were matched.

    Attributes:
        pixel: of the nadir line that sees its middle.
        track: from the field's middle along the flight, metres.
        points: measured.
        judgements: ``control`` (with the check points) or ``tie`` -> line -> against the truth.
    """

    pixel: float
    track: float
    points: PatchPoints
    judgements: Mapping[str, Mapping[str, LineJudgement]]


@dataclass(frozen=True, eq=False)
class FieldImages:
    """What became of a field's points.

    Attributes:
        name: of the field.
        patches: one by one.
        shown: the first patch itself, for a figure.
        wrong: line -> (n,) whether the place of a control or tie point is wrong, by number of the point.
        wrong_check: line -> (m,) likewise for check points.
        screening: what the adjustment has left out; None before it.
    """

    name: str
    patches: tuple[PatchRecord, ...]
    shown: Patch
    wrong: Mapping[str, np.ndarray]
    wrong_check: Mapping[str, np.ndarray]
    screening: Screening | None = None


@dataclass(frozen=True)
class Screening:
    """What the adjustment has left out of a field; counts are of image points, by truth where wrong or right.

    Attributes:
        entered, left: image points of control and tie points before and after.
        wrong_entered, wrong_left: wrong ones among them.
        right_lost: right ones that were left out.
        check_entered, check_left: check points before and after the test of their intersection.
        wrong_check_left: of these, with a wrong place in a line.
    """

    entered: int
    left: int
    wrong_entered: int
    wrong_left: int
    right_lost: int
    check_entered: int
    check_left: int
    wrong_check_left: int


@dataclass(eq=False)
class Imager:
    """Renders and measures fields, and says how far it is.

    Attributes:
        setup: test and camera.
        spec: of the images.
        optics: line -> lens and CCD.
        pattern: seed of the pixels' differences, the same over all fields.
        advance: told of each patch.
        done: patches so far.
    """

    setup: CalibrationSetup
    spec: CalibrationImagesSpec
    optics: Mapping[str, LineOptics]
    pattern: np.random.SeedSequence
    advance: Advance
    done: int = field(default=0)

    @classmethod
    def of(cls, setup: CalibrationSetup, pattern: np.random.SeedSequence, advance: Advance) -> Imager:
        """For a test with a section `images`."""
        spec = setup.test.images
        assert spec is not None
        optics = optics_of(setup.camera, tuple(setup.camera.lines), setup.test.line_time, setup.detectors)
        return cls(setup, spec, optics, pattern, advance)

    def measured(
        self,
        place: FieldSpec,
        sensors: Mapping[str, Sensor],
        data: PassData,
        effects: LightEffects,
        seed: np.random.SeedSequence,
    ) -> tuple[FieldPoints, FieldImages]:
        """Points of one field.

        Args:
            place: the field.
            sensors: the true ones.
            data: what is known of the pass.
            effects: on the light, which the user knows as well.
            seed: of the ground, of the control's errors and of the frames' noise.

        Raises:
            BenchError: a patch that cannot be imaged, points that cannot be measured, too few of them.
        """
        users = {name: replace(sensor, effects=effects) for name, sensor in data.sensors.items()}
        lines = imaged_lines(sensors, users, {name: self.optics[name] for name in sensors}, self.pattern)
        total = len(self.setup.test.fields) * len(self.spec.patches)
        self.advance("patches", self.done, total)
        patches, records = [], []
        for k, one in enumerate(self.spec.patches):
            own = stream(seed, k)
            try:
                patch = fly_patch(
                    lines,
                    _middle(one, sensors["nadir"], place.height),
                    (self.spec.lines, self.spec.pixels),
                    self._ground(place, stream(own, 1)),
                    self.spec.control,
                    stream(own, 0),
                    self.spec.oversampling,
                )
                points = measure_points(patch, self.spec.points)
            except PatchError as error:
                key, remedy = _REMEDIES[error.part]
                raise BenchError(f"{data.name}, patch {k + 1}: {error}", key, remedy) from error
            except PointsError as error:
                problem = f"{data.name}, patch {k + 1}: {error}"
                raise BenchError(problem, ("images", "points"), POINTS_REMEDY) from error
            patches.append(patch)
            judgements = {sort: judged(patch, some) for sort, some in points.sorts.items()}
            records.append(PatchRecord(one.pixel, one.track, points, FrozenMap(judgements)))
            self.done += 1
            self.advance("patches", self.done, total)
        return self._collected(data, patches, records)

    def _ground(self, place: FieldSpec, seed: np.random.SeedSequence) -> GroundSpec:
        terrain = self.spec.ground.terrain
        offset = np.random.default_rng(seed).uniform(-_OFFSET, _OFFSET, 2) + terrain.offset
        terrain = terrain.model_copy(update={"height": place.height, "offset": tuple(offset.tolist())})
        return self.spec.ground.model_copy(update={"terrain": terrain})

    def _collected(
        self, data: PassData, patches: list[Patch], records: list[PatchRecord]
    ) -> tuple[FieldPoints, FieldImages]:
        control, check, ties, truth = [], [], [], []
        for patch, record in zip(patches, records, strict=True):
            maps = record.points.control
            assert maps is not None
            control.append(_Chosen.of(maps, maps.in_all & ~maps.check, record.judgements["control"]))
            check.append(_Chosen.of(maps, maps.in_all & maps.check, record.judgements["control"]))
            truth.append(true_ground(patch, maps)[maps.in_all & maps.check])
            if record.points.ties is not None:
                tied = record.points.ties
                ties.append(_Chosen.of(tied, tied.in_all, record.judgements["tie"]))
        known, held_back, tie = (_joined(parts, data) for parts in (control, check, ties))
        if known.count < _LEAST_CONTROL or held_back.count < 2:
            raise BenchError(
                f"{data.name}: only {known.count} control and {held_back.count} check points were matched in every "
                f"line; {_lost(records)}",
                ("images", "points"),
                f"{_LEAST_CONTROL} control and 2 check points or more: {POINTS_REMEDY}",
            )
        # one error in plan moves all points of a patch: each of n weighs as if it had n times the variance
        share = np.sqrt(known.count / len(patches))
        sigma = self.spec.control.sigma * share, self.spec.points.height_sigma
        both = known.followed_by(tie)
        points = FieldPoints(
            data,
            both.images,
            both.ground,
            np.arange(both.count) < known.count,
            sigma if min(sigma) > 0.0 else (max(sigma[0], _EXACT), max(sigma[1], _EXACT)),
            held_back.images,
            np.concatenate(truth),
        )
        return points, FieldImages(data.name, tuple(records), patches[0], both.wrong, held_back.wrong)


_EXACT = 1e-3
"""Metres; of control without errors."""


@dataclass(frozen=True, eq=False)
class _Chosen:
    """Points of a patch or a field, seen by every line: image points, given ground, which places are wrong."""

    images: Mapping[str, ImagePoints]
    ground: np.ndarray
    wrong: Mapping[str, np.ndarray]

    @property
    def count(self) -> int:
        return len(self.ground)

    @classmethod
    def of(cls, points: MatchedPoints, chosen: np.ndarray, judgements: Mapping[str, LineJudgement]) -> _Chosen:
        images, wrong = {}, {}
        number = np.arange(int(chosen.sum()))
        for name, line in points.lines.items():
            place = line.image[chosen]
            spread = line.covariance[chosen] + BEYOND**2 * np.eye(2)
            images[name] = ImagePoints.of(number, place[:, 0], place[:, 1], spread)
            wrong[name] = judgements[name].wrong[chosen] if name in judgements else np.zeros(len(number), bool)
        return cls(images, points.ground[chosen], wrong)

    def followed_by(self, other: _Chosen) -> _Chosen:
        images = {}
        for name, row in self.images.items():
            after = other.images[name]
            columns = (np.concatenate([getattr(row, k), getattr(after, k)]) for k in ("line", "pixel", "covariance"))
            images[name] = ImagePoints(np.concatenate([row.point, after.point + self.count]), *columns)
        wrong = {name: np.concatenate([w, other.wrong[name]]) for name, w in self.wrong.items()}
        return _Chosen(images, np.concatenate([self.ground, other.ground]), wrong)


def _joined(parts: list[_Chosen], data: PassData) -> _Chosen:
    none = {name: ImagePoints.of(np.zeros(0, int), [], [], np.zeros((0, 2, 2))) for name in data.sensors}
    whole = _Chosen(none, np.zeros((0, 3)), {name: np.zeros(0, bool) for name in data.sensors})
    for part in parts:
        whole = whole.followed_by(part)
    return whole


def _lost(records: list[PatchRecord]) -> str:
    """Numbers of points that were sought, matched and agreed with by their neighbours, in words."""
    words = []
    for name in records[0].judgements["control"]:
        lines = [r.points.control.lines[name] for r in records if r.points.control is not None]
        sought, matched, accepted = (
            sum(int(np.sum(v)) for v in values)
            for values in zip(*((np.ones(len(x.status)), x.matched, x.accepted) for x in lines), strict=True)
        )
        words.append(f"{name}: {sought} sought, {matched} matched, {accepted} agree with their neighbours")
    return "; ".join(words)


def _middle(place: PatchPlaceSpec, nadir: Sensor, height: float) -> tuple[float, float]:
    """Longitude and latitude of a patch's middle, radians."""
    at = (0.0 - nadir.first_line_time) / nadir.line_time
    step = nadir.ground(np.array([at, at + 1.0]), np.array([place.pixel]), height)
    line = at + place.track / float(np.linalg.norm(step[1] - step[0]))
    if not 0.0 <= line <= nadir.lines - 1.0:
        problem = f"the patch at {place.track / 1e3:g} km along the track lies beyond the pass"
        raise PatchError(problem, "span")
    point = nadir.ground(np.array([line]), np.array([place.pixel]), height)
    longitude, latitude, _ = nadir.earth.geodetic(point[0])
    return float(longitude), float(latitude)
