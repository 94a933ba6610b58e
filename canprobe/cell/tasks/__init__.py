"""Controllers: what a cell does in each cycle, from a measurement to a command.

`from_plan.make_task` gives the controller of a plan's task; nothing is imported that the task does not need.

- `touch` approaches, settles, scans or holds, and retreats; `regain` searches for a lost contact, `requested` lets a
  bridge start, stop and set the task. `calibrate` touches a known object again and again: a ball from several sides,
  or it presses and rolls there. All derive from `probing.ProbingTask`, which has the order of a cycle and its phases,
  and turns the probe's pose into joint targets.
- `sensing` makes a contact of a measurement: joints at the instant of the image, the patch, the squeezed layer.
- `shape` is the estimator in the loop: contacts go in when they are measured, answers are computed in `update` when the
  commands are out, and are used from the next cycle on.
- `free_and_listen` has the tasks without touch: hold, swing, listen. `joint_check` moves each joint alone for the first
  time, by a small and a larger way, which an operator watches.
- `hand_way` is a way that a person asks for, `hand_motion` goes it, and `guided_arm` lets one after the other go, each
  as long as it is renewed.
- `paused` holds the arm of a cell that has come back from a loss, until motion is asked for.
- `trajectory` follows points, for own scripts and for ROS 2: `canprobe.cell.tasks.Trajectory`.
- `task` has the results that a task leaves for the summary.

A task guards its own contact (`retreats_itself`): it decides by the same table of conditions as the cell when to let
go. A task reads its setup (`canprobe.cell.scene.setup`) and nothing of a scene.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from canprobe.errors import door

if TYPE_CHECKING:  # for type checkers, which do not read the table
    from canprobe.cell.tasks.trajectory import Trajectory as Trajectory

__getattr__, __dir__, __all__ = door(__name__, {"tasks.trajectory": ("Trajectory",)})  # no task imports another one
