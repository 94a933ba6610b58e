"""The limits of image and force at which a touch is stopped.

The plan uses the same numbers, so that a scene that it accepts is not stopped by them.
"""

from __future__ import annotations

OFF_PAD_EDGE_SHARE = 0.95
"""Pressure at the pad's edge over the highest pressure from which on a contact counts as off the pad: a paraboloid has
lost a sixth of its force by then."""
OFF_PAD_SIGMAS, OFF_PAD_TAXELS = 1.55, 1.0
"""The same limit where only moments are known: distance of the centroid from the edge, in standard deviations of the
pressure (the width of a taxel included), and in taxels. A paraboloid has lost a fourth of its force by the first; one
of which only a rim is left has its centroid in the last row of taxels."""
TOUCH_FORCE = 0.15
"""N; contact is made above it, and gone below half of it: an image of less says nothing about its place."""
MAX_FORCE_SPREAD = 0.2
"""Largest standard deviation of a settled force over its target: twice that of a contact of 40 kN/m."""
