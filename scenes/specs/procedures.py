"""Tests that commands run: for each its files, its computation, its results and its report.

Commands and their help, the JSON Schemas, studies, the documentation and `twin.perform` use this table. A function of a
test is imported on first use: help and messages about files do not wait for numerical modules, and computations do not
wait for plotting modules.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
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
        about="""
    Align a misaligned focal plane: through-focus MTF of a slanted edge in every field and band, a weighted plane fit,
    shims, and a repetition as a check.

    focus.json holds, for every round, the confocal error, the line's level, MTF at Nyquist by band and the shims,
    and under `truth` the values of the exact ray trace.

    Example: `python -m twin.lab focus scenes/lab/focus.yaml`
    """,
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
        about="""
    Measure principal distance, principal point and distortion: a pinhole's spots on the line CCD while a turntable
    rotates the camera, with raw and with compensated angles.

    distortion.json: `rms_raw_um` and `rms_compensated_um` are the scatter of the points about a smooth curve, which a
    laboratory can measure; the true errors of the distortion are under `truth`, `error_rms_raw_um` and
    `error_rms_compensated_um`.

    Example: `python -m twin.lab distortion scenes/lab/distortion.yaml`
    """,
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
        about="""
    Calibrate a turntable's dividing error by regional comparison and compare five fits of it on held-out angles.

    Example: `python -m twin.lab turntable scenes/lab/turntable.yaml --seed 2`
    """,
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
        about="""
    Adjust all scenes of a block together: image points, control, the cameras' monitor, star trackers and their
    angles, a laser altimeter and a terrain model, with time laws for the errors of the readings.

    A file with `data: DIR` runs on the measurements of that folder, as `calibrate` does; a file with `images:` adjusts
    images that come with rational polynomials. `--export DIR` writes the adjusted points with their covariances, and
    the corrected polynomials of such images with the joint covariance of their corrections.

    block.json holds the errors in plan and height at check points, with all sensors and without each, the tests of
    observations and laws, the parameters that the prior determines more than the observations, and the cameras'
    changes. `--without SENSOR` excludes a sensor of the file.

    Example: `python -m twin.orbit adjust scenes/orbit/adjust.yaml`
    """,
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
        about="""
    Measure intersection angles of a three-line camera by planes through the station and ground points (paper 000),
    with space resection as the second method.

    A file with `data: DIR` runs on the measurements of that folder, as `calibrate` does: the angles of every pass,
    against those of the laboratory. `--export DIR` writes a simulation's measurements to such a folder, with a test
    file angle.yaml.

    angle.json holds the angles with sigmas, the truth, planes minus resection, and the sensitivity to errors of the
    station and of the points.

    Example: `python -m twin.orbit angle scenes/orbit/angle.yaml`
    """,
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
        about="""
    Calibrate interior orientation and attitude biases of a three-line camera over test fields, and test schemes of
    averaged parameters on all fields without ground control (paper 003); simulated, or on measured passes.

    A file with `data: DIR` runs on the measurements of that folder: orbit, attitude, line times, ground and image
    points. `--export DIR` writes the run's measurements to such a folder, with a test file calibrate.yaml.

    calibration.json holds the parameters with sigmas and truth, correlations, null vectors and gauge, and the errors in
    plan and height of every field before calibration and by each scheme.

    Example: `python -m twin.orbit calibrate scenes/orbit/calibrate.yaml`
    """,
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
        about="""
    Check the conventions of a pass in files: alternatives of each convention (order and sense of the quaternion,
    frames, time scales, an offset of the line times, origins and axes of pixels and lines), singly and in pairs, are
    compared on the ground points and ranked.

    check.json holds the alternatives with residuals and likelihoods, the conventions that the points determine and
    those that they do not, and the computed positions of the first points. Exit codes: 0 the stated conventions are
    confirmed, 3 others fit better, 4 none explains the points. With `--export DIR` a pass with confirmed conventions is
    written to a folder that `twin.orbit calibrate` reads.

    Example: `python -m twin.orbit check scenes/orbit/measured/check.yaml`
    """,
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
        about="""
    Search for jitter of the attitude in images of the same ground that two or more lines or bands took one after the
    other: oscillations with frequency, amplitude and false-alarm rate, the frequencies at which the lines are blind,
    and the attitude over time with its covariance.

    A file with `data: DIR` runs on the points of that folder, as `match --export DIR` writes it. `--export DIR` writes
    a simulation's measurements to such a folder, with a test file jitter.yaml.

    jitter.json holds the oscillations with sigmas, blind frequencies, and detection limits.

    Example: `python -m twin.orbit jitter scenes/orbit/jitter.yaml`
    """,
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
        about="""
    Measure points in a user's line images: distinct points of an orthophoto with heights of an elevation model, and
    tie points, are located in every image by least squares matching, as in a simulated patch.

    A file with `images:` that have rational polynomials, without a camera, gives tie points between them.

    match.json holds for every line the number of matched points and how they were matched. With `--export DIR` they are
    written with orbit, attitude and line times to a folder that `twin.orbit calibrate` reads.

    Example: `python -m twin.orbit match scenes/orbit/measured/match.yaml`
    """,
    ),
    "orbit monitor": Procedure(
        "monitor",
        setup="scenes.specs.orbit.setup:MonitorSetup",
        run="twin.orbit.monitoring.monitoring_run:run_monitor",
        numbers="twin.orbit.monitoring.monitoring_numbers:monitor_numbers",
        report="twin.orbit.monitoring.monitoring_report:monitor_report",
        varied=True,
        about="""
    Compute height errors of a stereo pair along its orbit with and without on-board monitoring of its cameras (paper
    001's monitor, heights as in papers 000 and 003). With `mechanisms:` the loop is closed: readings of rendered spots
    control mechanisms that point and refocus, with gain, delay and steps, compared with the same orbit in open loop.

    monitor.json holds the true and the monitored changes, errors in plan and height as calibrated, monitored at every
    time and at an interval, the table of intervals, metres per arcsecond, and the sources of the remaining errors; for
    a closed loop under `loop` the remaining errors of angle, focus and height with sigmas, gain and phase margins, and
    unobservable modes.

    Example: `python -m twin.orbit monitor scenes/orbit/monitor.yaml`
    """,
    ),
    "orbit simulate": Procedure(
        "simulate",
        setup="scenes.specs.orbit.setup:SimulateSetup",
        run="twin.orbit.images.simulate_run:run_simulation",
        numbers="twin.orbit.images.simulate_run:SIMULATE",
        report="twin.orbit.images.simulate_report:simulation_report",
        export="twin.orbit.images.simulate_run:simulation_exported",
        about="""
    Render images of a patch of ground by every line of a camera, with an orthophoto, an elevation model and the
    measured orbit and attitude: all inputs of an in-orbit calibration from images.

    simulate.json holds for every line the position of its window, grey values, ground sample distance and MTF. The
    true values are in artefacts/truth.json. `--export DIR` writes points, orbit and attitude as tables that `calibrate`
    reads.

    Example: `python -m twin.orbit simulate scenes/orbit/simulate.yaml`
    """,
    ),
    "design camera": Procedure(
        "design",
        setup="scenes.models.camera_design:CameraDesignSetup",
        run="twin.design.design_run:run_design",
        numbers="twin.design.design_run:DESIGN",
        report="twin.design.design_report:design_report",
        judged=False,
        about="""
    Optimise a camera's prescription: curvatures, conics, aspheric terms and positions vary; the wavefront error over
    the field is minimised, with the focal length, the envelope, the anamorphism and free beams as constraints.
    Several starts (``starts:``) show whether the optimum depends on the starting point.

    Example: `python -m twin.design camera scenes/examples/design_gf7_short.yaml`

    The run folder gets the new camera's file in artefacts/,
    design.json, config.yaml and a report.

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """,
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
        about="""
    Estimate the state of one instrument: all motions of its prior from all of its measurements, with the observable
    combinations, the performance of the camera compared with that of the design, and the next alignment move.

    asbuilt.json holds the motions and combinations with their sigmas, the consistency of every measurement with all
    others, the merits with their quantiles under the prior, as built and after the next move, and that move.
    artefacts/ gets the instrument as built, which every command accepts as its instrument, and its remaining
    uncertainty as a disturbances file.

    Example: `python -m twin.asbuilt scenes/examples/asbuilt_gf7.yaml`
    """,
    ),
    "asbuilt check": Procedure(
        "orientation",
        setup="scenes.specs.asbuilt:AsBuiltSetup",
        run="twin.asbuilt.orientation_check:run_check",
        numbers="twin.asbuilt.orientation_check:ORIENTATION",
        report="twin.asbuilt.orientation_check:check_report",
        judged=False,
        about="""
    Determine the orientation of measured wavefronts: eight orientations and two signs are compared with the prediction
    from the prior and the moves; those that the data do not distinguish are listed together.

    orientation.json holds all orientations with their chi-squares. Exit codes: 0 the stated orientation is confirmed, 3
    another one fits better, 4 none explains the wavefronts.

    Example: `python -m twin.asbuilt check scenes/examples/asbuilt_gf7.yaml`
    """,
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
PROCEDURES = ExtensionTable("procedures", _PROCEDURES, Procedure)
"""Command without the leading ``twin.`` -> test. A new test consists of its modules and one entry here."""
