"""The same seed gives the same frames and readings whatever the processor's linear algebra makes of the last digits.

OpenBLAS and NumPy choose their inner loops by the processor; both can be told to take those of an older one.
"""

import hashlib
import math
import os
import platform
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from threadpoolctl import threadpool_info

from optics.geometry import zernike
from optics.numerics import array_math, quadrature
from tests.twin.commands import files
from tests.twin.study_bench import ROOT, write_study
from twin.main_job.monitor_reading import rounded
from twin.monitor.monitor_beams import MAP_TERMS

KERNELS = {
    "one": {"OPENBLAS_CORETYPE": "Haswell"},
    "simple": {"OPENBLAS_CORETYPE": "Prescott", "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL X86_V3"},
}
PROBE = """
import hashlib, sys
import numpy as np
rng = np.random.default_rng(1)
a, b = rng.standard_normal((2, 300, 300))
print(hashlib.sha256((a @ b).tobytes()).hexdigest())
"""


def in_another_process(words, kernel, threads=1) -> str:
    environment = {key: value for key, value in os.environ.items() if key != "NPY_DISABLE_CPU_FEATURES"}
    environment |= KERNELS[kernel] | {"PYTHONPATH": str(ROOT)}
    environment |= {f"{library}_NUM_THREADS": str(threads) for library in ("OPENBLAS", "OMP", "MKL", "NUMEXPR")}
    command = [sys.executable, *words]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout


def require_kernels() -> None:
    """Skip where OpenBLAS is not used or has no such kernels; else the kernels do differ, so the test can fail."""
    if platform.machine() != "x86_64" or not any(info["internal_api"] == "openblas" for info in threadpool_info()):
        pytest.skip("the kernels are those of OpenBLAS for x86-64")
    products = {kernel: in_another_process(["-c", PROBE], kernel) for kernel in KERNELS}
    if len(set(products.values())) < len(KERNELS):
        pytest.skip(f"OpenBLAS here does not offer all of the kernels: {products}")


@pytest.mark.second
def test_neither_kernel_nor_threads_change_frames_and_readings(tmp_path) -> None:
    """The main job: more threads change no byte of any file, another kernel none of frames and readings.

    By chance, see docs/promises.md, this fails once in some thousand changes of the last digits.
    """
    write_study(tmp_path)
    job = tmp_path / "job.yaml"
    motions = "perturb:\n  base/forward/M2: {shift: [0 um, 0 um, 3 um]}\n"
    motions += "  base/backward/focal_plane: {rotate: [2 arcsec, -1.5 arcsec, 10 arcsec]}\n"
    job.write_text(job.read_text("utf-8") + motions, "utf-8")

    def contents(name: str, kernel: str, threads: int) -> dict[str, str]:
        """Return the checksums of all files but the manifest and the page, which name times."""
        out = tmp_path / name
        in_another_process(["-m", "twin.render", str(job), "--out", str(out), "--quiet"], kernel, threads)
        kept = files(out) - {"manifest.json", "report.html"}
        return {file: hashlib.sha256((out / file).read_bytes()).hexdigest() for file in sorted(kept)}

    one = contents("one", "one", 1)
    assert contents("threads", "one", 3) == one
    require_kernels()
    simple = contents("simple", "simple", 1)
    same = [file for file in one if file.endswith(".tiff") or file == "recovered.json"]
    assert len(same) == 9
    assert [file for file in same if simple[file] != one[file]] == []


def test_small_products_are_summed_in_one_order() -> None:
    """To the bit, which BLAS does not do: its products of these are another's on another processor."""
    rng = np.random.default_rng(1)
    a, b = rng.standard_normal((2, 50, 3, 3))
    parts = [a[:, :, k, None] * b[:, None, k, :] for k in range(3)]
    np.testing.assert_array_equal(array_math.product(a, b), parts[0] + parts[1] + parts[2])
    # two numbers at a time, as all processors of today can
    parts = [a[:, :, k] * b[:, 0, k][:, None] for k in range(3)]
    np.testing.assert_array_equal(array_math.matvec(a, b[:, 0]), parts[0] + parts[2] + parts[1])
    parts = [a[:, 0, k] * b[:, 0, k] for k in range(3)]
    np.testing.assert_array_equal(array_math.inner(a[:, 0], b[:, 0]), parts[0] + parts[2] + parts[1])


def test_two_by_two() -> None:
    matrix = np.random.default_rng(2).standard_normal((20, 2, 2))
    identity = np.broadcast_to(np.eye(2), matrix.shape)
    # products of numbers near one, divided by determinants down to some hundredths
    np.testing.assert_allclose(array_math.product(array_math.inverse(matrix), matrix), identity, atol=1e-12)
    np.testing.assert_allclose(array_math.determinant(matrix), np.linalg.det(matrix), rtol=1e-11)
    assert not np.isfinite(array_math.inverse(np.ones((2, 2)))).any()
    assert array_math.norm(np.array([3.0, 4.0])) == 5.0


@pytest.mark.parametrize("rings", [4, 6, 20])
def test_terms_of_a_map_are_found_by_projection(rings) -> None:
    """Zernike terms are orthonormal and the quadrature exact for their products: no least squares is needed."""
    nodes = quadrature.disk(rings)
    basis = zernike.basis(MAP_TERMS, nodes.x, nodes.y)
    # a sum of as many numbers as nodes, each rounded
    np.testing.assert_allclose((basis * nodes.share[:, None]).T @ basis, np.eye(MAP_TERMS), atol=1e-13)


finite = st.floats(-1e6, 1e6, allow_subnormal=False)
sigmas = st.floats(1e-9, 1e3)


@pytest.mark.second
@given(finite, sigmas)
def test_stated_readings(value, sigma) -> None:
    out = rounded({"a": {"x": value, "x_sigma": sigma}, "row": value, "row_sigma": sigma, "frames": 3, "text": "ml"})
    assert out["frames"] == 3
    assert out["text"] == "ml"
    for number, spread in ((out["a"]["x"], out["a"]["x_sigma"]), (out["row"], out["row_sigma"])):
        # half a millionth of a sigma, and what float64 leaves of large numbers
        assert abs(number - value) <= 0.5e-6 * 1.001 * sigma + 2.0 * math.ulp(value)
        assert abs(spread - sigma) <= 0.5e-7 * 1.001 * sigma
        assert math.copysign(1.0, number) == 1.0 or number != 0.0
    assert rounded(out) == out


@pytest.mark.parametrize("sigma", [0.0, math.inf, math.nan])
def test_a_reading_whose_sigma_says_nothing_is_stated_whole(sigma) -> None:
    assert rounded({"x": 1.0 / 3.0, "x_sigma": sigma})["x"] == 1.0 / 3.0
    assert rounded({"x": 1.0 / 3.0})["x"] == 1.0 / 3.0


@pytest.mark.second
def test_last_digits_are_not_stated() -> None:
    """What another kernel makes of readings, 1e-11 sigma, is gone from files but for one in 10^5."""
    rng = np.random.default_rng(3)
    values, sigma = rng.standard_normal(20_000), 3e-4
    moved = values + 1e-11 * sigma * rng.standard_normal(values.shape)
    one, other = ([rounded({"x": x, "x_sigma": sigma})["x"] for x in column.tolist()] for column in (values, moved))
    # 0.8e-5 of 20 000 are 0.2 expected; six have a chance of 1e-7
    assert sum(a != b for a, b in zip(one, other, strict=True)) < 6
