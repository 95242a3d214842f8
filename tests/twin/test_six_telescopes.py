"""Six telescopes as a new user takes them through a first afternoon: look, perturb, warm, judge, study, compare."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import twin
from tests.oracles.test_telescopes import HERE as TELESCOPES
from tests.oracles.test_telescopes import LSST, batoids_telescope
from tests.twin.commands import invoke
from twin.compare.__main__ import app as compare_app
from twin.export.__main__ import app as export_app
from twin.live.live_bench import LiveBench

SIX = ("cassegrain", "ritchey_chretien", "korsch", "maksutov", "schmidt_cassegrain", "lsst")


@pytest.fixture(scope="module")
def files(tmp_path_factory, backend) -> dict[str, str]:
    """Name of a telescope -> what a user gives: a name of the library, or a file."""
    folder = tmp_path_factory.mktemp("telescopes")
    found = {name: name for name in SIX[:3]} | {name: str(TELESCOPES / f"{name}.yaml") for name in SIX[3:5]}
    optics = pytest.importorskip("batoid") and batoids_telescope(backend, *LSST)
    (folder / "lsst.yaml").write_text(optics.model.spec.file_text(""), "utf-8")
    return found | {"lsst": str(folder / "lsst.yaml")}


@pytest.mark.parametrize(
    ("name", "runs"),
    [
        *(pytest.param(name, 6, marks=pytest.mark.slow) for name in ("ritchey_chretien", "schmidt_cassegrain")),
        *(pytest.param(name, 500, marks=pytest.mark.slow) for name in SIX),
    ],
)
def test_a_first_afternoon(files, tmp_path: Path, name: str, runs: int) -> None:
    camera = twin.load_camera(files[name])
    moved = camera.perturbed("M2 shift z 5 um" if "M2" in camera.model.mirrors else "M1 shift z 5 um")
    before, after = camera.mtf((0, 0)), moved.mtf((0, 0))
    assert np.all(before.values <= before.limit + 1e-3)
    assert np.abs(before.values - after.values).max() > 1e-4

    lenses = any(mirror.light == "refracts" for mirror in camera.model.spec.mirrors.values())
    if not lenses:
        warm = camera.perturbed("base temperature 2 K")
        assert warm.state
        assert np.isfinite(warm.wavefront().rms)

    shots = []
    for k, one in enumerate((camera.twin, moved.twin)):
        shot = one.render()
        assert np.all(np.isfinite(shot.quality.wfe_rms_waves))
        assert np.all((shot.quality.light_lost >= 0.0) & (shot.quality.light_lost < 1.0))
        shots.append(shot.save(tmp_path / f"run{k}"))
    assert invoke(compare_app, *shots, "--out", tmp_path / "compared").exit_code == 1  # results differ
    assert invoke(export_app, shots[1], "--out", tmp_path / "exported").exit_code == 0
    truth = json.loads((shots[1] / "truth.json").read_text("utf-8"))
    assert truth["cameras"][camera.name]["d_f_um"] != 0.0

    bench = LiveBench(moved.twin)
    told, _ = bench.state(bench.at_rest)
    for key, value in told["truth"]["cameras"][camera.name].items():
        assert value == pytest.approx(truth["cameras"][camera.name][key], rel=1e-9, abs=1e-9)

    mirror = next(iter(n for n in ("M2", "M1") if n in camera.model.mirrors))
    study = twin.study(camera.twin, {f"{mirror} shift z": "(0 +- 2) um"}, runs, out=tmp_path / "study", quiet=True)
    assert study.sizes["run"] == runs
    assert not study.failed.any()
    assert float(study[f"{camera.name}_d_f"].std()) > 0.0
    for key in ("d_alpha", "d_beta", "d_gamma", "d_f", "wfe", "defocus", "mtf_line", "mtf_track"):
        assert np.all(np.isfinite(study[f"{camera.name}_{key}"]))
    # a despace neither turns nor rolls a camera; one that is not symmetric about its axis looks elsewhere by a little
    assert float(np.abs(study[f"{camera.name}_d_gamma"]).max()) < 1e-3
    for key in ("mtf_line", "mtf_track"):
        assert float(study[f"{camera.name}_{key}"].min()) >= 0.0
        assert float(study[f"{camera.name}_{key}"].max()) <= 1.0
