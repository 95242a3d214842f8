import drjit as dr
import numpy as np
import pytest

from optics.numerics.backend import BackendUnavailable, load_backend


def test_uploaded_numbers_are_a_copy(backend) -> None:
    values = np.arange(5.0)
    array = backend.opaque(values)
    values[0] = 99.0
    np.testing.assert_array_equal(array.numpy(), np.arange(5.0))


def test_kernels_do_not_depend_on_where_the_numbers_lie(backend) -> None:
    memory = np.arange(100.0)
    hashes = set()
    for start in range(9):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            dr.eval(backend.opaque(memory[start : start + 16]) * 3.25)
            hashes |= {k["hash"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT}
    assert len(hashes) == 1


def test_vectors_and_scalars(backend) -> None:
    vector = backend.vector(np.arange(6.0).reshape(2, 3))
    np.testing.assert_array_equal(vector.y.numpy(), [1.0, 4.0])
    np.testing.assert_array_equal(backend.opaque(2.5).numpy(), [2.5])
    assert backend.vector([1.0, 2.0, 3.0]).z.numpy() == [3.0]


def test_unknown_backends_are_explained() -> None:
    with pytest.raises(BackendUnavailable, match="unknown backend 'opencl'; choose one of llvm, cuda"):
        load_backend("opencl")
