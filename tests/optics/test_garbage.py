"""Python's collection of cyclic garbage does not fall into the recording of a trace."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

GARBAGE = """
import gc

import numpy as np

from optics.numerics.backend import load_backend
from optics.raytrace.trace import _Lookup, _threads
from scenes.specs.load import load_camera
from twin.camera.camera_optics import CameraOptics

backend = load_backend("llvm")
camera = CameraOptics.alone(load_camera("gf7_conic"), backend)
camera.wavefront((0.0, 0.0), points=3)


class Cycle:
    def __init__(self):
        self.me, self.array = self, backend.Float(np.arange(1000.0))


look_up = _Lookup.__call__


def collecting(*arguments):
    gc.set_threshold(1)  # a collection is due at every new object of the recording
    return look_up(*arguments)


_Lookup.__call__ = collecting
gc.collect()
gc.set_threshold(10**9)
cycles = [Cycle() for _ in range(200)]
del cycles
_threads.known.clear()  # the trace is recorded anew
print(camera.wavefront((0.3, 0.1), points=3).rms)
"""


def test_garbage_of_numpy_does_not_end_the_process_while_a_trace_is_recorded() -> None:
    """Dr.Jit cannot record that memory of NumPy is freed: an exception of its in a destructor aborted the process."""
    done = subprocess.run([sys.executable, "-c", GARBAGE], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
