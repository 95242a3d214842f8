"""Orbits in SP3-c and SP3-d files (Hilla, The Extended Standard Product 3 Orbit Format, 2010 and 2016).

Positions are kilometres, velocities dm/s, both Earth-fixed; the time system stands in the header. A position of zeros
is a missing one.
"""

from __future__ import annotations

from pathlib import Path

from scenes.yaml.errors import InputError, Issue, Problem, names_text, nearest, shown
from twin.orbit.measured.clock import known_scale
from twin.orbit.measured.platform_readings import OrbitReadings, known_frame, require_orbit
from twin.orbit.measured.text_file import numbers, readings, require_rising, text_lines

WHAT = "an SP3-c or SP3-d file"


def is_sp3(first: str) -> bool:
    """Whether a file that begins with this line is one."""
    return first.startswith(("#a", "#b", "#c", "#d")) and not first.startswith("##")


def read_sp3(path: str | Path, satellite: str | None = None) -> OrbitReadings:
    """The orbit of a satellite.

    Args:
        path: of the file.
        satellite: its number as the file has it, L51; may be left out where there is one only.

    Raises:
        InputError: another version, no such satellite, fewer than two places, a line that cannot be read.
    """
    file, lines = str(path), text_lines(path, WHAT)
    head = lines[0]
    if head[:2] not in ("#c", "#d"):
        raise InputError(Issue("another version of SP3", file, 1, (), shown(head[:2]), "#c or #d"))
    which = satellite or _only_satellite(file, lines)
    scale = _scale(file, lines)
    system = head[46:51].strip()
    frame = known_frame(system, file, 1, "coordinate system") if system not in ("", "UNDEF") else None
    texts, where, places, rows, speeds, speed_rows = [], [], [], [], [], []
    epoch: str | None = None
    ended = last_used = False
    for k, line in enumerate(lines):
        mark = line[:1]
        if mark == "*":
            epoch, last_used = _epoch(file, k + 1, line), False
        elif mark in "PV" and line[1:4].strip() == which:
            if epoch is None:
                raise InputError(Issue("a record before the first epoch", file, k + 1, (), shown(line[:20]), WHAT))
            cells = [line[4:18], line[18:32], line[32:46]]
            if mark == "P":
                if not any(c.strip(" 0.-") for c in cells) and all(c.strip() for c in cells):
                    epoch_used = False
                else:
                    epoch_used = True
                    texts.append(epoch)
                    where.append(k + 1)
                    places.append(cells)
                    rows.append(k + 1)
                last_used = epoch_used
            elif rows and last_used:
                speeds.append(cells)
                speed_rows.append(k + 1)
        elif line.startswith("EOF"):
            ended = True
            break
    if not ended:
        raise InputError(Issue("the file ends early", file, len(lines), (), None, "EOF as the last line"))
    if not rows and satellite is not None:
        raise _unknown(file, lines, satellite)
    if len(rows) < 2:
        raise InputError(Issue(f"fewer than two places of {which}", file, None, (), str(len(rows)), "two or more"))
    clock = readings(file, texts, where)
    require_rising(file, clock, where)
    position = 1e3 * numbers(file, places, rows, ("x", "y", "z"))
    require_orbit(file, position, rows)
    velocity = None
    if speeds:
        if len(speeds) != len(rows):
            found = f"{len(speeds)} velocities and {len(rows)} positions"
            raise InputError(Issue("velocities are missing", file, None, (), found, "one for each position, or none"))
        velocity = 0.1 * numbers(file, speeds, speed_rows, ("vx", "vy", "vz"))
    return OrbitReadings(file, clock, position, velocity, frame, scale)


def _only_satellite(file: str, lines: list[str]) -> str:
    names = list(dict.fromkeys(line[1:4].strip() for line in lines if line[:1] == "P"))
    if len(names) != 1:
        found = names_text(names[:20]) or "none"
        raise InputError(Issue("which satellite is not said", file, None, ("satellite",), found, "the name of one"))
    return names[0]


def _unknown(file: str, lines: list[str], wanted: str) -> InputError:
    """What to say of a satellite that a file does not have."""
    names = list(dict.fromkeys(line[1:4].strip() for line in lines if line[:1] == "P"))
    issue = Issue(
        "no such satellite", file, None, ("satellite",), wanted, names_text(names[:20]), nearest(wanted, names)
    )
    return InputError(issue)


def _scale(file: str, lines: list[str]) -> str:
    for k, line in enumerate(lines[:400]):
        if line.startswith("%c"):
            try:
                return known_scale(line[9:12])
            except Problem as problem:
                key = ("time system",)
                raise InputError(Issue(problem.problem, file, k + 1, key, problem.found, problem.allowed)) from None
    raise InputError(Issue("no line %c with the time system", file, None, (), None, WHAT))


def _epoch(file: str, k: int, line: str) -> str:
    """Calendar text of an epoch header record."""
    cells = line[1:].split()
    try:
        year, month, day, hour, minute = (int(c) for c in cells[:5])
        whole, _, part = cells[5].partition(".")
        return f"{year:04d}-{month:02d}-{day:02d}T{hour:02d}:{minute:02d}:{int(whole):02d}.{part or '0'}"
    except (ValueError, IndexError):
        allowed = "*  2011  3  5  3  5  0.00000000"
        raise InputError(Issue("not an epoch", file, k, (), shown(line), allowed)) from None
