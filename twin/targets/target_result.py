"""What the images of test targets gave: frames, measured MTF and the truth beside it; the contract of mtf.json."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.mtf.bar_mtf import BarMtf
from analysis.mtf.slanted_edge import EdgeMtf
from twin.run.data_files import FrameFacts

NYQUIST = 0.5
"""Of any pixel, cycles/pixel."""


@dataclass(frozen=True, eq=False)
class EdgeReading:
    """MTF from one knife edge.

    Attributes:
        measured: from the frames, None if they cannot be measured.
        reason: why not.
        frequency: (F,) along the edge's normal, cycles/m.
        true: (F,) MTF of the traced pupil and the detector there.
        true_nyquist: the same at the Nyquist frequency.
        normal: of the edge on the image, (along, track), unit.
        true_axis: what ``true_nyquist`` would be without the edge's tilt, at the Nyquist frequency along the line or
            along the track: that of image quality at this place.
    """

    measured: EdgeMtf | None
    reason: str
    frequency: np.ndarray
    true: np.ndarray
    true_nyquist: float
    normal: tuple[float, float]
    true_axis: float

    @property
    def at_nyquist(self) -> tuple[float, float]:
        """Frequency of what is called the MTF at Nyquist, (along, track), cycles/pixel."""
        return NYQUIST * self.normal[0], NYQUIST * self.normal[1]

    @property
    def nyquist(self) -> tuple[float, float] | None:
        """Measured MTF at the Nyquist frequency, and its sigma."""
        return None if self.measured is None else self.measured.at(NYQUIST)

    @property
    def nyquist_bias(self) -> float | None:
        """How much noise lengthens the measured MTF at the Nyquist frequency on the average."""
        edge = self.measured
        return None if edge is None else float(np.interp(NYQUIST, edge.frequency, edge.noise_bias))


@dataclass(frozen=True, eq=False)
class BarReading:
    """MTF from one bar target near the Nyquist frequency.

    Attributes:
        measured: from the frames, None if they cannot be measured.
        reason: why not.
        true_nyquist: MTF of the traced pupil and the detector at the bars' frequency.
        at_nyquist: that frequency, (along, track), cycles/pixel.
        true_axis: what ``true_nyquist`` would be without the bars' tilt, as of ``EdgeReading``.
    """

    measured: BarMtf | None
    reason: str
    true_nyquist: float
    at_nyquist: tuple[float, float]
    true_axis: float

    @property
    def reading(self) -> tuple[float, float] | None:
        """Measured MTF and its sigma."""
        return None if self.measured is None else (self.measured.mtf, self.measured.sigma)


@dataclass(frozen=True, eq=False)
class TargetShots:
    """All targets at one place in one state.

    Attributes:
        frames: name of the image -> grey values, uint16 (N, H, W).
        column: of the windows' first pixels on the line.
        edges, bars: direction -> reading; empty if not rendered.
        light_lost: share of the light that bodies in the beam take.
    """

    frames: Mapping[str, np.ndarray]
    column: int
    edges: Mapping[str, EdgeReading]
    bars: Mapping[str, BarReading]
    light_lost: float


@dataclass(frozen=True, eq=False)
class PlaceTargets:
    """Before and after at one place of a line.

    Attributes:
        place: nominal (along, across) on the focal plane, metres.
        shift: true move of the image of a fixed direction on the focal plane, (along, across), metres.
        before, after: the images.
    """

    place: np.ndarray
    shift: np.ndarray
    before: TargetShots
    after: TargetShots

    @property
    def shots(self) -> dict[str, TargetShots]:
        """By their names in files and results."""
        return {"before": self.before, "after": self.after}


@dataclass(frozen=True, eq=False)
class CameraTargets:
    """One camera.

    Attributes:
        band: name of the line CCD's band.
        pitch: of its pixels, metres.
        places: left, centre, right.
    """

    band: str
    pitch: float
    places: Mapping[str, PlaceTargets]


@dataclass(frozen=True, eq=False)
class TargetRun:
    """All cameras.

    Attributes:
        cameras: by name.
        frames: of each image.
        obstruction: whether what stands in the beams is missing in the pupils.
    """

    cameras: Mapping[str, CameraTargets]
    frames: int
    obstruction: bool = True

    def images(self) -> Iterator[tuple[str, str, np.ndarray, FrameFacts]]:
        """Of every image the stem of its file, its name, the frames (N, H, W) and what is known of them."""
        for camera, found in self.cameras.items():
            for place, targets in found.places.items():
                for when, shots in targets.shots.items():
                    for name, frames in shots.frames.items():
                        facts = FrameFacts(
                            f"{camera}, line CCD {found.band}", found.pitch, note=f"{name}, {place}, {when}"
                        )
                        yield f"{camera}_{place}_{name}_{when}", name, frames, facts

    @property
    def has_edges(self) -> bool:
        """Whether there are curves."""
        return any(place.before.edges for camera in self.cameras.values() for place in camera.places.values())

    @property
    def warnings(self) -> tuple[str, ...]:
        """What could not be measured, and why."""
        out = []
        for camera, found in self.cameras.items():
            for place, targets in found.places.items():
                for when, shots in targets.shots.items():
                    kinds = (("knife edge", shots.edges), ("bars", shots.bars))
                    for what, readings in kinds:
                        for direction, reading in readings.items():
                            if reading.measured is None:
                                out.append(
                                    f"{what} ({direction}) at the {place} of {camera} {when}: no MTF at Nyquist, truly "
                                    f"{reading.true_nyquist:.3f}: {reading.reason}"
                                )
        return tuple(out)

    def to_dict(self) -> dict[str, Any]:
        """Contents of mtf.json. What could not be measured is null; ``truth`` has the shape of ``cameras``, and the MTF
        on the axes, which tilted edges and bars do not see, beside it.
        """
        cameras, truth = {}, {}
        for name, camera in self.cameras.items():
            places, true_places = {}, {}
            for place, targets in camera.places.items():
                along, across = (1e3 * targets.place + 0.0).tolist()
                columns = {when: shots.column for when, shots in targets.shots.items()}
                where = {"along_mm": along, "across_mm": across, "columns": columns}
                places[place] = {**where, **_directions(targets, _measured)}
                shift = dict(zip(("along", "across"), (1e6 * targets.shift + 0.0).tolist(), strict=True))
                lost = {when: shots.light_lost for when, shots in targets.shots.items()}
                true_places[place] = {"image_shift_um": shift, "light_lost": lost, **_directions(targets, _true)}
            cameras[name] = {
                "band": camera.band,
                "pixel_um": 1e6 * camera.pitch,
                "nyquist_per_mm": 1e-3 * NYQUIST / camera.pitch,
                "places": places,
            }
            truth[name] = {"places": true_places}
        about = {"frames": self.frames, "obstruction": "traced" if self.obstruction else "ignore"}
        return {**about, "cameras": cameras, "truth": {"cameras": truth}}


def _directions(targets: PlaceTargets, say: Any) -> dict[str, Any]:
    """Direction -> before/after -> what ``say`` makes of the readings."""
    out: dict[str, Any] = {}
    for when, shots in targets.shots.items():
        for direction in sorted({*shots.edges, *shots.bars}):
            out.setdefault(direction, {})[when] = say(shots.edges.get(direction), shots.bars.get(direction))
    return out


def _measured(edge: EdgeReading | None, bars: BarReading | None) -> dict[str, Any]:
    out: dict[str, Any] = {}
    if edge is not None:
        value, sigma = edge.nyquist or (None, None)
        found = edge.measured
        out |= {"mtf_nyquist": value, "mtf_nyquist_sigma": sigma, "mtf_nyquist_noise_bias": edge.nyquist_bias}
        out["curve"] = None if found is None else {**_curve(edge, found.mtf), "mtf_sigma": found.sigma.tolist()}
    if bars is not None:
        value, sigma = bars.reading or (None, None)
        out |= {"bars_mtf": value, "bars_mtf_sigma": sigma}
    return out


def _true(edge: EdgeReading | None, bars: BarReading | None) -> dict[str, Any]:
    out: dict[str, Any] = {}
    if edge is not None:
        out |= {"mtf_nyquist": edge.true_nyquist, "curve": _curve(edge, edge.true)}
        out |= {"mtf_nyquist_cycles_per_pixel": list(edge.at_nyquist), "mtf_nyquist_axis": edge.true_axis}
    if bars is not None:
        out |= {"bars_mtf": bars.true_nyquist, "bars_cycles_per_pixel": list(bars.at_nyquist)}
        out["mtf_nyquist_axis"] = bars.true_axis
    return out


def _curve(edge: EdgeReading, mtf: np.ndarray) -> dict[str, list[float]]:
    return {"frequency_per_mm": (1e-3 * edge.frequency).tolist(), "mtf": mtf.tolist()}
