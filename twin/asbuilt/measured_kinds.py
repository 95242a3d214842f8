"""Kinds of measurements on an instrument: predicted readings for a state, error model and data files.

A reading is one measured number. A new kind is a class here, an entry of ``asbuilt_bench.KINDS`` and its keys in
``scenes.specs.asbuilt.MeasurementsSpec``.
"""

from __future__ import annotations

import csv
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from analysis.arrays import ARCSEC, MeasurementError
from analysis.images.image_file import ImageError, ImageFile, Region
from analysis.instrument_state.state_estimate import MeasuredGroup
from analysis.wavefront_maps.pupil_fit import Orientation
from optics.geometry.tree import State
from optics.numerics.array_math import PhysicalError
from optics.raytrace.first_order import line_tangents
from scenes.specs import asbuilt as specs
from scenes.specs.perturbation import find_node
from scenes.specs.tolerance import MeritSpec
from scenes.yaml.errors import InputError, Problem
from twin.asbuilt.wavefront_files import read_coefficients
from twin.camera.varied_beams import VariedBeams
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.tolerance.tolerance_bench import ToleranceBench

UNKNOWN_FOCUS = 50e-6
"""Standard deviation, metres, of a simulated measurement's unknown focus, which the estimate treats as free.

Results do not depend on it.
"""
UNKNOWN_ZERO = 20.0 * ARCSEC
"""Standard deviation, radians, of a simulated measurement's unknown angle zero, which the estimate treats as free."""
UNKNOWN_FRAME = 100e-6
"""Standard deviation, metres and radians, of the unknown frame of the measuring machine in a simulated measurement.

The estimate treats shift and rotation of this frame as free.
"""
_LINE_DEGREE = 7
"""Degree of the polynomial in the tangent of the field angle that fits positions along a line to 1e-10 m."""


@dataclass(frozen=True, eq=False)
class View:
    """States of the instrument at the time of a measurement.

    Attributes
    ----------
    values : (S, K) ndarray
        K estimated parameters (motions, actuator errors) of each state, SI units.
    states : sequence of State
        S states of the instrument.
    warmth : callable
        Function from names of bodies to temperatures above nominal, (S, bodies), kelvin.
    """

    values: np.ndarray
    states: Sequence[State]
    temperatures_of: Any


class Site(ABC):
    """Interface through which a kind of measurement uses the instrument; it does not expose the instrument's state."""

    test: specs.AsBuiltSpec
    experiment: MonitorExperiment
    camera: str
    line: np.ndarray

    @abstractmethod
    def beams(self, fields: tuple[tuple[float, float], ...], planes: bool = False) -> VariedBeams:
        """Return the beams at some field points, traced once for all measurements at these field points.

        With ``planes``, their light has optical paths to plane waves.
        """

    @abstractmethod
    def bench(self, merits: Mapping[str, MeritSpec]) -> ToleranceBench:
        """Return the evaluator that computes the given merits for the camera."""


class MeasuredKind(ABC):
    """Measurement on an instrument; base class of all kinds.

    Parameters
    ----------
    site : Site
        Interface to the instrument.
    name : str
        Name of the measurement.
    spec : Spec
        Specification in the file.
    key : tuple of str
        Key path of the specification in the file.

    Attributes
    ----------
    labels : tuple of str
        Labels of its D readings, (D,).
    blocks : tuple of str
        Group to which each reading belongs, (D,); one gross error affects all readings of a group.
    """

    kind: ClassVar[str]
    shown: ClassVar[tuple[str, float]]
    """Unit in which its readings are reported, and the size of that unit in SI."""

    def __init__(self, site: Site, name: str, spec: Any, key: tuple[str, ...]) -> None:
        self.site, self.name, self.spec, self.key = site, name, spec, key
        try:
            self.prepare()
        except PhysicalError as error:
            raise site.test.error(str(error), key) from error

    @abstractmethod
    def prepare(self) -> None:
        """Compute once the data that the predictions for all states have in common."""

    labels: tuple[str, ...]
    blocks: tuple[str, ...]

    @abstractmethod
    def predict(self, view: View) -> np.ndarray:
        """Return the error-free readings, (S, D) for S states and D readings.

        PhysicalError is raised if the light of a state is lost.
        """

    def traced(self, view: View) -> np.ndarray:
        """Return what a trace determines of the readings, (S, Q) for S states: by default the readings themselves.

        PhysicalError is raised if the light of a state is lost.
        """
        return self.predict(view)

    @property
    def traced_count(self) -> int:
        """Number Q of traced quantities."""
        return len(self.labels)

    def reading_slope(self, traced: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Return the derivatives of D readings with respect to K parameters, (D, K).

        Parameters
        ----------
        traced : (Q,) ndarray
            Traced quantities of the state.
        slope : (Q, K) ndarray
            Their derivatives.
        """
        return slope

    def about(self, values: np.ndarray) -> MeasuredKind:
        """Return the measurement with the D readings that were made, (D,), on which its predictions may depend."""
        return self

    def expecting(self, view: View) -> MeasuredKind | None:
        """Return the measurement with the noise that is expected in a state; None if its noise is known beforehand."""
        return None

    def mirrored(self, traced: np.ndarray) -> np.ndarray | None:
        """Return other traced quantities, (Q,), whose readings are nearly the same; None if there are none."""
        return None

    def covariance(self) -> np.ndarray:
        """Return the covariance of the random errors of the D readings, (D, D), in squared SI units.

        By default all have the same variance, without correlation. Independent errors of many readings may be given by
        their variances, (D,).
        """
        return np.asarray(self.spec.sigma**2 * np.eye(len(self.labels)))

    def biases(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the effect of each systematic error on the readings, and the standard deviations of these errors.

        A bias that the estimate treats as free has an infinite standard deviation in the estimate.

        Returns
        -------
        tuple of ndarray
            Effect of B systematic errors of unit size on D readings, (D, B); standard deviations for the estimate,
            (B,), and for simulated data, (B,).
        """
        return np.zeros((len(self.labels), 0)), np.zeros(0), np.zeros(0)

    @abstractmethod
    def read(self) -> np.ndarray:
        """Return the D measured readings, (D,), SI units; raise InputError if a file does not contain them."""

    def group(self, values: np.ndarray) -> MeasuredGroup:
        """Return the measurement as the estimate needs it, with its D readings, (D,), and their errors."""
        columns, sigmas, _ = self.biases()
        used = sigmas > 0.0
        return MeasuredGroup(
            self.name, self.kind, self.labels, values, self.covariance(), columns[:, used], sigmas[used], self.blocks
        )

    def measured(self, view: View, rng: np.random.Generator) -> np.ndarray:
        """Return simulated readings of an instrument in one state, (D,)."""
        return self.drawn(self.predict(view)[0], rng)

    def drawn(self, true: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return D readings, (D,), with simulated random errors and biases added to the true ones."""
        columns, _, typical = self.biases()
        noise = np.linalg.cholesky(self.covariance()) @ rng.standard_normal(len(true))
        return np.asarray(true + noise + columns @ (typical * rng.standard_normal(len(typical))))

    def file(self, key: str, value: str, description: str) -> Path:
        """Return the path of a file that the measurement names."""
        return Path(self.spec.file_at((key,), value, Path(self.site.test.source.file).parent, description))

    def pages(self, key: str, value: str) -> np.ndarray:
        """Return the images of a file, one for each of F fields, in the program's orientation, (F, R, C).

        Grey values are those of the file; NaN where they are saturated.
        """
        spec = self.spec
        path = self.file(key, value, "an image file with a page for each field")
        try:
            source = ImageFile.open(path, choose="")
            header = source.header
            pages = source.read({"image": Region(0, 0, header.rows, header.columns)})["image"]
            orientation = Orientation.named(spec.orientation)
        except (ImageError, MeasurementError) as error:
            raise self.wrong(str(error), key) from error
        if len(pages) != len(spec.fields):
            text = f"{len(pages)} pages in the file, {len(spec.fields)} fields in the test"
            raise self.wrong(text, key, "one page for each field, in their order", str(path))
        limit = header.full_scale if spec.saturation is None else spec.saturation
        linear = np.where(pages >= limit, np.nan, pages.astype(np.float64))
        return np.stack([orientation.values(page) for page in linear])

    def wrong(self, text: str, key: str, allowed: str | None = None, value: str | None = None) -> InputError:
        """Return an InputError whose position is a key of the measurement in the file."""
        return InputError(self.spec.issue(Problem(text, value, allowed), (key,)))


def field_text(field: tuple[float, float]) -> str:
    """Return a field point as text for tables."""
    return f"({field[0]:g}, {field[1]:g})"


def field_texts(fields: Sequence[tuple[float, float]]) -> tuple[str, ...]:
    """Return field points as different texts; those of a field that was measured several times are numbered."""
    texts = [field_text(field) for field in fields]
    return tuple(
        text if texts.count(text) == 1 else f"{text} no. {texts[: k + 1].count(text)}" for k, text in enumerate(texts)
    )


class WavefrontReadings(MeasuredKind):
    """Measured Zernike terms of wavefronts at field points, metres rms, orthonormal over the illuminated pupil."""

    kind = "wavefronts"
    shown = ("nm", 1e-9)

    def prepare(self) -> None:
        """Trace the beams and compute the matrices from optical paths to Zernike terms."""
        spec = self.spec
        self.beams = self.site.beams(spec.fields)
        terms = spec.numbers
        self.rows = self.beams.zernike_rows(terms[-1])[:, terms[0] - 1 :]
        self.labels = tuple(f"{text} Z{j}" for text in field_texts(spec.fields) for j in terms)
        self.blocks = tuple(f"field {text}" for text in field_texts(spec.fields) for _ in terms)

    def predict(self, view: View) -> np.ndarray:
        """Return the Zernike terms of every state, field after field, metres rms."""
        paths = self.beams.light(view.states).paths
        return np.asarray(np.einsum("ftn,sfn->sft", self.rows, paths).reshape(len(view.states), -1))

    def biases(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the effects of an unknown focus at each field, and of a reference error of each Zernike term.

        The focus is that of the interferometer.

        The reference error is common to all fields. The effects come with their sigmas for estimate and simulation.
        """
        fields, terms, _ = self.rows.shape
        columns, sigmas, typical = [], [], []
        free = self.spec.focus == specs.FREE
        if free or self.spec.focus > 0.0:
            shift = np.einsum("ftn,fn->ft", self.rows, self.beams.defocus)
            for f in range(fields):
                column = np.zeros((fields, terms))
                column[f] = shift[f]
                columns.append(column.ravel())
            sigmas += [np.inf if free else self.spec.focus] * fields
            typical += [UNKNOWN_FOCUS if free else self.spec.focus] * fields
        if self.spec.common > 0.0:
            columns += list(np.tile(np.eye(terms), (1, fields)))
            sigmas += [self.spec.common] * terms
            typical += [self.spec.common] * terms
        table = np.stack(columns, axis=-1) if columns else np.zeros((len(self.labels), 0))
        return table, np.array(sigmas), np.array(typical)

    def read(self) -> np.ndarray:
        """Return the Zernike terms in the measurement's files, metres rms, in the program's orientation."""
        return np.asarray(read_coefficients(self).ravel())


class FocusReadings(MeasuredKind):
    """Measured best focus at field points, metres downstream of the line CCD."""

    kind = "focus"
    shown = ("um", 1e-6)

    def prepare(self) -> None:
        """Trace the beams and compute the linear map from optical paths to the best focus of each field."""
        self.fields = self.spec.fields if self.spec.fields is not None else self._from_file[0]
        self.beams = self.site.beams(self.fields)
        self.rows = self.beams.focus_rows()
        self.labels = field_texts(self.fields)
        self.blocks = tuple(f"field {text}" for text in self.labels)

    def predict(self, view: View) -> np.ndarray:
        """Return the best focus of each field in every state, metres downstream of the line CCD."""
        paths = self.beams.light(view.states).paths
        return np.asarray(np.einsum("fn,sfn->sf", self.rows, paths))

    def covariance(self) -> np.ndarray:
        """Return the covariance of the foci: independent errors, and one error common to all fields."""
        return super().covariance() + self.spec.common**2

    def read(self) -> np.ndarray:
        """Return the best foci in the test's file, or in focus.json, metres."""
        return np.array(self.spec.values if self.spec.values is not None else self._from_file[1])

    @cached_property
    def _from_file(self) -> tuple[tuple[tuple[float, float], ...], tuple[float, ...]]:
        path = self.file("file", self.spec.file, "a focus.json")
        data = read_json(self, path)
        try:
            # defocus of the chips of the first band, positive downstream of best focus, after the last round of shims
            sites = (data["rounds"][-1] if data.get("rounds") else data["initial"])["sites"]
            first_band = [site for site in sites if site["band"] == sites[0]["band"]]
            fields = tuple((float(site["field"]), 0.0) for site in first_band)
            return fields, tuple(-1e-6 * float(site["defocus_um"]) for site in first_band)
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise self.wrong(
                f"it holds no best foci ({error!r})", "file", "the focus.json of a run of twin.lab focus", str(path)
            ) from error


class DistortionReadings(MeasuredKind):
    """Measured image positions along the line for known field angles, metres."""

    kind = "distortion"
    shown = ("um", 1e-6)

    def prepare(self) -> None:
        """Read the angles and compute the positions at which the nominal camera images them."""
        site = self.site
        self.axes = site.experiment.instrument.camera_axes(site.camera)
        self.number = list(site.experiment.instrument.cameras).index(site.camera)
        self.line = site.line
        nominal = self._tangents([{}])[0]
        if self.spec.file is None:
            half = self.line[-1]
            self.tangents = np.interp(np.array(self.spec.fields) * half, self.line, nominal)
            self.sigmas = np.full(len(self.tangents), self.spec.sigma)
        else:
            angles, self.values, sigmas = self._from_file
            self.tangents = np.tan(angles)
            self.sigmas = sigmas if self.spec.sigma is None else np.full(len(angles), self.spec.sigma)
            if np.max(np.abs(self.tangents)) > 1.02 * np.max(np.abs(nominal)):
                raise self.wrong(
                    "angles beyond the camera's field",
                    "file",
                    f"at most {np.degrees(np.arctan(np.max(np.abs(nominal)))):.3f} deg",
                    f"{np.degrees(np.max(np.abs(angles))):.3f} deg",
                )
        self.labels = tuple(f"{np.degrees(np.arctan(t)):+.4f} deg" for t in self.tangents)
        self.blocks = tuple(f"angle {text}" for text in self.labels)
        self.focal = float(np.sum(self.line * nominal) / np.sum(nominal**2))

    def _tangents(self, states: Sequence[State]) -> np.ndarray:
        sight = self.site.experiment.sight.trace(states)[self.number]
        return line_tangents(sight, self.line, self.axes)[2]

    def predict(self, view: View) -> np.ndarray:
        """Return the image positions along the line, metres, by a polynomial through traced points of the line."""
        tangents = self._tangents(view.states)
        size = np.max(np.abs(tangents), axis=1, keepdims=True)
        table = (tangents / size)[..., None] ** np.arange(1, _LINE_DEGREE + 1)
        terms = np.linalg.pinv(table) @ self.line[None, :, None]
        asked = (self.tangents / size)[..., None] ** np.arange(1, _LINE_DEGREE + 1)
        return np.asarray(np.squeeze(asked @ terms, -1))

    def covariance(self) -> np.ndarray:
        """Return the covariance of the image positions: an independent variance for each."""
        return np.diag(self.sigmas**2)

    def biases(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the effect on the positions of an unknown zero of the angles, which the estimate treats as free."""
        return (self.focal * (1.0 + self.tangents**2))[:, None], np.array([np.inf]), np.array([UNKNOWN_ZERO])

    def read(self) -> np.ndarray:
        """Return the image positions in the measurement's file, metres."""
        return np.array(self.values)

    @cached_property
    def _from_file(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        path = self.file("file", self.spec.file, "a distortion.json")
        data = read_json(self, path)
        try:
            table = data["points"]
            if isinstance(table, list):
                table = {name: [row[name] for row in table] for name in table[0]}
            columns = [table[name] for name in ("field_deg", "position_mm", "distortion_compensated_um_sigma")]
            angle, position, sigma = (np.array(column, dtype=np.float64) for column in columns)
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise self.wrong(
                f"it holds no image positions ({error!r})",
                "file",
                "the distortion.json of a run of twin.lab distortion",
                str(path),
            ) from error
        return np.radians(angle), 1e-3 * position, 1e-6 * sigma


class SpotReadings(MeasuredKind):
    """Measured positions of monitor spots relative to their nominal positions, pixels."""

    kind = "spots"
    shown = ("px", 1.0)

    def prepare(self) -> None:
        """Set up the light path of the monitor's beams and trace the nominal spots."""
        experiment = self.site.experiment
        if not experiment.monitored:
            raise InputError(
                self.spec.issue(
                    Problem("the instrument has no monitor", None, "an instrument with a monitor, such as gf7_pair"), ()
                )
            )
        self.path = experiment.path.coarse
        channels = self.path.channels
        self.labels = tuple(f"{c.camera} {c.name} {axis}" for c in channels for axis in ("row", "column"))
        self.blocks = tuple(f"{c.camera} {c.name}" for c in channels for _ in range(2))
        self.nominal = self._positions([{}])[0]

    def _positions(self, states: Sequence[State]) -> np.ndarray:
        return self.path.mean_spots(states).reshape(len(states), -1)

    def predict(self, view: View) -> np.ndarray:
        """Return the spot positions relative to the nominal ones, pixels: energy centroids, as means of traced rays."""
        return self._positions(view.states) - self.nominal

    def read(self) -> np.ndarray:
        """Return the spot positions in the file minus the nominal ones, pixels."""
        path = self.file("file", self.spec.file, "a CSV file, or the recovered.json of a run")
        spots = self._recovered(path) if path.suffix.lower() == ".json" else self._table(path)
        out = []
        for channel in self.path.channels:
            if (channel.camera, channel.name) not in spots:
                raise self.wrong(f"no spot {channel.name} of {channel.camera}", "file", value=str(path))
            out.append(np.array(spots[channel.camera, channel.name]))
        return np.concatenate(out) - self.nominal

    def _recovered(self, path: Path) -> dict[tuple[str, str], tuple[float, float]]:
        data = read_json(self, path)
        try:
            return {
                (camera, channel): (float(spot[self.spec.state]["row"]), float(spot[self.spec.state]["column"]))
                for camera, channels in data["spots"].items()
                for channel, spot in channels.items()
            }
        except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            raise self.wrong(
                f"it holds no spots ({error!r})", "file", "the recovered.json of twin.recover or twin.render", str(path)
            ) from error

    def _table(self, path: Path) -> dict[tuple[str, str], tuple[float, float]]:
        spots: dict[tuple[str, str], tuple[float, float]] = {}
        with path.open(newline="", encoding="utf-8-sig") as stream:
            rows = csv.DictReader(line for line in stream if not line.startswith("#"))
            for row in rows:
                try:
                    spots[row["camera"], row["channel"]] = (float(row["row_px"]), float(row["column_px"]))
                except (KeyError, TypeError, ValueError) as error:
                    raise self.wrong(
                        f"line {rows.line_num}: {','.join(map(str, row.values()))} is not camera, channel and position"
                        f" of a spot ({error!r})",
                        "file",
                        "columns camera, channel, row_px, column_px; positions are numbers",
                        str(path),
                    ) from error
        return spots


class SightReadings(MeasuredKind):
    """Measured rotations of the line of sight, radians, and change of the principal distance, metres."""

    kind = "sight"
    shown = ("", 1.0)

    def prepare(self) -> None:
        """Select the quantities (rotations, principal distance) that the file measures."""
        names = ("alpha", "beta", "gamma", "principal_distance")
        self.which = [names.index(name) for name in self.spec.measured]
        self.labels = self.blocks = self.spec.measured
        if self.spec.correlation is not None and np.linalg.eigvalsh(self.spec.correlation)[0] <= 0.0:
            raise self.wrong("the correlation matrix is singular", "correlation", "a positive definite matrix")

    def predict(self, view: View) -> np.ndarray:
        """Return the rotations (rad) and the change of principal distance (m) from exactly traced chief rays."""
        truth = self.site.experiment.sight.truth(list(view.states))
        return np.asarray(truth.vector(self.site.camera)[:, self.which])

    def covariance(self) -> np.ndarray:
        """Return the covariance of the measured changes, with the correlation specified in the file."""
        sigma = np.array([getattr(self.spec, f"sigma_{name}") for name in self.spec.measured])
        rows = self.spec.correlation
        return np.asarray(np.diag(sigma**2) if rows is None else np.array(rows) * np.outer(sigma, sigma))

    def read(self) -> np.ndarray:
        """Return the rotations (rad) and the change of principal distance (m) in the test's file."""
        return np.array([getattr(self.spec, name) for name in self.spec.measured])


class TemperatureReadings(MeasuredKind):
    """Measured temperatures of bodies above nominal, kelvin."""

    kind = "temperatures"
    shown = ("K", 1.0)

    def prepare(self) -> None:
        """Resolve the names of the bodies in the file to their full paths."""
        self.bodies = named_bodies(self)
        self.labels = self.blocks = self.bodies

    def predict(self, view: View) -> np.ndarray:
        """Return the temperatures of the bodies above nominal in each state, kelvin."""
        return np.asarray(view.temperatures_of(self.bodies))

    def covariance(self) -> np.ndarray:
        """Return the covariance of the temperatures: independent errors, and one error common to all readings."""
        return super().covariance() + self.spec.common**2

    def read(self) -> np.ndarray:
        """Return the temperatures in the test's file above nominal, kelvin."""
        return np.array(self.spec.values)


class PositionReadings(MeasuredKind):
    """Measured displacements of bodies' origins in the axes of the base, metres."""

    kind = "positions"
    shown = ("um", 1e-6)

    def prepare(self) -> None:
        """Compute the nominal positions of the bodies."""
        self.bodies = named_bodies(self)
        self.labels = tuple(f"{body} {axis}" for body in self.bodies for axis in "xyz")
        self.blocks = tuple(body for body in self.bodies for _ in range(3))
        self.nominal = self._positions([{}])[0]

    def _positions(self, states: Sequence[State]) -> np.ndarray:
        placed = self.site.experiment.instrument.assembly.place(states)
        root = placed.index[self.bodies[0].split("/")[0]]
        offset = np.stack([placed.translation[:, placed.index[body]] for body in self.bodies], axis=1)
        offset = offset - placed.translation[:, root, None]
        return np.asarray(np.einsum("sji,sbj->sbi", placed.rotation[:, root], offset).real)

    def predict(self, view: View) -> np.ndarray:
        """Return the displacements of the bodies' origins from the drawing in each state, metres."""
        return np.asarray((self._positions(view.states) - self.nominal).reshape(len(view.states), -1))

    def biases(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the effect on the readings of an unknown shift and rotation of the measuring machine's frame."""
        if self.spec.frame != specs.FREE:
            return super().biases()
        shifts = np.tile(np.eye(3), (len(self.bodies), 1))
        rotations = np.stack([np.cross(axis, self.nominal).ravel() for axis in np.eye(3)], axis=-1)
        columns = np.concatenate([shifts, rotations], axis=1)
        return columns, np.full(6, np.inf), np.full(6, UNKNOWN_FRAME)

    def read(self) -> np.ndarray:
        """Return the displacements in the test's file, metres."""
        return np.array(self.spec.values).ravel()


def named_bodies(measurement: MeasuredKind) -> tuple[str, ...]:
    """Return the full paths of a measurement's bodies; raise InputError if a name is unknown or ambiguous."""
    nodes = measurement.site.experiment.instrument.nodes
    out = []
    for k, name in enumerate(measurement.spec.bodies):
        try:
            out.append(find_node(name, nodes))
        except Problem as problem:
            raise InputError(measurement.spec.issue(problem, ("bodies", k))) from None
    return tuple(out)


def read_json(measurement: MeasuredKind, path: Path) -> Any:
    """Return the contents of a JSON file; raise InputError if it is not a JSON file."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise measurement.wrong(f"not a JSON file ({error})", "file", value=str(path)) from error
