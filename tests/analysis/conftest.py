"""The analysis leaves threads to its callers; here, as in the commands, small matrices are worked on by one."""

import pytest

from optics.numerics.backend import one_blas_thread


@pytest.fixture(autouse=True, scope="package")
def one_thread():
    with one_blas_thread():
        yield
