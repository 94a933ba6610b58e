"""What a terminal shows: its width, its colours, steps and a bar; what the shell completes."""

import io
import json
import os
import pty
import subprocess
import sys

import pytest

from canprobe import api
from canprobe.cell.results.expected import expected_text, figures_of, read_expected
from canprobe.cell.scene.load import packaged
from canprobe.cell.session.terminal import StepReport, painted
from canprobe.cli import COMMANDS, main
from canprobe.cli.output import print_summary, print_table


class Terminal(io.StringIO):
    """A terminal without a device, 80 columns wide."""

    def isatty(self):
        return True


@pytest.fixture(autouse=True)
def plain(monkeypatch):
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("COLUMNS", raising=False)


def test_bar_is_as_wide_as_the_terminal_and_redraws_only_what_changes():
    assert StepReport(stream=io.StringIO()).bar() is None
    assert StepReport(-1, Terminal()).bar() is None, "quiet"
    terminal = Terminal()
    show = StepReport(stream=terminal).bar()
    for done in (0, 0.01, 5, 10):
        show(done, 10)
    drawn = terminal.getvalue()
    assert drawn.count("\r") == 3
    assert drawn.endswith("100 %  10.0 of 10.0 s\x1b[K\n")
    assert {len(line.removesuffix("\x1b[K")) for line in drawn.strip().split("\r") if line} <= set(range(70, 80))


def test_a_step_stands_above_the_bar_and_an_error_below():
    terminal = Terminal()
    report = StepReport(stream=terminal)
    report.bar()(5, 10)
    bar = terminal.getvalue()[1:].removesuffix("\x1b[K")
    terminal.truncate(0)
    report.say("a step")
    report.complain("canprobe: stopped")
    assert terminal.getvalue().lstrip("\0") == f"\r\x1b[Ka step\n{bar}\ncanprobe: stopped\n"


@pytest.mark.parametrize(
    ("verbosity", "terminal", "lines"),
    [
        (-1, True, ["warning: hot", "warning: open"]),
        (0, True, ["warning: hot", "said", "detail", "warning: open"]),
        (0, False, ["warning: hot", "said", "warning: open"]),
        (1, False, ["warning: hot", "said", "detail", "warning: open"]),
    ],
)
def test_quiet_and_verbose(verbosity, terminal, lines):
    stream = Terminal() if terminal else io.StringIO()
    report = StepReport(verbosity, stream)
    report.say("warning: hot")
    report.say("said")
    report.detail("detail")
    report.detail("warning: open")
    assert stream.getvalue().splitlines() == lines


def test_verbose_run_reports_steps_where_stderr_is_no_terminal(monkeypatch, capsys, tmp_path):
    def run(_, *, say, **__):
        say("enable the drives")
        raise api.UsageError("enough")

    monkeypatch.setattr(api, "run", run)
    for option, seen in (("-v", True), ("-q", False), (None, False)):
        assert main(["run", "free", "--out", str(tmp_path), *([option] if option else [])]) == 2
        assert ("enable the drives" in capsys.readouterr().err) == seen
    assert main(["run", "free", "-v", "-q"]) == 2


@pytest.mark.parametrize(
    ("environment", "coloured"), [({}, True), ({"NO_COLOR": "1"}, False), ({"TERM": "dumb"}, False)]
)
def test_colours(environment, coloured, monkeypatch):
    monkeypatch.delenv("NO_COLOR")
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert (painted("x", "red", Terminal()) != "x") == coloured
    assert painted("x", "red", io.StringIO()) == "x"


def test_colours_change_no_word_of_a_summary(monkeypatch):
    text = "free on direct: done\n  time       1 s\n  warning    hot\n  expected   nothing"
    monkeypatch.delenv("NO_COLOR")
    monkeypatch.setattr(sys, "stdout", Terminal())
    print_summary(text)
    shown = sys.stdout.getvalue()
    assert shown.count("\x1b[0m") == 4
    for code in ("0", "32", "33", "36"):
        shown = shown.replace(f"\x1b[{code}m", "")
    assert shown == text + "\n"


def test_table_breaks_the_widest_columns_on_a_terminal_only(monkeypatch, capsys):
    rows = [("one", "word " * 12, "more " * 10), ("another", "short", "")]
    print_table(rows)
    assert capsys.readouterr().out.splitlines() == [
        f"one      {'word ' * 12}  {'more ' * 10}".rstrip(),
        "another  short",
    ]
    monkeypatch.setattr(sys, "stdout", Terminal())
    print_table(rows)
    shown = sys.stdout.getvalue()
    assert max(map(len, shown.splitlines())) <= 80
    assert shown.split() == ["one", *_interleaved(shown), "another", "short"]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_as_wide_as_the_terminal(command, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "70")
    assert main([command, "--help"]) == 0
    _, _, described = capsys.readouterr().out.partition("\n\n")
    described, _, _ = described.partition(":\n")
    assert max(map(len, described.splitlines())) <= 70


def _interleaved(shown):
    words = shown.split()[1:-2]
    assert (words.count("word"), words.count("more")) == (12, 10)
    return words


# Figures to expect.


def test_every_packaged_scene_has_figures_to_expect_and_the_list_shows_them(capsys):
    scenes = read_expected()["scenes"]
    assert set(scenes) == {name for name, _ in packaged("scene")}
    for figures in scenes.values():
        assert all(0 <= low <= high for low, high in figures.values())
    assert main(["scenes"]) == 0
    out = capsys.readouterr().out
    assert f"curvature {scenes['fillet']['curvature'][0]:.1f}–" in out
    assert main(["scenes", "--json"]) == 0
    listed = {one["name"]: one["expected"] for one in json.loads(capsys.readouterr().out)}
    assert listed == scenes


@pytest.mark.slow(reason="a whole packaged scene")
def test_a_run_of_a_packaged_scene_as_it_is_shows_what_to_expect(capsys, tmp_path):
    assert main(["run", "press", "--bus", "direct", "--out", str(tmp_path / "a b"), "-q"]) == 0
    out, err = capsys.readouterr()
    assert f"  expected   {expected_text(read_expected()['scenes']['press'])} (seeds 0, 1, 2)" in out
    assert out.splitlines()[-1] == f"next: canprobe view '{tmp_path / 'a b'}'"
    assert err == ""
    summary = json.loads((tmp_path / "a b" / "summary.json").read_text())
    assert figures_of(summary).keys() == read_expected()["scenes"]["press"].keys()
    changed = ["--duration", "0.5", "--set", "outputs.figures=false"]
    assert main(["run", "press", "--bus", "direct", *changed, "--out", str(tmp_path / "c")]) == 0
    assert "expected" not in capsys.readouterr().out


def test_a_true_force_above_the_limit_is_a_warning_of_the_summary(capsys, tmp_path):
    stiff = [
        "--set",
        "plant.stiffness_n_m3=5e9",
        "--set",
        "limits.force_max_n=4",
        "--duration",
        "0.5",
        "--out",
        str(tmp_path / "run"),
    ]
    assert main(["run", "press", "--bus", "direct", *stiff]) == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    (warning,) = summary["warnings"]
    assert f"{summary['contact']['force_max_n']:.2f} N, above limits.force_max_n = 4" in warning
    assert f"  warning    {warning}" in capsys.readouterr().out


# A real terminal, and the shell.


def test_on_a_real_terminal_of_40_columns(tmp_path):
    ours, theirs = pty.openpty()
    subprocess.run(["stty", "cols", "40"], stdin=theirs, check=True)
    done = subprocess.run([sys.executable, "-m", "canprobe", "cells"], stdout=theirs, env=os.environ, check=True)
    os.close(theirs)
    with open(ours, encoding="utf-8") as terminal:
        lines = [terminal.readline().rstrip("\r\n") for _ in range(3)]
    assert done.returncode == 0
    assert max(map(len, lines)) <= 40


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("canprobe re", {"replay "}),
        ("canprobe run cyl", {"cylinder "}),
        ("canprobe run free --cell puma5", {"puma560 "}),
        ("canprobe run free --bridge ros", {"ros2 "}),
        ("canprobe run free --bus lock", {"lockstep "}),
        ("canprobe study sta", {"stability "}),
        ("canprobe eds path puma", {"puma260_joint "}),
        ("canprobe up free --check", {"--check-joints "}),
    ],
)
def test_the_shell_completes(line, found, tmp_path):
    words = {
        **{"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_IFS": "|"},
        **{"COMP_TYPE": "9", "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "answer")},
    }
    subprocess.run([sys.executable, "-c", "from canprobe.cli import main; main()"], env=os.environ | words, check=True)
    assert set((tmp_path / "answer").read_text().split("|")) == found
