"""Adjustment of a block of measured passes, as a file gives it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from scenes.specs.measured.orbit_data import MeasuredTestSpec
from scenes.specs.orbit.adjust import CameraChangeSpec, MonitorRecordSpec, ReadingLawsSpec, one_monitor
from scenes.specs.orbit.calibration import MonitorReadingSpec
from scenes.specs.orbit.flight import AngleErrors
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
