"""`cell.pml`, a page of Promela: Spin walks every order of two faults; each property needs the rule that serves it."""

import shutil
import subprocess
from pathlib import Path

import pytest

MODEL = Path(__file__).with_name("cell.pml")


def walk(folder, *defines):
    """What Spin reports: the number of errors, and its text."""
    for program, package in (("spin", "spin"), ("cc", "build-essential")):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is missing; type: sudo apt-get install -y {package}")
    shutil.copy(MODEL, folder)
    commands = (
        ["spin", *(f"-D{define}" for define in defines), "-a", MODEL.name],
        ["cc", "-w", "-O0", "-DSAFETY", "-DBFS", "-o", "pan", "pan.c"],
        ["./pan", "-m200000"],
    )
    for command in commands:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    errors = int(done.stdout.rsplit("errors: ", 1)[1].split()[0])
    return errors, done.stdout


def test_every_order_of_two_faults_keeps_all_properties(tmp_path):
    errors, text = walk(tmp_path)
    assert errors == 0, text


@pytest.mark.parametrize(
    ("rule", "property_"),
    [
        ("NO_PATIENCE", "(without[i]<=3)"),
        ("OLD_POSITION", "fresh[i]"),
        ("NO_HOLD", "(unheard[0]<=1)"),
        ("NO_STOP", "(since<=(3+2))"),
        ("REACHED", "&&moves))(at"),
    ],
)
def test_without_a_rule_its_property_fails(tmp_path, rule, property_):
    """`REACHED` leaves no rule out: it denies that a cell moves after two faults, which it does."""
    errors, text = walk(tmp_path, rule)
    assert errors == 1 and property_ in text.replace(" ", ""), text
