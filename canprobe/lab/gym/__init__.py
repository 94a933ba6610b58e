"""A Gymnasium environment: an agent leads the probe of a cell over an unknown surface.

    import gymnasium, canprobe.lab.gym
    env = gymnasium.make("canprobe/TouchScan-v0")

In comes an action, 25 times a second: velocity of the contact in its tangent plane, and set-point of the force.
Out goes an observation, the reward of the step, and the truth in `info`.

Between two actions the whole cell runs: drives, array, supervision and the tactile servo, 16 cycles at 400 Hz,
in virtual time without a bus. `env` is the environment; start reading there. `episode` is one cell that is led step by
step, with the touched part of the surface, `led` the touch task whose path and force are set from outside.
`observations` makes an agent's vectors. `randomise` draws the values that differ between episodes, with the keys of
a scene file, and has the objects to train on and those that are held out.

An episode begins in contact: approach, touch-down and settling are part of `reset`. It ends by itself (`terminated`)
where the supervision of the cell ends a scan: contact lost, force too high, a joint at its stop. It is cut off
(`truncated`) after `task.duration_s`.
"""

from __future__ import annotations

from canprobe.errors import UsageError, install_line

try:
    import gymnasium
except ImportError as error:
    raise UsageError(f"canprobe.lab.gym needs the package gymnasium: {install_line('gym')}") from error

from canprobe.lab.gym.env import TouchScan
from canprobe.lab.gym.randomise import OBJECTS, OneOf, Uniform

__all__ = ["OBJECTS", "OneOf", "TouchScan", "Uniform"]


gymnasium.register(id="canprobe/TouchScan-v0", entry_point="canprobe.lab.gym.env:TouchScan")
