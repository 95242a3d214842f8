"""Test of interior orientation and distortion on a turntable (paper 004, section 3), as scenes/lab gives it."""

from typing import Annotated

from pydantic import Field

from scenes.specs.focus_test import AngleSigma, CameraUnderTestSpec, CollimatorSpec, Light
from scenes.specs.instrument import Frames
from scenes.yaml.quantity import PositiveLength
from scenes.yaml.spec import Name, Number, Reference, Seed, Text, Whole


class DistortionTestSpec(CameraUnderTestSpec):
    """The camera on a turntable looks at a pinhole in the collimator, point by point along its line.

    Attributes:
        name: as the file is called.
        description: for people.
        camera: prescription, by name or path.
        as_built: how it departs from the prescription, ``M1`` ... or ``focal_plane`` -> perturbation as in a job.
        collimator: what the camera looks into.
        turntable: its dividing error and calibration, by name or path.
        pinhole: diameter of the target, metres.
        band: whose line CCD is measured.
        points: over the field.
        reach: of the first and last point, as a share of half the line's length.
        sets: how often all points are measured.
        light: of the brightest pixel, as a share of the full well.
        frames: images of each point that are averaged.
        window: side of the square region around the spot, pixels.
        zero: standard deviation with which the middle of the line is put on the collimator's axis at the turntable's
            middle angle, radians.
        axis_tilt: standard deviation of the turntable's axis against the camera's X, radians.
        setting: standard deviation with which the table stops at a wanted reading, radians.
        seed: of everything that is drawn.
    """

    name: Name
    description: Text = ""
    collimator: CollimatorSpec
    turntable: Reference
    pinhole: PositiveLength
    band: Name
    points: Annotated[Whole, Field(ge=3, le=1001)]
    reach: Annotated[Number, Field(ge=0.05, lt=1.0)]
    sets: Annotated[Whole, Field(ge=1, le=1000)]
    light: Light
    frames: Frames = 4
    window: Annotated[Whole, Field(ge=24, le=128)] = 32
    zero: AngleSigma
    axis_tilt: AngleSigma
    setting: AngleSigma = 0.0
    seed: Seed = 1
