"""Spectra and glasses of cameras: what files say, what means over them are."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy import constants
from scipy.integrate import quad

from optics.materials.glass import GLASSES
from optics.numerics.quadrature import gauss, gauss_of
from scenes.models.camera_model import coloured, glass_indices
from scenes.specs.camera import BandSpec, CameraSpec
from scenes.specs.load import load_camera
from scenes.specs.spectrum import SpectrumSpec
from scenes.yaml.spec import Spec, validate
from scenes.yaml.yaml_file import parse_yaml
from tests.scenes.lens.colour_cameras import colour_camera

TABLE = "wavelength [um],response\n0.45,0\n0.5,0.8\n0.6,1\n0.64,0.2\n0.7,0\n0.9,0\n"


class _Holder(Spec):
    spectrum: SpectrumSpec


def spectrum(text: str) -> SpectrumSpec:
    return validate(_Holder, parse_yaml(f"spectrum: {text}")).spectrum


def planck(wavelength: float, temperature: float) -> float:
    x = constants.h * constants.c / (wavelength * constants.k * temperature)
    return wavelength**-4 / np.expm1(x)


def test_gauss_rule_of_points_is_exact_for_their_polynomials() -> None:
    rng = np.random.default_rng(5)
    points, weights = rng.uniform(2.0, 3.0, 200), rng.uniform(0.1, 1.0, 200)
    node, share = gauss_of(points, weights, 6)
    for power in range(12):
        assert share @ node**power == pytest.approx(weights @ points**power, rel=1e-12)
    assert share @ node**13 != pytest.approx(weights @ points**13, rel=1e-14)
    # of Legendre's weight it is Legendre's rule
    fine, even = gauss(60)
    for ours, theirs in zip(gauss_of(fine, even, 9), gauss(9), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-13)
    alone, whole = gauss_of(np.array([2.0]), np.array([3.0]), 4)
    assert (alone.tolist(), whole.tolist()) == ([2.0], [3.0])


def test_an_even_band_is_what_it_was() -> None:
    pan = load_camera("gf7").bands["P"]
    assert pan.spectrum.ends == (450e-9, 900e-9)
    node, weight = gauss(7)
    wavelengths, weights = pan.spectrum.rule(7)
    np.testing.assert_array_equal(wavelengths, 0.5 * (450e-9 + 900e-9) + 0.5 * (900e-9 - 450e-9) * node)
    np.testing.assert_array_equal(weights, 0.5 * weight)
    assert pan.plain()["spectrum"] == ["450 nm", "900 nm"]
    assert pan.spectrum.even(3) == pytest.approx([450e-9, 675e-9, 900e-9])


def test_a_filter_in_a_black_bodys_light(tmp_path: Path) -> None:
    """Means by adaptive integration of Planck's law times the table's straight lines."""
    (tmp_path / "filter.csv").write_text(TABLE, "utf-8")
    text = colour_camera("achromat", "{table: filter.csv, black_body: 5800 K}").file_text("")
    (tmp_path / "camera.yaml").write_text(text, "utf-8")
    camera = load_camera(tmp_path / "camera.yaml")
    light = camera.spectrum
    assert light is not None
    assert light.ends == (450e-9, 700e-9)
    x, y = np.array([[0.45, 0.5, 0.6, 0.64, 0.7], [0.0, 0.8, 1.0, 0.2, 0.0]])

    def mean(of) -> float:
        def parts(function) -> float:
            pieces = pairwise(x)
            return sum(
                quad(lambda w: function(w) * np.interp(w, x, y) * planck(w * 1e-6, 5800.0), a, b)[0] for a, b in pieces
            )

        return parts(of) / parts(lambda w: 1.0)

    wavelengths, weights = light.rule(12)
    assert np.sum(weights) == pytest.approx(1.0, rel=1e-14)
    for of in (lambda w: w, lambda w: w**7, lambda w: np.cos(20.0 * w)):
        assert weights @ of(wavelengths * 1e6) == pytest.approx(mean(of), rel=1e-10)
    assert light.mean == pytest.approx(1e-6 * mean(lambda w: w), rel=1e-10)
    # the run's file has the curve and needs no table
    again = validate(CameraSpec, parse_yaml(camera.file_text("").replace("filter.csv", "gone.csv")))
    np.testing.assert_allclose(again.spectrum.rule(5), light.rule(5), rtol=1e-14)
    with pytest.raises(ValueError, match="has not been read"):
        spectrum("{table: filter.csv}").rule(3)


def test_lines_are_all_taken() -> None:
    light = spectrum("{wavelengths: [500 nm, 600 nm, 700 nm], weights: [1, 0, 3]}")
    wavelengths, weights = light.rule(1)
    np.testing.assert_allclose(wavelengths, [500e-9, 700e-9])
    np.testing.assert_allclose(weights, [0.25, 0.75])
    assert light.mean == pytest.approx(650e-9)
    assert spectrum("{wavelengths: [500 nm]}").rule(5)[1].tolist() == [1.0]


def test_the_index_of_a_named_glass() -> None:
    """Against air as makers state it, in vacuum times that of air; both at the design wavelength and others."""
    for medium, index in (("air", GLASSES["N-BK7"].index), ("vacuum", GLASSES["N-BK7"].vacuum_index)):
        spec = colour_camera("achromat", medium=medium)
        assert glass_indices(spec)["L1"] == index(587.5618e-9)
        assert glass_indices(spec, 500e-9)["L1"] == index(500e-9)
        # Schott's data sheet of F2: 1.62004 at the d line, 1.63208 at F, in air
        assert glass_indices(spec)["L3"] == pytest.approx(
            1.62004 * index(587.5618e-9) / GLASSES["N-BK7"].index(587.5618e-9), abs=1e-5
        )
    state = coloured(spec, "camera", {}, 486.1327e-9)
    assert set(state) == {"camera/L1", "camera/L3"}
    assert state["camera/L1"].index == pytest.approx(
        GLASSES["N-BK7"].vacuum_index(486.1327e-9) - GLASSES["N-BK7"].vacuum_index(587.5618e-9)
    )
    assert coloured(spec, "camera", state, spec.wavelength) is state
    again = validate(CameraSpec, parse_yaml(spec.file_text("")))
    assert again == spec
    assert spec.plain()["mirrors"]["L1"]["glass"] == "N-BK7"


def test_bands_of_a_camera_of_lenses() -> None:
    """With glasses that are named; an index alone stays valid without any light."""
    spec = colour_camera("achromat")
    band = BandSpec.model_validate(
        {"pixels": 200, "pitch": "7 um", "spectrum": ["500 nm", "600 nm"], "detector": "gf7_pan"}
    )
    lit = CameraSpec.model_validate({**spec.plain(), "spectrum": None, "bands": {"P": band.plain()}})
    assert lit.light is not None
    assert lit.light.ends == (500e-9, 600e-9)
    plain = spec.plain()
    plain["mirrors"] = {**plain["mirrors"], "L1": {**plain["mirrors"]["L1"], "glass": None, "index": 1.5}}
    del plain["spectrum"]
    old = CameraSpec.model_validate(plain)
    assert old.light is None
    with pytest.raises(ValueError, match="give its glass"):
        glass_indices(old, 500e-9)
