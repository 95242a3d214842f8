"""The interactive view of scene.glb as a part of a page that needs nothing else: no file beside it, no network."""

from __future__ import annotations

import base64
import gzip
from importlib.resources import files

from markupsafe import Markup

LIBRARY = "three.min.js"
"""What of three.js (MIT, see LICENSE.three.txt beside it) the viewer uses, made as viewer/three_parts.js says."""
_HERE = files(__package__) / "viewer"


def viewer_markup(moved: str) -> Markup:
    """The element in which the view appears, hidden until it does.

    Args:
        moved: what was moved, for readers; empty for nothing.
    """
    text = (_HERE / "viewer.html").read_text("utf-8")
    return Markup(text).format(moved=moved or "nothing")


def viewer_programs() -> tuple[str, str]:
    """All that runs in the view: the program as it stands between its tags, and the library, which it puts in."""
    return f"\n{(_HERE / 'viewer.js').read_text('utf-8')}", (_HERE / LIBRARY).read_text("utf-8")


def viewer_scripts(scene: bytes) -> Markup:
    """What makes the view: the library and the scene, both packed, and the program. They stand at the end of a page.

    Args:
        scene: binary glTF, as ``scene_file.write_scene`` writes it.
    """
    program, library = viewer_programs()
    # names of tags cannot stand in base64, and the program is ours
    return Markup(
        f'<script type="application/gzip" id="viewer-library">{_packed(library.encode())}</script>\n'
        f'<script type="application/gzip" id="viewer-scene">{_packed(scene)}</script>\n'
        f"<script>{program}</script>\n"
    )


def _packed(data: bytes) -> str:
    """Compressed, the same bytes at any time, as base64."""
    return base64.b64encode(gzip.compress(data, 9, mtime=0)).decode("ascii")
