"""Zernike terms in every order against GalSim, prysm and quadrature; tables of coefficients as one and the same."""

from pathlib import Path

import numpy as np
import pytest

from analysis.wavefront_maps.map_files import MapError
from analysis.wavefront_maps.zernike_table import (
    MOST_TERMS,
    ansi_to_nm,
    circle_terms,
    edge_value,
    fringe_to_nm,
    nm_to_noll,
    noll_to_nm,
    read_zernikes,
)
from optics.geometry import zernike
from tests.analysis.refusals import refuses

# fmt: off
FRINGE_BY_PRYSM = [
    (0, 0), (1, 1), (1, -1), (2, 0), (2, 2), (2, -2), (3, 1), (3, -1), (4, 0), (3, 3), (3, -3), (4, 2), (4, -2),
    (5, 1), (5, -1), (6, 0), (4, 4), (4, -4), (5, 3), (5, -3), (6, 2), (6, -2), (7, 1), (7, -1), (8, 0), (5, 5),
    (5, -5), (6, 4), (6, -4), (7, 3), (7, -3), (8, 2), (8, -2), (9, 1), (9, -1), (10, 0),
]
"""prysm.polynomials.fringe_to_nm (2026) of 1 to 36."""
# fmt: on


def ring(inner: float, count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    r, t = np.sqrt(rng.uniform(inner**2, 1.0, count)), rng.uniform(0.0, 2.0 * np.pi, count)
    return r * np.cos(t), r * np.sin(t)


def test_terms_are_those_of_the_trace():
    x, y = ring(0.0)
    np.testing.assert_allclose(circle_terms(range(1, 67), x, y), zernike.basis(66, x, y), rtol=0, atol=2e-12)


def test_high_terms_keep_their_digits():
    """To the 30th order, where sums of monomials have lost all: unit mean squares by quadrature."""
    node, weight = np.polynomial.legendre.leggauss(40)
    radius, angle = np.sqrt(0.5 + 0.5 * node), 2.0 * np.pi * np.arange(61) / 61
    x, y = (np.outer(radius, f(angle)).ravel() for f in (np.cos, np.sin))
    basis = circle_terms([1, 4, 300, 400, 480, MOST_TERMS], x, y)
    gram = basis.T @ (np.repeat(weight, 61)[:, None] * basis) / (2.0 * 61)
    np.testing.assert_allclose(gram, np.eye(6), rtol=0, atol=1e-12)


def test_orders_of_every_program():
    assert [fringe_to_nm(j) for j in range(1, 37)] == FRINGE_BY_PRYSM
    assert fringe_to_nm(37) == (12, 0)
    assert [ansi_to_nm(j) for j in range(6)] == [(0, 0), (1, -1), (1, 1), (2, -2), (2, 0), (2, 2)]
    assert [noll_to_nm(j) for j in range(1, 67)] == [zernike.noll_to_nm(j) for j in range(1, 67)]
    for to_nm, first in ((noll_to_nm, 1), (ansi_to_nm, 0)):
        orders = [to_nm(j) for j in range(first, first + MOST_TERMS)]
        assert len(set(orders)) == MOST_TERMS
        assert [noll_to_nm(nm_to_noll(n, m)) for n, m in orders] == orders
    for to_nm, index in ((noll_to_nm, 0), (noll_to_nm, MOST_TERMS + 1), (fringe_to_nm, 38), (ansi_to_nm, -1)):
        refuses(ValueError, "are known", to_nm, index)


def test_terms_of_unit_peak_reach_one_at_the_edge():
    for index in range(1, 37):
        n, m = noll_to_nm(index)
        angle = 0.5 * np.pi / m if m < 0 else 0.0
        peak = circle_terms([index], np.cos([-angle]), np.sin([-angle]))[0, 0] / edge_value(n, m)
        assert abs(peak) == pytest.approx(1.0, abs=1e-12)


WAVE = {4: 12e-9, 5: -3e-9, 6: 1e-9, 7: 4e-9, 8: -8e-9, 11: 5e-9}
"""Noll's terms of unit rms."""
INDICES = {
    "noll": {4: 4, 5: 5, 6: 6, 7: 7, 8: 8, 11: 11},
    "fringe": {4: 4, 5: 6, 6: 5, 7: 8, 8: 7, 11: 9},
    "ansi": {4: 4, 5: 3, 6: 5, 7: 7, 8: 8, 11: 12},
}
"""Noll's index -> that of the order, by the definitions."""
UNITS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "\u03bcm": 1e-6, "nm": 1e-9, "waves": 632.8e-9}


def text_of(order: str, size: str, unit: str, form: str) -> str:
    names, values = [], []
    # in no order of its own
    for noll, metres in sorted(WAVE.items(), key=lambda item: item[1]):
        # the program's own term, scaled so that it reaches 1 at the edge where it has unit peak
        own = 1.0 if size == "rms" else edge_value(*noll_to_nm(noll))
        names.append(INDICES[order][noll])
        values.append(repr(metres * own / UNITS[unit]))
    head = f"# order: {order}\n# normalised: {size}\n# unit: {unit}\n# wavelength: 632.8 nm\n# by someone\n"
    if form == "long":
        body = "index;coefficient\n" + "".join(f"{n};{v}\n" for n, v in zip(names, values, strict=True))
    else:
        body = "field," + ",".join(f"Z{n}" for n in names) + "\nleft," + ",".join(values) + "\n"
        body += "right," + ",".join(f"{2.0 * float(v)!r}" for v in values) + "\n"
    return head + body


@pytest.mark.second
@pytest.mark.parametrize("order", ["noll", "fringe", "ansi"])
@pytest.mark.parametrize("size", ["rms", "peak"])
@pytest.mark.parametrize("unit", UNITS)
def test_tables_of_one_wavefront_are_the_same(tmp_path, order, size, unit):
    path = tmp_path / "z.csv"
    for form in ("long", "wide"):
        path.write_text(text_of(order, size, unit, form), "utf-8")
        found = read_zernikes(path)
        assert found.terms == tuple(WAVE)
        np.testing.assert_allclose(found.coefficients[0], list(WAVE.values()), rtol=1e-14, atol=0)
        if form == "wide":
            np.testing.assert_allclose(found.coefficients[1], 2.0 * np.array(list(WAVE.values())), rtol=1e-14)
            assert found.others == {"field": ("left", "right")}


def test_the_unit_in_the_head_of_a_column(tmp_path):
    path = tmp_path / "z.csv"
    path.write_text("# order: noll\n# normalised: rms\nx [deg]\tZ4 [nm]\tZ5 [nm]\n-1\t10\t20\n")
    found = read_zernikes(path)
    np.testing.assert_allclose(found.coefficients, [[10e-9, 20e-9]], rtol=1e-15)
    assert found.others == {"x [deg]": ("-1",)}
    path.write_text("# order: osa\n# normalised: rms\nj,value [um]\nZ4,10\n5,20\n")
    np.testing.assert_allclose(read_zernikes(path).coefficients, [[10e-6, 20e-6]])


SAID = "# order: noll\n# normalised: rms\n# unit: nm\n"
BAD = {
    "order": ("# unit: nm\n# normalised: rms\nZ4\n1\n", "does not state its order: add a line '# order: noll'"),
    "size": ("# unit: nm\n# order: noll\nZ4\n1\n", "does not state its normalised"),
    "unit": ("# order: noll\n# normalised: rms\nZ4\n1\n", "does not state its unit"),
    "waves": ("# order: noll\n# normalised: rms\n# unit: waves\nZ4\n1\n", "does not state the wavelength"),
    "unknown": (
        "# order: zemax\n# normalised: rms\n# unit: nm\nZ4\n1\n",
        "order is 'zemax'; noll, fringe, ansi, osa, osa/ansi are",
    ),
    "two units": (SAID + "Z4 [um]\n1\n", "more than one unit"),
    "head": (SAID + "a,b\n1,2\n", "line 4: the head names neither terms"),
    "cells": (SAID + "Z4,Z5\n1,2\n1\n", "line 6: 1 cells, the head of the table has 2"),
    "text": (SAID + "Z4,Z5\n1,x\n", "line 5: 'x' is not a coefficient"),
    "infinite": (SAID + "Z4,Z5\n1,1e400\n", "line 5: '1e400' is not a coefficient"),
    "index": (SAID + "index,value\nfour,1\n", "line 5: 'four' is not the index"),
    "twice": (SAID + "index,value\n4,1\n4,2\n", "has term 4 more than once"),
    "zero": (SAID + "Z0\n1\n", "Noll's terms 1 to 496 are known, not 0"),
    "rows": (SAID + "Z4\n", "no row below"),
    "nothing": (SAID, "holds no table"),
    "wavelength": (SAID + "# wavelength: 632.8\nZ4\n1\n", "a positive length with its unit is needed"),
    "waves long": (SAID + "# wavelength: 2 waves\nZ4\n1\n", "a length is needed: 632.8 nm"),
    "huge": (SAID.replace("nm", "waves") + "# wavelength: 1000 m\nZ4\n1e308\n", "coefficient is not a finite number"),
    "cell": (SAID + "Z4\n" + "1" * 140_000, "is not a table: field larger than field limit"),
    "long": (SAID + "Z4\n" + "1\n" * 5_100_000, "is too long for a table"),
}


@pytest.mark.parametrize("case", BAD)
def test_tables_without_a_meaning_are_refused(tmp_path, case):
    text, told = BAD[case]
    path = tmp_path / "z.csv"
    path.write_text(text)
    with pytest.raises(MapError) as error:
        read_zernikes(path)
    assert told in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_statements_that_contradict_the_table(tmp_path):
    path = tmp_path / "z.csv"
    path.write_text(text_of("fringe", "peak", "nm", "long"))
    refuses(MapError, "remove the specification", read_zernikes, path, wavelength=5e-7)
    refuses(MapError, "there is no file", read_zernikes, Path(tmp_path / "other.csv"))
    refuses(MapError, "is no file", read_zernikes, tmp_path)
    refuses(MapError, "cannot be read: Input/output error", read_zernikes, "/proc/self/mem")
    with path.open("wb") as file:
        file.truncate(101_000_000)
    refuses(MapError, "101 MB, at most 100 MB are read: save a smaller map", read_zernikes, path)
