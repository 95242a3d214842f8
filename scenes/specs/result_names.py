"""Names in results that are others since a version: keys of JSON, columns of CSV, attributes of netCDF.

The one table of them. Studies that ask for an old key and comparisons of runs with older ones read it, and
docs/renamed.md, the note to users, is written from it, by which golden runs are held against older golden files.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Renamed:
    """A name in results that is another one now.

    Attributes:
        old: the key or column; after dots the keys that it must stand below, ``propagation.height_sigma_m``; ``*``
            stands for the beginning of a key.
        new: the key or column now.
        files: names of the files in which it is so; none for all.
        since: version that has the new name first.
    """

    old: str
    new: str
    files: tuple[str, ...] = ()
    since: str = "1.0.0"

    def name(self, path: Sequence[str], file: str) -> str | None:
        """The new name of the last key of a path, None if this entry is not about it.

        Args:
            path: keys from the root, without indices of lists.
            file: name of the file; "" for one that is not known, in which only names that hold for all files are told.
        """
        if self.files and file not in self.files:
            return None
        *above, last = self.old.split(".")
        if above and list(path[-1 - len(above) : -1]) != above:
            return None
        if not last.startswith("*"):
            return self.new if path[-1] == last else None
        ending = last[1:]
        own = path[-1]
        return own.removesuffix(ending) + self.new[1:] if own.endswith(ending) and own != ending else None


RENAMED: tuple[Renamed, ...] = (
    Renamed("propagation.height_sigma_m", "height_m_sigma_noise", ("monitor.json",)),
    Renamed("propagation.height_total_sigma_m", "height_m_sigma", ("monitor.json",)),
    Renamed("smoothing.height_sigma_m", "height_m_sigma", ("monitor.json",)),
    Renamed("monitored_change_sigma_noise_arcsec", "monitored_change_arcsec_sigma_noise", ("monitor.json",)),
    Renamed("points.sigma_arcsec", "mean_arcsec_sigma", ("turntable.json",)),
    Renamed("heldout_points.sigma_arcsec", "mean_arcsec_sigma", ("turntable.json",)),
    Renamed("sigma_raw_um", "distortion_raw_um_sigma", ("distortion.json",)),
    Renamed("sigma_um", "distortion_compensated_um_sigma", ("distortion.json",)),
    Renamed("line.sigma", "values_sigma", ("distortion.json",)),
    Renamed("sigma_mm", "values_mm_sigma", ("distortion.json",)),
    Renamed("sigma_lines_px", "displacement_lines_px_sigma", ("match.json", "simulate.json")),
    Renamed("sigma_pixels_px", "displacement_pixels_px_sigma", ("match.json", "simulate.json")),
    Renamed("sigma_row", "row_sigma"),
    Renamed("sigma_column", "column_sigma"),
    Renamed("sigma_line_px", "line_sigma"),
    Renamed("sigma_pixel_px", "pixel_sigma"),
    Renamed("*_sigma_arcsec", "*_arcsec_sigma"),
    Renamed("*_sigma_rad", "*_rad_sigma"),
    Renamed("*_sigma_deg", "*_deg_sigma"),
    Renamed("*_sigma_px", "*_px_sigma"),
    Renamed("held_start_sigma_m", "held_start_m_sigma"),
    Renamed("curvature_sigma_per_px", "curvature_per_px_sigma"),
    Renamed("mtf50_sigma_cycles_per_mm", "mtf50_cycles_per_mm_sigma"),
    Renamed("worst_wfe_waves", "wfe_worst_waves"),
    Renamed("rms_waves", "wfe_rms_waves"),
    Renamed("rms_before_waves", "wfe_rms_before_waves"),
    Renamed("rms_after_waves", "wfe_rms_after_waves"),
    Renamed("worst_before_waves", "wfe_worst_before_waves"),
    Renamed("worst_after_waves", "wfe_worst_after_waves"),
    Renamed("wavefront_error_waves", "wfe_rms_waves"),
    Renamed("worst_field_waves", "wfe_worst_waves"),
    Renamed("metres_per_arcsec", "height_m_per_arcsec"),
    Renamed("pixel_um", "pitch_um"),
    Renamed("focal_length_m", "principal_distance_m", ("camera.json", "truth.json")),
    Renamed("focal_length", "principal_distance", ("crosstalk.json",)),
    Renamed("focal_length_along_line_m", "principal_distance_along_line_m", ("optics.json",)),
    Renamed("focal_length_along_track_m", "principal_distance_along_track_m", ("optics.json",)),
    Renamed("side", "channel", ("spots.csv",)),
)
"""All of them, by version."""


def new_name(path: Sequence[str], file: str = "") -> str:
    """The name now of the last key of a path in a file's results; the same where it has not changed."""
    found = (name for one in RENAMED if (name := one.name(path, file)) is not None)
    return next(found, path[-1])


def by_new_names(tree: Any, file: str = "", above: tuple[str, ...] = ()) -> Any:
    """Plain data of a result with the names of now.

    Args:
        tree: mappings, lists and values. A mapping that says its ``schema`` is the content of that file.
        file: its name, without its folder; "" if it is not known.
        above: keys that it stands below.
    """
    if isinstance(tree, list):
        return [by_new_names(one, file, above) for one in tree]
    if not isinstance(tree, Mapping):
        return tree
    if isinstance(kind := tree.get("schema"), str):
        file, above = f"{kind.partition(' ')[0]}.json", ()
    names = {key: (*above, str(key)) for key in tree}
    return {new_name(names[key], file): by_new_names(one, file, names[key]) for key, one in tree.items()}


def key_now(key: Iterable[str | int]) -> tuple[str | int, ...]:
    """The key of a study's response, file without its ending first, with the names of now."""
    parts = tuple(key)
    file = f"{parts[0]}.json" if parts else ""
    out: list[str | int] = []
    names: list[str] = []
    for k, part in enumerate(parts):
        if isinstance(part, str) and k > 0:
            names.append(part)
            out.append(new_name(names, file))
        else:
            out.append(part)
    return tuple(out)
