"""Laboratory tests on measurements of a real bench: the files that hold the readings, and what is known beside them.

The same analysis as of the simulated bench runs on them. Paths are relative to the file that names them; heads of the
tables are on docs/measured_laboratory.md.
"""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from optics.numerics.frozen_map import FrozenMap
from scenes.specs.camera_tests import AngleSigma, LengthSigma, MountSpec
from scenes.specs.turntable_test import ErrorSize, TableAngle
from scenes.yaml.errors import Problem
from scenes.yaml.quantity import Angle, PositiveLength
from scenes.yaml.spec import Name, Number, Seed, Spec, Text, Whole

DataFile = Annotated[str, Field(strict=True, min_length=1, max_length=1000)]
"""Path of a file of measurements, relative to the file that names it."""
NotNegative = Annotated[Number, Field(ge=0.0, le=1e9)]
Positive = Annotated[Number, Field(gt=0.0, le=1e9)]
Folds = Annotated[Whole, Field(ge=2, le=1000)]


class TurntableFiles(Spec):
    """Readings of a turntable that were compared with a reference.

    Attributes:
        comparisons: table of the calibrated readings, a CSV file.
        held_out: table of readings between them, measured in a series of their own, by which the fits are judged;
            without it cross-validation judges them, and an error of a period below the step stays unseen.
        reference: standard deviation of what the reference's certificate leaves unknown at each position, the same in
            all repeats, radians.
        folds: of the cross-validation.
    """

    comparisons: DataFile
    held_out: DataFile | None = None
    reference: ErrorSize
    folds: Folds = 10


class MeasuredTurntableSpec(Spec):
    """The turntable test on measured readings.

    Attributes:
        name: as the file is called.
        description: for people.
        measured: the readings.
        seed: of the network's starts.
    """

    name: Name
    description: Text = ""
    measured: TurntableFiles
    seed: Seed = 1


class LineSpec(Spec):
    """A line CCD whose spots are given in pixels.

    Attributes:
        pitch: of its pixels, metres.
        middle: column of the line's middle, where positions count from; the centre of the first pixel is 0.
    """

    pitch: PositiveLength
    middle: Annotated[Number, Field(ge=0.0, le=1e7)]


class DistortionFiles(Spec):
    """Angles and spots of a camera on a turntable.

    Attributes:
        spots: table of readings of the turntable and places of the spot on the line, a CSV file.
        zero: reading at which the middle of the line is imaged, as near as it is known, radians; the fit finds its
            error.
        line: pixels of the line, for a table whose places are columns; none for one of lengths.
        reversed: readings of the turntable rise where places on the line fall.
        turntable: calibration of the turntable; without it angles count as read.
        angle_sigma: without a calibration: standard deviation of the error of each point's angle, independent from
            point to point and the same in all sets, radians.
    """

    spots: DataFile
    zero: TableAngle
    line: LineSpec | None = None
    reversed: bool = False
    turntable: TurntableFiles | None = None
    angle_sigma: AngleSigma | None = None

    @model_validator(mode="after")
    def _one_source_of_sigmas(self) -> "DistortionFiles":
        if (self.turntable is None) is (self.angle_sigma is None):
            found = "neither" if self.turntable is None else "both"
            raise Problem("how good the angles are is told in one way", found, "turntable: or angle_sigma:")
        return self


class MeasuredDistortionSpec(Spec):
    """The distortion test on measured angles and spots.

    Attributes:
        name: as the file is called.
        description: for people.
        focal_length: of the camera, about, metres; it serves to see the scatter between sets.
        measured: the angles and spots.
        seed: of nothing; the fits of the turntable that compete here draw nothing.
    """

    name: Name
    description: Text = ""
    focal_length: PositiveLength
    measured: DistortionFiles
    seed: Seed = 1


class NoiseSpec(Spec):
    """Noise of the detector that took images, as a data sheet of EMVA 1288 has it.

    Attributes:
        gain_dn_per_e: grey values per electron.
        dark_noise_e: read noise, electrons rms.
        dark_signal_e: dark signal of one exposure, electrons.
        offset_dn: black level, grey values.
        prnu: non-uniformity of the response, share rms.
        dsnu_e: non-uniformity of the dark signal, electrons rms.
        saturation_dn: grey value from which the response is not linear.
    """

    gain_dn_per_e: Positive
    dark_noise_e: NotNegative
    dark_signal_e: NotNegative = 0.0
    offset_dn: NotNegative = 0.0
    prnu: Annotated[Number, Field(ge=0.0, le=1.0)] = 0.0
    dsnu_e: NotNegative = 0.0
    saturation_dn: Positive


class LevelSpec(Spec):
    """The line's level as a theodolite read it.

    Attributes:
        angle: of the line out of the direction it is to have, about Z', radians.
        sigma: its standard deviation, radians.
    """

    angle: Angle
    sigma: AngleSigma


Noises = Annotated[dict[Name, NoiseSpec], AfterValidator(FrozenMap)]


class FocusFiles(Spec):
    """A through-focus series of many places.

    Attributes:
        mtf: table of MTF values with sigmas, a CSV file; or
        images: table of images of a slanted knife edge, a CSV file.
        moved: what was moved through focus. ``image``: shifts are those of the image along the light; ``target``: of
            the target along the light; ``focal_plane``: of the CCD along the light.
        per_shift: with ``target``: move of the image per move of the target, (f of the camera / f of the
            collimator)^2; a column `per shift` of the table overrides it.
        frequency: of the MTF that is measured in images, cycles per pixel.
        noise: with images: name of a band -> its detector; a band without one has its noise estimated from the image.
        level: of the line; without it the turn about Z' is left as it is.
    """

    mtf: DataFile | None = None
    images: DataFile | None = None
    moved: Literal["image", "target", "focal_plane"]
    per_shift: Annotated[Number, Field(gt=0.0, le=1e6)] | None = None
    frequency: Annotated[Number, Field(ge=0.01, le=0.75)] = 0.5
    noise: Noises = Field(default_factory=FrozenMap)
    level: LevelSpec | None = None

    @model_validator(mode="after")
    def _one_table(self) -> "FocusFiles":
        if (self.mtf is None) is (self.images is None):
            raise Problem("one table is needed", "neither" if self.mtf is None else "both", "mtf: or images:")
        if self.noise and self.images is None:
            raise Problem(
                "sigmas of MTF values stand in their table", "noise", "images: in place of mtf:", None, ("noise",)
            )
        if self.per_shift is not None and self.moved != "target":
            raise Problem(
                "only a target's move is another than the image's", allowed="moved: target", within=("per_shift",)
            )
        return self


class MeasuredFocusSpec(Spec):
    """A focal-plane alignment from a measured through-focus series.

    Attributes:
        name: as the file is called.
        description: for people.
        measured: the series.
        mount: how the assembly is mounted.
        shims: thickness of each hole's shim now, metres; by default all are as thick as `mount` says.
        vertex_error: error that the form of the through-focus curve leaves in all vertices alike, metres; its default
            is that of F/8 to F/10 and wavefronts of 0.2 waves.
        vertex_trend: by how much that error changes from the middle to the ends of the places, metres.
        seed: of nothing; nothing is drawn.
    """

    name: Name
    description: Text = ""
    measured: FocusFiles
    mount: MountSpec
    shims: tuple[PositiveLength, ...] | None = None
    vertex_error: LengthSigma = 0.5e-6
    vertex_trend: LengthSigma = 0.15e-6
    seed: Seed = 1

    @model_validator(mode="after")
    def _shim_for_each_hole(self) -> "MeasuredFocusSpec":
        if self.shims is not None and len(self.shims) != len(self.mount.holes):
            found, allowed = f"{len(self.shims)} of them", f"{len(self.mount.holes)}, one for each hole"
            raise Problem("another number of shims than of holes", found, allowed, within=("shims",))
        return self
