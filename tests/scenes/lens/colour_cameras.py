"""Cameras with lenses whose glasses are named, for tests of their colours: an achromat, a Schmidt and a Maksutov."""

from __future__ import annotations

from scenes.specs.camera import CameraSpec
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml

F2 = """{name: F2, formula: 2, range: [320 nm, 2500 nm],
    coefficients: [1.34533359, 0.00997743871, 0.209073176, 0.0470450767, 0.937357162, 111.886764]}"""

_HEAD = """
name: {name}
focal_length: {focal}
entrance_pupil: {pupil}
field_bias: 0 deg
field: {{x: {field}, y: {field}}}
wavelength: 587.5618 nm
medium: {medium}
stop: L1
mirrors: {{{mirrors}}}
image: {{z: {image}}}
line: {{pixels: 200, pitch: 7 um}}
edge_margin: 1 mm
spectrum: {spectrum}
"""
LINES = "{wavelengths: [486.1327 nm, 587.5618 nm, 656.2725 nm], weights: [1, 2, 1]}"

ACHROMAT = (
    "L1: {z: 0 mm, radius: 600 mm, light: refracts, glass: N-BK7}, "
    "L2: {z: 15 mm, radius: -440 mm, light: refracts, index: 1}, "
    f"L3: {{z: 16 mm, radius: -437 mm, light: refracts, glass: {F2}}}, "
    "L4: {z: 24 mm, radius: -2342 mm, light: refracts, index: 1}"
)
SCHMIDT = (
    "L1: {z: -10 mm, radius: flat, light: refracts, glass: fused silica}, "
    "L2: {z: 0 mm, radius: -130 m, aspheric: {A4: 0.0685 1/m^3}, light: refracts, index: 1}, "
    "M1: {z: 2 m, radius: -2 m}"
)
MAKSUTOV = (
    "L1: {z: 0 mm, radius: -152.8 mm, light: refracts, glass: N-BK7}, "
    "L2: {z: 10 mm, radius: -158.6 mm, light: refracts, index: 1}, "
    "M1: {z: 590 mm, radius: -823.2 mm}"
)
KINDS = {
    "achromat": {"focal": "1.1316 m", "pupil": "100 mm", "field": "0.5 deg", "mirrors": ACHROMAT, "image": "1141.2 mm"},
    "schmidt": {"focal": "1 m", "pupil": "200 mm", "field": "0.3 deg", "mirrors": SCHMIDT, "image": "1003.5 mm"},
    "maksutov": {"focal": "0.4 m", "pupil": "90 mm", "field": "0.3 deg", "mirrors": MAKSUTOV, "image": "170.02 mm"},
}


def colour_camera(name: str, spectrum: str = LINES, medium: str = "air", **changed: str) -> CameraSpec:
    """A camera of KINDS in light of a spectrum, as a file would give it."""
    text = _HEAD.format(name=name, spectrum=spectrum, medium=medium, **{**KINDS[name], **changed})
    return validate(CameraSpec, parse_yaml(text))
