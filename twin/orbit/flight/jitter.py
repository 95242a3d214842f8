"""Jitter: small fast turns of a body about its own axes, by frequency.

It is a sum of sinusoids and is evaluated, never interpolated. The noise of a band consists of sinusoids, too: the band
is cut into equal parts, each has one frequency drawn evenly within it, and two normal amplitudes whose variance is the
level times the part's width. The motion is then Gaussian at every time with exactly the stated variance, its expected
spectrum is exactly the stated one, and it does not repeat. Over longer than the inverse width of a part, some seconds,
its spectrum shows as the lines that it consists of.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline

from twin.sensors.charge_transfer import Collection

if TYPE_CHECKING:
    from collections.abc import Callable

    from scenes.specs.orbit.flight import JitterSpec

JITTER_STREAM = 2**31
"""Number of the random stream of jitter among those of a pass; far from those that are counted."""
_RESOLVED = 10.0
"""Seconds over which the noise of a band is to be told from lines."""
_LEAST, _MOST = 64, 4096
"""Sinusoids of a band."""
_AT_ONCE = 4_000_000
"""Phases that are held at a time."""
_MOMENTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48)


@dataclass(frozen=True, eq=False)
class Jitter:
    """Turns of a body over time: the sum of sine and cosine terms, seen at once or in the mean of a collection.

    Attributes:
        frequency: (K,) hertz.
        sine, cosine: (K, 3) rotation vectors about body X, Y and Z, radians.
        collection: over which it is meant; None for its values themselves.
    """

    frequency: np.ndarray
    sine: np.ndarray
    cosine: np.ndarray
    collection: Collection | None = None

    @classmethod
    def of(cls, spec: JitterSpec, seed: np.random.SeedSequence) -> Jitter | None:
        """As a file states it; None where it states none.

        Args:
            spec: lines and bands.
            seed: of random phases and of bands. Each has a stream of its own.
        """
        if not spec.stated:
            return None
        streams = seed.spawn(len(spec.lines) + len(spec.bands))
        frequencies, sines, cosines = [], [], []
        for line, own in zip(spec.lines, streams[: len(spec.lines)], strict=True):
            drawn = np.random.default_rng(own).uniform(0.0, 2.0 * np.pi, 3)
            phase = drawn if line.phase is None else np.array(line.phase)
            frequencies.append(np.array([line.frequency]))
            sines.append((np.array(line.amplitude) * np.cos(phase))[None])
            cosines.append((np.array(line.amplitude) * np.sin(phase))[None])
        for band, own in zip(spec.bands, streams[len(spec.lines) :], strict=True):
            random, width = np.random.default_rng(own), band.last - band.first
            count = int(np.clip(np.ceil(_RESOLVED * width), _LEAST, _MOST))
            frequencies.append(band.first + width * (np.arange(count) + random.uniform(size=count)) / count)
            sigma = np.sqrt(np.array(band.level) * width / count)
            sines.append(sigma * random.standard_normal((count, 3)))
            cosines.append(sigma * random.standard_normal((count, 3)))
        return cls(np.concatenate(frequencies), np.concatenate(sines), np.concatenate(cosines))

    def __call__(self, seconds: np.ndarray) -> np.ndarray:
        """Rotation vectors in body axes at times (...), seconds: (..., 3), radians."""
        t = np.asarray(seconds, np.float64)
        # image lines are asked for at many pixels
        moments, where = np.unique(t, return_inverse=True)
        kept = 1.0 if self.collection is None else self.collection.mean(self.frequency)[:, None]
        sine, cosine = kept * self.sine, kept * self.cosine
        found = np.empty((len(moments), 3))
        size = max(_AT_ONCE // len(self.frequency), 1)
        for part in (slice(k, k + size) for k in range(0, len(moments), size)):
            angle = 2.0 * np.pi * (moments[part, None] * self.frequency)
            found[part] = np.sin(angle) @ sine + np.cos(angle) @ cosine
        return np.asarray(found[where.reshape(t.shape)])

    @property
    def amplitude(self) -> np.ndarray:
        """(K,) of each sinusoid, about all axes together, radians."""
        return np.sqrt(np.sum(self.sine**2 + self.cosine**2, axis=1))

    def later(self, seconds: float) -> Jitter:
        """The jitter whose value at a time is that of this one so much later."""
        angle = 2.0 * np.pi * self.frequency[:, None] * seconds
        sine = self.sine * np.cos(angle) - self.cosine * np.sin(angle)
        cosine = self.sine * np.sin(angle) + self.cosine * np.cos(angle)
        return replace(self, sine=sine, cosine=cosine)

    def over(self, collection: Collection) -> Jitter:
        """Its mean over a collection about each time: where the image of a TDI line lies."""
        return replace(self, collection=collection)

    def exposures(self, collection: Collection, pixel: float, tolerance: float) -> list[tuple[float, Jitter]]:
        """Shares of the light of a collection, and the jitter that each saw; their mean is the image.

        Args:
            collection: of the line.
            pixel: its angle, radians.
            tolerance: of the image's place and smear, pixels.

        Raises:
            ValueError: an oscillation so fast and large that no reasonable number of moments is enough.
        """
        own, size = replace(self, collection=None), self.amplitude / pixel
        exact = [collection.mean(k * self.frequency) for k in (1, 2)]
        for count in _MOMENTS:
            moments, weights = collection.moments(count)
            angle = 2.0 * np.pi * self.frequency[:, None] * moments
            # what is even in time is all there is: the rule is symmetric
            off = [np.abs(np.cos(k * angle) @ weights - w) for k, w in zip((1, 2), exact, strict=True)]
            # at Nyquist the second harmonic of an oscillation of A pixels weighs J_2(pi A), or (pi A)^2 / 8
            if np.sqrt(np.sum((size * off[0] + np.minimum(1.25 * size**2, size) * off[1]) ** 2)) <= tolerance:
                return [(float(w), own.later(float(s))) for s, w in zip(moments, weights, strict=True)]
        highest = float(np.max(self.frequency))
        raise ValueError(
            f"jitter of up to {highest:g} Hz and {float(np.max(size)):.3g} pixels within {collection.length:.3g} s of "
            "collection is too fast to be imaged moment by moment"
        )

    def read(self, times: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """As one knows it who reads it at some times (K,) only and joins the readings by a cubic spline: what is faster
        than half of the readings' rate is mistaken for something slower.
        """
        return CubicSpline(times, self(times))
