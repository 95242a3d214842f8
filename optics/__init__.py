"""The physics of the twin: rigid bodies, surfaces, ray traces, wavefronts and diffraction images, in float64 and SI
units.

This package knows nothing of YAML, commands or Mitsuba scenes.
"""

from optics.llvm import ensure_llvm

# Before anything can import drjit: it looks for LLVM once, and on many systems finds one that kills the process.
ensure_llvm()
