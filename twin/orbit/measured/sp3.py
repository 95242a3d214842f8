"""Orbits in SP3-c and SP3-d files (Hilla, The Extended Standard Product 3 Orbit Format, 2010 and 2016), and in the
older SP3-a and SP3-b (Remondi 1991, Gurtner 1998), whose times are GPS and whose satellites are numbers.

Positions are kilometres, velocities dm/s, both Earth-fixed; the time system stands in the header. A position of zeros
is a missing one. A file without its last line EOF is whole where it has as many epochs as its header says.
"""

from __future__ import annotations

from pathlib import Path

from scenes.yaml.errors import InputError, Issue, Problem, names_text, nearest, shown
from twin.orbit.measured.clock import known_scale
from twin.orbit.measured.platform_readings import OrbitReadings, known_frame, require_orbit
from twin.orbit.measured.text_file import numbers, readings, require_rising, text_lines

WHAT = "an SP3 file"


def is_sp3(first: str) -> bool:
    """Whether a file that begins with this line is one."""
    return first.startswith(("#a", "#b", "#c", "#d")) and not first.startswith("##")


def read_sp3(path: str | Path, satellite: str | None = None) -> OrbitReadings:
    """The orbit of a satellite.

    Args:
        path: of the file.
        satellite: its number as the file has it, L51; may be left out where there is one only.

    Raises:
        InputError: no such satellite, fewer than two places, a line that cannot be read, a file that ends early.
    """
    file, lines = str(path), text_lines(path, WHAT)
    head = lines[0]
    old = head[:2] in ("#a", "#b")
    which = _name(satellite, lines, old) if satellite else _only_satellite(file, lines)
    scale = _scale(file, lines, old)
    system = head[46:51].strip()
    frame = known_frame(system, file, 1, "coordinate system") if system not in ("", "UNDEF") else None
    texts, where, places, rows, speeds, speed_rows = [], [], [], [], [], []
    epoch: str | None = None
    ended = last_used = False
    epochs = 0
    for k, line in enumerate(lines):
        mark = line[:1]
        if mark == "*":
            epoch, last_used, epochs = _epoch(file, k + 1, line), False, epochs + 1
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
    stated = head[32:39].strip()
    if not ended and not (stated.isdigit() and int(stated) == epochs and last_used):
        found = f"{epochs} of {stated} epochs" if stated.isdigit() else None
        allowed = "EOF as the last line, or all epochs of the header"
        raise InputError(Issue("the file ends early", file, len(lines), (), found, allowed))
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


def _name(wanted: str, lines: list[str], old: bool) -> str:
    """As a file spells it: in the old versions 5, 05 and G05 are one."""
    names = {line[1:4].strip() for line in lines if line[:1] == "P"}
    if wanted in names or not old:
        return wanted
    number = wanted.lstrip("Gg").lstrip("0")
    return next((n for n in sorted(names) if n.lstrip("Gg").strip().lstrip("0") == number), wanted)


def _unknown(file: str, lines: list[str], wanted: str) -> InputError:
    """What to say of a satellite that a file does not have."""
    names = list(dict.fromkeys(line[1:4].strip() for line in lines if line[:1] == "P"))
    issue = Issue(
        "no such satellite", file, None, ("satellite",), wanted, names_text(names[:20]), nearest(wanted, names)
    )
    return InputError(issue)


def _scale(file: str, lines: list[str], old: bool) -> str:
    for k, line in enumerate(lines[:400]):
        if line.startswith("%c"):
            if old and line[9:12].lower() in ("ccc", "", "   "):
                return known_scale("GPS")
            try:
                return known_scale(line[9:12])
            except Problem as problem:
                key = ("time system",)
                raise InputError(Issue(problem.problem, file, k + 1, key, problem.found, problem.allowed)) from None
    if old:
        return known_scale("GPS")
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
