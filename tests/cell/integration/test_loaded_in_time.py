"""What is loaded before the nodes wait for their master."""

import subprocess
import sys


def test_a_cell_on_a_real_bus_has_loaded_what_moves_by_hand_need():
    made = "import canprobe, sys; canprobe.open_cell('free', bus='virtual'); print(*sys.modules)"
    ran = subprocess.run([sys.executable, "-c", made], capture_output=True, text=True, check=True)
    wanted = {"canprobe.cell.tasks.hand_motion", "canprobe.cell.session.up", "scipy.spatial.transform"}
    assert wanted <= set(ran.stdout.split())
