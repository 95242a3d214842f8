"""Recorded frames of many images by kernels: what ``EmvaDetector`` does pixel by pixel, in one pass over its random
numbers.

The frames are those that NumPy would make of the same streams, bit for bit: a Poisson number is the quantile of its
mean (``twin.sensors.poisson_numbers``), and whatever a kernel cannot tell with certainty is decided there. A first
kernel looks every number of a small mean up in the table of quantiles, which tells nineteen of twenty, works those of
larger means out by Giles' expansion in single precision, and reads the electrons out. A second one compares what the
table leaves open with the distribution function between its rows. Some of ten thousand numbers remain; they lie within
the bounds of these approximations.

All frames of a pixel share its mean, so that a kernel runs over the pixels of some images, frame after frame: then no
number has to be gathered but those of the table. Images of one stream share their numbers, too, which are then drawn
once.
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
from twin.sensors.poisson_numbers import (
    CELLS_PER_UNIT,
    MOST_IN_TABLE,
    SERIES_END,
    TABLE_BITS,
    TABLE_END,
    poisson_quantile,
    quantile_table,
    split_stream,
    words_of,
)

FEWEST = 50_000
"""Numbers of an exposure from which it is done by kernels: fewer take as long to hand over as to work out."""

_TOGETHER = 1 << 20
"""Numbers that are drawn and read out at once; their words and normal numbers take 16 MiB, and as much again while the
next are drawn.
"""

_MOST_KEPT = 1 << 22
"""Numbers of streams of several images that are kept until all of these are exposed; they take 64 MiB."""

_LANES = 16
"""Numbers of pixels are rounded up to a multiple of this, so that each frame begins at an aligned address."""

_NORMAL_ERROR = 4e-6
"""More than the error of the normal quantile in single precision, of numbers up to 6."""

_SINGLE = 4e-7
"""More than what single precision does to a distribution function, and to u."""


@dataclass(frozen=True, eq=False)
class Reading:
    """How electrons become grey values.

    Attributes
    ----------
    sigma_e : float
        Read noise, electrons rms; 0 for none, for which no number is drawn.
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
        """Grey values of electrons, whose array they take over.

        Parameters
        ----------
        level : np.ndarray
            Electrons, of any shape.
        noise : Sequence[np.ndarray]
            Terms that are added to them one after the other, electrons.
        shift : np.ndarray
            Black level with the pixels' own offsets, grey values.
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
        """Expose images.

        Parameters
        ----------
        expected : Callable[[int], tuple[np.ndarray, np.ndarray]]
            Number of an image -> its expected electrons, and ``shift`` as of ``read_out``, P numbers each.
        streams : Sequence[np.random.SeedSequence]
            Of the I images, each a stream of words, of Poisson numbers of huge means and of normal numbers; some may be
            the same.
        out : np.ndarray
            The frames, (I, F, P) uint16.
        together : int
            Frames of an image that are done at once.
        threads : int
            That draw.
        """
        images, frames, pixels = out.shape
        together = min(together, frames)
        size = min(images, max(1, _TOGETHER // (together * pixels)))
        pieces = (images > size) + (frames > together)
        rooms = [_Numbers.room(together, size * pixels, self.sigma_e > 0) for _ in range(min(2, 1 + pieces))]
        same = {} if together < frames else _same_numbers(streams, _MOST_KEPT // (frames * pixels))
        # the next numbers are drawn while kernels work on the last ones
        drawn: _Drawn | None = None
        with one_kernel_thread(), ThreadPoolExecutor(threads) as pool:
            for first in range(0, images, size):
                some = range(first, min(first + size, images))
                group: _Group | None = None
                for start in range(0, frames, together):
                    numbers = rooms[(first // size * len(range(0, frames, together)) + start // together) % len(rooms)]
                    numbers.expect(expected, some)
                    if group is None:
                        group = _Group(self, numbers, [streams[k] for k in some], same, together, frames, pixels)
                    following = group.draw(numbers, out[some.start : some.stop, start : start + together], pool)
                    if drawn is not None:
                        drawn.read_out()
                        release_memory(out)
                    drawn = following
            if drawn is not None:
                drawn.read_out()


def exposing_bytes(frames: int, pixels: int) -> int:
    """Memory that an exposure by kernels takes for a while, bytes.

    Parameters
    ----------
    frames : int
        Of an image that are done at once.
    pixels : int
        Of a frame.
    """
    return max(_TOGETHER, frames * pixels) * 40 + pixels * 64


@dataclass(frozen=True, eq=False)
class _Numbers:
    """What a group of images is made of; its memory serves one group after the other.

    Attributes
    ----------
    mean : np.ndarray
        Expected electrons of all pixels, (lanes,), likewise ``shift`` as of ``Reading.read_out``.
    words : np.ndarray
        Of 64 bits, frame by frame, (frames, lanes).
    normals : np.ndarray | None
        Of the read noise, likewise; None without.
    """

    mean: np.ndarray
    shift: np.ndarray
    words: np.ndarray
    normals: np.ndarray | None

    @classmethod
    def room(cls, frames: int, pixels: int, noisy: bool) -> _Numbers:
        """Memory for so many frames of all pixels of a group."""
        lanes = -(-pixels // _LANES) * _LANES
        mean, shift = _aligned(np.float64, 2, lanes)
        normals = _aligned(np.float64, frames, lanes) if noisy else None
        return cls(mean, shift, _aligned(np.uint64, frames, lanes), normals)

    def expect(self, expected: Callable[[int], tuple[np.ndarray, np.ndarray]], images: range) -> None:
        """Set what is expected of some images."""
        for place, image in enumerate(images):
            for row, values in zip((self.mean, self.shift), expected(image), strict=True):
                row[place * values.size : (place + 1) * values.size] = values.reshape(-1)


@dataclass(eq=False)
class _SameNumbers:
    """Random numbers of a stream of several images, none of whose means is huge: whoever comes first draws them.

    Attributes
    ----------
    words, normals : np.ndarray | None
        Of all frames, (frames, pixels); None before they are drawn, normals also without read noise.
    """

    words: np.ndarray | None = None
    normals: np.ndarray | None = None
    drawing: threading.Lock = field(default_factory=threading.Lock)

    def put(self, numbers: _Numbers, own: slice, count: int, draw: Callable[[], None]) -> None:
        """Put the numbers where an image has its own.

        Parameters
        ----------
        numbers : _Numbers
            Of a group of images.
        own : slice
            The image's lanes.
        count : int
            Of frames.
        draw : Callable[[], None]
            Draws them to this place.
        """
        with self.drawing:
            if self.words is None:
                draw()
                self.words = numbers.words[:count, own].copy()
                if numbers.normals is not None:
                    self.normals = numbers.normals[:count, own].copy()
                return
        numbers.words[:count, own] = self.words
        if numbers.normals is not None:
            numbers.normals[:count, own] = self.normals


_Key = tuple[str, tuple[int, ...], int]


def _key(stream: np.random.SeedSequence) -> _Key:
    """What two streams of the same numbers have in common."""
    return str(stream.entropy), tuple(stream.spawn_key), stream.pool_size


def _same_numbers(streams: Sequence[np.random.SeedSequence], most: int) -> dict[_Key, _SameNumbers]:
    """Room for the numbers of each stream of several images, of so many streams at most."""
    several = [key for key, times in Counter(map(_key, streams)).items() if times > 1]
    return {key: _SameNumbers() for key in several[:most]}


class _Group:
    """Some images whose frames are drawn together, and their streams."""

    def __init__(
        self,
        how: Reading,
        numbers: _Numbers,
        streams: Sequence[np.random.SeedSequence],
        same: Mapping[_Key, _SameNumbers],
        together: int,
        frames: int,
        pixels: int,
    ) -> None:
        self.how, self.pixels = how, pixels
        self.same = [same.get(_key(own)) for own in streams]
        self.huge: list[np.ndarray] = []
        self.sources = []
        self.last: list[Future[np.ndarray | None] | None] = [None] * len(streams)
        for image, own in enumerate(streams):
            mean = numbers.mean[self.own(image)]
            self.huge.append(np.flatnonzero(mean >= SERIES_END))
            rng = np.random.Generator(np.random.SFC64(own))
            self.sources.append((*split_stream(rng, mean[self.huge[image]], frames, pixels, together), rng))

    def own(self, image: int) -> slice:
        """Lanes of an image."""
        return slice(image * self.pixels, (image + 1) * self.pixels)

    def draw(self, numbers: _Numbers, out: np.ndarray, pool: ThreadPoolExecutor) -> _Drawn:
        """Begin to draw the numbers of the next frames (images, frames, pixels)."""
        work = [pool.submit(self._drawn, numbers, image, out.shape[1], self.last[image]) for image in range(len(out))]
        self.last = list(work)
        return _Drawn(self, numbers, out, work)

    def _drawn(
        self, numbers: _Numbers, image: int, count: int, before: Future[np.ndarray | None] | None
    ) -> np.ndarray | None:
        """Draw the random numbers of an image; its Poisson numbers of huge means, (count, huge), None where no mean
        is.
        """
        if before is not None:
            before.result()  # another thread may still draw the image's last frames from the same streams
        words, huge, rng = self.sources[image]
        own, which = self.own(image), self.huge[image]
        found: np.ndarray | None = None

        def draw() -> None:
            nonlocal found
            numbers.words[:count, own] = words_of(words, count, self.pixels)
            found = huge.poisson(numbers.mean[own][which], (count, which.size)) if which.size else None
            if numbers.normals is not None:
                for row in numbers.normals[:count]:
                    rng.standard_normal(out=row[own])

        # numbers of huge means are drawn before the normal ones, which then are this image's own
        if (same := self.same[image]) is None or which.size:
            draw()
        else:
            same.put(numbers, own, count, draw)
        return found


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Frames whose random numbers are being drawn.

    Attributes
    ----------
    group : _Group
        Their images.
    numbers : _Numbers
        Where they are drawn to.
    out : np.ndarray
        The frames, (images, frames, pixels).
    work : Sequence[Future[np.ndarray | None]]
        Draws each image.
    """

    group: _Group
    numbers: _Numbers
    out: np.ndarray
    work: Sequence[Future[np.ndarray | None]]

    def read_out(self) -> None:
        """Fill the frames."""
        huge = [one.result() for one in self.work]
        numbers, group = self.numbers, self.group
        frame, lane = _kernels(group.how, numbers, self.out)
        if frame.size:
            self._put(frame, lane, poisson_quantile(numbers.mean[lane], numbers.words[frame, lane]))
        for image, (which, found) in enumerate(zip(group.huge, huge, strict=True)):
            if found is not None:
                frame, lane = np.divmod(np.arange(found.size), which.size)
                self._put(frame, image * group.pixels + which[lane], found.astype(np.float64).reshape(-1))

    def _put(self, frame: np.ndarray, lane: np.ndarray, electrons: np.ndarray) -> None:
        """Read numbers of electrons out into some pixels of some frames."""
        numbers, how = self.numbers, self.group.how
        noise = [] if numbers.normals is None else [numbers.normals[frame, lane] * how.sigma_e]
        image, pixel = np.divmod(lane, self.group.pixels)
        self.out[image, frame, pixel] = how.read_out(electrons, noise, numbers.shift[lane])


def _aligned(kind: type, rows: int, columns: int) -> np.ndarray:
    """An array (rows, columns) of zeros at an address that kernels expect."""
    room: np.ndarray = np.zeros(rows * columns + _LANES, kind)
    start = (-room.__array_interface__["data"][0] % 128) // room.itemsize
    return room[start : start + rows * columns].reshape(rows, columns)


@cache
def kernels_there() -> bool:
    """Whether there are kernels for the processor; looked for once in a process."""
    ensure_llvm()
    import drjit as dr

    return bool(dr.has_backend(dr.JitBackend.LLVM))


@dataclass(frozen=True, eq=False)
class _Table:
    """The table of quantiles in the kernels' memory.

    Attributes
    ----------
    known : Any
        Four cells a word: the least quantile of each, and in its highest bit whether it has others.
    law : Any
        Distribution functions at the rows' means, single precision.
    bound : Any
        Of each row, of the error of an interpolation of them.
    """

    known: Any
    law: Any
    bound: Any


@cache
def _table() -> _Table:
    import drjit as dr
    from drjit.llvm import Float32, UInt32

    cells, law, bound = quantile_table()
    table = _Table(UInt32(cells.view(np.uint32)), Float32(law.astype(np.float32)), Float32(bound + _SINGLE))
    dr.make_opaque(table.known, table.law, table.bound)
    return table


def _kernels(how: Reading, numbers: _Numbers, out: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fill frames (images, frames, pixels); frames and lanes of the numbers that are not certain."""
    import drjit as dr
    from drjit.llvm import Float64, UInt32, UInt64

    images, count, pixels = out.shape
    used, width = images * pixels, numbers.mean.size
    means, shifts = Float64(numbers.mean), Float64(numbers.shift)
    read = [dr.opaque(Float64, value) for value in (how.sigma_e, how.gain_dn_per_e, how.full_well_e, how.most_dn)]
    normals = numbers.normals
    done = []
    for place in range(count):
        normal = None if normals is None else Float64(normals[place])
        found = _looked_up(means, UInt64(numbers.words[place]), normal, shifts, read)
        dr.eval(*found)
        done.append(found)
    open_ = []
    for place, (grey, left) in enumerate(done):
        np.copyto(out[:, place], grey.numpy()[:used].reshape(images, pixels), casting="unsafe")
        open_.append(np.flatnonzero(left.numpy()[:used]))
    lane = np.concatenate(open_)
    frame = np.repeat(np.arange(count), [one.size for one in open_])
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
    """Grey values, as ``Reading.read_out`` has them."""
    import drjit as dr
    from drjit.llvm import UInt32

    sigma, gain, well, most = numbers
    level = dr.minimum(electrons, well)
    if normal is not None:
        level = level + normal * sigma
    return UInt32(dr.clip(dr.round(level * gain + shift), 0.0, most))


def _cell(mean: Any, word: Any) -> tuple[Any, Any, Any]:
    """Row of the table, and the least quantile in the cell of it with whether it has others."""
    import drjit as dr
    from drjit.llvm import UInt32

    row = UInt32(dr.select(mean < TABLE_END, mean, 0.0) * float(CELLS_PER_UNIT))
    place = (row << TABLE_BITS) + UInt32(word >> (64 - TABLE_BITS))
    cell = (dr.gather(UInt32, _table().known, place >> 2) >> ((place & 3) << 3)) & 255
    return row, cell & 127, cell >= 128


def _looked_up(mean: Any, word: Any, normal: Any, shift: Any, numbers: Sequence[Any]) -> tuple[Any, Any]:
    """Grey values of one frame, and where the table or the expansion leaves the number open."""
    import drjit as dr
    from drjit.llvm import Float64

    _, number, open_ = _cell(mean, word)
    electrons, open_ = dr.if_stmt(
        (Float64(number), open_, mean, word),
        mean >= TABLE_END,
        lambda electrons, open_, mean, word: _by_series(mean, word),
        lambda electrons, open_, mean, word: (electrons, open_),
        mode="symbolic",
    )
    return _grey(electrons, normal, shift, numbers), open_


def _compared(
    mean: Any, word: Any, normal: Any, shift: Any, numbers: Sequence[Any], at: tuple[Any, Any]
) -> tuple[Any, Any]:
    """Grey values of what ``_looked_up`` left open, and where the number still is not certain.

    Parameters
    ----------
    mean : Any
        Of all lanes.
    word : Any
        Of all frames, one after the other.
    normal : Any
        likewise.
    shift : Any
        Of all lanes.
    numbers : Sequence[Any]
        Of the read-out.
    at : tuple[Any, Any]
        Places in all frames, and lanes, of the open ones.
    """
    import drjit as dr
    from drjit.llvm import Bool, Float32, Float64, UInt32, UInt64

    place, lane = at
    mean, shift = dr.gather(Float64, mean, lane), dr.gather(Float64, shift, lane)
    word = dr.gather(UInt64, word, place)
    normal = None if normal is None else dr.gather(Float64, normal, place)
    table = _table()
    row, number, _ = _cell(mean, word)
    small = mean < TABLE_END
    u = Float32(UInt32(word >> 32)) * 2.0**-32
    share = Float32(mean * float(CELLS_PER_UNIT) - Float64(row))
    index, bound = row * MOST_IN_TABLE + number, dr.gather(Float32, table.bound, row)

    def passed(going: Any, number: Any, index: Any, close: Any) -> tuple[Any, Any, Any, Any]:
        law = dr.gather(Float32, table.law, index, going)
        law = dr.fma(share, dr.gather(Float32, table.law, index + MOST_IN_TABLE, going) - law, law)
        ahead = u - law
        close = close | (going & (dr.abs(ahead) <= bound))
        going = going & (ahead > bound)
        one = dr.select(going, UInt32(1), UInt32(0))
        return going, number + one, index + one, close

    _, number, _, close = dr.while_loop(
        (small, number, index, ~small & Bool(True)), lambda going, *rest: going, passed, mode="symbolic"
    )
    return _grey(Float64(number), normal, shift, numbers), close


def _by_series(mean: Any, word: Any) -> tuple[Any, Any]:
    """Quantiles of means from ``TABLE_END`` on, and where they are not certain: as ``poisson_numbers._by_series``."""
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
    at = dr.fma(Float64(x), root, mean) + Float64(rest)
    number = dr.floor(at)
    left = Float32(at - number)
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
"""Giles, Approximating the erfinv function, GPU Computing Gems (2012), single precision: polynomials of w - 2.5 and of
the root of w less 3, w = -log(4 t (1 - t)).
"""


def _normal_quantile(tail: Any) -> tuple[Any, Any]:
    """Normal quantile, at most 0, of a chance up to 1/2, single precision; and where it is too far out for that."""
    import drjit as dr

    def polynomial(coefficients: Sequence[float], at: Any) -> Any:
        value = coefficients[0]
        for one in coefficients[1:]:
            value = dr.fma(value, at, one)
        return value

    w = -dr.log(4.0 * tail * (1.0 - tail))
    value = dr.select(w < 5.0, polynomial(_CENTRAL, w - 2.5), polynomial(_TAIL, dr.sqrt(w) - 3.0))
    return 2.0**0.5 * (2.0 * tail - 1.0) * value, w > 15.0
