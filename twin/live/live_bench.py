"""Computation of the live twin: a built and calibrated instrument, evaluated state by state.

A state is computed as in the main job (`twin.main_job.render_job`), with the same seed and random streams, so that the
page shows what `python -m twin.render` would write for the job of the knobs. States can be saved as files that `python
-m twin.render` repeats.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from analysis.monitor import parameters
from analysis.monitor.parameters import Parameter
from analysis.spots.spot_positions import SpotError
from optics.geometry.tree import PlacedBodies, State
from scenes.models.disturbances import Component, state_of
from scenes.models.obstruction import Clearances
from scenes.specs.course import DEFAULT_PIVOT, FEWEST, MOST, CourseSpec, moment
from scenes.specs.job import JobSpec, checked_nodes
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import YamlFile, dump_yaml
from twin.framework.provenance import Provenance, versions
from twin.framework.random_streams import stream
from twin.live.knobs import AXES, Knob, knobs_of, perturbation
from twin.live.messages import LARGEST_SEED, MOST_FRAMES, AskedState, BlindState
from twin.main_job.monitor_reading import stated
from twin.main_job.render_job import MIN_LIGHT, require_one_state
from twin.main_job.render_results import JobRun, RenderRun
from twin.main_job.systematics import contradiction, doubted
from twin.monitor.crosstalk import crosstalk
from twin.monitor.image_quality import quality_dicts
from twin.monitor.observation import StateReader
from twin.pictures.scene_file import motions
from twin.scripting.instrument_twin import InstrumentTwin
from twin.sensors.area_detector import coarse_warnings
from twin.study.runs.base_job import PHYSICS

BLIND = 7
"""Number of the random stream of the hidden motions, different from those of the monitor and of targets."""
IMPOSSIBLE = (*PHYSICS, ArithmeticError, ValueError)
"""Exceptions that mean that a state is physically impossible."""


IMAGES: Mapping[str, tuple[list[str], str]] = {
    "wavefront error": (["wfe_rms_waves"], "waves"),
    "worst wavefront error": (["wfe_worst_waves"], "waves"),
    "best focus − line CCD": (["defocus_um", "centre"], "µm"),
    "MTF with the pixel at Nyquist along the line": (["mtf_along_line", "centre"], ""),
    "MTF with the pixel at Nyquist along the track": (["mtf_along_track", "centre"], ""),
}
"""Image quality quantities on the page of a camera without a monitor.

The mapping is from a quantity's name to its path in quality.json and its unit.
"""


class LiveBench:
    """Instrument whose motions are set by knobs (sliders of the page) and whose states are computed for the page.

    It caches everything that does not depend on the knobs.

    Parameters
    ----------
    twin
        The instrument with its initial perturbation.
    """

    def __init__(self, twin: InstrumentTwin) -> None:
        if not twin.experiment.monitored:
            require_one_state(twin.resolved)
        job = checked_nodes(twin.resolved.job, twin.experiment.instrument.nodes)
        named = job if job is not twin.resolved.job else None
        self.twin = twin if named is None else InstrumentTwin.of(twin.resolved.with_job(named), like=twin)
        self._reader = lru_cache(maxsize=4)(self._new_reader)
        # the knobs do not move while a course is played
        self._perturbed_twin = lru_cache(maxsize=2)(self._new_perturbed_twin)

    @cached_property
    def knobs(self) -> dict[str, Knob]:
        """All knobs (adjustable motions of bodies) by name."""
        return knobs_of(self.twin.experiment.instrument.nodes, self.twin.resolved.job)

    @cached_property
    def clearances(self) -> Clearances:
        """Object that computes the distances between bodies that may collide."""
        return Clearances.of(self.twin.experiment.instrument)

    @cached_property
    def _crosstalk(self) -> Any:
        # any covariance suffices: only the effects of motions on spots are used
        return crosstalk(self.twin.experiment, np.eye(2 * len(self.twin.experiment.path.channels)))

    @cached_property
    def initial_state(self) -> AskedState:
        """State of the knobs when a page is opened: that of the job."""
        job = self.twin.resolved.job
        return AskedState(
            n=0,
            knobs={knob.name: knob.value for knob in self.knobs.values() if knob.value},
            pivots={path: what.pivot for path, what in job.perturb.items() if what.pivot != DEFAULT_PIVOT},
            frames=min(self.twin.resolved.frames, MOST_FRAMES),
            seed=job.render.seed & LARGEST_SEED,
            time=None if job.course is None else job.course.shown,
        )

    @property
    def monitored(self) -> bool:
        """True if the instrument has a monitor.

        Without one the page shows true changes by ray trace and the cameras' image quality.
        """
        return self.twin.experiment.monitored

    def warm(self, advance: Callable[[str], None] = lambda part: None) -> None:
        """Compute everything that does not depend on the knobs, and compile every kernel, before the first page.

        Parameters
        ----------
        advance : Callable[[str], None]
            Callback that receives the name of each part of the preparation when it begins.
        """
        experiment = self.twin.experiment
        advance("trace the unperturbed instrument")
        if not self.monitored:
            self._designed  # noqa: B018
            self.clearances  # noqa: B018
            self.state(self.initial_state)
            return
        experiment.nominal_focus  # noqa: B018
        advance("calibrate its spots")
        experiment.calibration  # noqa: B018
        advance("prior on disturbances")
        experiment.disturbances  # noqa: B018
        self._crosstalk  # noqa: B018
        self.clearances  # noqa: B018
        advance("compile")
        self.state(self.initial_state)

    def greeting(self) -> dict[str, Any]:
        """Return the data that a page needs before its first request: cameras, knobs and settings."""
        twin, experiment = self.twin, self.twin.experiment
        job = twin.resolved.job
        nodes = {
            path: {
                "pivots": list(info.pivots),
                "pivot": job.perturb[path].pivot if path in job.perturb else DEFAULT_PIVOT,
            }
            for path, info in experiment.instrument.nodes.items()
        }
        common = {
            "instrument": twin.name,
            "cameras": list(twin.cameras),
            "nodes": nodes,
            "knobs": [asdict(knob) for knob in self.knobs.values()],
            "frames": twin.resolved.frames,
            "seed": self.initial_state.seed,
            "parameters": [_label(p) for p in self._parameters],
            "angle": _label(parameters.ANGLE) if len(twin.cameras) == 2 else None,
            "ground": [_label(p) for p in parameters.GROUND] if experiment.ground is not None else [],
        }
        if not self.monitored:
            images = [{"path": path, "symbol": name, "unit": unit} for name, (path, unit) in IMAGES.items()]
            none: dict[str, Any] = {"channels": [], "rows": 0, "columns": 0, "pitch_um": 0.0, "white": 1, "offset": 0.0}
            asked_nothing: dict[str, Any] = {"estimators": [], "judged": "", "disturbances": "", "course": None}
            return {**common, **none, **asked_nothing, "images": images, "designed": self._designed}
        run = self._run(self.initial_state, {})[0]
        stated_motion = experiment.disturbances
        return {
            **common,
            "channels": [{"key": c.key, "camera": c.camera, "name": c.name} for c in experiment.path.channels],
            "rows": experiment.path.shape[0],
            "columns": experiment.path.shape[1],
            "pitch_um": 1e6 * experiment.path.pitch,
            "white": experiment.detector.max_dn,
            "offset": float(experiment.expected_frames(np.zeros((1, 1)))[0, 0]),
            "estimators": list(run.estimators),
            "judged": run.judged,
            "disturbances": "" if stated_motion is None else stated_motion.name,
            "course": None if job.course is None else _course_data(job.course),
        }

    @property
    def _parameters(self) -> Sequence[parameters.Parameter]:
        """Parameters of a camera shown on the page, such as ``d_alpha`` and ``d_f``."""
        return tuple(parameters.CAMERA_PARAMETERS.values()) if self.monitored else parameters.ESTIMATED

    @cached_property
    def _designed(self) -> dict[str, Any]:
        """Image quality of the nominal instrument."""
        return self._quality({})

    def _quality(self, state: State) -> dict[str, Any]:
        """Return the image quality of a perturbed state, as the content of quality.json."""
        job, experiment = self.twin.resolved.job, self.twin.experiment
        obstructed = job.render.obstructed
        return quality_dicts(experiment.instrument, experiment.backend, [state], obstructed)[0]

    def perturbed(self, asked: AskedState) -> InstrumentTwin:
        """Return the instrument perturbed by the knobs.

        Raises
        ------
        InputError
            A knob does not exist, or a job's file could not have its value.
        """
        return self._perturbed_twin(tuple(asked.knobs.items()), tuple(asked.pivots.items()))

    def _new_perturbed_twin(
        self, knobs: Sequence[tuple[str, float]], pivots: Sequence[tuple[str, str]]
    ) -> InstrumentTwin:
        return self.twin.with_perturbations(
            perturbation(dict(knobs), dict(pivots), self.knobs, self._job_perturbations)
        )

    @cached_property
    def _job_perturbations(self) -> Mapping[str, Any]:
        """Perturbations of bodies in the job, as under ``perturb`` of its file."""
        moved: Mapping[str, Any] = self.twin.resolved.job.plain().get("perturb", {})
        return moved

    def state(self, asked: AskedState) -> tuple[dict[str, Any], np.ndarray | None]:
        """Compute spots, estimated and true changes for the motions that the knobs set.

        Parameters
        ----------
        asked : AskedState
            State of the knobs that the page requests.

        Returns
        -------
        tuple[dict[str, Any], ndarray | None]
            Plain data for the page, and the images after the perturbation, uint16 (C, H, W) for C area CCDs of H rows
            and W columns; None without images. An impossible state has ``problem`` instead of estimates.
        """
        began = time.perf_counter()
        message: dict[str, Any] = {"type": "state", "n": asked.n, "t": asked.t}
        try:
            if not self.monitored:
                return {**message, **self._traced(asked), "ms": _elapsed_ms(began)}, None
            run, after, placed = self._run(asked, self._hidden(asked))
        except IMPOSSIBLE as error:
            return {**message, **self._problem_of(asked, error), "ms": _elapsed_ms(began)}, None
        message |= self._state_data(run, asked, placed)
        message["ms"] = _elapsed_ms(began)
        return message, after

    def _traced(self, asked: AskedState) -> dict[str, Any]:
        """Return the page's data for a state of an instrument without a monitor.

        They are true changes, image quality and motions.
        """
        experiment, state = self.twin.experiment, self.states(asked)
        placed = experiment.instrument.assembly.place([state])
        quality = self._quality(state)
        cameras = quality["cameras"].items()
        run = JobRun(
            resolved=self.twin.resolved,
            experiment=experiment,
            state=state,
            frames=asked.frames,
            seed=self.seed_of(asked.seed),
            truth=experiment.sight.truth([state], placed),
            warnings=tuple(f"image quality of {name}: {own['reason']}" for name, own in cameras if "reason" in own),
        )
        overlaps = self.clearances.overlaps(placed)
        return {
            "truth": run.truth_dict(),
            "quality": quality,
            "motions": motions(experiment.instrument, state, placed),
            "warnings": list(run.warnings),
            "collisions": [f"{o.first} overlaps {o.second} by {1e3 * o.depth:.3g} mm" for o in overlaps],
        }

    def before(self, asked: AskedState) -> np.ndarray:
        """Return the images before the perturbation, uint16 (C, H, W) for C area CCDs; empty without a monitor.

        H and W are the numbers of rows and columns.
        """
        if not self.monitored:
            return np.zeros((0, 0, 0), np.uint16)
        frames = self._reader(asked.frames, asked.seed).before if asked.noise else None
        return self._shown(frames, self.twin.experiment.nominal_photons)

    def _problem_of(self, asked: AskedState, error: Exception) -> dict[str, Any]:
        """Return the page's data for an impossible state, with the reason in words."""
        if isinstance(error, SpotError):
            channels = self.twin.experiment.path.channels
            reasons = [f"{channels[i % len(channels)].key}: {reason}" for i, reason in error.reasons.items()]
            return {"problem": "a spot cannot be measured", "causes": reasons}
        lines = [line.strip().removeprefix("input: ") for line in str(error).splitlines() if line.strip()]
        return {"problem": "this state is impossible", "causes": lines[:6]}

    def states(self, asked: AskedState) -> State:
        """Return the motion of each body: that of the knobs plus that of the job's time series at the selected time.

        Raises
        ------
        InputError
            A knob does not exist, or a job's file could not have its value.
        TemperatureError
            A temperature is outside the range for which a material is known.
        """
        perturbed = self.perturbed(asked)
        job, experiment = perturbed.resolved.job, perturbed.experiment
        if asked.time is None or job.course is None:
            return experiment.state(job)
        fields = experiment.fields(job, asked.time)
        experiment.thermal.check(fields)
        return experiment.thermal.state(fields, experiment.motions(job, asked.time))

    def _hidden(self, asked: AskedState) -> State:
        """Return body -> its motion that is hidden from the page, for the user to guess; empty if nothing is hidden."""
        experiment = self.twin.experiment
        if not isinstance(asked, BlindState) or experiment.stated is None:
            return {}
        return state_of(self._drawn(asked), experiment.stated.components, experiment.thermal)

    @property
    def _components(self) -> tuple[Component, ...]:
        stated = self.twin.experiment.stated
        return () if stated is None else stated.components

    def _drawn(self, asked: BlindState) -> np.ndarray:
        """Return the random amounts of the hidden motions, SI units."""
        stated = self.twin.experiment.stated
        assert stated is not None
        return stated.draw(np.random.default_rng(stream(asked.blind, BLIND)), 1)[0]

    def hidden(self, asked: BlindState) -> dict[str, Any]:
        """Return the motions hidden for the user to guess, most significant first, and the true changes due to them."""
        state = self._hidden(asked)
        if not state:
            return {}
        parts, row = self._components, self._drawn(asked)
        order = sorted(range(len(parts)), key=lambda k: -abs(row[k] / parts[k].sigma) if parts[k].sigma else 0.0)
        run, _, _ = self._run(asked, state)
        return {
            "truth": run.truth_dict(),
            "hidden": [
                {
                    "what": parts[k].name,
                    "value": float(row[k] / parts[k].unit_size),
                    "unit": parts[k].unit,
                    "sigmas": float(row[k] / parts[k].sigma),
                }
                for k in order
                if row[k]
            ],
        }

    def seed_of(self, asked: int) -> int:
        """Return the seed that a page's number stands for.

        The job's own seed, such as that of a study's run, may exceed the numbers that a page represents exactly. The
        page then uses the lowest bits of that seed, and this method recognises them.
        """
        job_seed = self.twin.resolved.job.render.seed
        return job_seed if asked == job_seed & LARGEST_SEED else asked

    def _new_reader(self, frames: int, seed: int) -> StateReader:
        return StateReader(self.twin.experiment, frames, self.seed_of(seed), self.twin.resolved.job.analysis.centroid)

    def _shown(self, frames: np.ndarray | None, photons: np.ndarray) -> np.ndarray:
        """Return the image of a state for the page, uint16 (C, H, W).

        It is the state's first frame, or the rounded expected image.

        C is the number of area CCDs, H and W the numbers of rows and columns.
        """
        if frames is not None:
            return frames[:, 0]
        experiment = self.twin.experiment
        expected = experiment.expected_frames(photons)
        return np.rint(np.clip(expected, 0, experiment.detector.max_dn)).astype(np.uint16)

    def _run(self, asked: AskedState, hidden: State) -> tuple[RenderRun, np.ndarray, PlacedBodies]:
        """Compute a state as in the main job, and return its results, its images and the placed bodies."""
        experiment = self.twin.experiment
        # the knobs are a guess of the hidden motions, and are not added to them
        state = hidden or self.states(asked)
        of_course = asked.time is not None and self.twin.resolved.job.course is not None
        reading = self._reader(asked.frames, asked.seed).read(state, asked.noise, asked.time or 0, of_course)
        photons = reading.light.photons[0]
        frames = reading.after[0] if asked.noise else None
        after = self._shown(frames, photons)
        run = RenderRun(
            resolved=self.twin.resolved,
            experiment=experiment,
            state=state,
            frames=asked.frames,
            seed=self.seed_of(asked.seed),
            truth=reading.truth,
            photons_before=experiment.nominal_photons,
            photons_after=photons,
            before=self.before(asked)[:, None],
            after=after[:, None] if frames is None else frames,
            recovery=reading.recovery,
            crosstalk=self._crosstalk,
            warnings=(),
        )
        return run, after, reading.light.placed

    def _state_data(self, run: RenderRun, asked: AskedState, placed: PlacedBodies) -> dict[str, Any]:
        """Return the page's data for a state of an instrument with a monitor.

        They are estimated and true changes, spots and warnings.
        """
        experiment = self.twin.experiment
        instrument = experiment.instrument
        message: dict[str, Any] = {"readings": stated(run.recovered_dict())}
        if not isinstance(asked, BlindState):
            message["truth"] = run.truth_dict()
            message["motions"] = motions(instrument, run.state, placed)
        else:
            message["guess"] = self._guess(asked)
        light = run.photons_after.sum(axis=(1, 2)) / run.photons_before.sum(axis=(1, 2))
        message["light"] = [float(share) for share in light]
        message["warnings"] = [*self._warnings(run, light), *doubted(run), *contradiction(run)]
        message["collisions"] = [
            f"{o.first} overlaps {o.second} by {1e3 * o.depth:.3g} mm" for o in self.clearances.overlaps(placed)
        ]
        return message

    def _guess(self, asked: AskedState) -> dict[str, Any]:
        """Return the expected images and spots for the knobs alone, as the user's guess of the hidden motions."""
        try:
            reading = self._reader(asked.frames, asked.seed).read(self.states(asked), noise=False)
        except IMPOSSIBLE as error:
            return {"problem": str(error)}
        return {"spots": reading.recovery.after[0].tolist(), "image": self._shown(None, reading.light.photons[0])}

    def _warnings(self, run: RenderRun, light: np.ndarray) -> list[str]:
        """Return warnings about coarse sampling, saturation and lost light."""
        detector, channels = self.twin.experiment.detector, self.twin.experiment.path.channels
        out = list(coarse_warnings(self.twin.resolved))
        saturated = np.ravel(detector.saturated(run.after).pixels)
        for channel, share, full in zip(channels, light, saturated, strict=True):
            if full:
                out.append(f"{channel.key}: saturated pixels; its centroid is biased")
            if share < MIN_LIGHT:
                out.append(f"{channel.key}: only {100.0 * share:.0f} % of its light reaches the CCD")
        return out


def _elapsed_ms(began: float) -> float:
    """Return the time since ``began`` (a reading of the clock), in milliseconds."""
    return 1e3 * (time.perf_counter() - began)


def _course_data(course: CourseSpec) -> dict[str, Any]:
    """Return the times of a job's time series: in seconds, as texts, and the index of the one shown in full."""
    return {"times": list(course.times), "names": list(map(moment, course.times)), "shown": course.shown}


def _label(parameter: Parameter) -> Mapping[str, str]:
    """Return key, symbol, unit and meaning of a camera parameter, for the page."""
    return {"key": parameter.key, "symbol": parameter.symbol, "unit": parameter.unit, "meaning": parameter.meaning}


HEAD = "# Recorded with python -m twin.live; repeat it: python -m twin.render THIS_FILE\n"
"""Comment in the first line of a saved file."""


def _head() -> str:
    """Return the comment that states where a file was recorded."""
    made, by = Provenance.here(), versions()
    kernels = ", ".join(dict.fromkeys(f"{one.name} {one.version} for {one.kernels}" for one in made.blas))
    return (
        f"{HEAD}# made by space-camera-twin {by['space-camera-twin']}, source {made.source}, Python {by['python']}, "
        f"numpy {by['numpy']}, Dr.Jit {by['drjit']}, on {made.processor}; {kernels}\n"
    )


GUESSED = (
    "# Saved while motions were hidden: this job holds the guess of the knobs alone, so that twin.render gives the\n"
    "# spots of the guess and not those that were shown.\n"
)
"""Comment at the top of a job file that was saved while motions were hidden, which it does not contain."""


def job_text(bench: LiveBench, asked: AskedState) -> str:
    """Return a self-contained job file of one state; for a job with a time series, that at the selected time.

    Parameters
    ----------
    bench : LiveBench
        Instrument that is evaluated.
    asked : AskedState
        State of the knobs to be saved.

    Raises
    ------
    InputError
        A job's file could not have a value.
    """
    resolved = bench.perturbed(asked).resolved.with_render(asked.frames, bench.seed_of(asked.seed))
    plain = resolved.plain()
    if asked.time is not None and resolved.job.course is not None:
        plain["job"]["course"]["detail"] = moment(resolved.job.course.times[asked.time])
    hidden = GUESSED if isinstance(asked, BlindState) else ""
    return _head() + hidden + dump_yaml(plain)


def course_text(bench: LiveBench, kept: Sequence[tuple[float, AskedState]]) -> str:
    """Return a job file with the recorded states as a time series (``course``), timed to the millisecond.

    Parameters
    ----------
    bench : LiveBench
        Instrument that is evaluated.
    kept : Sequence[tuple[float, AskedState]]
        (seconds since the recording began, state) in the order in which they were shown.

    Raises
    ------
    ValueError
        There are too few states, or something changed that a job's time series cannot change.
    """
    steps = _limited_times(kept)
    if len(steps) < FEWEST:
        raise ValueError(f"a course has at least {FEWEST} different times; move a knob while recording")
    first = steps[0][1]
    if any(step.time is not None for _, step in steps):
        raise ValueError("a course of the job was shown; it is in the job's own file")
    if any(step.pivots != first.pivots for _, step in steps):
        raise ValueError(
            "a course rotates each body about one pivot at all times; record again without changing pivots"
        )
    knobs = bench.knobs
    fixed, moving = _split([dict(step.knobs) for _, step in steps], knobs)
    resolved = bench.twin.resolved.with_render(first.frames, bench.seed_of(first.seed))
    plain = resolved.plain()
    job = plain["job"]
    job["perturb"] = perturbation(fixed, first.pivots, knobs, job.get("perturb", {}))
    job["course"] = {"times": [f"{time!r} s" for time, _ in steps], **_courses(moving, first.pivots, knobs, len(steps))}
    validate(JobSpec, YamlFile("", job, {}))
    return _head() + dump_yaml(plain)


def _limited_times(kept: Sequence[tuple[float, AskedState]]) -> list[tuple[float, AskedState]]:
    """Return states at ascending times in milliseconds, at most as many as a job's time series may have.

    The first and the last state are among them.
    """
    out: list[tuple[float, AskedState]] = []
    for seconds, state in kept:
        rounded = round(seconds, 3)
        if out and rounded <= out[-1][0]:
            out[-1] = (out[-1][0], state)
        else:
            out.append((rounded, state))
    if len(out) <= MOST:
        return out
    chosen = sorted({round(k * (len(out) - 1) / (MOST - 1)) for k in range(MOST)})
    return [out[k] for k in chosen]


def _split(
    states: Sequence[Mapping[str, float]], knobs: Mapping[str, Knob]
) -> tuple[dict[str, float], dict[str, list[float]]]:
    """Separate knobs that change over the recorded states from constant ones.

    Returns
    -------
    tuple of dict
        Constant knob -> its value, and changing knob -> its values at each time.

    Raises
    ------
    ValueError
        The figure of a surface changes, which a job's time series cannot contain.
    """
    names = dict.fromkeys(name for state in states for name in state)
    moving = {}
    fixed = {}
    for name in names:
        values = [state.get(name, 0.0) for state in states]
        if all(a == b for a, b in pairwise(values)):
            fixed[name] = values[0]
        elif knobs[name].kind == "figure":
            raise ValueError(f"{name}: a course holds motions and temperatures, not figures; save the job instead")
        else:
            moving[name] = values
    if not moving:
        raise ValueError("nothing moved while recording; save the job instead")
    # a body's constant motion belongs to its course, too
    bodies = {(knobs[name].node, knobs[name].kind) for name in moving}
    for name in list(fixed):
        if (knobs[name].node, knobs[name].kind) in bodies:
            moving[name] = [fixed.pop(name)] * len(states)
    return fixed, moving


def _courses(
    moving: Mapping[str, Sequence[float]], pivots: Mapping[str, str], knobs: Mapping[str, Knob], count: int
) -> dict[str, Any]:
    """Return the entries ``temperature`` and ``motion`` of a job's time series (``course``) for changing knobs."""
    out: dict[str, dict[str, dict[str, Any]]] = {}
    for name in moving:
        knob = knobs[name]
        heat = knob.kind in ("temperature", "gradient")
        key = {"temperature": "change"}.get(knob.kind, knob.kind)
        body = out.setdefault("temperature" if heat else "motion", {}).setdefault(knob.node, {})
        if key in body:
            continue
        axes = AXES if knob.kind in ("rotate", "shift", "gradient") else ("",)
        columns = [moving.get(f"{knob.node} {knob.kind} {axis}".strip(), [0.0] * count) for axis in axes]
        rows = [[f"{value!r} {knob.unit}" for value in row] for row in zip(*columns, strict=True)]
        body[key] = rows if len(axes) > 1 else [row[0] for row in rows]
        if not heat and pivots.get(knob.node, DEFAULT_PIVOT) != DEFAULT_PIVOT:
            body["pivot"] = pivots[knob.node]
    return out
