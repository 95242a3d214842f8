"""The monitor in a loop with mechanisms along one orbit, as a file in scenes/orbit gives it: what moves, when the spots
are read, and what acts on what they say.
"""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from optics.numerics.array_math import number_of
from optics.numerics.frozen_map import FrozenMap
from scenes.specs.course import Moment, no_such_time
from scenes.specs.disturbances import JobDisturbances, component_named
from scenes.specs.job import AnalysisSpec, JobSpec, RenderSpec
from scenes.specs.orbit.calibration import LineTime, Side
from scenes.specs.orbit.flight import AttitudeSpec, EarthSpec, OrbitSpec
from scenes.specs.orbit.monitor import Frames, GroundSpec, Interval, MonitorErrorsSpec, MotionSpec
from scenes.specs.orbit.scene import GroundSpec as SceneGroundSpec
from scenes.specs.orbit.scene import ImagePointsSpec
from scenes.yaml.errors import Problem, shown
from scenes.yaml.spec import Name, Named, NothingIsEmpty, Number, Paths, Reference, Seed, Spec, Text, TitledSpec, Whole
from scenes.yaml.units import ANGLE, LENGTH, Kind, parse_quantity

Controlled = Literal["d_alpha", "d_beta", "d_gamma", "d_f", "defocus"]
_WHOLE = 1e-9
"""Of a step, by which a range is rounded to whole ones."""
_KINDS: dict[str, Kind] = {"rotate": ANGLE, "shift": LENGTH}
"""Kind of a mechanism's motion -> what its steps measure."""
_QUANTITIES: dict[str, Kind] = {"d_alpha": ANGLE, "d_beta": ANGLE, "d_gamma": ANGLE, "d_f": LENGTH, "defocus": LENGTH}


class CorrectionSpec(Spec):
    """What acts on one quantity of the posterior.

    With every reading the command changes by `gain` times what the posterior says is left of the quantity, over what
    the mechanism does to it.

    Attributes:
        camera: whose quantity it is.
        quantity: `d_alpha`, `d_beta`, `d_gamma`, `d_f`, or `defocus`, best focus less line CCD.
        mechanism: the motion of a body that corrects it, in words without amount: `forward/focal_plane shift z`; by
            default the line of sight is corrected in the processing of the images on the ground, and no body moves.
        gain: share of what is left that one reading corrects.
        delay: readings after which a command has its effect; 0 for at once, before the images of that moment.
        step: the mechanism moves by whole steps, with unit; by default it moves by any amount.
        range: to either side of where it stands at the beginning, with unit; none by default.
        dead_band: what is left and is smaller is left alone, in the quantity's unit.
        response: what the mechanism does over what it is known to do; the estimate does not know it.
    """

    camera: Name
    quantity: Controlled
    mechanism: Text | None = None
    gain: Annotated[Number, Field(ge=0.0, le=4.0)]
    delay: Annotated[Whole, Field(ge=0, le=20)] = 0
    step: Text | None = None
    range: Text | None = None
    dead_band: Text | None = None
    response: Annotated[Number, Field(gt=0.0, le=4.0)] = 1.0

    @model_validator(mode="after")
    def _can_be(self) -> "CorrectionSpec":
        if self.mechanism is None and self.quantity == "defocus":
            allowed = "mechanism: the motion of a body, as forward/focal_plane shift z"
            raise Problem("no processing corrects the focus", "no mechanism", allowed, within=("quantity",))
        if self.mechanism is None and self.response != 1.0:
            allowed = "no response, or a mechanism"
            raise Problem(
                "a correction by processing does what it says", str(self.response), allowed, None, ("response",)
            )
        try:
            kind = self.motion[1]
        except Problem as problem:
            raise problem.below("mechanism") from None
        if self.mechanism is not None and kind not in _KINDS:
            raise Problem("no motion of a mechanism", shown(kind), "rotate or shift, and an axis", None, ("mechanism",))
        for key in ("step", "range", "dead_band"):
            self._size(key)
        if self.largest == 0.0:
            raise Problem("less than one step", shown(self.range), f"{self.step} or more", None, ("range",))
        return self

    @property
    def motion(self) -> tuple[str, str, str, str]:
        """Node, kind, axis and pivot of the mechanism; empty for none."""
        return ("", "", "", "") if self.mechanism is None else component_named(self.mechanism)

    def kind_of(self, key: str) -> Kind:
        """What ``step``, ``range`` or ``dead_band`` measures."""
        own = self.mechanism is not None and key != "dead_band"
        return _KINDS[self.motion[1]] if own else _QUANTITIES[self.quantity]

    def _size(self, key: str) -> float | None:
        text = getattr(self, key)
        if text is None:
            return None
        kind = self.kind_of(key)
        try:
            value = parse_quantity(text, kind)
        except Problem as problem:
            raise problem.below(key) from None
        if not value > 0.0:
            raise Problem("not greater than zero", shown(text), kind.allowed, None, (key,))
        return value

    @property
    def smallest(self) -> float | None:
        """The step, rad or m."""
        return self._size("step")

    @property
    def largest(self) -> float | None:
        """The range to either side, rad or m; of a mechanism of steps that of its whole steps."""
        reach, step = self._size("range"), self._size("step")
        return reach if reach is None or step is None else step * math.floor(reach / step + _WHOLE)

    @property
    def band(self) -> float:
        """The dead band, rad or m of the quantity."""
        return self._size("dead_band") or 0.0


class ReadingsSpec(Spec):
    """When the spots are read, and images are taken just after.

    Attributes:
        begin: of the first, seconds from the orbit's epoch.
        every: from one to the next.
        count: how many.
    """

    begin: Moment = 0.0
    every: Interval
    count: Annotated[Whole, Field(ge=2, le=1000)]

    @property
    def times(self) -> tuple[float, ...]:
        """Seconds from the orbit's epoch."""
        return tuple(self.begin + self.every * k for k in range(self.count))


class LoopImagesSpec(Spec):
    """Pairs of line images, rendered after some of the readings with the loop open and closed.

    Attributes:
        times: of these readings, seconds from the orbit's epoch.
        side: lines and pixels of every image.
        ground: what is there.
        points: how points of the second camera's image are sought in the first one's; `tie` says how many.
    """

    times: Annotated[tuple[Moment, ...], Field(min_length=1, max_length=20)]
    side: Annotated[Side, Field(le=2000)] = 400
    ground: SceneGroundSpec = SceneGroundSpec()
    points: ImagePointsSpec = ImagePointsSpec.model_validate({"control": 0, "tie": 60, "reach": 16})

    @model_validator(mode="after")
    def _has_ties(self) -> "LoopImagesSpec":
        if not self.points.tie:
            raise Problem("no points of one image are sought in the other", "tie: 0", "some", None, ("points", "tie"))
        return self


class OrbitLoopSpec(TitledSpec):
    """A stereo pair whose monitor's readings are acted upon along an orbit, beside the same pair left alone.

    Attributes:
        name: as the file is called.
        description: for people.
        instrument: name in scenes/library/instruments or path of a file; has a monitor on each of the pair's cameras.
        cameras: the pair, the forward one first; by default the instrument's two.
        disturbances: what moves and gets warm: amounts are drawn by its laws in time, and the estimate knows these. The
            instrument's by default.
        motion: node -> how it moves beside, which the estimate does not know.
        readings: when the spots are read.
        corrections: name -> what acts on what the readings say.
        frames: of one reading; as many as the instrument's monitor takes by default.
        analysis: how the monitor's images are analysed.
        earth: its rotation.
        orbit: true orbit, over the readings and a minute more at either end.
        attitude: true attitude.
        line_time: from one image line to the next, seconds.
        ground: check points.
        images: pairs of line images; none without this section.
        errors: of what is measured.
        seed: of every random number.
    """

    instrument: Reference
    cameras: tuple[Name, ...] | None = None
    disturbances: JobDisturbances | None = None
    motion: Paths[MotionSpec] = Field(default_factory=FrozenMap)
    readings: ReadingsSpec
    corrections: Annotated[Named[CorrectionSpec], Field(min_length=1, max_length=50)]
    frames: Frames | None = None
    analysis: Annotated[AnalysisSpec, NothingIsEmpty] = AnalysisSpec()
    earth: EarthSpec = EarthSpec()
    orbit: OrbitSpec
    attitude: AttitudeSpec = AttitudeSpec(steering="yaw")
    line_time: LineTime = 0.09e-3
    ground: GroundSpec
    images: LoopImagesSpec | None = None
    errors: MonitorErrorsSpec = MonitorErrorsSpec()
    seed: Seed = 0

    @model_validator(mode="after")
    def _times_fit(self) -> "OrbitLoopSpec":
        if self.cameras is not None and (len(self.cameras) != 2 or len(set(self.cameras)) != 2):
            found = ", ".join(self.cameras) or "none"
            raise Problem("not a pair of cameras", found, "two different cameras", within=("cameras",))
        for time in (self.readings.times[0], self.readings.times[-1]):
            if wrong := self.orbit.misses(time):
                raise wrong.below("readings")
        for k, time in enumerate(self.images.times if self.images is not None else ()):
            if number_of(time, self.readings.times) is None:
                raise no_such_time(time, self.readings.times, "the time of a reading").below("images", "times", k)
        return self

    @property
    def job(self) -> JobSpec:
        """The job of the monitor's images; what is wrong with it is told at this file's lines."""
        frames = RenderSpec.model_construct(
            images=("spots",), targets=None, stray=None, frames=self.frames, seed=self.seed
        )
        job = JobSpec.model_construct(
            instrument=self.instrument,
            perturb=FrozenMap(),
            course=None,
            disturbances=self.disturbances,
            render=frames,
            analysis=self.analysis,
        )
        return job.with_source(self.source)
