"""Tests that commands run: for each its files, its computation, its results and its report.

Commands and their help, the JSON Schemas, studies, the documentation and `twin.perform` use this table. A function of a
test is imported on first use: help and messages about files do not wait for numerical modules, and computations do not
wait for plotting modules.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from optics.numerics.extension_table import ExtensionTable
from optics.numerics.number_tree import FrozenMap
from scenes.yaml.named import FileKind, Named


@dataclass(frozen=True)
class Procedure:
    """Test that a command runs, with a report, and whose results a study can use.

    Functions and the set-up may be given as names for `Named`. The modules that ``run`` and ``numbers`` need neither
    plot nor fill templates.

    Attributes
    ----------
    kind : str
        Name of the result file without .json, for example ``focus``.
    setup : type or callable
        Class, derived from `ExperimentSetup`, that holds the simulated test with the content of all its files; or a
        function that reads the file.
    run : callable
        Function from set-up, backend, seed and progress to the complete result. Raises InputError, BenchError.
    numbers : callable
        Function from the result to the plain data of KIND.json, whose keys end in their unit.
    report : callable
        Function from the result to a `twin.framework.report.Report`.
    measured : type, tuple of types, or None
        Classes of the tests on measurements, chosen by the keys of the file; None if there is none.
    export : callable or None
        Function from the result to paths and contents of files with the measured data, for the option ``--export``;
        None if there is none.
    files : tuple[FileKind, ...]
        Kinds of file that the test reads beside those in file_kinds.csv.
    varied : bool
        True if a study can vary the test.
    judged : bool
        True if the user is warned of cameras that are blurred even as designed.
    seeded : bool
        True if the test draws random numbers; config.yaml then has the seed.
    options : tuple[str, ...]
        Options of the command that are named arguments of ``run``, True or False; `twin.perform` takes them as well.
    about : str
        Text of ``--help`` in Markdown; its first paragraph is shown in the list of subcommands.
    frames : Mapping[str, str]
        Quantity of KIND.json -> its reference frame, where `twin.framework.reference_frames` has none.
    """

    kind: str
    setup: Any
    run: Any
    numbers: Any
    report: Any
    measured: Any = None
    export: Any = None
    files: tuple[FileKind, ...] = ()
    varied: bool = False
    judged: bool = True
    seeded: bool = True
    options: tuple[str, ...] = ()
    about: str = ""
    frames: Mapping[str, str] = field(default_factory=FrozenMap)

    def __post_init__(self) -> None:
        """Replace names of functions by references that import them on first use."""
        for name in ("run", "numbers", "report", "export"):
            if isinstance(path := getattr(self, name), str):
                object.__setattr__(self, name, Named(path))

    @property
    def model(self) -> Any:
        """Class that holds the simulated test with the content of all its files."""
        return Named(self.setup).get() if isinstance(self.setup, str) else self.setup

    def resolve(self, path: Path | str, *named: str | None) -> Any:
        """Read a test's file and all files to which it refers.

        Parameters
        ----------
        path : Path | str
            Path of its file or of a run's config.yaml, or name of a test in the library.
        named : str | None
            Further arguments of a function that reads the set-up.

        Raises
        ------
        InputError
            A file cannot be read or is not valid, or the files do not fit together.
        """
        for source in (self.measured,) if isinstance(self.measured, str) else self.measured or ():
            measured = Named(source).get()
            if measured.measured_by(Named("scenes.specs.resolved:test_keys")(path)):
                return measured.read(path)
        return getattr(self.model, "read", self.model)(path, *named)


BASES: dict[str, Named] = {
    # a study imports only the modules of its base, which halves the start-up time of a worker
    "render": Named("twin.study.runs.render_base:RenderBase"),
    "tolerance": Named("twin.tolerance.samples:ToleranceBase"),
}
"""Command -> class that evaluates many of its runs at once for a study; other tests run one after the other."""


def studied_commands() -> tuple[str, ...]:
    """Return the commands that a study can vary."""
    return (*BASES, *(name for name, procedure in PROCEDURES.items() if procedure.varied))


SENSORS = ("ties", "control", "monitor", "laser", "terrain", "tracker_angles")
"""Sensors that the adjustment of a block can exclude; the command's help lists them."""


def _with_help(tests: Mapping[str, Procedure]) -> dict[str, Procedure]:
    """Return the tests with the texts of ``--help``, each a section of the file beside this module."""
    text = Path(__file__).with_suffix(".md").read_text("utf-8")
    about = dict(section.split("\n", 1) for section in text.split("\n## ")[1:])
    return {name: replace(test, about=about.get(name, "").strip()) for name, test in tests.items()}


_PROCEDURES: dict[str, Procedure] = {
    "lab focus": Procedure(
        "focus",
        setup="scenes.specs.resolved:FocusSetup",
        measured="scenes.specs.resolved:MeasuredFocusSetup",
        run="twin.laboratory.focus_run:run_focus",
        numbers="twin.laboratory.focus_run:focus_numbers",
        report="twin.laboratory.focus_report:focus_report",
        export="twin.laboratory.export:export_focus",
        varied=True,
    ),
    "lab distortion": Procedure(
        "distortion",
        setup="scenes.specs.resolved:DistortionSetup",
        measured="scenes.specs.resolved:MeasuredDistortionSetup",
        run="twin.laboratory.distortion_run:run_distortion",
        numbers="twin.laboratory.distortion_run:DISTORTION",
        report="twin.laboratory.distortion_report:distortion_report",
        export="twin.laboratory.export:export_distortion",
        varied=True,
    ),
    "lab turntable": Procedure(
        "turntable",
        setup="scenes.specs.resolved:TurntableSetup",
        measured="scenes.specs.resolved:MeasuredTurntableSetup",
        run="twin.laboratory.turntable_run:run_turntable_test",
        numbers="twin.laboratory.turntable_run:TURNTABLE",
        report="twin.laboratory.turntable_report:turntable_report",
        export="twin.laboratory.export:export_turntable",
        varied=True,
    ),
    "orbit adjust": Procedure(
        "block",
        setup="scenes.specs.orbit.setup:AdjustSetup",
        measured=("scenes.specs.orbit.setup:MeasuredAdjustSetup", "scenes.specs.orbit.setup:RationalAdjustSetup"),
        run="twin.operate.operated_block:run_operated_block",
        numbers="twin.orbit.block.block_numbers:BLOCK",
        report="twin.orbit.block.block_report:block_report",
        export="twin.orbit.block.block_files:exported",
        varied=True,
    ),
    "orbit angle": Procedure(
        "angle",
        setup="scenes.specs.orbit.setup:AngleSetup",
        measured="scenes.specs.orbit.setup:MeasuredAngleSetup",
        run="twin.orbit.angle.measured_angle:run_angle_test",
        numbers="twin.orbit.angle.angle_run:angle_numbers",
        report="twin.orbit.angle.angle_report:angle_report",
        export="twin.orbit.angle.measured_angle:angle_exported",
        varied=True,
    ),
    "orbit calibrate": Procedure(
        "calibration",
        setup="scenes.specs.orbit.setup:CalibrationSetup",
        measured="scenes.specs.orbit.setup:MeasuredCalibrationSetup",
        run="twin.orbit.calibration.calibration_run:run_calibration",
        numbers="twin.orbit.calibration.calibration_numbers:CALIBRATION",
        report="twin.orbit.calibration.calibration_report:calibration_report",
        export="twin.orbit.calibration.calibration_run:exported",
        varied=True,
    ),
    "orbit check": Procedure(
        "check",
        setup="scenes.specs.orbit.setup:CheckSetup",
        run="twin.orbit.conventions.check_run:run_check",
        numbers="twin.orbit.conventions.check_report:CHECK",
        report="twin.orbit.conventions.check_report:check_report",
        export="twin.orbit.conventions.check_run:exported",
        judged=False,
        seeded=False,
    ),
    "orbit jitter": Procedure(
        "jitter",
        setup="scenes.specs.orbit.setup:JitterSetup",
        measured="scenes.specs.orbit.setup:MeasuredJitterSetup",
        run="twin.orbit.jitter.jitter_run:run_jitter",
        numbers="twin.orbit.jitter.jitter_run:JITTER",
        report="twin.orbit.jitter.jitter_report:jitter_report",
        export="twin.orbit.jitter.jitter_run:exported",
        varied=True,
        judged=False,
    ),
    "orbit match": Procedure(
        "match",
        setup="scenes.specs.orbit.setup:MatchSetup",
        measured=("scenes.specs.orbit.setup:RationalMatchSetup",),
        run="twin.orbit.matching.match_run:run_match",
        numbers="twin.orbit.matching.match_run:match_numbers",
        report="twin.orbit.matching.match_report:match_report",
        export="twin.orbit.matching.match_run:exported",
        judged=False,
        seeded=False,
    ),
    "orbit monitor": Procedure(
        "monitor",
        setup="scenes.specs.orbit.setup:MonitorSetup",
        run="twin.orbit.monitoring.monitoring_run:run_monitor",
        numbers="twin.orbit.monitoring.monitoring_numbers:monitor_numbers",
        report="twin.orbit.monitoring.monitoring_report:monitor_report",
        varied=True,
    ),
    "orbit simulate": Procedure(
        "simulate",
        setup="scenes.specs.orbit.setup:SimulateSetup",
        run="twin.orbit.images.simulate_run:run_simulation",
        numbers="twin.orbit.images.simulate_run:SIMULATE",
        report="twin.orbit.images.simulate_report:simulation_report",
        export="twin.orbit.images.simulate_run:simulation_exported",
    ),
    "design camera": Procedure(
        "design",
        setup="scenes.models.camera_design:CameraDesignSetup",
        run="twin.design.design_run:run_design",
        numbers="twin.design.design_run:DESIGN",
        report="twin.design.design_report:design_report",
        judged=False,
    ),
    "design monitor": Procedure(
        "layouts",
        setup="scenes.models.monitor_layout:MonitorDesignSetup",
        run="twin.design.monitor_design:run_monitor_design",
        numbers="twin.design.monitor_design:LAYOUTS",
        report="twin.design.monitor_report:monitor_design_report",
        judged=False,
    ),
    "asbuilt estimate": Procedure(
        "asbuilt",
        setup="scenes.specs.asbuilt:AsBuiltSetup",
        run="twin.asbuilt.asbuilt_run:run_asbuilt",
        numbers="twin.asbuilt.asbuilt_run:ASBUILT",
        report="twin.asbuilt.asbuilt_report:asbuilt_report",
    ),
    "asbuilt check": Procedure(
        "orientation",
        setup="scenes.specs.asbuilt:AsBuiltSetup",
        run="twin.asbuilt.orientation_check:run_check",
        numbers="twin.asbuilt.orientation_check:ORIENTATION",
        report="twin.asbuilt.orientation_check:check_report",
        judged=False,
    ),
    "camera": Procedure(
        "optics",
        setup="scenes.specs.resolved:resolve_camera",
        run="twin.camera.camera_run:run_camera",
        numbers="twin.camera.camera_run:CAMERA",
        report="twin.camera.camera_report:camera_report",
        options=("refocus", "tilt"),
    ),
    "recover": Procedure(
        "recovered",
        setup="scenes.specs.monitor_frames:MeasurementSetup",
        run="twin.recover.recover_run:run_recover",
        numbers="twin.recover.recover_run:recover_numbers",
        report="twin.recover.recover_report:recover_report",
        judged=False,
    ),
    "tolerance": Procedure(
        "tolerance",
        setup="scenes.specs.tolerance:ToleranceSetup",
        run="twin.tolerance.tolerance_run:run_tolerance",
        numbers="twin.tolerance.tolerance_run:TOLERANCE",
        report="twin.tolerance.tolerance_report:tolerance_report",
        judged=False,
    ),
    "uncertainty": Procedure(
        "uncertainty",
        setup="scenes.specs.resolved:resolve_with",
        run="twin.uncertainty.coverage:run_uncertainty",
        numbers="twin.uncertainty.uncertainty_numbers:uncertainty_numbers",
        report="twin.uncertainty.uncertainty_report:uncertainty_report",
        judged=False,
        seeded=False,
    ),
}
PROCEDURES = ExtensionTable("procedures", _with_help(_PROCEDURES), Procedure)
"""Command without the leading ``twin.`` -> test. A new test consists of its modules, one entry here and its help."""
