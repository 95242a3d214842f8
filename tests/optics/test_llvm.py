"""The LLVM library that kernels are compiled with, the threads that run them, and arrays of the backend."""

import os
import sys

import drjit as dr
import numpy as np
import pytest
from threadpoolctl import threadpool_info

from optics.numerics import backend as threads
from optics.numerics import llvm
from optics.numerics.backend import BackendUnavailable, load_backend
from optics.numerics.llvm import VARIABLE, LibraryMissing, ensure_llvm


def test_a_library_that_cannot_be_used_is_refused_with_a_remedy(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(llvm.platform, "machine", lambda: "x86_64")
    monkeypatch.setenv(VARIABLE, str(tmp_path / "libLLVM.so"))
    with pytest.raises(LibraryMissing, match=r"names .*libLLVM.so, which does not exist; correct or unset it"):
        ensure_llvm()
    (tmp_path / "libLLVM.so").touch()
    assert ensure_llvm() == tmp_path / "libLLVM.so"
    monkeypatch.delenv(VARIABLE)
    with monkeypatch.context() as patch:
        patch.setattr(llvm, "find_llvm", lambda: None)
        with pytest.raises(LibraryMissing, match=f"{llvm.LIBRARY} is missing: install it"):
            ensure_llvm()
    for version, refused in (((16, 0, 6), True), ((17, 0, 0), False), ((19, 1, 7), False)):
        monkeypatch.setattr(dr.detail, "llvm_version", lambda version=version: version)
        if refused:
            with pytest.raises(LibraryMissing, match=r"has loaded LLVM 16\.0\.6, but needs 17 or newer"):
                ensure_llvm()
        else:
            assert ensure_llvm() is None
    with monkeypatch.context() as patch:
        patch.delitem(sys.modules, "drjit")
        assert ensure_llvm() == llvm.find_llvm()
        assert os.environ.pop(VARIABLE) == str(llvm.find_llvm())

    def broken(name):
        raise OSError("no file")

    monkeypatch.setattr(llvm.ctypes, "CDLL", broken)
    with pytest.raises(LibraryMissing, match=r"libatomic.so.1 cannot be loaded \(no file\); install libatomic1"):
        ensure_llvm()


def test_cores_are_those_given_or_fewer(monkeypatch) -> None:
    monkeypatch.setattr(threads, "_assigned_cores", lambda: 4)
    for named, count in (("", 4), ("1", 1), ("3", 3), ("4", 4), ("9", 4), ("0", 4), ("-2", 4), ("two", 4)):
        monkeypatch.setenv(threads.THREADS_VARIABLE, named)
        assert threads.cores() == count, named


def test_threads_are_limited_inside_and_as_before_afterwards() -> None:
    def blas() -> list[int]:
        return [one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"]

    before, count = blas(), dr.thread_count()
    with threads.one_blas_thread():
        assert set(blas()) == {1}
    assert blas() == before
    threads.kernel_threads(2)
    with threads.one_kernel_thread():
        assert dr.thread_count() == 1
    assert dr.thread_count() == 2
    with pytest.raises(ZeroDivisionError), threads.one_kernel_thread():
        _ = 1 / 0
    assert dr.thread_count() == 2
    threads.kernel_threads(count)


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


def test_a_usable_library_that_is_loaded_stays() -> None:
    assert llvm._check_loaded() is None


def test_unknown_backends_are_explained() -> None:
    with pytest.raises(BackendUnavailable, match="unknown backend 'opencl'; choose one of llvm, cuda"):
        load_backend("opencl")
