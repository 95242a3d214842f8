"""Selection of the LLVM library that Dr.Jit compiles with.

Dr.Jit generates code that needs LLVM 17 or newer. By default it takes the first libLLVM that the system offers; on
Debian 12 that is 14 or 15, and then `drjit.maximum`, `minimum`, `clip`, `safe_sqrt`, `atan2` and every Mitsuba render
abort the whole process ("Cannot select: fmaximum"). So the library of the package karellen-llvm-core is named
explicitly, in the environment variable that Dr.Jit reads when it is first imported.
"""

import ctypes
import importlib.metadata
import os
import platform
import sys
import sysconfig
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"
PACKAGE = "karellen-llvm-core"
LIBRARY = "libLLVM.so.19.1"
OLDEST = 17
"""Oldest major version of LLVM that Dr.Jit's code compiles with."""


class LibraryMissing(ImportError):
    """Error: a shared library that Dr.Jit or Mitsuba needs is missing; the message says what to install."""


def ensure_llvm() -> Path | None:
    """Set the LLVM library for Dr.Jit, once and before `import drjit`; later calls change nothing.

    A value of `DRJIT_LIBLLVM_PATH` that the user set is respected. On systems for which there is no wheel of LLVM
    (other than Linux on x86-64) nothing is set and Dr.Jit's own search decides.

    Returns
    -------
    Path or None
        The library that Dr.Jit will load, or None where Dr.Jit searches by itself.

    Raises
    ------
    LibraryMissing
        libatomic.so.1 cannot be loaded; or the LLVM wheel is not installed; or the library that the user named does not
        exist; or drjit was imported before and has loaded an LLVM that is too old.
    """
    check_libatomic()
    named = os.environ.get(VARIABLE)
    if named:
        if not Path(named).exists():
            raise LibraryMissing(f"{VARIABLE} names {named}, which does not exist; correct or unset it")
        return Path(named)
    if not (sys.platform == "linux" and platform.machine() == "x86_64"):
        return None
    library = find_llvm()
    if library is None:
        raise LibraryMissing(
            f"{LIBRARY} is missing: install it (pip install {PACKAGE}==19.1.7), or set {VARIABLE} to a libLLVM "
            f"of version {OLDEST} or newer"
        )
    if "drjit" in sys.modules:
        _check_loaded()
        return None
    os.environ[VARIABLE] = str(library)
    return library


def find_llvm() -> Path | None:
    """Return the LLVM library that karellen-llvm-core installed for this interpreter, or None."""
    candidates = [Path(sysconfig.get_path("data")) / "lib" / LIBRARY, Path(sys.prefix) / "lib" / LIBRARY]
    try:
        files = importlib.metadata.files(PACKAGE) or []
    except importlib.metadata.PackageNotFoundError:
        files = []
    # The wheel's own list comes second: some installers leave it without the libraries, which are laid down at first
    # start.
    candidates += [Path(str(file.locate())) for file in files if file.name == LIBRARY]
    return next((path.resolve() for path in candidates if path.exists()), None)


def check_libatomic() -> None:
    """Check that libatomic.so.1 loads. Without it `import mitsuba` fails with a misleading "NameError: _drjit_ext".

    Raises
    ------
    LibraryMissing
        The library does not load.
    """
    if sys.platform != "linux":
        return
    try:
        ctypes.CDLL("libatomic.so.1")
    except OSError as error:
        raise LibraryMissing(
            f"libatomic.so.1 cannot be loaded ({error}); install libatomic1 (apt install libatomic1)"
        ) from error


def _check_loaded() -> None:
    """Raise LibraryMissing if drjit was imported before optics and has chosen an LLVM that is too old."""
    import drjit

    drjit.has_backend(drjit.JitBackend.LLVM)
    version = tuple(drjit.detail.llvm_version())
    if version[0] < OLDEST:
        loaded = ".".join(str(part) for part in version)
        raise LibraryMissing(
            f"drjit was imported before optics and has loaded LLVM {loaded}, but needs {OLDEST} or newer: "
            f"import optics first, or set {VARIABLE}"
        )
