"""What a scene does not need is not even imported: a run in a fresh process, and the modules that it has loaded."""

import subprocess
import sys

import pytest

ROOMS = (
    "canprobe.mechanics",
    "canprobe.fieldbus.drive",
    "canprobe.fieldbus.tools.faults",
    "canprobe.cell.tasks",
    "scipy",
)
TASKS = {f"canprobe.cell.tasks.{name}" for name in ("free_and_listen", "from_plan", "paused", "shape", "task")}
ARM = {"chain", "denavit_hartenberg", "model", "motion_profile", "tool_calibration"}
LIMITS = {
    "checks",
    "depth_witness",
    "image.force_creep",
    "image.force_errors",
    "pad",
    "shapes",
    "sinkage",
    "stops",
    "tangent_frames",
}
"""Limits and geometry that the supervision and the emulated contact have in every cell: no image, no estimator."""
IMAGES = {f"image.{name}" for name in ("calibration", "force_reading", "image_model", "moments", "patch")}
DRIVE = {"cyclic_modes", "drive", "homing", "mode", "parameters", "parts", "profile", "profile_position"}
DRIVE |= {"reference", "units"}
OBJECTS = {"contact", "heights", "mesh_curvature", "mesh_fit", "mesh_repair", "objects"}
NEEDED = {
    "listen": {
        *(f"canprobe.mechanics.robot.{name}" for name in ARM),
        *(f"canprobe.mechanics.touch.{name}" for name in (*LIMITS, *IMAGES, "image.silent_taxels", *OBJECTS)),
    },
    "free": {
        *(f"canprobe.mechanics.robot.{name}" for name in (*ARM, "inverse", "probe_poses", "urdf", "urdf_tree")),
        *(f"canprobe.mechanics.touch.{name}" for name in LIMITS),
        *(f"canprobe.fieldbus.drive.{name}" for name in DRIVE),
    },
}
RUN = """
import sys
from canprobe.cli import main
status = main(["run", sys.argv[1], "--bus", "direct", "--duration", "0.1", "--no-figures", "--out", sys.argv[2]])
print(*sys.modules, file=sys.stderr)
sys.exit(status)
"""


@pytest.mark.parametrize("scene", NEEDED)
def test_a_scene_loads_the_modules_of_its_task_only(scene, tmp_path):
    ran = subprocess.run([sys.executable, "-c", RUN, scene, str(tmp_path)], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    loaded = {name for name in ran.stderr.split() if f"{name}.".startswith(tuple(f"{room}." for room in ROOMS))}
    doors = {"canprobe.mechanics", "canprobe.mechanics.types", "canprobe.cell.tasks", "canprobe.fieldbus.drive"}
    doors |= {f"canprobe.mechanics.{room}" for room in ("robot", "touch", "touch.image", "touch.estimate")}
    doors |= {"canprobe.mechanics.touch.estimate.estimator"}  # the interface, which imports nothing
    assert sorted(loaded - doors - TASKS - NEEDED[scene]) == []
    assert loaded >= TASKS | NEEDED[scene]  # no line of the list is out of date


def test_a_cell_on_a_real_bus_has_loaded_what_moves_by_hand_need_before_nodes_wait_for_it():
    made = "import canprobe, sys; canprobe.open_cell('free', bus='virtual'); print(*sys.modules)"
    ran = subprocess.run([sys.executable, "-c", made], capture_output=True, text=True, check=True)
    wanted = {"canprobe.cell.tasks.hand_motion", "canprobe.cell.session.up", "scipy.spatial.transform"}
    assert wanted <= set(ran.stdout.split())
