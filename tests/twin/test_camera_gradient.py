"""Derivatives of a camera's numbers by motions of its parts, without a monitor: against formulas of the first order."""

import pytest

from scenes.specs.load import load_camera
from tests.scenes.lens.colour_cameras import colour_camera
from twin.study.gradient.study_gradient import AD, TRACED, Gradient, study_gradient
from twin.study.runs.setup import resolve_study

RC = "ritchey_chretien"
JOB = f"instrument: {{camera: {RC}}}\n"
STUDY = f"""name: study
base: {{command: render, file: job.yaml}}
factors:
  m2z: {{motion: M2 shift z, normal: {{mean: 0 um, sigma: 2 um}}}}
  m2rx: {{motion: M2 rotate x, normal: {{mean: 0 arcsec, sigma: 2 arcsec}}}}
  warmth: {{motion: base temperature, uniform: [-1 K, 1 K]}}
design: {{kind: monte_carlo, runs: 4, seed: 3}}
responses:
  da: {{key: [truth, cameras, {RC}, d_alpha_arcsec]}}
  df: {{key: [truth, cameras, {RC}, d_f_um]}}
"""


def jacobian(folder, backend, text: str = STUDY, job: str = JOB) -> Gradient:
    (folder / "job.yaml").write_text(job, "utf-8")
    (folder / "study.yaml").write_text(text, "utf-8")
    return study_gradient(resolve_study(folder / "study.yaml"), backend)


def entry(found: Gradient, response: str, factor: str) -> float:
    names = [one.name for one in found.factors]
    return float(found.best[found.responses.index(response), names.index(factor)])


def first_order() -> tuple[float, float, float, float]:
    """Spacing of the mirrors, way from M2 to the image, power of M2 (diverging positive), and the focal length that
    follows: a chief ray of slope W from the middle of M1 meets M2 at d W and the image at (d + s (1 + p d)) W.
    """
    spec = load_camera(RC)
    spacing = spec.mirrors["M1"].z - spec.mirrors["M2"].z
    way, power = spec.image.z - spec.mirrors["M2"].z, 2.0 / abs(spec.mirrors["M2"].radius)
    return spacing, way, power, spacing + way * (1.0 + power * spacing)


def test_motions_of_a_telescope_by_hand(tmp_path, backend) -> None:
    """A turn of M2 sweeps the image by twice itself over its way; a despace changes where the chief ray ends."""
    found = jacobian(tmp_path, backend)
    spacing, way, power, focal = first_order()
    assert entry(found, "da", "m2rx") == pytest.approx(-2.0 * way / focal, rel=1e-4)
    despace = -(1.0 + (1.0 + power * spacing) + way * power)
    assert entry(found, "df", "m2z") == pytest.approx(despace, rel=1e-4)
    motions = [k for k, one in enumerate(found.factors) if one.name != "warmth"]
    assert set(found.method[:, motions].ravel()) == {AD}
    # entries are judged down to 1e-3 of the largest, of differences that leave 1e-8 and rounding
    assert found.worst < 1e-6
    # heat is no elementary motion: differences of exact traces; half a kelvin each way is the same as one there
    assert set(found.method[:, 2]) == {TRACED}


@pytest.mark.second
def test_lenses_have_derivatives_too(tmp_path, backend) -> None:
    """A face of a lens moves by itself; what turns the line of sight is known by two methods."""
    (tmp_path / "lens.yaml").write_text(colour_camera("achromat").file_text(""), "utf-8")
    text = STUDY.replace("M2", "L2").replace(RC, "achromat").replace("  warmth", "  #")
    found = jacobian(tmp_path, backend, text, "instrument: {camera: lens.yaml}\n")
    assert set(found.method.ravel()) == {AD}
    assert abs(entry(found, "da", "m2rx")) > 1e-3
    # the field is 0.6 mrad to each side, of which the formulas' step has to be a small part
    assert found.worst < 1e-7
    spec, step = colour_camera("achromat"), 1e-5

    def scale(despace: float) -> float:
        """Height at the image of the chief ray of unit slope, paraxially, metres."""
        height, slope, index, place = 0.0, 1.0, 1.0, spec.mirrors["L1"].z
        for name, face in spec.mirrors.items():
            z, behind = face.z + despace * (name == "L2"), spec.index_behind(name)
            height, place = height + slope * (z - place), z
            slope, index = (index * slope - height * (behind - index) / face.radius) / behind, behind
        return height + slope * (spec.image.z - place)

    by_hand = (scale(step) - scale(-step)) / (2.0 * step)
    assert entry(found, "df", "m2z") == pytest.approx(by_hand, rel=1e-6)
