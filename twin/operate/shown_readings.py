"""Single readings of the monitor as pages show them: chosen ones of many, spots of one, and its frames where their
files are still there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from sqlalchemy import Select, func, select

from analysis.images.image_file import ImageFile
from scenes.yaml.input_file import digest_of
from twin.operate.record.entries import utc_text
from twin.operate.record.history import History, content_of
from twin.operate.record.schema import ENTRY, FRAME, SOURCE

KIND = "monitor"
_TOGETHER = 400
"""Rows asked for at once."""
LARGEST_SIDE = 512
"""Pixels of a frame's picture; larger ones are shown with fewer."""
MOST_PAGES = 16
"""Frames of a file of which the mean is shown."""
DARK, BRIGHT = 0.5, 99.95
"""Percentiles of the pixels that are black and white in a frame's picture."""


def _rows() -> Select[Any]:
    return select(*ENTRY.c, SOURCE.c.file).join(SOURCE, ENTRY.c.source_id == SOURCE.c.id).where(ENTRY.c.kind == KIND)


def first_time(history: History) -> int:
    """Time of the first reading of the monitor, microseconds of TAI since 2000; 0 without any."""
    with history.reading() as connection:
        found = connection.execute(select(func.min(ENTRY.c.time_us)).where(ENTRY.c.kind == KIND)).scalar()
    return int(found or 0)


def last_time(history: History) -> int | None:
    """Time of the newest reading of the monitor, microseconds of TAI since 2000; None without any."""
    with history.reading() as connection:
        found = connection.execute(select(func.max(ENTRY.c.time_us)).where(ENTRY.c.kind == KIND)).scalar()
    return None if found is None else int(found)


def reading_times(history: History, begin: int, end: int) -> np.ndarray:
    """Times of the readings of the monitor in a span, microseconds of TAI since 2000, int64."""
    c = ENTRY.c
    query = select(c.time_us).where(c.kind == KIND, c.time_us >= begin, c.time_us <= end).order_by(c.time_us)
    with history.reading() as connection:
        return np.array(connection.execute(query).scalars().all(), np.int64)


def readings(history: History, begin: int, end: int, most: int) -> list[dict[str, Any]]:
    """Readings of the monitor in a span, in the order of time; evenly chosen if there are more than ``most``.

    Args:
        history: the record.
        begin: microseconds of TAI since 2000.
        end: likewise; both ends belong to the span.
        most: readings.

    Returns:
        Rows as `History.entries` yields them, with ``content`` as plain data.
    """
    c = ENTRY.c
    query = select(c.id).where(c.kind == KIND, c.time_us >= begin, c.time_us <= end).order_by(c.time_us, c.id)
    with history.reading() as connection:
        found = list(connection.execute(query).scalars())
        step = max(1, -(-len(found) // most))
        chosen = found[::-1][::step][::-1]  # the newest is always among them
        rows: list[dict[str, Any]] = []
        for k in range(0, len(chosen), _TOGETHER):
            part = connection.execute(_rows().where(c.id.in_(chosen[k : k + _TOGETHER])).order_by(c.time_us, c.id))
            rows += map(dict, part.mappings())
    return [{**row, "content": content_of(row)} for row in rows]


def reading_near(history: History, time: int) -> dict[str, Any] | None:
    """The reading of the monitor that is nearest to a time, with the times of its neighbours; None without any.

    Args:
        history: the record.
        time: microseconds of TAI since 2000.

    Returns:
        Its row with ``content`` as plain data, ``before_us`` and ``after_us``, which are None at the ends.
    """
    c = ENTRY.c
    with history.reading() as connection:
        early = connection.execute(_rows().where(c.time_us <= time).order_by(c.time_us.desc()).limit(1)).mappings()
        late = connection.execute(_rows().where(c.time_us >= time).order_by(c.time_us).limit(1)).mappings()
        both = [dict(row) for rows in (early, late) for row in rows]
        if not both:
            return None
        own = min(both, key=lambda row: abs(row["time_us"] - time))
        before = select(func.max(c.time_us)).where(c.kind == KIND, c.time_us < own["time_us"])
        after = select(func.min(c.time_us)).where(c.kind == KIND, c.time_us > own["time_us"])
        ends = {"before_us": connection.execute(before).scalar(), "after_us": connection.execute(after).scalar()}
    return {**own, **ends, "content": content_of(own)}


def spots_of(row: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Spots of a reading, before and after, in pixels of their CCDs; none where the run did not keep them.

    Args:
        row: with ``content`` as plain data.
    """
    out = []
    for camera, channels in (row["content"]["numbers"].get("spots") or {}).items():
        for channel, spot in channels.items():
            before, after = spot.get("before"), spot.get("after")
            if before and after:
                out.append({"camera": camera, "channel": channel, "before": before, "after": after})
    return out


@dataclass(frozen=True)
class FrameFile:
    """A file from which a reading was found.

    Attributes:
        number: by which the record has it.
        path: where it was.
        sha256: of its content then.
    """

    number: int
    path: Path
    sha256: str

    @property
    def state(self) -> str:
        """``there`` as it was, ``gone``, or ``changed``, and then no longer what the reading was found from."""
        try:
            if not self.path.is_file():
                return "gone"
            return "there" if digest_of(self.path) == self.sha256 else "changed"
        except OSError:
            return "gone"

    @property
    def plain(self) -> dict[str, Any]:
        """For a page."""
        return {"number": self.number, "name": self.path.name, "path": str(self.path), "state": self.state}


def frames_of(history: History, row: Mapping[str, Any]) -> list[FrameFile]:
    """Files from which a reading was found, as the record has them.

    Args:
        history: the record.
        row: of the reading.
    """
    query = select(FRAME.c.id, FRAME.c.file, FRAME.c.sha256).where(FRAME.c.source_id == row["source_id"])
    folder = Path(row["file"]).parent
    with history.reading() as connection:
        found = connection.execute(query.order_by(FRAME.c.id)).all()
    return [FrameFile(int(number), folder / file, str(digest)) for number, file, digest in found]


def frame_numbered(history: History, number: int) -> FrameFile | None:
    """A file of the record by its number; None where it has none such."""
    query = select(FRAME.c.file, FRAME.c.sha256, SOURCE.c.file.label("source"))
    query = query.join(SOURCE, FRAME.c.source_id == SOURCE.c.id).where(FRAME.c.id == number)
    with history.reading() as connection:
        found = connection.execute(query).first()
    return None if found is None else FrameFile(number, Path(found[2]).parent / found[0], str(found[1]))


def frame_png(path: Path) -> bytes:
    """The mean of a file's first frames as a picture, PNG: grey, stretched to what it holds.

    Args:
        path: of the file.

    Raises:
        ImageError: it cannot be read.
    """
    file = ImageFile.open(path)
    pages = min(len(file.header.pages), MOST_PAGES)
    mean = np.asarray(ImageFile.open(path, frames=pages).frames(), np.float64).mean(axis=0)
    low, high = np.percentile(mean, (DARK, BRIGHT))
    grey = np.clip((mean - low) / max(high - low, 1e-12), 0.0, 1.0)
    side = max(grey.shape)
    if side > LARGEST_SIDE:
        size = (round(grey.shape[1] * LARGEST_SIDE / side), round(grey.shape[0] * LARGEST_SIDE / side))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    done, png = cv2.imencode(".png", np.round(255.0 * grey).astype(np.uint8))
    assert done
    return bytes(png.tobytes())


def plain_reading(history: History, row: Mapping[str, Any]) -> dict[str, Any]:
    """A reading for a page: its time, its neighbours', its spots and its frames.

    Args:
        history: the record.
        row: as `reading_near` gives it.
    """
    numbers = row["content"]["numbers"]
    return {
        "time_us": row["time_us"],
        "utc": utc_text(row["time_us"]),
        "before_us": row["before_us"],
        "after_us": row["after_us"],
        "source": row["file"],
        "sha256": row["sha256"],
        "sigma_holds": numbers.get("sigma_holds"),
        "spots": spots_of(row),
        "frames": [file.plain for file in frames_of(history, row)],
    }
