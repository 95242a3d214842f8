"""Files of design trade studies: what they may say, and how they are told that they may not."""

import pytest

from scenes.specs.load import EXAMPLES
from scenes.specs.study import StudySpec, unit_of
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import dump_yaml, parse_yaml, read_yaml

TEXT = """name: study
base: {command: render, file: perturb}
factors:
  a: {key: [job, x], range: [0 um, 0.003 mm], count: 3}
  b: {keys: [[y, 1], [z]], values: [9, 16]}
responses:
  r: {key: [truth, d_f_um], sigma: [truth, d_f_um_sigma]}
  s: {key: [truth, share], unit: percent}
report: {scatter: [[a, r]], thresholds: {good: {response: r, at_most: 2}}}
"""


def read(text: str) -> StudySpec:
    return validate(StudySpec, parse_yaml(text, "study.yaml"))


def test_what_it_says() -> None:
    study = read(TEXT)
    assert study.factors["a"].unit == "um"
    assert study.factors["a"].numbers().values == (0.0, 3.0)
    assert study.factors["a"].places == (("job", "x"),)
    assert study.factors["b"].places == (("y", 1), ("z",))
    assert study.factors["b"].numbers().whole
    assert study.responses["r"].units == "um"
    assert study.responses["s"].units == "percent"
    assert read(dump_yaml(study.plain())) == study


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("study_*.yaml")), ids=lambda file: file.stem)
def test_the_examples_are_valid(file) -> None:
    study = validate(StudySpec, read_yaml(file))
    assert study.name == file.stem
    assert study.description
    # what is called noise is the noise's own sigma, not the total one, in which it is a thousandth
    said = [one.noise for one in study.responses.values() if one.noise is not None]
    said += [one.key for name, one in study.responses.items() if name.endswith("_noise")]
    assert all(str(key[-1]).endswith("_sigma_noise") for key in said)
    assert all(one.noise is not None for one in study.responses.values() if one.sigma is not None)


UNITS = {
    "focus.fields.0.error_um": "um", "recovered.change_arcsec_sigma": "arcsec", "focus.shims_um.2": "um",
    "recovered.change_arcsec_sigma_noise": "arcsec", "monitor.gradient_K_per_m": "K/m",
    "temperature.linear_gradient_k_per_m": "K/m", "monitor.height_m_per_arcsec": "m/arcsec",
    "angle.height_m_per_arcsec.alpha": "m/arcsec", "quality.cameras.forward.defocus_um.centre": "um",
    "quality.cameras.forward.wfe_rms_waves_focus_removed.1": "waves",
    "block.cameras.scene.d_alpha_arcsec_sigma_before": "arcsec", "block.cameras.scene.d_f_um_true": "um",
    "simulate.lines.drift_px_per_line": "", "optics.nyquist_per_mm": "1/mm", "turntable.rejected": "", "x.m": "",
    "optics.plate_scale_arcsec_per_mm_sigma": "arcsec/mm", "orbit.velocity_m_per_s": "m/s",
}  # fmt: skip


def test_units_of_results() -> None:
    for key, unit in UNITS.items():
        assert unit_of(tuple(int(part) if part.isdigit() else part for part in key.split("."))) == unit, key
