import pytest

from optics.materials.glass import GLASSES
from optics.materials.material import MATERIALS, Material, TemperatureRange, material

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


@pytest.mark.parametrize("name", list(PLAUSIBLE))
def test_numbers_are_those_of_the_material(name: str) -> None:
    entry = material(name)
    expansion, density, modulus = PLAUSIBLE[name]
    assert expansion[0] <= entry.expansion * 1e6 <= expansion[1]
    assert density[0] <= entry.density <= density[1]
    assert modulus[0] <= entry.youngs_modulus * 1e-9 <= modulus[1]
    assert 0.1 < entry.poisson_ratio < 0.4
    assert 1.0 < entry.conductivity < 250.0
    assert entry.source


def test_the_catalogue_is_complete() -> None:
    assert set(MATERIALS) == set(PLAUSIBLE)


@pytest.mark.parametrize("name", list(GLASSES))
def test_every_glass_has_a_material_of_its_name(name: str) -> None:
    assert material(name).name == name


def test_names() -> None:
    assert material("BK7") is material("n-bk7")
    assert material("titanium").name == "Ti-6Al-4V"
    assert material("Al2O3").name == "alumina"
    assert material("aluminium nitride").name == "AlN"
    assert material("aluminum") is material("Aluminium")
    with pytest.raises(KeyError, match="did you mean 'Invar'"):
        material("inver")
    with pytest.raises(KeyError, match="known: AlN, CFRP, Invar"):
        material("xyz")


ANY = TemperatureRange.celsius(-200.0, 200.0, "a test")


def test_impossible_solids_are_refused() -> None:
    with pytest.raises(ValueError, match="positive"):
        Material("x", 0.0, -1.0, 1.0, 0.3, 1.0, "", ANY)
    with pytest.raises(ValueError, match="Poisson"):
        Material("x", 0.0, 1.0, 1.0, 0.5, 1.0, "", ANY)
