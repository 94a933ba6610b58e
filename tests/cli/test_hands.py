"""`move`, `tare`, `listen`, `posture`: what is printed, what is refused, and what is written."""

import json
import os
import pty
import re
import subprocess
import sys

import numpy as np
import pytest

from canprobe.cell.results.recording import recording
from canprobe.cell.scene.load import packaged_files
from canprobe.cli import main

HEAD = "# my cell, with a comment\n"


@pytest.fixture
def mine(tmp_path):
    """A cell file of one's own."""
    path = tmp_path / "mine.toml"
    path.write_text(HEAD + packaged_files("cells")["puma260"].read_text())
    return path


def told(capsys, *words, status=0):
    assert main([*map(str, words)]) == status
    return capsys.readouterr()


def test_a_dry_run_shows_the_way_and_moves_nothing(capsys):
    out = told(capsys, "move", "puma260", "-90,65,15,0,100,0", "--dry-run").out
    assert "joint 1: 90.00 to -90.00 deg (-180.00)" in out and "the way: 8.7 s at 10 % of the speed limits" in out
    assert "the arm stands at" not in out
    err = told(capsys, "move", "puma260", "start", "--dry-run", "--set", "arm.when_disabled=brakes").err
    assert "when its drives are disabled, its brakes hold it; they are at the end" in err
    words = ("move", "puma260", "--joint", 2, "--by", "-5deg", "--speed", "50%", "--dry-run")
    assert "joint 2: 65.00 to 60.00 deg (-5.00)" in told(capsys, *words).out


def test_a_dry_run_of_homing_tells_how_and_homes_nothing(mine, capsys):
    zero = [f"--set=joints.joint_3.{key}" for key in ("zero=homing", "homing_method=33", "home_deg=15")]
    found = told(capsys, "home", mine, "--dry-run", *zero)
    assert found.out == (
        "joint 3 (joint_3, node 3): home it by method 33: move in negative direction to the next index pulse, at 5 and"
        " 1 deg/s\n"
    )
    assert "joint 3 is left as it is" in found.err and "is homed" not in found.err


def test_an_arm_without_a_probe_ends_in_its_flange(mine, capsys):
    carries = told(capsys, "move", "free", "90,65,16,0,100,0", "--dry-run").out
    mine.write_text(re.sub(r"\[sensor\]\n.*\n\n\[probe\]\n", "", mine.read_text()))
    bare = told(capsys, "move", mine, "90,65,16,0,100,0", "--dry-run").out
    places = [re.search(rf"{name} comes to (.*) mm", out)[1] for name, out in (("flange", bare), ("tip", carries))]
    flange, tip = (np.array(place.split(", "), dtype=float) for place in places)
    assert np.linalg.norm(tip - flange) == pytest.approx(120.0, abs=1.0)
    limit = ("--set", f"limits.workspace_min_mm=[-999, -999, {flange[2] + 1:g}]")
    err = told(capsys, "move", mine, "90,65,16,0,100,0", "--dry-run", *limit, status=2).err
    assert f"the flange at z = {flange[2]:.0f}." in err or f"the flange at z = {flange[2] - 1:.0f}." in err


def test_a_move_in_millimetres(capsys):
    out = told(capsys, "move", "gantry", "--joint", 1, "--by", "10mm", "--yes", "-q").out
    assert out.endswith("the arm stands at 210.00 mm, 200.00 mm, 150.00 mm\n")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("move", "puma260"), "expected a posture, or --joint and --by"),
        (("move", "puma260", "start", "--joint", "1", "--by", "1deg"), "expected a posture, or --joint and --by"),
        (("move", "puma260", "start"), "move asks before the motion and needs a terminal; --yes leaves that out"),
        (("move", "puma260", "1,2", "--yes"), "expected positions of 6 joints, got 2"),
        (("move", "puma260", "strat", "--yes"), "did you mean start?"),
        (("move", "puma260", "start", "--speed", "20deg"), "expected a share such as 20% or 0.2"),
        (("move", "puma260", "--joint", "7", "--by", "1", "--yes"), "the arm has joints 1 to 6"),
        (("move", "puma260", "--joint", "3", "--by", "5mm", "--yes"), "joint 3 moves in deg"),
        (("move", "listen", "start", "--yes"), "expected a scene with an arm|has no arm"),
        (("home", "puma260", "--yes"), 'home: no joint of puma260 has zero = "homing"'),
        (("home", "puma260"), "home asks before each joint and needs a terminal"),
        (("tare", "free", "--yes"), r"free: has no array \(\[sensor\]\)"),
        (("listen", "free"), r"free: has no array"),
        (("posture", "save", "puma260", "a"), "`canprobe init` makes one of a packaged cell"),
    ],
)
def test_what_cannot_be_is_one_clear_line_before_anything_is_sent(words, said, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin.isatty", lambda: False, raising=False)
    *sent, line = told(capsys, *words, status=2).err.splitlines()
    assert re.search(said, line) and not sent


def test_a_posture_is_saved_without_touching_the_rest(mine, capsys):
    before = mine.read_text()
    told(capsys, "posture", "save", mine, "ready", "-q", "--set", "joints.joint_1.start_deg=80")
    told(capsys, "posture", "save", mine, "other one", "-q")
    told(capsys, "posture", "save", mine, "ready", "-q", "--set", "joints.joint_1.start_deg=70")
    text = mine.read_text()
    assert text.startswith(before.rstrip("\n")) and text.startswith(HEAD)
    listed = json.loads(told(capsys, "posture", "list", mine, "--json").out)
    assert [*listed] == ["start", "other one", "ready"]
    assert (
        listed["ready"][0] == pytest.approx(70.0, abs=0.01) and len(text.splitlines()) == len(before.splitlines()) + 4
    )
    assert told(capsys, "posture", "check", mine).out.splitlines() == ["start: fits", "other one: fits", "ready: fits"]
    told(capsys, "move", mine, "ready", "--yes", "-q")
    assert "choose another name" in told(capsys, "posture", "save", mine, "start", "-q", status=2).err


def test_a_posture_that_does_not_fit_is_named(mine, capsys):
    mine.write_text(mine.read_text() + "\n[postures]\nfar = [90, 65, 80, 0, 100, 0]\n")
    out = told(capsys, "posture", "check", mine, status=2).out
    assert "far: from the start, joint 3 would come to 5" in out
    low = told(capsys, "posture", "check", mine, "--set", "keep_out.floor_mm=900", status=2).out.splitlines()[0]
    assert re.fullmatch("start: from the start, .* mm, the floor is at 900 mm, at the start of the way", low)
    mine.write_text(mine.read_text().replace("80, 0, 100, 0]", "80, 0]"))
    assert (
        "postures.far: expected a position of each of the 6 joints, got 4"
        in told(capsys, "posture", "check", mine, status=2).err
    )


def test_listen_records_each_image_and_leaves_out_a_pose_that_is_not_there(capsys, tmp_path):
    path = tmp_path / "images.csv"
    told(capsys, "listen", "puma260", "--duration", 0.2, "--every", 0.1, "--record", path, "-q")
    head = path.read_text().partition("\n")[0].split(",")
    assert (head[:3], head[-1], len(head)) == (["t_s", "p0_0", "p0_1"], "p15_15", 257)
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    assert np.diff(rows[1:, 0]) == pytest.approx([0.005] * (len(rows) - 2), abs=2e-5) and len(rows) > 35
    assert ((rows[:, 1:] == rows[:, 1:].round()) & (rows[:, 1:] >= 0) & (rows[:, 1:] < 256)).all()
    missing = tmp_path / "no" / "images.csv"
    err = told(capsys, "listen", "puma260", "--duration", 0.1, "--record", missing, "-q", status=3).err
    assert f"{missing}: cannot be written: No such file or directory" in err


def test_a_recording_has_the_pose_of_each_image(tmp_path):
    T = np.eye(4)
    T[:3, 3] = 0.1, -0.2, 0.3
    with recording(tmp_path / "touch.csv") as add:
        add(1.5, np.arange(6, dtype=np.uint8).reshape(2, 3), T)
    head, row = (tmp_path / "touch.csv").read_text().splitlines()
    assert head == "t_s,T00,T01,T02,T03,T10,T11,T12,T13,T20,T21,T22,T23,p0_0,p0_1,p0_2,p1_0,p1_1,p1_2"
    values = np.array(row.split(","), dtype=float)
    np.testing.assert_array_equal(values[1:13].reshape(3, 4), T[:3])
    np.testing.assert_array_equal(values[13:], np.arange(6))


def test_listen_prints_each_image_as_a_document(capsys):
    lines = told(capsys, "listen", "puma260", "--duration", 0.5, "--json", "-q").out.splitlines()
    images = [json.loads(line) for line in lines]
    assert len(images) == 5 and [*images[0]][:2] == ["t_s", "force_n"] and images[0]["highest_count"] == 0
    assert "no contact" in told(capsys, "listen", "puma260", "--duration", 0.2, "-q").out


def test_a_tare_shows_the_image_before_and_after(capsys):
    lines = told(capsys, "tare", "gantry", "--yes", "-q").out.splitlines()
    assert [line.split()[0] for line in lines] == ["before:", "after:"]


def test_a_person_is_asked_and_may_say_no():
    command = [sys.executable, "-m", "canprobe", "move", "puma260", "--joint", "1", "--by", "-20deg"]
    master, slave = pty.openpty()
    with subprocess.Popen(command, stdin=slave, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        os.close(slave)
        lines = []
        for line in process.stdout:
            lines.append(line)
            if line.startswith("move? ["):
                os.write(master, b"n\n")
    os.close(master)
    assert process.returncode == 0 and "nothing was moved" in "".join(lines)


def test_the_end_of_a_pipe_at_stdin_brakes_the_motion():
    """The motion takes a minute of the cell's time, and the pipe ends when it has begun."""
    command = [sys.executable, "-m", "canprobe", "move", "puma260", "--joint", "1", "--by", "-100deg", "--yes"]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen([*command, "--speed", "0.5%", "-v"], **pipes) as process:
        for line in process.stderr:
            if b"enable the drives" in line:
                break
        process.stdin.close()
        out, err = process.stdout.read(), process.stderr.read()
    assert process.returncode == 0 and b"stdin has ended, and the motion was braked" in err
    assert b"-10.00 deg, 65.00" not in out and b"the arm stands at" in out
