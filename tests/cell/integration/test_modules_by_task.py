"""What a scene does not need is not even imported: a run in a fresh process, and the modules that it has loaded."""

import subprocess
import sys

import pytest

UNNEEDED = {
    "listen": (
        "canprobe.fieldbus.drive.",
        "canprobe.cell.tasks.probing",
        "canprobe.mechanics.touch.servo",
        "canprobe.mechanics.robot.inverse",
    ),
    "free": ("canprobe.cell.tasks.probing", "canprobe.mechanics.touch.servo", "canprobe.mechanics.touch.image.patch"),
}
NEVER = ("canprobe.mechanics.touch.estimate.recursive", "canprobe.fieldbus.tools.faults.", "scipy", "matplotlib")
RUN = """
import sys
from canprobe.cli import main
status = main(["run", sys.argv[1], "--bus", "direct", "--duration", "0.1", "--no-figures", "--out", sys.argv[2]])
print(*sys.modules, file=sys.stderr)
sys.exit(status)
"""


@pytest.mark.parametrize("scene", UNNEEDED)
def test_a_scene_loads_the_modules_of_its_task_only(scene, tmp_path):
    ran = subprocess.run([sys.executable, "-c", RUN, scene, str(tmp_path)], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert [name for name in ran.stderr.split() if name.startswith((*NEVER, *UNNEEDED[scene]))] == []


def test_a_cell_on_a_real_bus_has_loaded_what_moves_by_hand_need_before_nodes_wait_for_it():
    made = "import canprobe, sys; canprobe.open_cell('free', bus='virtual'); print(*sys.modules)"
    ran = subprocess.run([sys.executable, "-c", made], capture_output=True, text=True, check=True)
    wanted = {"canprobe.cell.tasks.hand_motion", "canprobe.cell.session.up", "scipy.spatial.transform"}
    assert wanted <= set(ran.stdout.split())
