"""Memory of a monitor's images and their measurement, estimated before anything is rendered.

Each pixel of a spot, each traced ray and each recorded frame takes a fixed number of bytes. How many there are follows
from the instrument alone; of its optics only the aperture of the returned beam matters: with it and with the square of
the CCD's diagonal grows the number of pupil nodes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from optics.numerics.backend import cores
from scenes.specs.course import FEWEST
from scenes.specs.detector import LEAST_SIDE
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.errors import KeyPath
from scenes.yaml.spec import Spec
from twin.framework import memory
from twin.framework.frame_store import IN_MEMORY, resident_bytes
from twin.framework.memory import STARTED, Lowered, amount_text
from twin.monitor.image_sampling import NodeClasses
from twin.sensors.area_detector import EmvaDetector

CHUNK = 25
"""Largest number of states rendered at once, to limit memory; fewer if their frames are large."""
LARGEST_FRAMES = 200_000_000
"""Largest number of pixels of all frames that are exposed at once."""


def largest_piece(each: int) -> int:
    """Return how many states of a series may be rendered at once without exceeding the memory limit.

    Parameters
    ----------
    each : int
        Pixels of all frames of one state.
    """
    return max(1, min(CHUNK, LARGEST_FRAMES // each))


def pieces(count: int, each: int) -> Iterator[slice]:
    """Yield slices of the states of a series; the frames of one slice are processed at once.

    Parameters
    ----------
    count : int
        Number of states.
    each : int
        Pixels of all frames of one state.
    """
    size = largest_piece(each)
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))


DRAWN = 410e6
"""Memory for drawing figures and writing files of a job, in bytes; for small jobs it is most of the memory."""
_PIXEL = 380.0
"""Bytes per pixel of a spot's image during the measurement and the analysis of its limits: photons 24, fixed pattern
16, mean frames and maps of the fits before and after 64, images and maps of a state of the prior 85, the current fit
190.
"""
_RAY = 600.0
"""Bytes per traced ray, including its derivatives, aim parameters and Zernike polynomials at its pupil node."""
GREY = 2.0
"""Bytes per pixel of a recorded frame."""
_OF_COURSE = 6.0
"""Bytes per pixel and time of a time series of states: single-precision photons and a first frame."""
WRITTEN = 60.0
"""Bytes per pixel of a spot's image for drawing and writing: photons, their file, and means over frames."""
_OF_STATE = 24.0
"""Bytes per pixel of each state rendered at once: its photons, and the effect of their noise on the spot's position."""


@dataclass(frozen=True)
class MonitorSize:
    """Numbers that determine the memory of a monitor's job.

    Attributes
    ----------
    spots : int
        Number of channels (one spot each) of all cameras.
    rows, columns : int
        Size of an area CCD, in pixels.
    phase : float
        Phase difference between the centre and the edge of the pupil for a point one pixel off the spot, in radians per
        pixel.
    frames : int
        Number of frames of each state.
    times : int
        Number of times of a time series of states, 0 if there is none.
    pictures : int
        Number of pixels of the frames of all other images.
    """

    spots: int
    rows: int
    columns: int
    phase: float
    frames: int = 1
    times: int = 0
    pictures: int = 0

    @classmethod
    def of_job(cls, resolved: ResolvedJob, frames: int, times: int = 0, pictures: int = 0) -> MonitorSize:
        """Return the size that an instrument's files specify, before the instrument is built.

        Parameters
        ----------
        resolved : ResolvedJob
            Job.
        frames : int
            Number of frames of each state.
        times : int
            Number of times of a time series of states, 0 if there is none.
        pictures : int
            Number of pixels of the frames of all other images.

        Raises
        ------
        InputError
            The instrument has no monitor.
        """
        monitor, ccd = resolved.instrument.autocollimator, resolved.instrument.autocollimator.area_ccd
        focal_length = min(camera.focal_length for camera in resolved.cameras.values())
        # of a beam that fills its aperture
        phase = math.pi * monitor.return_face.aperture / focal_length * ccd.pitch / monitor.wavelength
        spots = sum(len(resolved.instrument.channels_of(name)) for name in resolved.instrument.cameras)
        return cls(spots, ccd.rows, ccd.columns, phase, frames, times, pictures)

    @property
    def rays(self) -> int:
        """Number of traced rays that sharp spots of all channels need, wherever they are on their CCDs."""
        return self.spots * NodeClasses(self.phase, (0.5 * self.rows, 0.5 * self.columns)).sharp_count

    def parts(self, detector: EmvaDetector) -> Mapping[str, float]:
        """Return name of a part of the job -> its memory in bytes: CCDs, frames, times and other pictures.

        Parameters
        ----------
        detector : EmvaDetector
            Model of the area CCDs.
        """
        image = self.rows * self.columns
        pixels, frames = self.spots * image, self.frames
        states = min(self.times, largest_piece(pixels * frames)) if self.times else 1
        threads = min(cores(), 8, self.spots * states)  # that expose images
        return {
            "ccd": pixels * (_PIXEL + (states - 1) * _OF_STATE) + self.rays * _RAY,
            "frames": resident_bytes(pixels * frames * GREY)
            + resident_bytes(states * pixels * frames * GREY)
            + detector.exposing_bytes(frames, image, threads),
            "times": self.times * pixels * _OF_COURSE,
            "pictures": self.pictures * GREY,
        }

    def bytes(self, detector: EmvaDetector) -> float:
        """Return the memory of all parts, in bytes, in addition to the imported program.

        Parameters
        ----------
        detector : EmvaDetector
            Model of the area CCDs.
        """
        parts = self.parts(detector)
        pixels = self.spots * self.rows * self.columns
        stack = pixels * self.frames * GREY
        written = pixels * WRITTEN + 2.0 * resident_bytes(stack)
        written += stack / self.spots if stack <= IN_MEMORY else resident_bytes(stack)
        return max(STARTED + sum(parts.values()), DRAWN + written + parts["times"] + parts["pictures"])


def require_memory(resolved: ResolvedJob, size: MonitorSize, detector: EmvaDetector) -> None:
    """Raise InputError if a job does not fit into the free memory.

    Parameters
    ----------
    resolved : ResolvedJob
        Job, with the numbers of its files.
    size : MonitorSize
        Size of the job.
    detector : EmvaDetector
        Model of its area CCDs.

    Raises
    ------
    InputError
        The job does not fit; the error is at the key that needs most memory, with the number that would fit.
    """
    parts = size.parts(detector)
    worst = max(parts, key=lambda name: parts[name])
    what, lower = _lowered(resolved, size, worst, detector)
    memory.require_memory(lower, started=0.0, shares=f"{amount_text(parts[worst])} of it {what}")


def _lowered(resolved: ResolvedJob, size: MonitorSize, part: str, detector: EmvaDetector) -> tuple[str, Lowered]:
    """Return a description of a part of the memory, and which number in the files must be lowered to reduce it."""
    job, rows, columns, frames = resolved.job, size.rows, size.columns, size.frames
    owner: Spec = job
    least = 1
    if part == "ccd":
        what, unit = f"for the images of area CCDs of {rows} x {columns} pixels", "rows and columns"
        owner, least, number = resolved.instrument, LEAST_SIDE, max(rows, columns)
        key: KeyPath = ("monitor", "area_ccd", "rows" if rows >= columns else "columns")
        each = {"rows": 1, "columns": 1}
    elif part == "times":
        assert job.course is not None
        what, unit, each = f"for {size.times} times of the course", "times", {"times": 1}
        owner, least, number, key = job.course, FEWEST, size.times, ("times",)
    elif part == "pictures":
        number, unit, key = resolved.targets.frames or frames, "frames", ("render", "targets", "frames")
        each, what = {"pictures": size.pictures // number}, f"for {number} frames of test targets"
    else:
        what, unit, number = f"for {frames} frames of area CCDs of {rows} x {columns} pixels", "frames", frames
        in_job, each = job.render.frames is not None, {"frames": 1}
        owner, key = (job if in_job else resolved.instrument), ("render" if in_job else "monitor", "frames")

    def needed(n: int) -> float:
        fewer = {name: min(getattr(size, name), n * count_per_unit) for name, count_per_unit in each.items()}
        return replace(size, **fewer).bytes(detector)

    return what, Lowered(owner, key, number, unit, needed, least)
