"""The limits at which a touch ends, as images and forces show it.

The plan reckons with the same numbers, so that what it accepts comes to its end.
"""

from __future__ import annotations

OFF_PAD_EDGE_SHARE = 0.95
"""Pressure at the pad's edge over the highest from which the contact runs off: a paraboloid has lost a sixth."""
OFF_PAD_SIGMAS, OFF_PAD_TAXELS = 1.55, 1.0
"""The same where only moments are known: from the centroid to the edge, a taxel's own width included in σ. A paraboloid
has lost a fourth by then, and one of which only a rim is left lies in the last row of taxels."""
TOUCH_FORCE = 0.15
"""N; contact is made above it, and gone below half of it: an image of less says nothing about its place."""
MAX_FORCE_SPREAD = 0.2
"""Standard deviation of the force over the target above which it has not settled: twice that of a 40 kN/m contact."""
