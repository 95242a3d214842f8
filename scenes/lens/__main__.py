"""Command ``python -m scenes.lens``: prescriptions of other optical programs to cameras of the twin, and back."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

import os
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from optics.camera.telescope_types import TELESCOPES
from scenes.yaml.errors import InputError, Issue, Problem, printable
from scenes.yaml.standard_output import BAD_INPUT, FAILURE, print_error, to_stdout
from scenes.yaml.units import ANGLE, LENGTH, Kind, parse_quantity

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.lens.prescription import Prescription

READS = {".zmx": "Zemax", ".seq": "CODE V", ".yaml": "batoid", ".yml": "batoid"}
WRITES = (".zmx", ".yaml", ".yml")

app = typer.Typer(
    add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False, no_args_is_help=True
)
Force = Annotated[bool, typer.Option("--force", help="Replace the file if it exists.")]


@contextmanager
def _explained(errors: Console) -> Iterator[None]:
    """Print the errors that a user can cause (bad input, missing backend) as one sentence, and exit with their code."""
    from optics.numerics.backend import BackendUnavailable
    from optics.numerics.llvm import LibraryMissing

    try:
        yield
    except InputError as error:
        print_error(errors, str(error))
        raise typer.Exit(BAD_INPUT) from None
    except (BackendUnavailable, LibraryMissing) as error:
        print_error(errors, str(error))
        raise typer.Exit(FAILURE) from None


def _quantity(option: str, text: str | None, kind: Kind) -> float | None:
    """Return the value of a command-line option given as text with a unit, in SI; None if it is not given."""
    if text is None:
        return None
    try:
        value = parse_quantity(text, kind)
    except Problem as problem:
        raise InputError(Issue(f"{option}: {problem.problem}", value=problem.value, allowed=problem.allowed)) from None
    if not value > 0.0:
        raise InputError(Issue(f"{option} is not greater than zero", "", None, (), text))
    return value


def check_out(out: Path, suffixes: Sequence[str], force: bool) -> None:
    """Raise InputError if an output file has an unknown suffix or exists."""
    if out.suffix.lower() not in suffixes:
        raise InputError(Issue("unknown suffix of an output file", str(out), allowed=", ".join(suffixes)))
    if out.exists() and not force:
        raise InputError(Issue("the file exists", str(out), allowed="another name, or --force to replace it"))


def _camera_name(out: Path) -> str:
    """Return the name of a camera in a file: that of the file, in letters, digits and underscores."""
    name = re.sub(r"[^A-Za-z0-9_-]", "_", out.stem)[:64]
    return name if re.match(r"[A-Za-z]", name) else f"camera_{name}"[:64]


def _write(out: Path, content: bytes) -> None:
    """Write a file so that it never exists half-written, even if the program is interrupted."""
    handle, name = -1, ""
    try:
        handle, name = tempfile.mkstemp(prefix=f".{out.name}.", suffix=".partial", dir=out.parent)
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(name, 0o666 & ~mask)
        os.replace(name, out)
    except OSError as error:
        if name:
            Path(name).unlink(missing_ok=True)
        raise InputError(Issue(f"cannot be written: {error.strerror or error}", str(out))) from None


def read_prescription(path: Path, glasses: Sequence[Path] = (), wavelength: float | None = None) -> Prescription:
    """Read the prescription of another optical program; the suffix of the file selects the format.

    Parameters
    ----------
    path : Path
        A .zmx, .seq or .yaml file.
    glasses : sequence of Path
        Glass catalogues in AGF format.
    wavelength : float or None
        Wavelength for a batoid file, which names none, in metres.

    Raises
    ------
    InputError
        The file is not valid in its format.
    """
    from scenes.lens.statements import read_catalogues

    kind = READS.get(path.suffix.lower())
    if kind is None:
        raise InputError(Issue("unknown suffix of a prescription", str(path), allowed=", ".join(READS)))
    if kind == "batoid":
        from scenes.lens.batoid_reader import read_batoid

        if wavelength is None:
            raise InputError(Issue("a batoid file names no wavelength", str(path), allowed='--wavelength "620 nm"'))
        return read_batoid(path, wavelength)
    if wavelength is not None:
        raise InputError(Issue("--wavelength is for batoid files; this file names its wavelengths", str(path)))
    known = read_catalogues(glasses)
    if kind == "Zemax":
        from scenes.lens.zemax_reader import read_zemax

        return read_zemax(path, known)
    from scenes.lens.codev_reader import read_codev

    return read_codev(path, known)


@app.command()
def read(
    file: Annotated[
        Path, typer.Argument(readable=False, help="Zemax .zmx, CODE V .seq, or a telescope of batoid, .yaml.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE.yaml", readable=False, help="The camera's file to write.")],
    glasses: Annotated[
        list[Path] | None, typer.Option(readable=False, help="AGF catalogue of glasses; may be given several times.")
    ] = None,
    pupil: Annotated[
        str | None, typer.Option(help='Diameter of the entrance pupil, "0.6 m", in place of the file\'s.')
    ] = None,
    field: Annotated[
        str | None, typer.Option(help='Half field about the axis, "1.5 deg", in place of the file\'s.')
    ] = None,
    wavelength: Annotated[str | None, typer.Option(help='"620 nm", for batoid files, which name none.')] = None,
    pitch: Annotated[str, typer.Option(help="Pixel pitch of the line CCD, which such files do not have.")] = "7 um",
    flat_image: Annotated[
        bool, typer.Option("--flat-image", help="Replace a curved image by the tangent plane at its middle.")
    ] = False,
    force: Force = False,
) -> None:
    """Convert another program's prescription to a camera's file, and list what was not converted.

        python -m scenes.lens read threemir.seq --out threemir.yaml

        python -m scenes.lens read doublet.zmx --glasses schott.agf --out doublet.yaml

        python -m scenes.lens read LSST_r.yaml --wavelength "620 nm" --field "1.75 deg" --pupil "8.36 m" --out lsst.yaml

    Both are traced before the camera's file is written, and the largest difference between their rays is printed. A
    statement that would change the optics if it were ignored is refused with its line; every other statement that is
    not understood is listed. Pupil and field are those of the file unless they are given here. Exit code 2 for a file
    that cannot be read.
    """
    errors = Console(stderr=True)
    with _explained(errors):
        check_out(out, (".yaml", ".yml"), force)
        wide, half = _quantity("--pupil", pupil, LENGTH), _quantity("--field", field, ANGLE)
        step, colour = _quantity("--pitch", pitch, LENGTH), _quantity("--wavelength", wavelength, LENGTH)
        lens = read_prescription(file, glasses or (), colour)
        from dataclasses import replace

        from optics.numerics.backend import load_backend
        from scenes.lens.camera_reader import Width, camera_of, camera_text, with_flat_image

        if half is not None:
            lens = replace(lens, fields=((0.0, 0.0), (0.0, half)), heights=(), field_kind="angles", round_field=True)
        if flat_image and not lens.image.surface.is_plane:
            lens = with_flat_image(lens)
        assert step is not None
        made = camera_of(lens, _camera_name(out), load_backend("llvm"), Width(wide, step))
        _write(out, camera_text(made, lens).encode())
    with to_stdout(errors, f"the camera is complete in {out}"):
        for line in made.summary_lines(lens):
            sys.stdout.write(f"{printable(line)}\n")
        sys.stdout.write(f"{out}\n")


@app.command()
def new(
    kind: Annotated[
        str,
        typer.Argument(help=f"{'; '.join(f'{name}: {telescope.title}' for name, telescope in TELESCOPES.items())}."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.yaml", readable=False, help="The camera's file to write. Default: standard output."),
    ] = None,
    aperture: Annotated[str, typer.Option(help="Diameter of the entrance pupil.")] = "0.5 m",
    f_number: Annotated[float, typer.Option(min=0.5, max=1000.0, help="Focal length over the aperture.")] = 10.0,
    wavelength: Annotated[str, typer.Option(help="Design wavelength.")] = "650 nm",
    field: Annotated[
        str | None,
        typer.Option(help='Half field along the line, "0.2 deg". Default: one over which the kind is sharp.'),
    ] = None,
    pitch: Annotated[str, typer.Option(help="Pixel pitch of the line CCD.")] = "7 um",
    primary: Annotated[
        float | None, typer.Option(min=0.5, help="F-number of the primary of two mirrors. Default: a third, 1.5 to 3.")
    ] = None,
    behind: Annotated[
        str | None,
        typer.Option(help="Distance of the focus behind the primary of two mirrors. Default: half the aperture."),
    ] = None,
    force: Force = False,
) -> None:
    """Write the camera file of a new telescope, which the other commands read at once.

        python -m scenes.lens new ritchey-chretien --aperture "0.4 m" --f-number 8 --out my_camera.yaml

        python -m twin.camera my_camera.yaml

    First-order optics give the layout with exactly this focal length, third-order optics the conic constants; those of
    the off-axis anastigmat minimise the traced wavefront error, and the lenses of the triplet its ray errors over the
    field. Exit code 2 if there is no such telescope.
    """
    errors = Console(stderr=True)
    with _explained(errors):
        if out is not None:
            check_out(out, (".yaml", ".yml"), force)
        sizes = [_quantity("--aperture", aperture, LENGTH), _quantity("--wavelength", wavelength, LENGTH)]
        half, step = _quantity("--field", field, ANGLE), _quantity("--pitch", pitch, LENGTH)
        back = _quantity("--behind", behind, LENGTH)
        from scenes.lens.prescription import first_camera
        from scenes.specs.camera import CameraSpec
        from scenes.yaml.spec import validate
        from scenes.yaml.yaml_file import parse_yaml

        assert sizes[0] is not None
        assert sizes[1] is not None
        assert step is not None
        try:
            name = _camera_name(Path(kind) if out is None else out)
            text = first_camera(kind, name, sizes[0], f_number, sizes[1], half, step, primary, back)
        except ValueError as error:
            raise InputError(Issue(str(error))) from None
        validate(CameraSpec, parse_yaml(text))
        if out is not None:
            _write(out, text.encode())
    with to_stdout(errors, "" if out is None else f"the camera is complete in {out}"):
        sys.stdout.write(text if out is None else f"{out}\nanalyse it: python -m twin.camera {out}\n")


@app.command()
def write(
    camera: Annotated[Path, typer.Argument(readable=False, help="A camera of the library (gf7), or a camera's file.")],
    out: Annotated[Path, typer.Option(metavar="FILE", readable=False, help="Zemax .zmx, or .yaml for batoid.")],
    perturbed: Annotated[
        Path | None, typer.Option(readable=False, help="A job, in whose perturbed state the camera is written.")
    ] = None,
    mounted: Annotated[
        str | None, typer.Option("--camera", help="With --perturbed: which of the instrument's cameras.")
    ] = None,
    force: Force = False,
) -> None:
    """Write a camera as a prescription for other programs, as designed or in the perturbed state of a job.

        python -m scenes.lens write gf7 --out gf7.zmx

        python -m scenes.lens write gf7 --out gf7_batoid.yaml

        python -m scenes.lens write gf7 --perturbed perturb.yaml --camera forward --out forward.zmx

    Motions of mirrors, of the camera and of the focal plane become coordinate breaks, thermal expansion changes the
    shapes, figures are Zernike terms (Noll, rms). What a format cannot represent exactly is refused with its name.
    """
    errors = Console(stderr=True)
    with _explained(errors):
        check_out(out, WRITES, force)
        if mounted is not None and perturbed is None:
            raise InputError(Issue("--camera is for --perturbed", "", None, (), mounted))
        from optics.numerics.backend import load_backend

        backend = load_backend("llvm")
        lens = _perturbed(camera, perturbed, mounted, backend) if perturbed else _designed(camera, backend)
        notes = list(lens.notes)
        if out.suffix.lower() == ".zmx":
            from scenes.lens.camera_writer import zemax_text

            content = zemax_text(lens).replace("\n", "\r\n").encode("utf-16")
        else:
            from scenes.lens.camera_writer import batoid_text

            text, more = batoid_text(lens)
            notes += more
            content = text.encode()
        _write(out, content)
    with to_stdout(errors, f"the prescription is complete in {out}"):
        for note in notes:
            sys.stdout.write(f"omitted: {printable(str(note))}\n")
        sys.stdout.write(f"{out}\n")


def _designed(camera: Path, backend: Backend) -> Prescription:
    """Return the prescription of a camera as designed."""
    from scenes.lens.camera_writer import prescription_of
    from scenes.models.camera_model import derive_camera
    from scenes.specs.load import load_camera

    return prescription_of(derive_camera(load_camera(str(camera)), backend))


def _perturbed(camera: Path, job_file: Path, mounted: str | None, backend: Backend) -> Prescription:
    """Return the prescription of a camera of a job's instrument in the job's state."""
    from scenes.lens.camera_writer import perturbed_prescription
    from scenes.models.instrument_builder import build_instrument
    from scenes.models.job_state import job_state
    from scenes.models.thermal_model import ThermalModel
    from scenes.specs.job import checked_nodes
    from scenes.specs.load import load_camera
    from scenes.specs.resolved import resolve
    from scenes.yaml.errors import names_text, unknown

    resolved = resolve(job_file)
    wanted = load_camera(str(camera)).name
    cameras = {name: resolved.cameras[site.camera].name for name, site in resolved.instrument.cameras.items()}
    places = [name for name, known in cameras.items() if known == wanted]
    if not places:
        allowed = names_text(f"{known} ({name})" for name, known in cameras.items())
        raise InputError(Issue("the job's instrument has no such camera", str(job_file), None, (), wanted, allowed))
    if mounted is None and len(places) > 1:
        problem, choice = "the instrument has this camera several times", f"--camera {' or '.join(places)}"
        raise InputError(Issue(problem, str(job_file), None, (), None, choice))
    if mounted is not None and mounted not in places:
        raise InputError(unknown("no such camera", mounted, places).at(str(job_file)))
    instrument = build_instrument(resolved.instrument, resolved.cameras, backend)
    job = checked_nodes(resolved.job, instrument.nodes)
    state = job_state(job, ThermalModel(instrument))
    try:
        return perturbed_prescription(instrument, mounted or places[0], state)
    except ValueError as error:
        raise InputError(Issue(str(error), str(job_file))) from None


if __name__ == "__main__":
    app()
