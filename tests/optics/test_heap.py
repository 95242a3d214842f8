"""Freed memory stays with the process."""

import os
import subprocess
import sys

import pytest

SIZE = 1 << 20
"""Bytes of an array; NumPy takes larger pages for those of 4 MiB and more."""
FAULTS = f"""
import resource, numpy as np
from optics.numerics.backend import load_backend
load_backend("llvm")
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(3):
    np.ones({SIZE} // 8)
before = faults()
for _ in range(20):
    np.ones({SIZE} // 8)
print(faults() - before)
"""
PAGES = 20 * SIZE // 4096
"""Of all arrays."""


def faults_with(**environment: str) -> int:
    clean = {name: value for name, value in os.environ.items() if "MALLOC" not in name}
    done = subprocess.run(
        [sys.executable, "-c", FAULTS], env={**clean, **environment}, capture_output=True, text=True, check=True
    )
    return int(done.stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="of the GNU C library")
def test_arrays_take_memory_that_others_have_left() -> None:
    """But for a page here and there; where the user has said how memory is given back, that holds."""
    assert faults_with() < PAGES // 100
    assert faults_with(MALLOC_TRIM_THRESHOLD_="131072", MALLOC_MMAP_THRESHOLD_="131072") > PAGES // 2
