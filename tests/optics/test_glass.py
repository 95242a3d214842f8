"""Glasses and materials against data sheets and handbooks."""

import pytest

from optics.materials.glass import FORMULAS, GLASSES, CatalogueGlass, air_index, glass
from optics.materials.material import MATERIALS, material

D_LINE, E_LINE, F_LINE, C_LINE = 587.5618e-9, 546.074e-9, 486.1327e-9, 656.2725e-9
FUSED_SILICA, N_BK7, ZERODUR = (GLASSES[name] for name in ("fused silica", "N-BK7", "Zerodur"))


@pytest.mark.parametrize(
    ("name", "nd", "abbe", "tolerance"),
    [("N-BK7", 1.5168, 64.17, 5e-6), ("fused silica", 1.458464, 67.82, 5e-6), ("Zerodur", 1.5424, 56.1, 5e-5)],
)
def test_catalogue_index_and_abbe_number(name: str, nd: float, abbe: float, tolerance: float) -> None:
    entry = glass(name)
    assert entry.index(D_LINE) == pytest.approx(nd, abs=tolerance)
    got = (entry.index(D_LINE) - 1) / (entry.index(F_LINE) - entry.index(C_LINE))
    assert got == pytest.approx(abbe, rel=2e-3)


UV, IR, W2 = (1.2, 0.09), (0.9, 9.0), 0.36
"""A glass with resonances at 0.3 and 3 um, n^2 = 1 + 1.2 w^2 / (w^2 - 0.09) + 0.9 w^2 / (w^2 - 9), at w = 0.6 um."""


def low(count: int) -> list[float]:
    """Factors of w^-2, w^-4 ... of the first resonance, a geometric series; the last stands for its rest, too."""
    terms = [UV[0] * UV[1] ** k for k in range(1, count + 1)]
    return [*terms[:-1], terms[-1] / (1 - UV[1] / W2)]


def high(count: int) -> list[float]:
    """Those of w^2, w^4 ... of the second."""
    terms = [-IR[0] / IR[1] ** k for k in range(1, count + 1)]
    return [*terms[:-1], terms[-1] / (1 - W2 / IR[1])]


HALVES, FIRST = (0.5 * UV[0], UV[1]) * 2, 1 + UV[0]
FAR, WAVE = 1.0 / (W2 - 0.028), W2**0.5
COEFFICIENTS = {
    1: (FIRST, *high(1), *low(4)),
    2: (*HALVES, *IR),
    3: (1.4, 0.1 / FAR, 0.02 / FAR**2, -3e-3 / W2, 4e-4 / W2**2, -5e-5 / W2**3),
    4: (IR[0], UV[0], UV[1] ** 0.5, IR[0] * IR[1], IR[1] ** 0.5),
    5: (1.5, 0.02 * WAVE, 0.003 * WAVE**3.5),
    6: (*HALVES, 0.4, IR[1], IR[0] - 0.4, IR[1]),
    7: (FIRST, UV[0] * UV[1], UV[1], -high(1)[0]),
    8: (1.0, *UV, -high(1)[0]),
    9: (1.0, *UV, *IR),
    10: (FIRST, *high(1), *low(6)),
    11: (*HALVES, 0.4, IR[1], 0.3, IR[1], IR[0] - 0.7, IR[1]),
    12: (FIRST, high(3)[0], *low(4), *high(3)[1:]),
    13: (FIRST, *high(2), *low(6)),
}
OTHERS = {3: 1.4 + 0.1 + 0.02 - 3e-3 + 4e-4 - 5e-5, 5: 1.5 + 0.02 + 0.003}
"""Indices by the formulas of n and not of its square: each coefficient has its power of the wavelength taken out."""


@pytest.mark.parametrize("number", FORMULAS)
def test_every_formula_of_the_catalogues_describes_one_glass(number: int) -> None:
    index = OTHERS.get(number, (1 + UV[0] * W2 / (W2 - UV[1]) + IR[0] * W2 / (W2 - IR[1])) ** 0.5)
    own = CatalogueGlass("G", number, (*COEFFICIENTS[number], *[0.0] * 6), 300e-9, 2e-6)
    assert own(600e-9) == pytest.approx(index, rel=1e-12)


def test_dn_dt_of_bk7_as_its_data_sheet_states_it() -> None:
    # Schott, N-BK7: absolute dn/dT in 1e-6/K, mean over +20..+40 C, at 1060.0 nm, e and g lines
    stated = {1060.0e-9: 1.1, E_LINE: 1.6, 435.8343e-9: 2.1}
    for wavelength, want in stated.items():
        mean = (N_BK7.index(wavelength, 313.15) - N_BK7.index(wavelength, 293.15)) / 20.0
        assert mean * 1e6 == pytest.approx(want, abs=0.06)


def test_dn_dt_of_fused_silica() -> None:
    # absolute, Corning 7980 at 293 K: 8.74e-6/K in the visible, 8.16e-6/K at 1.55 um (Rego, Sensors 23, 6023 (2023));
    # other makers' silica differs by some per cent
    assert FUSED_SILICA.dn_dt(600e-9) == pytest.approx(8.74e-6, rel=0.06)
    assert FUSED_SILICA.dn_dt(1550e-9) == pytest.approx(8.16e-6, rel=0.06)


@pytest.mark.parametrize("entry", [N_BK7, FUSED_SILICA])
def test_dn_dt_is_the_slope_of_the_index(entry) -> None:
    for temperature in (250.0, 293.15, 330.0):
        h = 0.01
        difference = (entry.index(D_LINE, temperature + h) - entry.index(D_LINE, temperature - h)) / (2 * h)
        assert entry.dn_dt(D_LINE, temperature) == pytest.approx(difference, rel=1e-7)


def test_vacuum_index_is_that_of_the_glass_times_the_air() -> None:
    assert air_index(D_LINE) - 1 == pytest.approx(2.724e-4, abs=5e-7)  # Edlen: 2.7240e-4 at 20 C, 1013.25 hPa
    assert N_BK7.vacuum_index(D_LINE) == pytest.approx(N_BK7.index(D_LINE) * 1.00027236, abs=5e-7)
    step = N_BK7.vacuum_index(D_LINE, 303.15) - N_BK7.vacuum_index(D_LINE)
    assert step == pytest.approx(N_BK7.index(D_LINE, 303.15) - N_BK7.index(D_LINE), rel=1e-9)


def test_outside_of_ranges_is_refused_by_name() -> None:
    for entry in GLASSES.values():
        for wavelength in (0.99 * entry.shortest, 1.01 * entry.longest, float("nan")):
            with pytest.raises(ValueError, match=f"{entry.name}: wavelength .* nm is outside"):
                entry.index(wavelength)
        assert entry.index(entry.shortest) > entry.index(entry.longest)
        assert entry.source
    for temperature in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="N-BK7: a temperature must be above 0 K"):
            N_BK7.index(D_LINE, temperature)
    assert ZERODUR.index(D_LINE, 293.15) > 1.5
    with pytest.raises(ValueError, match="Zerodur: no constants"):
        ZERODUR.index(D_LINE, 300.0)
    assert glass("n-bk7") is N_BK7
    with pytest.raises(KeyError, match="did you mean 'N-BK7'"):
        glass("N-BK8")


# name: range of CTE 1e-6/K, density, E GPa that handbooks give
PLAUSIBLE = {
    "Zerodur": ((-0.1, 0.1), (2520, 2540), (89, 92)),
    "fused silica": ((0.48, 0.58), (2195, 2210), (70, 74)),
    "N-BK7": ((7.0, 7.2), (2500, 2520), (81, 83)),
    "SiC": ((2.0, 2.6), (3100, 3210), (400, 470)),
    "Invar": ((0.5, 1.6), (8000, 8150), (137, 150)),
    "Ti-6Al-4V": ((8.5, 9.0), (4420, 4440), (105, 120)),
    "alumina": ((4.6, 7.2), (3600, 3990), (300, 420)),
    "AlN": ((2.5, 4.6), (3250, 3300), (310, 350)),
    "CFRP": ((-1.0, 1.0), (1500, 1800), (60, 200)),
    "aluminium": ((23, 24), (2690, 2720), (68, 71)),
}


def test_numbers_are_those_of_the_material() -> None:
    assert set(MATERIALS) == set(PLAUSIBLE)
    for name, (expansion, density, modulus) in PLAUSIBLE.items():
        entry = material(name)
        assert expansion[0] <= entry.expansion * 1e6 <= expansion[1], name
        assert density[0] <= entry.density <= density[1], name
        assert modulus[0] <= entry.youngs_modulus * 1e-9 <= modulus[1], name
        assert 0.1 < entry.poisson_ratio < 0.4, name
        assert 1.0 < entry.conductivity < 250.0, name
    assert all(material(name).name == name for name in GLASSES)


def test_names_and_refusals() -> None:
    others = {"BK7": "N-BK7", "titanium": "Ti-6Al-4V", "Al2O3": "alumina", "aluminum": "aluminium"}
    assert {name: material(name).name for name in others} == others
    for wrong, words in (("inver", "did you mean 'Invar'"), ("xyz", "known: AlN, CFRP, Invar")):
        with pytest.raises(KeyError, match=words):
            material(wrong)
