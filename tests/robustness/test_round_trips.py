"""What goes out and comes back is the same: YAML, quantities, configurations, pixels on the ground."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenes.specs.orbit.setup import AngleSetup, CalibrationSetup, MonitorSetup, load_three_line_camera
from scenes.specs.resolved import FocusSetup, resolve
from scenes.yaml.errors import InputError
from scenes.yaml.units import ANGLE, LENGTH, PER_LENGTH3, SCALE, format_quantity, parse_quantity
from scenes.yaml.yaml_file import dump_yaml, parse_yaml
from tests.daily import numbers
from tests.robustness.cases import cases
from tests.robustness.spoilt_run import mutant, write_files
from tests.twin.orbit_bench import CirclePlatform
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.line_camera import line_cameras
from twin.orbit.flight.sensor import LightEffects, Sensor

pytestmark = pytest.mark.second

TEXT = st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")), max_size=20)
SCALARS = st.none() | st.booleans() | st.integers(-(10**29), 10**29) | st.floats(allow_nan=False) | TEXT
TREES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4), max_leaves=20
)


@settings(max_examples=30)
@given(st.dictionaries(TEXT, TREES, min_size=1, max_size=4))
def test_yaml(data) -> None:
    found = parse_yaml(dump_yaml(data)).data
    assert repr(found) == repr(data)  # tells 1 from 1.0 and true, and -0.0 from 0.0


@settings(max_examples=100)
@given(st.sampled_from((ANGLE, LENGTH, SCALE, PER_LENGTH3)), st.floats(allow_nan=False, allow_infinity=False))
def test_quantities(kind, value) -> None:
    text = format_quantity(value, kind)
    assert parse_quantity(text, kind) == value
    turned = text[1:] if text.startswith("-") else f"-{text}"
    assert parse_quantity(turned, kind) == -value


RESOLVERS = {
    "render-perturb": resolve,
    "render-targets": resolve,
    "render-own-gf7": resolve,
    "lab-focus": FocusSetup.read,
    "orbit-angle": AngleSetup.read,
    "orbit-calibrate": CalibrationSetup.read,
    "orbit-monitor": MonitorSetup.read,
}


def test_configurations_of_spoilt_files_that_are_good(tmp_path) -> None:
    """The config.yaml of whatever can be read is read back to the same text, wherever it lies."""
    table, good = cases(), 0
    for name, read in RESOLVERS.items():
        for number in numbers(range(400, 404), 2):
            folder = tmp_path / f"{name}-{number}"
            folder.mkdir()
            given = write_files(table[name], folder, mutant(table[name], number).content)
            try:
                text = read(given).to_yaml()
            except InputError:
                continue
            config = tmp_path / "config.yaml"
            config.write_text(text, "utf-8")
            assert read(config).to_yaml() == text, f"{name} {number}"
            good += 1
    assert good > 4


CAMERAS = line_cameras(load_three_line_camera("th1"))
SHARE = st.floats(0.0, 1.0)


@given(
    name=st.sampled_from(sorted(CAMERAS)),
    effects=st.tuples(st.booleans(), st.booleans(), st.booleans()),
    wobble=st.floats(0.0, 3e-5),
    places=st.lists(st.tuples(SHARE, SHARE, st.floats(-400.0, 8800.0)), min_size=1, max_size=8),
)
def test_pixels_on_the_ground_and_back(name, effects, wobble, places) -> None:
    """Newton's method ends below 1e-9 px; coordinates of 7e6 m keep 1e-9 m, with pixels of 2 m and more."""
    camera, lines = CAMERAS[name], 2000
    sensor = Sensor(camera, CirclePlatform(wobble=wobble), Earth(), 0.7e-3, -3.0, lines, LightEffects(*effects))
    along, across, height = np.array(places).T
    # within the image, so that rounding puts none outside
    line, pixel = along * (lines - 1.0), across * (camera.pixels - 1.0)
    found = sensor.image(sensor.ground(line, pixel, height))
    np.testing.assert_allclose(found, [line, pixel], rtol=0, atol=1e-6)
