"""Images of a random texture that is known exactly at every place: a sum of sinusoids below the sampling limit."""

import numpy as np


class Texture:
    """Grey values in electrons; places in pixels. Amplitudes fall as frequency^-slope, contrast is their rms."""

    def __init__(self, seed, *, waves=700, top=0.45, slope=1.0, contrast=120.0, mean=800.0):
        rng = np.random.default_rng(seed)
        angle = rng.uniform(0.0, 2.0 * np.pi, waves)
        self.frequency = top * np.sqrt(rng.random(waves))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self.phase = rng.uniform(0.0, 2.0 * np.pi, waves)
        self.mean = mean
        self.amplitude = (np.hypot(*self.frequency.T) + 0.02) ** -slope
        self.amplitude *= contrast / np.sqrt(0.5 * np.sum((self.amplitude * self.mtf((0.25, 0.25))) ** 2))

    def mtf(self, sharp):
        """Square pixels and Gaussian optics with a share `sharp` (rows, columns) left at 0.5 cycles a pixel."""
        row, column = self.frequency.T
        return np.sinc(row) * np.sinc(column) * sharp[0] ** (4 * row**2) * sharp[1] ** (4 * column**2)

    def grid(
        self, rows, columns, *, matrix=((1.0, 0.0), (0.0, 1.0)), shift=(0.0, 0.0), sharp=(0.25, 0.25), order=(0, 0)
    ):
        """(k, l) at matrix @ (row, column) + shift for all rows (k,) and columns (l,), or its derivatives by place."""
        wave = 2.0 * np.pi * self.frequency @ np.asarray(matrix)
        start = self.phase + 2.0 * np.pi * self.frequency @ np.asarray(shift)
        weight = self.amplitude * self.mtf(sharp) * np.exp(1j * start)
        weight = weight * (1j * wave[:, 0]) ** order[0] * (1j * wave[:, 1]) ** order[1]
        down, across = np.exp(1j * np.outer(rows, wave[:, 0])), np.exp(1j * np.outer(columns, wave[:, 1]))
        return (self.mean if order == (0, 0) else 0.0) + ((down * weight) @ across.T).real

    def patches(self, places, half=15, **options):
        """(n, 2 half + 1, 2 half + 1) about places (n, 2)."""
        offset = np.arange(-half, half + 1)
        return np.array([self.grid(row + offset, column + offset, **options) for row, column in places])


def detected(electrons, seed, read=20.0):
    """uint16 frame with shot noise, read noise and rounding; 1 DN is one electron."""
    rng = np.random.default_rng(seed)
    return (
        np.rint(rng.poisson(electrons) + read * rng.standard_normal(electrons.shape)).clip(0, 65535).astype(np.uint16)
    )


def lattice(side, step, first, seed):
    """(side^2, 2) places on a grid, each off a whole pixel by up to a half along both axes."""
    row, column = (first + step * x.ravel() for x in np.mgrid[:side, :side])
    return np.stack([row, column], axis=1) + np.random.default_rng(seed).uniform(-0.5, 0.5, (side**2, 2))
