"""Frames of one spot with whatever real frames hold beside it, made from a calibrated shape and a data sheet.

Everything is drawn from a seed: where the spot stands, by how much it moves, and the dirt. The truth is the shift.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from analysis.spots.screened_fit import single_template
from scenes.specs.monitor_frames import MeasurementSpec
from twin.recover.channel_measurement import ChannelMeasurement
from twin.recover.measured_frames import ChannelFrames, StateFrames
from twin.sensors.area_detector import EmvaDetector

FRAMES = 9
PHOTONS = 4.0e6
EXPOSURE = 0.01


@dataclass
class Scene:
    """One state of one spot before it is recorded; all that dirt may change.

    Attributes:
        place: row and column, px.
        light: photons of the spot in every frame, (N,).
        offsets: (N, 2) px of the spot in every frame.
        smear: (2, 2) px^2 within a frame.
        others: (row, column, share) of reflections.
        background: (N, H, W) photons, or what broadcasts to it.
        static: (H, W) electrons that are added to every frame, hot pixels.
        dead: (H, W) pixels without response.
        struck: (N, H, W) electrons that single frames get.
        lost: numbers of frames without light.
    """

    place: np.ndarray
    light: np.ndarray
    offsets: np.ndarray
    smear: np.ndarray
    others: list
    background: np.ndarray
    static: np.ndarray
    dead: np.ndarray
    struck: np.ndarray
    lost: list = field(default_factory=list)


def clean_scene(place, shape) -> Scene:
    zero = np.zeros(shape)
    return Scene(
        place=np.array(place, float), light=np.full(FRAMES, PHOTONS), offsets=np.zeros((FRAMES, 2)),
        smear=np.zeros((2, 2)), others=[], background=np.zeros((FRAMES, 1, 1)), static=zero.copy(),
        dead=np.zeros(shape, bool), struck=np.zeros((FRAMES, *shape)),
    )  # fmt: skip


def expected(scene: Scene, template) -> np.ndarray:
    """(N, H, W) photons. Smear by 5 x 5 nodes of a normal distribution."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(5)
    value, vector = np.linalg.eigh(scene.smear)
    root = vector * np.sqrt(np.maximum(value, 0.0))
    out = np.zeros((FRAMES, *template.shape)) + scene.background
    for dr, dc, share in [(0.0, 0.0, 1.0), *((r - scene.place[0], c - scene.place[1], s) for r, c, s in scene.others)]:
        for k in range(FRAMES):
            centre = scene.place + scene.offsets[k] + (dr, dc)
            image = 0.0
            for x, wx in zip(nodes, weights, strict=True):
                for y, wy in zip(nodes, weights, strict=True):
                    if (x or y) and not np.any(root):
                        continue
                    w = 1.0 if not np.any(root) else wx * wy / (2.0 * np.pi)
                    d = root @ (x, y)
                    image = image + w * template.evaluate(centre[0] + d[0], centre[1] + d[1])[0][0]
            out[k] += share * scene.light[k] * image
    out[scene.lost] = 0.0
    return np.maximum(out, 0.0)


def record(scene: Scene, template, detector: EmvaDetector, pattern, rng) -> np.ndarray:
    """(N, H, W) uint16; the signal chain of the detector with the dirt's electrons."""
    photons = expected(scene, template)
    gain = np.where(scene.dead, 0.0, pattern.gain)
    mean = photons * gain * detector.quantum_efficiency + detector.dark_current_e_per_s * EXPOSURE + scene.static
    electrons = rng.poisson(mean) + scene.struck
    electrons = np.minimum(electrons, detector.full_well_e)
    level = electrons + detector.dark_noise_e * rng.standard_normal(electrons.shape) + pattern.offset_e
    level = detector.system_gain_dn_per_e * level + detector.offset_dn
    return np.clip(np.rint(level), 0, detector.max_dn).astype(np.uint16)


def hot_pixels(scenes, rng, shape):
    """Hot ones by a log-uniform rate, dead ones, one column without response and one with an offset; in both states."""
    for _ in range(12):
        at = tuple(rng.integers(0, n) for n in shape)
        rate = 10 ** rng.uniform(2.7, 4.7)
        for scene in scenes:
            scene.static[at] += rate
    for _ in range(6):
        at = tuple(rng.integers(0, n) for n in shape)
        for scene in scenes:
            scene.dead[at] = True
    dead, bright = rng.integers(0, shape[1], 2)
    for scene in scenes:
        scene.dead[:, dead] = True
        scene.static[:, bright] += 60.0
    # damage between both states
    scenes[1].static[tuple(rng.integers(0, n) for n in shape)] += 5e3


def cosmic_rays(scenes, rng, shape):
    """Four tracks in the frames of a state, of one to ten pixels."""
    for scene in scenes:
        for _ in range(4):
            frame, length = rng.integers(FRAMES), rng.integers(1, 11)
            at, step = rng.uniform(0, shape[0], 2), rng.normal(size=2)
            step /= np.hypot(*step)
            charge = 10 ** rng.uniform(2.5, 4.5)
            for k in range(length):
                r, c = np.rint(at + k * step).astype(int)
                if 0 <= r < shape[0] and 0 <= c < shape[1]:
                    scene.struck[frame, r, c] += charge * rng.uniform(0.5, 1.5)


def background(scenes, rng, shape):
    """A level that drifts over the frames and has slopes and a bend, another one in each state."""
    v, u = np.meshgrid(np.linspace(-1, 1, shape[0]), np.linspace(-1, 1, shape[1]), indexing="ij")
    for scene in scenes:
        a, b, c = rng.uniform(-150, 150, 3)
        field_ = 500.0 + a * u + b * v + 0.5 * abs(c) * (u * u + v * v)
        scene.background = scene.background + field_ + np.linspace(0, rng.uniform(-100, 300), FRAMES)[:, None, None]


def other_light(scenes, rng, shape):
    """After with 0.3 to 1.5 times the light, which also flickers."""
    scenes[1].light *= rng.uniform(0.3, 1.5) * (1.0 + 0.03 * rng.standard_normal(FRAMES))


def saturation(scenes, rng, shape):
    """After with so much light that the middle of the spot is at the full well."""
    scenes[1].light *= rng.uniform(2.15, 2.6)


def reflection(scenes, rng, shape):
    """A second spot of 0.3 to 5 % at 8 to 22 pixels, another one in each state."""
    for scene in scenes:
        away, turn, share = rng.uniform(8, 22), rng.uniform(0, 2 * np.pi), 10 ** rng.uniform(-2.5, -1.3)
        scene.others.append((scene.place[0] + away * np.cos(turn), scene.place[1] + away * np.sin(turn), share))


def vibration(scenes, rng, shape):
    """Smear of 0.3 to 1.2 px rms along one direction."""
    for scene in scenes:
        turn, size = rng.uniform(0, np.pi), rng.uniform(0.3, 1.2)
        way = np.array([np.cos(turn), np.sin(turn)])
        scene.smear = size**2 * np.outer(way, way)


def movement(scenes, rng, shape):
    """The spot moves from frame to frame by 0.02 to 0.3 px rms."""
    for scene in scenes:
        scene.offsets = rng.uniform(0.02, 0.3) * rng.standard_normal((FRAMES, 2))


def missing_frames(scenes, rng, shape):
    """One or two frames of each state without light."""
    for scene in scenes:
        scene.lost = list(rng.choice(FRAMES, rng.integers(1, 3), replace=False))


KINDS: Mapping[str, Callable] = {
    "bad pixels": hot_pixels,
    "cosmic rays": cosmic_rays,
    "background": background,
    "other light": other_light,
    "saturation": saturation,
    "reflection": reflection,
    "vibration": vibration,
    "movement": movement,
    "missing frames": missing_frames,
}


@dataclass
class Drawn:
    """Frames before and after, and the true shift."""

    before: np.ndarray
    after: np.ndarray
    shift: np.ndarray


def draw(template, detector: EmvaDetector, kinds, seed: int) -> Drawn:
    """One set of frames with dirt of these kinds.

    Args:
        template: one calibrated shape.
        detector: by its data sheet.
        kinds: names of KINDS.
        seed: of everything.
    """
    rng = np.random.default_rng(seed)
    shape = template.shape
    middle = (np.array(shape) - 1) / 2.0
    first = middle + rng.uniform(-6, 6, 2)
    shift = rng.uniform(-8, 8, 2)
    scenes = [clean_scene(first, shape), clean_scene(first + shift, shape)]
    for kind in kinds:
        KINDS[kind](scenes, rng, shape)
    pattern = detector.fixed_pattern(shape, int(rng.integers(1 << 31)))
    before, after = (record(scene, template, detector, pattern, rng) for scene in scenes)
    return Drawn(before, after, shift)


def measurement(drawn, template, noise, vibration_fitted=False, shape="template", **changes) -> ChannelMeasurement:
    """The search of one set of frames.

    Args:
        drawn: the frames.
        template: one calibrated shape.
        noise: of the detector.
        vibration_fitted: as a measurement's file says.
        shape: of the spot in place of the template; None to learn it.
        changes: of the measurement.
    """
    spec = MeasurementSpec.model_construct(
        instrument="x", frames={}, vibration="fitted" if vibration_fitted else "none", **changes
    )
    states = [
        StateFrames((f"{name}.tiff",), frames, (0, 0), ("frames", "forward/left", name))
        for name, frames in (("before", drawn.before), ("after", drawn.after))
    ]
    frames = ChannelFrames("forward/left", template.shape, states[0], (states[1],), None, None, None, noise, noise)
    return ChannelMeasurement(spec, frames, template if isinstance(shape, str) else shape)


__all__ = ["KINDS", "Drawn", "draw", "measurement", "replace", "single_template"]
