"""Noise formulas by hand, and their scaling with frames."""

import numpy as np
import pytest

from analysis.spots.noise import NoiseModel
from tests.analysis.refusals import refuses

NOISE = NoiseModel(0.5, 4.0, 10.0, 100.0, 0.01, 2.0, 4095.0)


def test_by_hand():
    # 1105 DN: 2010 electrons, of them 10 dark; shot 0.25 * 2010, read 0.25 * 16
    assert NOISE.temporal_variance_dn2(1105.0, 1) == pytest.approx(0.25 * 2010 + 4.0 + 1 / 12, rel=1e-14)
    assert NOISE.fixed_variance_dn2(1105.0) == pytest.approx((0.01 * 1000) ** 2 + 1.0, rel=1e-14)
    assert NOISE.light_signal_dn(1105.0) == pytest.approx(1000.0)
    # without light the dark signal still has shot noise, but no PRNU
    assert NOISE.temporal_variance_dn2(105.0, 1) == pytest.approx(0.25 * 10 + 4.0 + 1 / 12, rel=1e-14)
    assert NOISE.fixed_variance_dn2(105.0) == pytest.approx(1.0)


def test_only_temporal_noise_averages_down():
    level = np.array([[50.0, 200.0], [1000.0, 4000.0]])
    assert np.allclose(NOISE.temporal_variance_dn2(level, 9) * 9, NOISE.temporal_variance_dn2(level, 1), rtol=1e-14)
    refuses(ValueError, "frames", NOISE.temporal_variance_dn2, level, 0)


@pytest.mark.parametrize(("field", "value"), [("prnu", -0.1), ("gain_dn_per_e", 0.0), ("saturation_dn", 50.0)])
def test_impossible_values_name_the_field(field, value):
    values = {name: getattr(NOISE, name) for name in NOISE.__dataclass_fields__}
    refuses(ValueError, field, NoiseModel, **{**values, field: value})
