"""Instruments whose cameras are not of one kind: traced together where that is possible, else refused."""

import numpy as np
import pytest

from optics.numerics.frozen_map import FrozenMap
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.specs.camera import CameraSpec
from scenes.specs.load import load_camera, load_instrument
from scenes.yaml.errors import InputError
from twin.monitor.truth import LineSight

GF7 = load_camera("gf7")


def with_terms(terms: dict[str, float]) -> CameraSpec:
    """gf7 whose third mirror has these aspheric terms."""
    third = GF7.mirrors["M3"].model_copy(update={"aspheric": FrozenMap(terms)})
    return GF7.model_copy(update={"mirrors": FrozenMap({**GF7.mirrors, "M3": third})})


def built(backend, other: CameraSpec) -> Instrument:
    """gf7_pair with another camera for the one that looks backward."""
    spec = load_instrument("gf7_pair")
    backward = spec.cameras["backward"].model_copy(update={"camera": "other"})
    spec = spec.model_copy(update={"cameras": FrozenMap({**spec.cameras, "backward": backward})})
    return build_instrument(spec, {"gf7": GF7, "other": other}, backend)


@pytest.mark.second
def test_terms_that_one_camera_lacks_are_zero(backend) -> None:
    """The forward camera, which has no A8, sees what it sees beside its like."""
    terms = dict(GF7.mirrors["M3"].aspheric)
    alone, zero, more = (
        LineSight(built(backend, with_terms(t)), backend).trace([{}])
        for t in (terms, {**terms, "A8": 0.0}, {**terms, "A8": 1e-7})
    )
    np.testing.assert_allclose(zero, alone, rtol=0, atol=1e-15)
    np.testing.assert_allclose(more[0], alone[0], rtol=0, atol=1e-15)
    assert np.max(np.abs(more[1] - alone[1])) > 1e-12


def test_cameras_that_cannot_be_traced_together_are_refused(backend) -> None:
    with pytest.raises(InputError, match=r"cameras: these cameras are too different .*; allowed: cameras with"):
        built(backend, GF7.model_copy(update={"stop": "M1", "stop_diameter": None}))
