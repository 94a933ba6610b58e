"""`canprobe replay` on the command line: what is wrong is one clear line, and the exit status is 2."""

import pytest

from canprobe.cell.recorded import reestimate as recorded
from canprobe.cli import main

SYNCS = "".join(f"({k // 400:010d}.{k % 400 * 2500:06d}) can0 080#\n" for k in range(10))


@pytest.mark.parametrize(
    ("files", "words", "message"),
    [
        ({}, [], "no bus.log in this folder"),
        ({"bus.log": SYNCS}, [], "no scene.toml in this folder: name the scene (--scene)"),
        ({"bus.log": SYNCS, "scene.toml": "[scen]\n"}, [], "scene.toml: scen: unknown section; did you mean scene?"),
        ({"bus.log": SYNCS}, ["--scene", "cylindr"], "cylindr: no such scene, cell or file; did you mean cylinder?"),
        ({"bus.log": SYNCS}, ["--scene", "press"], "scene press: task press estimates no shape"),
        ({"bus.log": SYNCS}, ["--scene", "cylinder", "--method", "recursiv"], "did you mean recursive?"),
        ({"bus.log": SYNCS}, ["--scene", "cylinder"], "node 1 (joint 1) was never heard: no TPDO 181h"),
        ({"bus.log": SYNCS + "(00\n"}, ["--scene", "cylinder"], "bus.log:11: no candump line: '(00'"),
        ({"bus.log": SYNCS + "(00"}, ["--scene", "cylinder"], "node 1 (joint 1) was never heard: no TPDO 181h"),
    ],
)
def test_what_is_wrong_is_told(tmp_path, capsys, files, words, message):
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    assert main(["replay", str(tmp_path), *words]) == 2
    out, err = capsys.readouterr()
    assert out == "" and message in err
    assert all(line.startswith("canprobe: ") for line in err.splitlines())


def test_a_log_that_does_not_exist(tmp_path, capsys):
    assert main(["replay", str(tmp_path / "none")]) == 2
    assert "none: no such folder or file; expected the folder of a run, or a candump file" in capsys.readouterr().err


def test_every_node_that_is_missing_is_named(tmp_path, capsys):
    log = tmp_path / "candump.log"
    log.write_text(SYNCS)
    assert main(["replay", str(log), "--scene", "cylinder"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [line.split("node ")[1].split()[0] for line in lines] == ["1", "2", "3", "4", "5", "6", "16"]


@pytest.mark.parametrize("json", [False, True])
def test_what_the_command_passes_on_and_prints(tmp_path, capsys, monkeypatch, json):
    calls, saved = [], []

    class Result:
        def __init__(self):
            self.summary = {"log": "x"}

        def text(self):
            return "the shape"

        def save(self, path):
            saved.append(path)

    def replay(log, **words):
        calls.append((log, words))
        return Result()

    monkeypatch.setattr(recorded, "replay", replay)
    words = ["--method", "ml", "--method", "chord", "--scene", "s", "--out", "e.npz", *(["--json"] if json else [])]
    assert main(["replay", "DIR", *words]) == 0
    ((log, given),) = calls
    assert (str(log), given) == ("DIR", {"scene": "s", "method": ["ml", "chord"]})
    assert [str(path) for path in saved] == ["e.npz"]
    assert capsys.readouterr().out == ('{\n  "log": "x"\n}\n' if json else "the shape\n")
