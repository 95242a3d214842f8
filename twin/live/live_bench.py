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
from typing import Any

import numpy as np

from analysis.monitor import parameters
from analysis.monitor.parameters import Parameter
from analysis.spots.spot_image import SpotError
from optics.geometry.tree import PlacedBodies, State
from scenes.models.disturbances import Component, state_of
from scenes.models.instrument_model import Instrument
from scenes.models.obstruction import Clearances
from scenes.specs.course import DEFAULT_PIVOT, CourseSpec, moment
from scenes.specs.job import checked_nodes
from scenes.yaml.errors import InputError
from twin.camera.camera_optics import CameraOptics
from twin.camera.camera_results import Field
from twin.framework.procedure import stream
from twin.live.camera_design import BLURRED, DESIGN, CameraDesign, changed_camera, optics_data, with_traced_focal_length
from twin.live.knobs import Knob, checked_knob, knobs_of, perturbation
from twin.live.messages import LARGEST_SEED, MOST_FRAMES, AskedState, BlindState
from twin.main_job.monitor_reading import rounded
from twin.main_job.render_job import MIN_LIGHT, require_one_state
from twin.main_job.render_results import JobRun, RenderRun
from twin.main_job.systematics import contradiction, doubted
from twin.monitor.crosstalk import crosstalk
from twin.monitor.image_quality import MOST_BLUR, quality_dicts
from twin.monitor.monitor_experiment import MonitorExperiment
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
        self._designed_twin = lru_cache(maxsize=2)(self._new_designed_twin)
        self._clearances = lru_cache(maxsize=2)(Clearances.of)
        # the knobs do not move while a course is played
        self._perturbed_twin = lru_cache(maxsize=2)(self._new_perturbed_twin)

    @cached_property
    def knobs(self) -> dict[str, Knob]:
        """All knobs by name: of the camera's design, if it has any, and adjustable motions of bodies."""
        motions = knobs_of(self.twin.experiment.instrument.nodes, self.twin.resolved.job)
        return motions if self.design is None else {**self.design.knobs, **motions}

    @cached_property
    def design(self) -> CameraDesign | None:
        """Knobs of the prescription, for an instrument that is one camera without a monitor; None for any other."""
        if self.monitored or len(self.twin.cameras) > 1:
            return None
        (name, site), resolved = next(iter(self.twin.resolved.instrument.cameras.items())), self.twin.resolved
        return CameraDesign.of(name, site.camera, resolved.cameras[site.camera], self.twin.experiment.backend)

    @property
    def clearances(self) -> Clearances:
        """Object that computes the distances between bodies that may collide."""
        return self._clearances(self.twin.experiment.instrument)

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
            advance("ranges of the knobs")
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
        if self.design is not None:
            unmoved = {"pivots": [DEFAULT_PIVOT], "pivot": DEFAULT_PIVOT}
            nodes = {**dict.fromkeys(self.design.nodes, unmoved), **nodes}
        common = {
            "instrument": twin.name,
            "design": None if self.design is None else self.design.name,
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
        return self._quality(self.twin.experiment, {})

    def _quality(self, experiment: MonitorExperiment, state: State) -> dict[str, Any]:
        """Return the image quality of a perturbed state, as the content of quality.json."""
        obstructed = self.twin.resolved.job.render.obstructed
        return quality_dicts(experiment.instrument, experiment.backend, [state], obstructed)[0]

    def perturbed(self, asked: AskedState) -> InstrumentTwin:
        """Return the instrument with the design and the perturbations of the knobs.

        Raises
        ------
        InputError
            A knob does not exist, a job's file could not have its value, or the designed camera forms no image.
        """
        design = {} if self.design is None else self.design.knobs
        drawn = {name: value for name, value in asked.knobs.items() if name in design}
        kinds = {name: checked_knob(name, value, design).kind for name, value in drawn.items()}
        changed = tuple((name, value) for name, value in drawn.items() if kinds[name] == DESIGN and value)
        motions = tuple((name, value) for name, value in asked.knobs.items() if name not in design)
        return self._perturbed_twin(changed, motions, tuple(asked.pivots.items()))

    def _new_perturbed_twin(
        self,
        design: tuple[tuple[str, float], ...],
        motions: Sequence[tuple[str, float]],
        pivots: Sequence[tuple[str, str]],
    ) -> InstrumentTwin:
        return self._designed_twin(design).with_perturbations(
            perturbation(dict(motions), dict(pivots), self.knobs, self._job_perturbations)
        )

    def _new_designed_twin(self, design: Sequence[tuple[str, float]]) -> InstrumentTwin:
        if self.design is None or not design:
            return self.twin
        reference, camera = self.design.reference, changed_camera(self.design.spec, dict(design))
        try:
            return self.twin.with_cameras({reference: camera})
        except InputError as error:
            if error.issues[0].key != ("focal_length",):
                raise
        return self.twin.with_cameras({reference: with_traced_focal_length(camera, self.twin.experiment.backend)})

    def field(self, asked: AskedState) -> Field | None:
        """Return the field point that the knobs set, as fractions of the half angles; None without such knobs."""
        return None if self.design is None else self.design.field(asked.knobs)

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

        They are true changes, image quality if requested, motions, and the optics at the field point.
        """
        experiment, state = self.perturbed(asked).experiment, self.states(asked)
        placed = experiment.instrument.assembly.place([state])
        optics: dict[str, Any] = {}
        if self.design is not None:
            # as `twin.camera` analyses the camera's file, without the bodies around it
            view = CameraOptics.within(experiment.instrument, self.design.name, experiment.backend, state, False)
            data, pictures = optics_data(view, self.design.field(asked.knobs))
            optics = {"optics": data, "pictures": pictures}
        blurred = bool(optics) and optics["optics"]["wavefront"]["rms_waves"] > MOST_BLUR
        quality = self._quality(experiment, state) if asked.quality and not blurred else {}
        cameras = quality.get("cameras", {}).items()
        run = JobRun(
            resolved=self.twin.resolved,
            experiment=experiment,
            state=state,
            frames=asked.frames,
            seed=self.seed_of(asked.seed),
            truth=experiment.sight.truth([state], placed),
            warnings=(
                *(f"image quality of {name}: {quality['reason']}" for name, quality in cameras if "reason" in quality),
                *([BLURRED] if blurred else []),
            ),
        )
        return {
            **optics,
            "truth": run.truth_dict(),
            **({"quality": quality} if quality else {}),
            "motions": motions(experiment.instrument, state, placed),
            "warnings": list(run.warnings),
            "collisions": self._collisions(experiment.instrument, placed),
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
        if not isinstance(asked, BlindState) or experiment.prior is None:
            return {}
        return state_of(self._drawn(asked), experiment.prior.components, experiment.thermal)

    @property
    def _components(self) -> tuple[Component, ...]:
        prior = self.twin.experiment.prior
        return () if prior is None else prior.components

    def _drawn(self, asked: BlindState) -> np.ndarray:
        """Return the random amounts of the hidden motions, SI units."""
        prior = self.twin.experiment.prior
        assert prior is not None
        return prior.draw(np.random.default_rng(stream(asked.blind, BLIND)), 1)[0]

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
        instrument = self.twin.experiment.instrument
        message: dict[str, Any] = {"readings": rounded(run.recovered_dict())}
        if not isinstance(asked, BlindState):
            message["truth"] = run.truth_dict()
            message["motions"] = motions(instrument, run.state, placed)
        else:
            message["guess"] = self._guess(asked)
        light = run.photons_after.sum(axis=(1, 2)) / run.photons_before.sum(axis=(1, 2))
        message["light"] = [float(share) for share in light]
        message["warnings"] = [*self._warnings(run, light), *doubted(run), *contradiction(run)]
        message["collisions"] = self._collisions(instrument, placed)
        return message

    def _collisions(self, instrument: Instrument, placed: PlacedBodies) -> list[str]:
        """Return a sentence on each pair of bodies that overlap in a state."""
        overlaps = self._clearances(instrument).overlaps(placed)
        return [f"{o.first} overlaps {o.second} by {1e3 * o.depth:.3g} mm" for o in overlaps]

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
