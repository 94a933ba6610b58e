"""Setup → plan: which nodes and PDOs a scene needs, whether they fit, what is left out and why."""

from canprobe.planning.make import make_plan
from canprobe.planning.model import Plan, PlannedNode, PlannedPdo
from canprobe.planning.text import plan_text

__all__ = ["Plan", "PlannedNode", "PlannedPdo", "make_plan", "plan_text"]
