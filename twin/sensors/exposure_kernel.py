"""Recording of frames of many images by compiled kernels.

The result is the same as that of ``EmvaDetector`` pixel by pixel, but faster.

The frames are bit for bit those that NumPy would make from the same streams: a Poisson number is the quantile of its
mean (``twin.sensors.poisson_numbers``), and any number that a kernel cannot determine with certainty is computed there.
A first kernel looks up every number of a small mean in the table of quantiles, which determines nineteen of twenty,
computes those of larger means by Giles' expansion in single precision, and converts the electrons to grey values. A
second kernel determines the undetermined ones by the distribution function, interpolated between the table's rows. A
few of ten thousand numbers remain undetermined, within the error bounds of these approximations.

All frames of a pixel share its mean, so a kernel runs over the pixels of some images, frame after frame; then only
table values have to be gathered. Images with the same stream share their random numbers, which are drawn once.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from optics.numerics.backend import one_kernel_thread
from optics.numerics.llvm import ensure_llvm
from twin.framework.frame_store import release_memory
from twin.sensors import poisson_numbers

FEWEST = 50_000
"""Smallest number of random numbers of an exposure for which kernels are used.

For fewer, the transfer to the kernels takes as long as the work without them.
"""

_TOGETHER = 1 << 20
"""Count of random numbers that are drawn and read out at once.

Their words and normal numbers take 16 MiB, and as much again while the next ones are drawn.
"""

_MOST_KEPT = 1 << 22
"""Largest number of random numbers that are kept because several images share their stream; they take 64 MiB."""

_LANES = 16
"""Multiple to which the number of pixels is rounded up, so that each frame begins at an aligned memory address."""

_NORMAL_ERROR = 4e-6
"""Upper bound of the error of the normal quantile in single precision, for arguments up to 6."""

_SINGLE = 4e-7
"""Upper bound of the rounding error, in single precision, of a distribution function and of the uniform number u."""


@dataclass(frozen=True, eq=False)
class Reading:
    """Read-out of electrons to grey values: the numbers of the detector that it needs.

    Attributes
    ----------
    sigma_e : float
        Read noise, in electrons rms; for 0 no numbers are drawn.
    gain_dn_per_e : float
        Grey values per electron.
    full_well_e : float
        Electrons at which a pixel saturates.
    most_dn : int
        Largest grey value.
    """

    sigma_e: float
    gain_dn_per_e: float
    full_well_e: float
    most_dn: int

    def read_out(self, level: np.ndarray, noise: Sequence[np.ndarray], shift: np.ndarray) -> np.ndarray:
        """Return the grey values of electrons, written into their array.

        Parameters
        ----------
        level : ndarray
            Electrons, of any shape; overwritten.
        noise : sequence of ndarray
            Noise terms that are added in turn, in electrons.
        shift : ndarray
            Black level with the pixels' own offsets, in grey values.
        """
        np.minimum(level, self.full_well_e, out=level)
        for term in noise:
            level += term
        level *= self.gain_dn_per_e
        level += shift
        np.rint(level, out=level)
        return np.clip(level, 0, self.most_dn, out=level)

    def frames(
        self,
        expected: Callable[[int], tuple[np.ndarray, np.ndarray]],
        streams: Sequence[np.random.SeedSequence],
        out: np.ndarray,
        together: int,
        threads: int,
    ) -> None:
        """Record frames of images with compiled kernels.

        Dimensions: F frames.

        Parameters
        ----------
        expected : callable
            Function of the number of an image that returns its expected electrons, and the black level with the pixels'
            own offsets (grey values), P numbers each.
        streams : sequence of SeedSequence
            Random streams of the I images; each serves for 64-bit random words, for Poisson numbers of means above
            ``poisson_numbers.SERIES_END`` and for normal numbers. Some may be equal.
        out : (I, F, P) ndarray of uint16
            Frames to fill.
        together : int
            Number of frames of an image that are exposed at once.
        threads : int
            Number of threads that draw random numbers.
        """
        images, frames, pixels = out.shape
        together = min(together, frames)
        size = min(images, max(1, _TOGETHER // (together * pixels)))
        pieces = (images > size) + (frames > together)
        rooms = [_Numbers.room(together, size * pixels, self.sigma_e > 0) for _ in range(min(2, 1 + pieces))]
        same = {} if together < frames else _shared_numbers(streams, _MOST_KEPT // (frames * pixels))
        # the next numbers are drawn while kernels process the previous ones
        drawn: _Drawn | None = None
        with one_kernel_thread(), ThreadPoolExecutor(threads) as pool:
            for first in range(0, images, size):
                batch = range(first, min(first + size, images))
                group: _Group | None = None
                for start in range(0, frames, together):
                    numbers = rooms[(first // size * len(range(0, frames, together)) + start // together) % len(rooms)]
                    numbers.expect(expected, batch)
                    if group is None:
                        group = _Group(self, numbers, [streams[k] for k in batch], same, together, frames, pixels)
                    following = group.draw(numbers, out[batch.start : batch.stop, start : start + together], pool)
                    if drawn is not None:
                        drawn.read_out()
                        release_memory(out)
                    drawn = following
            if drawn is not None:
                drawn.read_out()


def exposing_bytes(frames: int, pixels: int) -> int:
    """Return the temporary memory of an exposure by kernels, in bytes.

    Parameters
    ----------
    frames : int
        Number of frames of an image that are exposed at once.
    pixels : int
        Number of pixels of a frame.
    """
    return max(_TOGETHER, frames * pixels) * 40 + pixels * 64


@dataclass(frozen=True, eq=False)
class _Numbers:
    """Means and random numbers of a group of images; the memory is reused by the next group.

    A lane is an entry of the kernels' arrays: one pixel of one image, and some of padding.

    Attributes
    ----------
    mean : (lanes,) ndarray
        Expected electrons of all pixels.
    shift : (lanes,) ndarray
        Black level with the pixels' own offsets, in grey values.
    words : (frames, lanes) ndarray of uint64
        Random words, frame by frame.
    normals : (frames, lanes) ndarray | None
        Normal numbers of the read noise; None without read noise.
    """

    mean: np.ndarray
    shift: np.ndarray
    words: np.ndarray
    normals: np.ndarray | None

    @classmethod
    def room(cls, frames: int, pixels: int, noisy: bool) -> _Numbers:
        """Return memory for the random numbers of ``frames`` frames of ``pixels`` pixels.

        ``noisy`` is True if there is read noise, for which normal numbers are needed.
        """
        lanes = -(-pixels // _LANES) * _LANES
        mean, shift = _aligned(np.float64, 2, lanes)
        normals = _aligned(np.float64, frames, lanes) if noisy else None
        return cls(mean, shift, _aligned(np.uint64, frames, lanes), normals)

    def expect(self, expected: Callable[[int], tuple[np.ndarray, np.ndarray]], images: range) -> None:
        """Set the expected electrons and the black levels of some images of the group."""
        for position, image in enumerate(images):
            for row, values in zip((self.mean, self.shift), expected(image), strict=True):
                row[position * values.size : (position + 1) * values.size] = values.reshape(-1)


@dataclass(eq=False)
class _SharedNumbers:
    """Random numbers of a stream that several images share; they are drawn for the first image and kept.

    None of these images has means above ``poisson_numbers.SERIES_END``.

    Attributes
    ----------
    words, normals : (frames, pixels) ndarray | None
        Random words and normal numbers of all frames; None before they are drawn, normals also without read noise.
    """

    words: np.ndarray | None = None
    normals: np.ndarray | None = None
    drawing: threading.Lock = field(default_factory=threading.Lock)

    def put(self, numbers: _Numbers, lanes: slice, count: int, draw: Callable[[], None]) -> None:
        """Copy the random numbers to an image's lanes (entries of the kernels' arrays, one per pixel).

        Parameters
        ----------
        numbers : _Numbers
            Numbers of a group of images.
        lanes : slice
            Lanes of the image.
        count : int
            Number of frames.
        draw : callable
            Function that draws the numbers into these lanes; called for the first image only.
        """
        with self.drawing:
            if self.words is None:
                draw()
                self.words = numbers.words[:count, lanes].copy()
                if numbers.normals is not None:
                    self.normals = numbers.normals[:count, lanes].copy()
                return
        numbers.words[:count, lanes] = self.words
        if numbers.normals is not None:
            numbers.normals[:count, lanes] = self.normals


_Key = tuple[str, tuple[int, ...], int]


def _key(stream: np.random.SeedSequence) -> _Key:
    """Return a key that is equal for random streams that give the same numbers."""
    return str(stream.entropy), tuple(stream.spawn_key), stream.pool_size


def _shared_numbers(streams: Sequence[np.random.SeedSequence], most: int) -> dict[_Key, _SharedNumbers]:
    """Return stream -> (still empty) memory for the random numbers of each stream that several images share.

    At most ``most`` streams get such memory.
    """
    several = [key for key, times in Counter(map(_key, streams)).items() if times > 1]
    return {key: _SharedNumbers() for key in several[:most]}


class _Group:
    """Group of images whose frames are exposed together by one call of a kernel, with their random streams."""

    def __init__(
        self,
        how: Reading,
        numbers: _Numbers,
        streams: Sequence[np.random.SeedSequence],
        same: Mapping[_Key, _SharedNumbers],
        together: int,
        frames: int,
        pixels: int,
    ) -> None:
        self.how, self.pixels = how, pixels
        self.same = [same.get(_key(sequence)) for sequence in streams]
        self.huge: list[np.ndarray] = []
        self.sources = []
        self.last: list[Future[np.ndarray | None] | None] = [None] * len(streams)
        for image, sequence in enumerate(streams):
            mean = numbers.mean[self.lanes(image)]
            self.huge.append(np.flatnonzero(mean >= poisson_numbers.SERIES_END))
            rng = np.random.Generator(np.random.SFC64(sequence))
            self.sources.append(
                (*poisson_numbers.split_stream(rng, mean[self.huge[image]], frames, pixels, together), rng)
            )

    def lanes(self, image: int) -> slice:
        """Return the range of lanes (entries of the kernels' arrays) that hold an image's pixels."""
        return slice(image * self.pixels, (image + 1) * self.pixels)

    def draw(self, numbers: _Numbers, out: np.ndarray, pool: ThreadPoolExecutor) -> _Drawn:
        """Start drawing the random numbers of the group's next frames, which will fill ``out``.

        ``out`` has the shape (images, frames, pixels).
        """
        work = [pool.submit(self._drawn, numbers, image, out.shape[1], self.last[image]) for image in range(len(out))]
        self.last = list(work)
        return _Drawn(self, numbers, out, work)

    def _drawn(
        self, numbers: _Numbers, image: int, count: int, before: Future[np.ndarray | None] | None
    ) -> np.ndarray | None:
        """Draw the random numbers of an image for ``count`` frames, after those of ``before``.

        Returns
        -------
        (count, huge) ndarray | None
            Poisson numbers of the pixels with means from ``poisson_numbers.SERIES_END`` on, which kernels do not
            compute; None if there are none.
        """
        if before is not None:
            before.result()  # another thread may still draw the image's previous frames from the same streams
        words, huge, rng = self.sources[image]
        lanes, which = self.lanes(image), self.huge[image]
        huge_numbers: np.ndarray | None = None

        def draw() -> None:
            nonlocal huge_numbers
            numbers.words[:count, lanes] = poisson_numbers.words_of(words, count, self.pixels)
            huge_numbers = huge.poisson(numbers.mean[lanes][which], (count, which.size)) if which.size else None
            if numbers.normals is not None:
                for row in numbers.normals[:count]:
                    rng.standard_normal(out=row[lanes])

        # with huge means the normal numbers follow others in the stream and cannot be shared
        if (same := self.same[image]) is None or which.size:
            draw()
        else:
            same.put(numbers, lanes, count, draw)
        return huge_numbers


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Frames whose random numbers are being drawn.

    Attributes
    ----------
    group : _Group
        Images.
    numbers : _Numbers
        Destination of the random numbers.
    out : (images, frames, pixels) ndarray
        Frames to fill.
    work : sequence of Future
        Drawing of each image.
    """

    group: _Group
    numbers: _Numbers
    out: np.ndarray
    work: Sequence[Future[np.ndarray | None]]

    def read_out(self) -> None:
        """Fill the frames with grey values once their random numbers have been drawn."""
        huge = [drawing.result() for drawing in self.work]
        numbers, group = self.numbers, self.group
        frame, lane = _kernels(group.how, numbers, self.out)
        if frame.size:
            self._put(frame, lane, poisson_numbers.poisson_quantile(numbers.mean[lane], numbers.words[frame, lane]))
        for image, (which, huge_numbers) in enumerate(zip(group.huge, huge, strict=True)):
            if huge_numbers is not None:
                frame, lane = np.divmod(np.arange(huge_numbers.size), which.size)
                self._put(frame, image * group.pixels + which[lane], huge_numbers.astype(np.float64).reshape(-1))

    def _put(self, frame: np.ndarray, lane: np.ndarray, electrons: np.ndarray) -> None:
        """Write the grey values of given electrons into some pixels of some frames.

        ``frame`` and ``lane`` are the frame, and the entry of the kernels' arrays, of each pixel.
        """
        numbers, how = self.numbers, self.group.how
        noise = [] if numbers.normals is None else [numbers.normals[frame, lane] * how.sigma_e]
        image, pixel = np.divmod(lane, self.group.pixels)
        self.out[image, frame, pixel] = how.read_out(electrons, noise, numbers.shift[lane])


def _aligned(kind: type, rows: int, columns: int) -> np.ndarray:
    """Return an array (rows, columns) of zeros at an aligned address for kernels."""
    room: np.ndarray = np.zeros(rows * columns + _LANES, kind)
    start = (-room.__array_interface__["data"][0] % 128) // room.itemsize
    return room[start : start + rows * columns].reshape(rows, columns)


@cache
def kernels_available() -> bool:
    """Return True if kernels are available for the processor; checked once per process."""
    ensure_llvm()
    import drjit as dr

    return bool(dr.has_backend(dr.JitBackend.LLVM))


@dataclass(frozen=True, eq=False)
class _Table:
    """Table of Poisson quantiles over cells of the mean and of the uniform number u, in the kernels' memory.

    Attributes
    ----------
    known : UInt32
        Four cells per word: the smallest quantile of each cell, and in its highest bit whether the cell has others.
    law : Float32
        Poisson distribution functions at the means at which the table's rows begin.
    bound : Float32
        For each row, bound of the error of their interpolation.
    """

    known: Any
    law: Any
    bound: Any


@cache
def _table() -> _Table:
    """Return the table of Poisson quantiles in the kernels' memory, made once."""
    import drjit as dr
    from drjit.llvm import Float32, UInt32

    cells, law, bound = poisson_numbers.quantile_table()
    table = _Table(UInt32(cells.view(np.uint32)), Float32(law.astype(np.float32)), Float32(bound + _SINGLE))
    dr.make_opaque(table.known, table.law, table.bound)
    return table


def _kernels(how: Reading, numbers: _Numbers, out: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fill frames (images, frames, pixels) by kernels, and return which of their numbers are still undetermined.

    The two returned arrays hold the frame and the lane (entry of the kernels' arrays) of each of these numbers.
    """
    import drjit as dr
    from drjit.llvm import Float64, UInt32, UInt64

    images, count, pixels = out.shape
    used, width = images * pixels, numbers.mean.size
    means, shifts = Float64(numbers.mean), Float64(numbers.shift)
    read = [dr.opaque(Float64, value) for value in (how.sigma_e, how.gain_dn_per_e, how.full_well_e, how.most_dn)]
    normals = numbers.normals
    done = []
    for row in range(count):
        normal = None if normals is None else Float64(normals[row])
        result = _looked_up(means, UInt64(numbers.words[row]), normal, shifts, read)
        dr.eval(*result)
        done.append(result)
    open_ = []
    for row, (grey, left) in enumerate(done):
        np.copyto(out[:, row], grey.numpy()[:used].reshape(images, pixels), casting="unsafe")
        open_.append(np.flatnonzero(left.numpy()[:used]))
    lane = np.concatenate(open_)
    frame = np.repeat(np.arange(count), [lanes.size for lanes in open_])
    if not lane.size:
        return frame, lane
    normal = None if normals is None else Float64(normals.reshape(-1))
    at = UInt32((frame * width + lane).astype(np.uint32)), UInt32(lane.astype(np.uint32))
    grey, left = _compared(means, UInt64(numbers.words.reshape(-1)), normal, shifts, read, at)
    dr.eval(grey, left)
    image, pixel = np.divmod(lane, pixels)
    out[image, frame, pixel] = grey.numpy()
    still = np.flatnonzero(left.numpy())
    return frame[still], lane[still]


def _grey(electrons: Any, normal: Any, shift: Any, numbers: Sequence[Any]) -> Any:
    """Return grey values of electrons with read noise and black level, as the detector's read-out gives them.

    ``normal`` are standard normal numbers, ``shift`` the black level with the pixel's offset, in grey values, and
    ``numbers`` the detector's read noise, gain, full well and largest grey value.
    """
    import drjit as dr
    from drjit.llvm import UInt32

    sigma, gain, well, most = numbers
    level = dr.minimum(electrons, well)
    if normal is not None:
        level = level + normal * sigma
    return UInt32(dr.clip(dr.round(level * gain + shift), 0.0, most))


def _cell(mean: Any, word: Any) -> tuple[Any, Any, Any]:
    """Return the table's row for a mean, the smallest quantile in its cell, and whether the cell has others.

    The cell is that of the mean and of the uniform number u of the 64-bit random ``word``.
    """
    import drjit as dr
    from drjit.llvm import UInt32

    row = UInt32(dr.select(mean < poisson_numbers.TABLE_END, mean, 0.0) * float(poisson_numbers.CELLS_PER_UNIT))
    position = (row << poisson_numbers.TABLE_BITS) + UInt32(word >> (64 - poisson_numbers.TABLE_BITS))
    cell = (dr.gather(UInt32, _table().known, position >> 2) >> ((position & 3) << 3)) & 255
    return row, cell & 127, cell >= 128


def _looked_up(mean: Any, word: Any, normal: Any, shift: Any, numbers: Sequence[Any]) -> tuple[Any, Any]:
    """Return the grey values of one frame whose electrons are quantiles from the table or from Giles' expansion.

    The second result is True for each number that these do not determine.
    """
    import drjit as dr
    from drjit.llvm import Float64

    _, number, open_ = _cell(mean, word)
    electrons, open_ = dr.if_stmt(
        (Float64(number), open_, mean, word),
        mean >= poisson_numbers.TABLE_END,
        lambda electrons, open_, mean, word: _by_series(mean, word),
        lambda electrons, open_, mean, word: (electrons, open_),
        mode="symbolic",
    )
    return _grey(electrons, normal, shift, numbers), open_


def _compared(
    mean: Any, word: Any, normal: Any, shift: Any, numbers: Sequence[Any], at: tuple[Any, Any]
) -> tuple[Any, Any]:
    """Return grey values of numbers that ``_looked_up`` did not determine, by interpolated distribution functions.

    The second result is True for each number that is still undetermined.

    Parameters
    ----------
    mean : Float64
        Means of all lanes.
    word : UInt64
        Random words of all frames, one after the other.
    normal : Float64 | None
        Normal numbers of all frames, one after the other.
    shift : Float64
        Black levels of all lanes, in grey values.
    numbers : sequence
        Read noise, gain, full well and largest grey value of the detector.
    at : tuple
        Position among the words of all frames, and lane, of each undetermined number.
    """
    import drjit as dr
    from drjit.llvm import Bool, Float32, Float64, UInt32, UInt64

    position, lane = at
    mean, shift = dr.gather(Float64, mean, lane), dr.gather(Float64, shift, lane)
    word = dr.gather(UInt64, word, position)
    normal = None if normal is None else dr.gather(Float64, normal, position)
    table = _table()
    row, number, _ = _cell(mean, word)
    small = mean < poisson_numbers.TABLE_END
    u = Float32(UInt32(word >> 32)) * 2.0**-32
    share = Float32(mean * float(poisson_numbers.CELLS_PER_UNIT) - Float64(row))
    index, bound = row * poisson_numbers.MOST_IN_TABLE + number, dr.gather(Float32, table.bound, row)

    def passed(going: Any, number: Any, index: Any, close: Any) -> tuple[Any, Any, Any, Any]:
        law = dr.gather(Float32, table.law, index, going)
        law = dr.fma(share, dr.gather(Float32, table.law, index + poisson_numbers.MOST_IN_TABLE, going) - law, law)
        ahead = u - law
        close = close | (going & (dr.abs(ahead) <= bound))
        going = going & (ahead > bound)
        increment = dr.select(going, UInt32(1), UInt32(0))
        return going, number + increment, index + increment, close

    _, number, _, close = dr.while_loop(
        (small, number, index, ~small & Bool(True)), lambda going, *rest: going, passed, mode="symbolic"
    )
    return _grey(Float64(number), normal, shift, numbers), close


def _by_series(mean: Any, word: Any) -> tuple[Any, Any]:
    """Return Poisson quantiles of means from ``TABLE_END`` on by Giles' expansion, and whether each is uncertain.

    A quantile is uncertain if a whole number lies within the error bound of the expansion.
    """
    import drjit as dr
    from drjit.llvm import Float32, Float64

    upper = word >= 1 << 63
    tail = Float32(dr.select(upper, ~word, word)) * 2.0**-64
    x, far = _normal_quantile(tail)
    x = dr.select(upper, -x, x)
    root = dr.sqrt(mean)
    inverse, square = 1.0 / Float32(root), x * x
    rest = dr.fma(dr.fma(square, 1.0 / 270.0, 7.0 / 810.0), square, -8.0 / 405.0) * inverse
    rest = (rest - dr.fma(square, 1.0 / 72.0, 1.0 / 36.0) * x) * inverse + dr.fma(square, 1.0 / 6.0, 1.0 / 3.0)
    quantile = dr.fma(Float64(x), root, mean) + Float64(rest)
    number = dr.floor(quantile)
    left = Float32(quantile - number)
    term = dr.fma(square * square * square, 0.001, 0.1) * inverse * inverse * inverse
    term = term + _NORMAL_ERROR * (1.0 + dr.abs(x) / 6.0) * (Float32(root) + 4.0)
    return dr.maximum(number, 0.0), (left < term) | (left > 1.0 - term) | far


_CENTRAL = (
    2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087, -0.00125372503, -0.00417768164,
    0.246640727, 1.50140941,
)  # fmt: skip
_TAIL = (
    -0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773, -0.0076224613, 0.00943887047,
    1.00167406, 2.83297682,
)  # fmt: skip
"""Coefficients of the inverse error function in single precision, for the tails; ``_CENTRAL`` has those of the middle.

They are of polynomials of sqrt(w) - 3 (tails) and of w - 2.5 (middle), with w = -log(4 t (1 - t)) for a probability t.
Source: Giles, Approximating the erfinv function, GPU Computing Gems (2012).
"""


def _normal_quantile(tail: Any) -> tuple[Any, Any]:
    """Return the standard normal quantile of a probability up to 1/2, and whether it is too far in the tail.

    Too far means that single precision does not suffice.
    """
    import drjit as dr

    def polynomial(coefficients: Sequence[float], at: Any) -> Any:
        value = coefficients[0]
        for coefficient in coefficients[1:]:
            value = dr.fma(value, at, coefficient)
        return value

    w = -dr.log(4.0 * tail * (1.0 - tail))
    value = dr.select(w < 5.0, polynomial(_CENTRAL, w - 2.5), polynomial(_TAIL, dr.sqrt(w) - 3.0))
    return 2.0**0.5 * (2.0 * tail - 1.0) * value, w > 15.0
