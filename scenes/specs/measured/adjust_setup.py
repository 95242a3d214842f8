"""An adjustment of a block together with its camera, and with its tables where it was measured.

Adjustment of a block of measured passes, as a file gives it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import Field, model_validator

from scenes.specs import load
from scenes.specs.measured.orbit_data import MeasuredTestSpec, OrbitDataSpec
from scenes.specs.measured.orbit_data_setup import FixedSetup, data_of
from scenes.specs.orbit.adjust import CameraChangeSpec, MonitorRecordSpec, OrbitAdjustSpec, ReadingLawsSpec, one_monitor
from scenes.specs.orbit.calibration import MonitorReadingSpec
from scenes.specs.orbit.flight import AngleErrors
from scenes.specs.orbit.setup import load_three_line_camera
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.specs.resolved import ExperimentSetup, read_setup, test_keys
from scenes.yaml.errors import Problem, unknown
from scenes.yaml.quantity import Quantity
from scenes.yaml.spec import Flag, Name, Named, Spec, not_empty
from scenes.yaml.units import LENGTH


class CameraReadingSpec(Spec):
    """What a monitor reads of a line camera in a pass, against the state of its calibration.

    Attributes:
        angles: d_alpha (about the camera's Y), d_beta (about X) and d_gamma (about the line of sight), radians.
        principal_distance: d_f, metres.
    """

    angles: AngleErrors
    principal_distance: Annotated[float, Quantity(LENGTH, largest="5 mm")] = 0.0


class MonitoredSpec(MonitorReadingSpec):
    """Readings of an on-board monitor, one of every line camera in every pass that it watched.

    Attributes:
        angles: standard deviation of d_alpha, d_beta and d_gamma, radians.
        principal_distance: of d_f, metres.
        readings: pass -> line -> what it read.
    """

    readings: Annotated[Named[Named[CameraReadingSpec]], not_empty("no readings", "at least one pass")]


class MeasuredAdjustSpec(MeasuredTestSpec):
    """A block of measured passes, adjusted at once.

    Attributes:
        name: as the file is called.
        description: for people.
        camera: name in scenes/library/payloads or path of a file: the camera as it was calibrated.
        data: folder with a ``data.yaml``, or the path of such a file; else `conventions` and `passes` stand here.
        conventions: of all tables.
        passes: by name.
        effects: on the light, that are in the image points; `corrected` takes them out.
        names: whether one name of a point in the tables of two passes is one point on the ground (shared), or names
            count within their pass (own).
        errors: laws of the errors of orbit and attitude.
        trackers: pass -> star tracker that gave its attitude; "tracker" where not said.
        changes: line -> how its camera may have changed since the calibration.
        monitor: readings of these changes; None for no monitor.
        monitor_record: what a record of `twin.operate` says of them, in place of `monitor`.
        without: sensors that are there and are not used.
        robust: whether gross errors are looked for.
        components: laws and groups of measurements whose variances are estimated.
    """

    names: Literal["shared", "own"]
    errors: ReadingLawsSpec
    trackers: Named[Name] = Field(default_factory=dict, validate_default=True)
    changes: Annotated[Named[CameraChangeSpec], not_empty("no changes", "how each line may have changed")]
    monitor: MonitoredSpec | None = None
    monitor_record: MonitorRecordSpec | None = None
    without: tuple[Literal["ties", "control", "monitor"], ...] = ()
    robust: Flag = True
    components: tuple[Name, ...] = ()

    @model_validator(mode="after")
    def _has_known_groups(self) -> MeasuredAdjustSpec:
        groups = ("image", "control", *self.errors.attitude, *self.errors.orbit)
        for k, name in enumerate(self.components):
            if name not in groups:
                raise unknown("no such group of variances", name, groups, ("components", k))
        one_monitor(self.monitor, self.monitor_record)
        if "monitor" in self.without and "monitor" not in self.sensors:
            raise Problem("no monitor to do without", None, "a section `monitor:`", within=("without",))
        return self

    @property
    def sensors(self) -> tuple[str, ...]:
        """What can be left out; whether there are points of a role is known when the tables are read."""
        watched = self.monitor is not None or self.monitor_record is not None
        return ("ties", "control", "monitor") if watched else ("ties", "control")


class AdjustSetup(ExperimentSetup[OrbitAdjustSpec]):
    """A block with its camera.

    Attributes:
        camera: the payload.
    """

    camera: ThreeLineCameraSpec


class MeasuredAdjustSetup(FixedSetup[MeasuredAdjustSpec]):
    """A block of measured passes with its camera.

    Attributes:
        camera: the payload.
        data: the passes, with paths that hold from anywhere.
    """

    data: OrbitDataSpec


Adjusted = TypeVar("Adjusted", OrbitAdjustSpec, MeasuredAdjustSpec)
AnyAdjust = AdjustSetup | MeasuredAdjustSetup
"""Simulated, or on measurements."""


def resolve_any_adjust(path: str | Path) -> AnyAdjust:
    """Read a block as `resolve_adjust`, or `resolve_measured_adjust` for a file that names measurements."""
    said = test_keys(path)
    # `passes` of a simulation are told by their epochs alone
    return resolve_measured_adjust(path) if "data" in said or "conventions" in said else resolve_adjust(path)


def resolve_measured_adjust(path: str | Path) -> MeasuredAdjustSetup:
    """Read a block of measured passes and what it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid, or a pass or a line is named that there is not.
    """
    setup = read_setup(MeasuredAdjustSetup, path)
    if setup is None:
        test = load.load_named(MeasuredAdjustSpec, load.ORBIT, path)
        camera = load_three_line_camera(load.find_named(load.PAYLOADS, test.camera, test, ("camera",)))
        setup = MeasuredAdjustSetup.model_construct(test=_placed(test), camera=camera, data=data_of(test))
    test = setup.test
    for name in test.trackers:
        if name not in setup.data.passes:
            raise test.error(unknown("no such pass", name, setup.data.passes), ("trackers", name))
    for name in test.changes:
        if name not in setup.camera.lines:
            raise test.error(unknown("no such line", name, setup.camera.lines), ("changes", name))
    for name, lines in (test.monitor.readings if test.monitor is not None else {}).items():
        if name not in setup.data.passes:
            raise test.error(unknown("no such pass", name, setup.data.passes), ("monitor", "readings", name))
        for line in lines:
            if line not in test.changes:
                raise test.error(unknown("no such line", line, test.changes), ("monitor", "readings", name, line))
    _require_sensors(test)
    return setup


def resolve_adjust(path: str | Path) -> AdjustSetup:
    """Read a block and the camera it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid, or the camera has no such line.
    """
    setup = read_setup(AdjustSetup, path)
    if setup is None:
        test = load.load_named(OrbitAdjustSpec, load.ORBIT, path)
        camera = load_three_line_camera(load.find_named(load.PAYLOADS, test.camera, test, ("camera",)))
        setup = AdjustSetup.model_construct(test=_placed(test), camera=camera)
    for k, name in enumerate(setup.test.lines):
        if name not in setup.camera.lines:
            raise setup.test.error(unknown("no such line", name, setup.camera.lines), ("lines", k))
    _require_sensors(setup.test)
    return setup


def _placed(test: Adjusted) -> Adjusted:
    """The test with paths of its record that hold from anywhere; the URL of a database stays."""
    one = test.monitor_record
    if one is None:
        return test
    folder = Path(test.source.file).parent if test.source.file else Path()
    record = one.record if "://" in one.record else str((folder / one.record).resolve())
    plan = None if one.plan is None else str((folder / one.plan).resolve())
    return test.model_copy(update={"monitor_record": one.model_copy(update={"record": record, "plan": plan})})


def without_sensors(setup: AnyAdjust, names: Sequence[str]) -> AnyAdjust:
    """The block adjusted without further sensors.

    Args:
        setup: the block.
        names: of sensors.

    Raises:
        InputError: the block has no such sensor.
    """
    if not names:
        return setup
    every = tuple(dict.fromkeys((*setup.test.without, *names)))
    test = setup.test.model_copy(update={"without": every})
    _require_sensors(test)
    return setup.model_copy(update={"test": test})


def _require_sensors(test: OrbitAdjustSpec | MeasuredAdjustSpec) -> None:
    """InputError for a sensor that is to be left out and is not there."""
    for name in test.without:
        if name not in test.sensors:
            raise test.error(unknown("the block has no such sensor", name, test.sensors), ("without",))
