"""README, CONTRIBUTING and docs: Python blocks run as they stand, commands are understood, and the cheap ones run."""

import ast
import re
import shutil
import tomllib
import typing
from importlib.metadata import entry_points
from pathlib import Path

import pytest
import system_packages
from command_lines import command_lines, parse
from undrawn import undrawn_run

import canprobe.cell.tasks
import canprobe.errors
from canprobe.cell.planning.bridges import BRIDGES
from canprobe.cell.scene.checks import convert
from canprobe.cell.scene.load import load_scene, scenes_folder
from canprobe.cell.scene.model import ArrayFile, Scene
from canprobe.cli import COMMANDS, main
from canprobe.fieldbus.eds.packaged import eds_path
from canprobe.fieldbus.tools.conform.own_points import read_points
from canprobe.lab.studies.sweep import STUDIES

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXTS = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in PAGES}
PATHS = ("canprobe/", "docs/", "tests/", ".ci/")
SECTIONS = {
    name: typing.get_args(hint)[-1] if name in ("joints", "postures") else next(iter(typing.get_args(hint)), hint)
    for name, hint in {**typing.get_type_hints(ArrayFile), **typing.get_type_hints(Scene)}.items()
}


LONG_PAGES = ("docs/python.md", "docs/gym.md")
PAGE = pytest.mark.slow(reason="the blocks of a page run cells for half a minute; the default runs those of the others")


def blocks(language):
    """Every block of a language as (page, text); a block in a list is indented."""
    found = re.compile(rf"^( *)```{language}\n(.*?)^ *```$", re.DOTALL | re.MULTILINE)
    return [pytest.param(match[2], id=f"{page}-{i}", marks=[PAGE] * (language == "python" and page in LONG_PAGES))
            for page, text in TEXTS.items() for i, match in enumerate(found.finditer(text))]  # fmt: skip


def commands():
    """Every command line of canprobe in a block, once."""
    lines = {tuple(line): page for page, text in TEXTS.items() for block in re.findall(r"```sh\n(.*?)```", text, re.S)
             for line in command_lines(block)}  # fmt: skip
    return [pytest.param(list(line), id=f"{page}-{' '.join(line)}") for line, page in lines.items()]


def is_cheap(line):
    """It needs no bus, no extra that tests lack, and less than a second or two."""
    quick = line[0] in ("scenes", "plan", "eds") or line[:2] == ["study", "--list"]
    return quick or (line[0] == "replay" and "--bridge" not in line)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the files that the pages name: a scene, an EDS, a run and its log."""
    folder = tmp_path_factory.mktemp("pages")
    shutil.copy(scenes_folder() / "cylinder.toml", folder / "mine.toml")
    shutil.copy(eds_path("puma260_joint"), folder / "drive.eds")
    assert main(["init", str(folder / "my-cell"), "--eds", str(folder / "drive.eds")]) == 0
    undrawn_run(load_scene("cylinder", {"task.clearance_mm": 0.3}), out=folder / "runs" / "first", duration_s=0.5)
    shutil.copy(folder / "runs" / "first" / "bus.log", folder / "candump.log")
    shutil.copy(folder / "drive.eds", folder / "epos4.dcf")
    assert main(["init", str(folder / "rehearsal"), "--eds", str(folder / "epos4.dcf")]) == 0
    first = load_scene(str(folder / "rehearsal" / "first.toml"))
    undrawn_run(first, out=folder / "runs" / "rehearsal", duration_s=0.5)
    return folder


@pytest.mark.parametrize("block", blocks("python"))
def test_python_block_runs(block, tmp_path, monkeypatch, capsys):
    def load_quick(scene, overrides=None):
        return load_scene(scene, {"outputs.figures": False, "cycle.rate_hz": 200.0, **(overrides or {})})

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("canprobe.api.load_scene", load_quick)
    monkeypatch.setattr("canprobe.lab.studies.sweep.system.processors", lambda: 1)  # each would import anew
    exec(compile(block, "page", "exec"), {"__name__": "page"})
    out = capsys.readouterr().out
    if "607A" in block:  # the drive of docs/fieldbus.md has moved
        assert out.splitlines()[-1] == "5000 0x1437"
    if "estimate.kappa" in block:
        first = float(re.search(r"[\d.]+", out)[0])
        assert first == pytest.approx(27.75 if "0.036" in block else 20.0, abs=0.01)


@pytest.mark.parametrize("line", commands())
def test_command_is_understood(line, folder, monkeypatch):
    monkeypatch.chdir(folder)
    args = vars(parse(line))
    for scene in (args.get("scene"), args.get("what")):
        if scene is not None and not Path(scene).is_dir():
            load_scene(scene)
    assert args.get("name") is None or line[0] != "study" or args["name"] in STUDIES
    assert set(args.get("bridge") or ()) <= set(BRIDGES)


@pytest.mark.parametrize("line", [one for one in commands() if is_cheap(one.values[0])])
def test_cheap_command_runs(line, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(line) == 0
    assert capsys.readouterr().out


@pytest.mark.parametrize("block", blocks("toml"))
def test_keys_exist_and_take_the_values(block):
    sections = tomllib.loads(block)
    joints = [("joints", joint) for joint in sections.pop("joints", {}).values()]
    postures = sections.pop("postures", {})  # whose keys are names
    for section, keys in [*sections.items(), *joints]:
        annotations = typing.get_type_hints(SECTIONS[section], include_extras=True)
        for key, value in keys.items():
            convert(value, annotations[key])
    for posture in postures.values():
        convert(posture, SECTIONS["postures"])


@pytest.mark.parametrize("block", blocks("sh"))
def test_paths_and_programs_of_a_shell_block_exist(block):
    known = entry_points(group="console_scripts").names
    for word in block.split():
        assert not word.startswith(PATHS) or (ROOT / word).exists()
        assert not re.fullmatch(r"can_\w+", word) or word in known


@pytest.mark.parametrize("page", TEXTS)
def test_links_pictures_and_names_of_commands(page):
    for target in re.findall(r"\]\((?!https://)([^)#]+)[^)]*\)", TEXTS[page]):
        assert ((ROOT / page).parent / target).is_file(), target
    assert set(re.findall(r"`canprobe (\w+)", TEXTS[page])) <= set(COMMANDS)


def test_the_api_reference_has_every_public_name():
    rendered = set(re.findall(r"^\.\. auto\w+:: ([\w.]+)$", TEXTS["docs/api.md"], re.M))
    errors = {name for name, kind in vars(canprobe.errors).items() if isinstance(kind, type)}
    public = set(canprobe.__all__) - errors - {"__version__"}
    modules = {"canprobe.errors", *(f"canprobe.cell.tasks.{name}" for name in canprobe.cell.tasks.__all__)}
    assert rendered >= {*modules, *(f"canprobe.{name}" for name in public)}


def test_the_first_screen_has_two_lines_to_type_with_all_of_their_set_up():
    """`.ci/fresh` types them on a fresh machine."""
    screen = "\n".join(TEXTS["README.md"].splitlines()[:24])
    first, tests = re.findall(r"^```\w*\n(.*?)\n```$", screen, re.S | re.M)
    for line in (first, tests):
        assert "\n" not in line and line.startswith("sudo apt-get update && sudo apt-get install -y python3-venv && ")
    assert first.endswith(" && canprobe run cylinder") and tests.endswith(" && CANPROBE_INSTALL=1 python -m pytest")


def test_the_line_for_every_test_is_that_of_ci():
    """Where nothing may be skipped."""
    line, ci = "python -m pytest -m ''", (ROOT / ".ci/run").read_text(encoding="utf-8")
    assert f"`{line}`" in TEXTS["README.md"] and f"`{line}`" in TEXTS["CONTRIBUTING.md"]
    assert re.search(r"^python -m pytest -q -ra -m ''$", ci, re.M) and "export CANPROBE_NO_SKIPS=1" in ci
    assert "CANPROBE_NO_SKIPS=1 .ci/fresh" in ci


def test_the_readme_names_each_package_that_pytest_installs():
    named = set(re.findall(r"`([\w-]+)`", TEXTS["README.md"]))
    assert named >= {*system_packages.PROGRAMS, *system_packages.LIBRARIES}


def test_the_readme_stays_short():
    assert TEXTS["README.md"].count("\n") <= 180


def test_messages_on_the_page_of_troubles_are_those_of_the_code():
    source = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "canprobe").rglob("*.py"))
    source = re.sub(r'"\s*\n\s*f?"', "", source)  # a string in several parts
    rows = re.findall(r"^\| (.*?) \|", TEXTS["docs/troubleshooting.md"], re.M)
    for message in [text for row in rows for text in re.findall(r"`([^`]+)`", row)]:
        for part in filter(None, (part.strip() for part in message.split("…"))):
            assert part in source, message


def test_the_stops_of_the_path_through_the_code_are_there():
    page = TEXTS["docs/architecture.md"]
    stops = re.findall(r'<a href="\.\./(canprobe/[\w/.]+)">[\w/.]+</a> \| `(\w+)`', page)
    assert 10 <= len(stops) <= 15
    for file, name in stops:
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        assert name in [node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)], file


def test_the_example_of_own_points_can_be_read(tmp_path):
    (block,) = re.findall(r"```text\n(\[\[point\]\].*?)```", TEXTS["docs/conform.md"], re.DOTALL)
    (tmp_path / "own.toml").write_text(block, encoding="utf-8")
    assert [point.title for point in read_points(tmp_path / "own.toml")] == ["201 temperature"]
