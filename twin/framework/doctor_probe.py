"""Small jobs that `twin.doctor` runs in a child process.

Run ``python -m twin.framework.doctor_probe kernel|render|gpu [VARIANT]``.

An unsuitable LLVM aborts the process instead of raising an error, so these jobs run in their own process. Each job
writes one line of JSON to stdout.
"""

import importlib
import json
import sys
from typing import Any

import numpy as np

import optics  # noqa: F401  (names the LLVM library before drjit is imported)

ULPS = 8
"""Largest accepted difference of the test kernel's results from NumPy's, in spacings of float64: the last bits of atan2
may differ.
"""


def kernel(backend: str = "llvm") -> dict[str, Any]:
    """Run the float64 operations that abort under an LLVM older than 17, and compare them with numpy.

    Parameters
    ----------
    backend : str
        "llvm" or "cuda".

    Raises
    ------
    RuntimeError
        The results differ from numpy's.
    """
    import drjit as dr

    float64 = importlib.import_module(f"drjit.{backend}.ad").Float64
    x = np.linspace(-2.0, 2.0, 1001)
    y = np.linspace(0.5, 1.5, 1001)
    a, b = dr.opaque(float64, 0.0) + float64(x), dr.opaque(float64, 0.0) + float64(y)
    result = dr.maximum(a, b) + dr.minimum(a, 1.0) + dr.clip(a, -1.0, 1.0) + dr.safe_sqrt(a) + dr.atan2(a, b)
    expected = (
        np.maximum(x, y) + np.minimum(x, 1.0) + np.clip(x, -1.0, 1.0) + np.sqrt(np.maximum(x, 0.0)) + np.arctan2(x, y)
    )
    error = float(np.max(np.abs(np.asarray(result.numpy()) - expected)))
    if not error <= ULPS * np.spacing(np.max(np.abs(expected))):
        raise RuntimeError(f"the kernel's results differ from numpy's by {error:.3g}")
    version = dr.detail.llvm_version() if backend == "llvm" else dr.detail.cuda_version()
    return {
        "backend": backend,
        "version": ".".join(str(part) for part in version),
        "drjit": dr.__version__,
        "error": error,
    }


def render(variant: str = "llvm_ad_mono") -> dict[str, Any]:
    """Render a bright sky of 16 x 16 pixels in exactly this Mitsuba variant.

    Given several names Mitsuba would silently fall back to another variant; given one it does not.

    Raises
    ------
    RuntimeError
        The picture is not the uniform sky.
    """
    import mitsuba as mi

    mi.set_variant(variant)
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "emitter": {"type": "constant"},
            "sphere": {"type": "sphere", "center": [0.0, 0.0, -10.0]},
            "sensor": {
                "type": "perspective",
                # Luminance is what mono and rgb variants can both record.
                "film": {
                    "type": "hdrfilm",
                    "pixel_format": "luminance",
                    "width": 16,
                    "height": 16,
                    "rfilter": {"type": "box"},
                },
            },
        }
    )
    image = np.asarray(mi.render(scene, spp=4, seed=1))
    # The camera looks along +z, away from the sphere: every pixel sees the unit radiance of the sky.
    if image.shape[:2] != (16, 16) or not np.allclose(image[..., 0], 1.0, atol=0.05):
        raise RuntimeError(
            f"a uniform sky of radiance 1 was rendered as {image[..., 0].min():.3g} .. {image[..., 0].max():.3g}"
        )
    return {"variant": mi.variant(), "mitsuba": mi.__version__, "mean": float(image[..., 0].mean())}


def gpu() -> dict[str, Any]:
    """Report whether Dr.Jit can use an NVIDIA GPU, and if so run the kernel on it."""
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.CUDA):
        return {"available": False}
    return {"available": True, "compute_capability": dr.detail.cuda_compute_capability(), **kernel("cuda")}


def main(argv: list[str]) -> int:
    """Run the named job and write its result, or its error, as one line of JSON."""
    jobs = {"kernel": kernel, "render": render, "gpu": gpu}
    try:
        result: dict[str, Any] = {"result": jobs[argv[0]](*argv[1:])}
    except Exception as error:
        result = {"error": f"{type(error).__name__}: {error}"}
    sys.stdout.write(json.dumps(result) + "\n")
    return 1 if "error" in result else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
