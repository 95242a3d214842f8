"""Motions of a course, also from a CSV file."""

from pathlib import Path

import numpy as np
import pytest

from scenes.models.job_state import motions_of
from scenes.specs.load import load_job
from scenes.specs.resolved import resolve, resolve_job
from scenes.yaml.errors import InputError
from tests.twin.commands import invoke
from tests.twin.study_bench import REFUSED
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.time_series import run_series, series_states
from twin.render import app

FOCAL, MIRROR, CAMERA = "base/backward/focal_plane", "base/forward/M2", "base/forward"
HEADS = (
    *("time [min]", f"{MIRROR} shift z [um]", f" {FOCAL} rotate x [arcsec] ", f"{FOCAL} rotate z [arcsec]"),
    *(f"{CAMERA} scale [ppm]", f"{CAMERA} temperature [K]"),
)
TABLE = f"""# what the mounts did
{",".join(HEADS)}
0,0,0,0,0,0

12,3,2,10,0.5,0.1
30,-1.5,-1,0.25,0,-0.2
"""
JOB = f"""instrument: gf7_pair
course:
  table: motions.csv
  detail: 12 min
  motion: {{{FOCAL}: {{pivot: rear_node}}}}
render: {{frames: 1, seed: 3}}
"""


def written(folder: Path, job: str = JOB, table: str = TABLE) -> Path:
    (folder / "motions.csv").write_text(table, "utf-8")
    path = folder / "job.yaml"
    path.write_text(job, "utf-8")
    return path


@pytest.fixture(scope="module")
def experiment(backend, tmp_path_factory) -> MonitorExperiment:
    return MonitorExperiment(resolve(written(tmp_path_factory.mktemp("job"))), backend)


@pytest.mark.second
def test_a_table_is_the_same_course_written_out(tmp_path) -> None:
    out = f"""instrument: gf7_pair
course:
  times: [0 min, 12 min, 30 min]
  detail: 12 min
  temperature: {{{CAMERA}: {{change: [0 K, 0.1 K, -0.2 K]}}}}
  motion:
    {MIRROR}: {{shift: [0 0 0 um, 0 0 3 um, [0 um, 0 um, -1500 nm]]}}
    {FOCAL}: {{rotate: [0 0 0 arcsec, 2 0 10 arcsec, -1 0 0.25 arcsec], pivot: rear_node}}
    {CAMERA}: {{scale: [0 ppm, 0.5 ppm, 0 ppm]}}
render: {{frames: 1, seed: 3}}
"""
    table = load_job(written(tmp_path))
    assert table == load_job(written(tmp_path, out))
    # config.yaml needs the table no longer
    config = tmp_path / "elsewhere" / "config.yaml"
    config.parent.mkdir()
    config.write_text(resolve_job(table).to_yaml(), "utf-8")
    assert resolve(config).job == table


def test_motions_are_added_to_those_under_perturb(tmp_path) -> None:
    fixed = f"  {FOCAL}: {{rotate: [1 arcsec, 0 arcsec, 0 arcsec], shift: 0 1 0 um, pivot: rear_node}}\n"
    fixed += f"  {MIRROR}: {{figure: {{Z5: 20 nm}}, shift: 0 0 1 um}}\n"
    job = load_job(written(tmp_path, JOB + f"perturb:\n{fixed}"))
    before, after = motions_of(job), motions_of(job, 1)
    arcsec = np.radians(1.0 / 3600.0)
    np.testing.assert_allclose(after[FOCAL].rotate, (3 * arcsec, 0.0, 10 * arcsec), rtol=1e-15)
    assert after[FOCAL].shift == before[FOCAL].shift == (0.0, 1e-6, 0.0)
    assert after[MIRROR].shift == pytest.approx((0.0, 0.0, 4e-6), rel=1e-15)
    assert after[MIRROR].figure == before[MIRROR].figure
    assert motions_of(job, 0)[MIRROR] == before[MIRROR]
    other = fixed.replace("rear_node", "line_centre")
    with pytest.raises(InputError, match=r"another pivot than under perturb.*found 'rear_node', allowed: line_centre"):
        load_job(written(tmp_path, JOB + f"perturb:\n{other}"))


@pytest.mark.second
def test_the_course_tells_its_motions(experiment, tmp_path) -> None:
    resolved = resolve(written(tmp_path))
    found = run_series(experiment, resolved, series_states(experiment, resolved.job)).to_dict()
    assert set(found["motions"]) == {MIRROR, FOCAL, CAMERA}
    assert found["motions"][FOCAL]["pivot"] == "rear_node"
    np.testing.assert_allclose(found["motions"][FOCAL]["rotate_arcsec"][1], (2.0, 0.0, 10.0), rtol=1e-14)
    np.testing.assert_allclose(found["motions"][MIRROR]["shift_um"][2], (0.0, 0.0, -1.5), rtol=1e-14)
    np.testing.assert_allclose(found["motions"][CAMERA]["scale_ppm"], (0.0, 0.5, 0.0), rtol=1e-14)
    # what is read in the images follows: a despace of M2 makes the camera longer by some 100 um per 3 um
    true = found["cameras"]["forward"]["true"]["d_f_um"]
    read = found["cameras"]["forward"]["model"]["d_f_um"]
    assert np.ptp(true) > 10.0
    np.testing.assert_allclose(read, true, atol=0.1 * np.ptp(true))


@pytest.mark.parametrize("case", REFUSED["tables_of_motions"])
def test_a_bad_table_is_explained_with_file_and_line(case: str, tmp_path) -> None:
    (old, new), file, line, words = REFUSED["tables_of_motions"][case]
    assert old in TABLE
    job = {
        "file": JOB.replace("motions.csv", "none.csv"),
        "both": JOB.replace("  detail: 12 min", "  times: [0 min, 1 min]"),
        "pivot": JOB.replace(FOCAL, f"{MIRROR}x"),
    }.get(case, JOB)
    path = written(tmp_path, job, TABLE.replace(old, new, 1) if old else TABLE)
    done = invoke(app, path, "--out", tmp_path / "run", "--frames", 1)
    assert (done.exit_code, done.stdout) == (2, ""), done.stderr
    assert f"{path.parent / file}:{line}: " in done.stderr
    for word in words:
        assert word in done.stderr
    assert not (tmp_path / "run").exists()
