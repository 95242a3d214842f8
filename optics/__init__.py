"""The physics of the twin: rigid bodies, surfaces, ray traces, wavefronts and diffraction images, in float64 and SI
units.

This package knows nothing of YAML, commands or Mitsuba scenes.
"""

from contextlib import suppress

from optics.numerics.llvm import LibraryMissing, ensure_llvm

# Before anything can import drjit: it looks for LLVM once, and on many systems finds one that kills the process. What
# is missing is said by `load_backend`, where a command can tell its user, and not in the middle of an import.
with suppress(LibraryMissing):
    ensure_llvm()
