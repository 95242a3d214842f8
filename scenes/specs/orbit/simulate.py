"""Images of a patch of ground by every line of a camera in orbit, as a file in scenes/orbit gives them."""

from typing import Annotated

from pydantic import AfterValidator, Field

from scenes.specs.orbit.angle import LightEffectsSpec, Moment
from scenes.specs.orbit.calibration import InteriorChangeSpec, LineTime, Side
from scenes.specs.orbit.flight import AttitudeSpec, EarthSpec, ErrorsSpec, OrbitSpec
from scenes.specs.orbit.scene import ControlSpec, GroundSpec, ImagePointsSpec
from scenes.yaml.errors import Problem, names_text
from scenes.yaml.spec import Name, Named, Number, Reference, Seed, Spec, TitledSpec, Whole


def _each_once(lines: tuple[str, ...]) -> tuple[str, ...]:
    if not lines or len(set(lines)) != len(lines):
        raise Problem("no lines, or one twice", names_text(lines) or "none", "each line once")
    return lines


class PatchSpec(Spec):
    """The patch of ground that is imaged; its middle lies on what one line sees at a moment.

    Attributes:
        line: of the camera, by name.
        pixel: of that line that sees the middle.
        time: at which it does, seconds from the orbit's epoch.
        lines, pixels: size of every image.
    """

    line: Name = "nadir"
    pixel: Number
    time: Moment = 0.0
    lines: Side = 1000
    pixels: Side = 1000


class OrbitSimulateSpec(TitledSpec):
    """A pass over a patch of ground.

    Attributes:
        name: as the file is called.
        description: for people.
        camera: name in scenes/library/payloads or path of a file; it needs a section `image`.
        lines: those that are rendered, by name.
        perturb: line -> how its interior has changed since the laboratory.
        earth: its rotation.
        orbit: true orbit.
        attitude: true attitude.
        effects: what happens to the light between ground and camera.
        line_time: from one image line to the next, seconds.
        patch: where and how large.
        ground: what is there.
        control: what is known of the ground.
        points: that are measured in the images; none without this section.
        errors: of what the satellite measures of itself.
        oversampling: samples of the ground along each side of a pixel.
        seed: of every random number.
    """

    camera: Reference
    lines: Annotated[tuple[Name, ...], AfterValidator(_each_once)] = ("forward", "nadir", "backward")
    perturb: Named[InteriorChangeSpec] = Field(default_factory=dict, validate_default=True)
    earth: EarthSpec = EarthSpec.model_construct()
    orbit: OrbitSpec
    attitude: AttitudeSpec = AttitudeSpec.model_construct(steering="yaw")
    effects: LightEffectsSpec = LightEffectsSpec.model_construct()
    line_time: LineTime = 0.7e-3
    patch: PatchSpec
    ground: GroundSpec = GroundSpec.model_construct()
    control: ControlSpec = ControlSpec.model_construct()
    points: ImagePointsSpec | None = None
    errors: ErrorsSpec = ErrorsSpec.model_construct()
    oversampling: Annotated[Whole, Field(ge=2, le=8)] = 3
    seed: Seed = 0
