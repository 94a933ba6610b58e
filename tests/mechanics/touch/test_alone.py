"""The functions of touch without a cell: what its door exports loads nothing of a cell, a bus or a plan."""

import subprocess
import sys

ALONE = """
import sys
import canprobe.mechanics.touch as touch
for name in touch.__all__:
    getattr(touch, name)
print([name for name in sys.modules if name.startswith(("canprobe.cell", "canprobe.fieldbus", "canprobe.lab"))])
"""


def test_the_door_of_touch_loads_nothing_of_a_cell():
    ran = subprocess.run([sys.executable, "-c", ALONE], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"
