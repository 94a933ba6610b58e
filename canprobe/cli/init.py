"""Write a cell file for your own arm and a first scene that runs on the emulator at once.

The chain comes from a URDF; without one the file begins with the rows of a PUMA 560, to be replaced. EDS or DCF files
are copied beside the cell file: one for all drives, or one for each joint from the base. The bus has the fastest bit
rate that all of them and the array have. What no file says (counts a turn, gears) has a placeholder with a comment.
Two JSON Schemas stand beside the two files: an editor completes and explains their keys.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator
from pathlib import Path

from canprobe.cli.argument_types import folder_path
from canprobe.cli.parser import Parser, option_for
from canprobe.errors import UsageError

HELP = "write a cell file and a first scene for your own arm"
EXAMPLE = """\
examples:
  canprobe init my-cell
  canprobe init my-cell --urdf arm.urdf --eds puma260_joint
  canprobe init my-cell --urdf arm.urdf --tip tool0 --eds drive.eds
  canprobe init my-cell --urdf arm.urdf --eds big.eds --eds big.eds --eds small.eds
  canprobe run my-cell/first.toml
"""


def add_arguments(parser: Parser) -> None:
    parser.add_argument("folder", metavar="DIR", type=folder_path, help="folder to write into; made if it is missing")
    parser.add_option("--urdf FILE", "URDF of the arm [rows of a PUMA 560]", Path)
    parser.add_option("--base LINK", "link of the URDF that is the base [its root]")
    parser.add_option("--tip LINK", "link of the URDF that is the flange [its only end]")
    parser.add_option(
        "--eds FILE",
        "EDS, DCF, XDD or XDC of the drives, or the name of a packaged one: given once for all of them, or once"
        " for each joint from the base",
        many=True,
    )


def run(args: argparse.Namespace) -> None:
    """Write cell.toml and first.toml, with the files that they name."""
    from canprobe.cell.scene.schemas import schema_line, schema_name, schema_text
    from canprobe.cell.scene.toml_files import written_by_line
    from canprobe.cli.init_cell import template_cell, urdf_cell
    from canprobe.cli.init_scene import write_with_first_scene
    from canprobe.fieldbus.bus.files import write_text, writing
    from canprobe.fieldbus.eds.packaged import eds_file
    from canprobe.mechanics.robot.urdf_visuals import with_meshes_found

    folder: Path = args.folder
    if (option := option_for(folder.name, ("--urdf", "--eds"))) is not None:
        raise UsageError(f"{folder}: DIR is the folder to write into; type: canprobe init my-cell {option} {folder}")
    for name in ("cell.toml", "first.toml", schema_name("cell"), schema_name("scene")):
        if (folder / name).exists():
            raise UsageError(f"{folder / name} exists already: choose another folder, or remove it")
    args.eds = [eds_file(name) for name in args.eds]
    if args.urdf and not args.urdf.is_file():
        raise UsageError(f"{args.urdf}: no such file")
    if args.urdf is None and (args.base or args.tip):
        raise UsageError("--base and --tip are links of a URDF: give it with --urdf FILE")
    cell = f"{schema_line('cell')}{written_by_line()}{urdf_cell(args) if args.urdf else template_cell(args)}"
    with _folder_or_nothing(folder):
        for path in {*args.eds, *([args.urdf] if args.urdf else [])}:
            copy = folder / path.name
            if path.resolve() != copy.resolve():
                with writing(copy):
                    copy.write_bytes(with_meshes_found(path) if path == args.urdf else path.read_bytes())
        first, no_scan = write_with_first_scene(folder, cell)
        write_text(folder / "first.toml", f"{schema_line('scene')}{written_by_line()}{first}")
        for kind in ("cell", "scene"):
            write_text(folder / schema_name(kind), schema_text(kind))
    print(f"wrote {folder / 'cell.toml'} and {folder / 'first.toml'}")
    if no_scan:
        print(f"first.toml moves the arm freely: a scan was refused: {no_scan}")
    print(f"next: canprobe plan {folder / 'first.toml'}")
    print(f"      canprobe run {folder / 'first.toml'}")


@contextlib.contextmanager
def _folder_or_nothing(folder: Path) -> Iterator[None]:
    """Make the folder for the files of the block; where the block fails, folder and files are removed."""
    from canprobe.fieldbus.bus.files import make_folder

    new = [path for path in (folder, *folder.parents) if not path.exists()]
    make_folder(folder)
    before = set(folder.iterdir())
    try:
        yield
    except BaseException:
        for path in set(folder.iterdir()) - before:
            path.unlink()
        for path in new:
            path.rmdir()
        raise
