import pytest

from optics.materials.glass import GLASSES
from optics.materials.material import MATERIALS, material

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
    others = {
        "BK7": "N-BK7",
        "titanium": "Ti-6Al-4V",
        "Al2O3": "alumina",
        "aluminium nitride": "AlN",
        "aluminum": "aluminium",
    }
    assert {name: material(name).name for name in others} == others
    for wrong, words in (("inver", "did you mean 'Invar'"), ("xyz", "known: AlN, CFRP, Invar")):
        with pytest.raises(KeyError, match=words):
            material(wrong)
