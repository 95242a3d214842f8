"""Files of measurements with something wrong in them: refused with file, line, column and remedy, never misread."""

import re
import shutil

import pytest

import twin.orbit.__main__ as command
from scenes.yaml.errors import InputError
from tests.twin.commands import invoke
from tests.twin.orbit_files import export, flown, read_back, small


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """Files of a small campaign over one field."""
    setup = small()
    fields = type(setup.test.fields)({"Beijing": setup.test.fields["Beijing"]})
    setup = setup.model_copy(
        update={"test": setup.test.model_copy(update={"fields": fields, "schemes": (("Beijing",),)})}
    )
    folder = tmp_path_factory.mktemp("clean")
    export(folder, setup, flown(setup))
    return folder


@pytest.fixture
def folder(tmp_path, clean):
    """A copy to spoil."""
    shutil.copytree(clean, tmp_path / "data")
    return tmp_path / "data"


def cell(line: int, column: int, text: str):
    """Another cell; lines count from 1 as messages do."""

    def change(content: str) -> str:
        rows = content.split("\n")
        cells = rows[line - 1].split(",")
        cells[column] = text
        rows[line - 1] = ",".join(cells)
        return "\n".join(rows)

    return change


def again(line: int):
    """A row twice."""

    def change(content: str) -> str:
        rows = content.split("\n")
        return "\n".join([*rows[:line], rows[line - 1], *rows[line:]])

    return change


def kept(*lines: int):
    """The head and some rows."""

    def change(content: str) -> str:
        rows = content.split("\n")
        return "\n".join([rows[0], *(rows[k - 1] for k in lines)]) + "\n"

    return change


def swapped(old: str, new: str):
    """Every occurrence of a text."""

    def change(content: str) -> str:
        assert old in content
        return content.replace(old, new)

    return change


ORBIT = {
    "empty": (lambda _: "", ["an empty table"]),
    "no rows": (kept(), ["0 rows", "2 or more"]),
    "one row": (kept(2), ["1 rows", "2 or more"]),
    "no unit": (swapped("x [m]", "x"), [":1: x", "without a unit"]),
    "wrong unit": (swapped("x [m]", "x [s]"), [":1: x [s]"]),
    "column missing": (swapped("x [m]", "vx [m/s]"), [":1"]),
    "unknown column": (swapped("vz [m/s]", "speed [m/s]"), [":1: speed", "no such column"]),
    "velocity of two axes": (swapped(", vz [m/s]", ", "), ["column"]),
    "no number": (cell(5, 1, "abc"), [":5: x [m]", "not a number", "'abc'"]),
    "not finite": (cell(6, 2, "nan"), [":6: y [m]", "not a finite number"]),
    "time twice": (again(7), [":8: time [s]", "stands twice"]),
    "another place": (cell(9, 1, "1.0"), [":8: x [m]", "a jump of the orbit"]),
    "in the Earth": (lambda t: cell(9, 1, "1.0")(cell(9, 2, "1.0")(t)), [":9: x [m]", "no place of a satellite"]),
    "kilometres under m": (swapped("[m]", "[mm]"), [":2: x [mm]", "no place of a satellite", "unit"]),
    "another velocity": (swapped("vx [m/s], vy [m/s]", "vy [m/s], vx [m/s]"), ["not the velocity of these positions"]),
    "cells missing": (lambda text: text.replace("\n", ",1\n", 3).replace(",1", "", 1), ["cells under"]),
    "binary": (lambda _: "\0\x01", [":1"]),
}
ATTITUDE = {
    "empty": (lambda _: "", ["an empty table"]),
    "one row": (kept(2), ["1 rows", "2 or more"]),
    "three numbers": (swapped(", q4", ", "), ["column"]),
    "unknown column": (swapped("q1", "qx"), [":1: qx", "no such column"]),
    "q with a unit": (swapped("q1", "q1 [m]"), [":1: q1 [m]", "no unit"]),
    "no number": (cell(3, 2, "-"), [":3: q2", "not a number"]),
    "empty cell": (cell(3, 2, ""), [":3: q2", "not a number"]),
    "comma for a point": (lambda t: t.replace(",", ";").replace(".", ","), [":2: time [s]", "not a number", "point"]),
    "infinite": (cell(4, 1, "inf"), [":4: q1", "not a finite number"]),
    "degrees": (cell(4, 1, "34.5"), [":4: q1", "out of range"]),
    "no unit quaternion": (cell(10, 1, "0.0"), [":10: q1", "no unit quaternion", "norm 1"]),
    "turned around": (cell(12, 4, "-0.35"), [":12: q1", "no unit quaternion"]),
    "another attitude": (
        lambda t: cell(12, 1, "0")(cell(12, 2, "0")(cell(12, 3, "0")(cell(12, 4, "1")(t)))),
        [":12: q1", "a jump of the attitude"],
    ),
    "time twice": (again(30), [":31: time [s]", "stands twice"]),
    "too short for the lines": (kept(*range(2, 300)), ["lines.csv:", "outside the readings", "leave out"]),
}
LINES = {
    "empty": (lambda _: "", ["an empty table"]),
    "no rows": (kept(), ["0 rows"]),
    "no such camera": (
        swapped("forward,0.0", "foreward,0.0"),
        [":2: camera", "no such camera", "did you mean 'forward'"],
    ),
    "one line": (kept(2, 4, 5, 6, 7), [":2: line", "tells no line time"]),
    "line twice": (cell(3, 1, "0.0"), [":3: line", "stands twice"]),
    "times fall": (cell(3, 2, "-59.9997"), [":3: time [s]", "do not rise"]),
    "no number": (cell(2, 1, "first"), [":2: line", "not a number"]),
    "no unit": (swapped("time [s]", "time"), [":1: time", "without a unit"]),
    "a length": (swapped("time [s]", "time [m]"), [":1: time [m]"]),
    "outside the orbit": (cell(3, 2, "1000.0"), ["lines.csv", "outside the readings", "-60 s to 60 s"]),
    "before the orbit": (cell(2, 2, "-100.0"), [":2: time [s]", "outside the readings"]),
    "not finite": (cell(3, 2, "inf"), [":3: time [s]", "not a finite number"]),
    "camera without times": (kept(2, 3, 4, 5), ["image_points.csv:", "camera", "no such camera", "forward"]),
}
GROUND = {
    "empty": (lambda _: "", ["an empty table"]),
    "no rows": (kept(), ["0 rows"]),
    "point twice": (again(5), [":6: point", "stands twice, first on line 5"]),
    "no such role": (cell(3, 1, "chek"), [":3: role", "no such role", "did you mean 'check'"]),
    "geodetic": (
        lambda t: re.sub(r"-?\d{7}\.\d+,-?\d{7}\.\d+,-?\d{7}\.\d+", "116.4,40.0,400.0", t),
        [":2: x [m]", "not geodetic"],
    ),
    "kilometres": (swapped("z [m]", "z [km]"), [":2: z [km]", "out of range"]),
    "no sigma": (swapped(", sigma [m]", ", "), ["column"]),
    "negative sigma": (cell(4, 5, "-1.0"), [":4: sigma [m]", "out of range", "0 to 1e+06"]),
    "some exact": (cell(4, 5, "0.0"), [":4: sigma [m]", "some sigmas are zero"]),
    "sigma of a plan alone": (swapped("sigma [m]", "plan_sigma [m]"), ["no column 'height_sigma'"]),
    "two ways": (lambda t: _with_column(t, "plan_sigma [m]", "1.0"), ["sigmas are given in two ways"]),
    "no correlation": (lambda t: _with_column(t, "correlation_xy", "0.1"), ["correlations go with x_sigma"]),
    "no covariance": (lambda t: _correlated(t), [":2: correlation_xy", "these correlations contradict each other"]),
    "nobody controls": (swapped("control", "check"), ["no control point is seen"]),
    "nobody checks": (lambda t: t.replace("check", "control").replace(",0.0\n", ",1.0\n"), ["no check point is seen"]),
    "no name": (cell(3, 0, ""), [":3: point", "an empty cell"]),
    "a point less": (kept(*range(3, 46)), ["image_points.csv:2: point", "no coordinates", "tie_points"]),
}
IMAGES = {
    "empty": (lambda _: "", ["an empty table"]),
    "no rows": (kept(), ["0 rows"]),
    "no such camera": (cell(3, 1, "nadirr"), [":3: camera", "no such camera", "did you mean 'nadir'"]),
    "no such point": (cell(3, 0, "c999"), [":3: point", "no coordinates", "'c999'"]),
    "point twice": (again(6), [":7: point", "stands twice in forward"]),
    "outside along": (cell(4, 2, "-7.0"), [":4: line", "outside the image", "-0.5 to 171426.5"]),
    "outside across": (cell(4, 3, "12000.0"), [":4: pixel", "outside the image", "-0.5 to 11999.5"]),
    "no sigma": (swapped("line_sigma", "lines_sigma"), [":1: lines_sigma", "did you mean 'line_sigma'"]),
    "zero sigma": (cell(5, 4, "0.0"), [":5: line_sigma", "out of range"]),
    "negative sigma": (cell(5, 5, "-0.3"), [":5: pixel_sigma", "out of range"]),
    "correlation of 2": (lambda t: _with_column(t, "correlation", "2.0"), [":2: correlation", "out of range"]),
    "with a unit": (swapped("pixel", "pixel [mm]"), [":1: pixel [mm]", "no unit"]),
    "one camera": (
        lambda t: "\n".join(r for r in t.split("\n") if "nadir" not in r and "backward" not in r),
        ["no check point is seen by two"],
    ),
    "no number": (cell(5, 2, "1_000"), [":5: line", "not a number"]),
}


def _with_column(text: str, head: str, value: str) -> str:
    head_row, *rows = text.strip().split("\n")
    return "\n".join([f"{head_row}, {head}", *(f"{row},{value}" for row in rows)]) + "\n"


def _correlated(text: str) -> str:
    """Sigmas along all axes, of which each is against another what the third denies."""
    text = text.replace("sigma [m]", "x_sigma [m]")
    for head, value in (("y_sigma [m]", "1"), ("z_sigma [m]", "1"), ("correlation_xy", "1"), ("correlation_xz", "1")):
        text = _with_column(text, head, value)
    return _with_column(text, "correlation_yz", "-1")


TABLES = {"orbit": ORBIT, "attitude": ATTITUDE, "lines": LINES, "ground": GROUND, "image_points": IMAGES}


@pytest.mark.parametrize(("table", "case"), [(t, c) for t, cases in TABLES.items() for c in cases])
def test_a_table_is_refused(folder, table, case) -> None:
    """With its path, and what the user needs to mend it."""
    change, words = TABLES[table][case]
    file = folder / "Beijing" / f"{table}.csv"
    file.write_text(change(file.read_text()))
    with pytest.raises(InputError) as told:
        read_back(folder / "calibrate.yaml")
    text = str(told.value)
    assert "Beijing/" in text
    for word in words:
        assert word in text, text


SAID = {
    "another frame": (swapped("frame: itrs", "frame: moon"), ["frame", "itrs"]),
    "another order": (swapped("scalar: last", "scalar: middle"), ["scalar", "first", "last"]),
    "left-handed": (swapped("[forward, right, down]", "[forward, right, up]"), ["body_axes", "right-handed"]),
    "axis twice": (swapped("[forward, right, down]", "[forward, forward, down]"), ["body_axes"]),
    "first pixel 2": (swapped("first_pixel: 0", "first_pixel: 2"), ["first_pixel"]),
    "epoch without its zone": (swapped("03:05:00Z", "03:05:00"), ["epoch", "without its zone"]),
    "no such table": (swapped("Beijing/orbit.csv", "Beijing/orbits.csv"), ["orbits.csv", "no such file", "orbit.csv"]),
    "a folder": (swapped("Beijing/orbit.csv", "Beijing"), ["not a regular file"]),
    "no passes": (lambda t: t[: t.index("passes:")] + "passes: {}\n", ["passes"]),
}
TESTS = {
    "no such folder": (swapped("data: .\n", "data: elsewhere\n"), ["data", "no such measurements", "data.yaml"]),
    "no such field": (swapped("- [Beijing]", "- [Peking]"), ["schemes", "no such field", "Beijing"]),
    "no schemes": (swapped("schemes:\n  - [Beijing]\n", "schemes: []\n"), ["schemes", "no schemes"]),
    "no noise": (lambda t: re.sub(r"    noise: \[50 mm.*\n", "", t), ["errors", "gps", "noise"]),
    "bias is estimated": (
        swapped("  season:", "  bias: [1 arcsec, 1 arcsec, 1 arcsec]\n  season:"),
        ["errors", "bias"],
    ),
    "noise without unit": (swapped("noise: [50 mm", "noise: [50"), ["noise", "without a unit"]),
    "screening": (swapped("screening: none", "screening: maybe"), ["screening", "robust"]),
    "passes as well": (lambda t: t + "passes: {}\n", ["data", "once"]),
}
SAID["ties of control"] = (
    swapped(
        "    image_points: Beijing/image_points.csv\n",
        "    image_points: Beijing/image_points.csv\n    tie_points: Beijing/image_points.csv\n",
    ),
    ["this point has coordinates in", "another name"],
)
SAID["no quaternion"] = (lambda t: re.sub(r"  quaternion:\n(    .*\n)+", "", t), ["quaternion is missing"])
FILES = {"data": SAID, "calibrate": TESTS}


@pytest.mark.parametrize(("name", "case"), [(n, c) for n, cases in FILES.items() for c in cases])
def test_a_file_that_does_not_say_all_is_refused(folder, name, case) -> None:
    """By file and key."""
    change, words = FILES[name][case]
    file = folder / f"{name}.yaml"
    file.write_text(change(file.read_text()))
    with pytest.raises(InputError) as told:
        read_back(folder / "calibrate.yaml")
    text = str(told.value)
    for word in words:
        assert word in text, text


def test_the_command_ends_with_2_and_writes_nothing(folder) -> None:
    """As every bad input."""
    file = folder / "Beijing/ground.csv"
    file.write_text(cell(3, 1, "chek")(file.read_text()))
    out, data = folder / "run", folder / "again"
    result = invoke(command.app, "calibrate", folder / "calibrate.yaml", "--out", out, "--export", data)
    assert result.exit_code == 2
    assert "ground.csv:3: role: no such role" in " ".join(result.stderr.split())
    assert not out.exists()
    assert not data.exists()
