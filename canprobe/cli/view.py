"""Show a scene or a recorded run in three dimensions, in a browser (extra `view`).

A scene is run and shown live, at the pace of real time, and then as a replay; on Windows only as a replay. The page is
served until Ctrl-C. If a folder has the name of a packaged scene, write ./NAME for the folder.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import webbrowser
from collections.abc import Callable
from pathlib import Path

from canprobe.cli.argument_types import whole
from canprobe.cli.interrupts import left_by_ctrl_c
from canprobe.cli.parser import Parser
from canprobe.cli.target import target_of
from canprobe.fieldbus.bus.clock import Pace
from canprobe.fieldbus.bus.real.interrupts import interrupts_held, interrupts_repeated

HELP = "show a scene or a run in a browser"
EXAMPLE = """\
examples:
  canprobe view cylinder
  canprobe view runs/cylinder-20260101-120000-000 --port 9000 --no-open
  canprobe view runs/cylinder-20260101-120000-000 --html cylinder.html
"""


def add_arguments(parser: Parser) -> None:
    parser.add_argument("what", metavar="SCENE|RUN_DIR", help="scene to run, or folder of a recorded run")
    parser.add_option(
        "--host H", "address of the server; 0.0.0.0 serves other machines [127.0.0.1]", default="127.0.0.1"
    )
    parser.add_option("--port N", "port of the server; 0: any free port [8080]", whole(0, 65_535), default=8080)
    parser.add_option("--no-open", "print the address and open no browser")
    parser.add_option("--html FILE", "write the replay to one HTML file, and end", Path)
    of_scene = parser.add_argument_group("options of a SCENE")
    parser.add_shared("--set", "BUS", "--out", "--force", "--seed", "--duration", to=of_scene)
    parser.add_shared("-v")


def run(args: argparse.Namespace) -> None:
    """Show it until Ctrl-C, or write the file."""
    from canprobe.cell.planning.bridges import check_view
    from canprobe.cell.scene.load import packaged_files

    check_view()
    folder, browser = Path(args.what), _Browser(args.port, args.report.say, quiet=args.no_open)
    leave = left_by_ctrl_c() if args.html is None else contextlib.nullcontext()  # the normal end of a page only
    with leave:
        if not folder.is_dir() or args.what in packaged_files("scenes"):  # `./cylinder` is a folder of that name
            folder = _run_scene(args, browser)
        from canprobe.lab.bridge.view.page import write_page
        from canprobe.lab.bridge.view.recorded import read_run
        from canprobe.lab.bridge.view.replay import serve_run

        recorded = read_run(folder)
        if args.html is not None:
            with interrupts_repeated():
                write_page(recorded, args.html, args.report.say)
            print(args.html)
        else:
            serve_run(
                recorded,
                port=browser.port,
                host=args.host,
                ready=browser.show,
                say=args.report.say,
                whole=interrupts_held,
            )


def _run_scene(args: argparse.Namespace, browser: _Browser) -> Path:
    """Run the scene, live unless only a file is wanted; returns the folder of its results."""
    from dataclasses import replace

    from canprobe import api
    from canprobe.cell.planning.bridges import BRIDGES
    from canprobe.cell.scene.load import load_scene, packaged_files
    from canprobe.cell.scene.model import BridgeSettings
    from canprobe.cell.session.target import VIRTUAL
    from canprobe.errors import SceneError

    try:
        scene = load_scene(args.what, dict(args.set))
    except SceneError as error:
        if not os.path.exists(args.what) and args.what not in {**packaged_files("scenes"), **packaged_files("cells")}:
            raise SceneError([f"{error}; nor is there a folder of a run of that name"]) from error
        raise
    settings = replace(scene.bridge or BridgeSettings(), view_port=args.port, view_host=args.host)
    scene = target_of(args, scene).applied_to(replace(scene, bridge=settings))
    pace = Pace()
    live = args.html is None and not BRIDGES["view"].lacks
    folder = api.results_folder(scene, args.out)
    api.run(
        scene,
        out=folder,
        seed=args.seed,
        duration_s=args.duration,
        force=args.force,
        bridge=("view",) if live else (),
        observers=[lambda seen: pace.keep(seen.t_ns)] if live and scene.bus.interface in VIRTUAL else [],
        say=browser.say,
    )
    return folder


class _Browser:
    """Prints the address of the page and opens it in the user's browser, once.

    Args:
        port: requested port.
        say: function that reports the other steps.
        quiet: whether to print the address only.

    Attributes:
        port: port of the last page, so that a browser that shows it finds the next page there.
    """

    def __init__(self, port: int, say: Callable[[str], None], *, quiet: bool) -> None:
        from canprobe.cell.results.result import has_display

        self.port, self._say = port, say
        self._quiet = quiet or not has_display()

    def show(self, address: str) -> None:
        """Print the address of the page, and open the browser."""
        print(f"{address} (Ctrl-C ends it)", flush=True)
        self.port = int(address.rpartition(":")[2])
        if not self._quiet:
            self._quiet = True
            webbrowser.open(address)

    def say(self, line: str) -> None:
        """Report a step of the run; the bridge's step is its address."""
        where = line.removeprefix("bridge view: ")
        if where != line:
            self.show(where)
        else:
            self._say(line)
