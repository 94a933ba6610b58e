"""Exploration: which stretch of path shows most of a rectangle of ground that a probe is to learn.

The rectangle lies in the scan plane, its middle at the first contact. `ground.GroundCells` divides it into cells, each
with the deviation of the height that the surface map states there. `stretches` has the paths that a contact may take
next: a turn at constant radius, then straight. `forecast.Forecast` says by how much a path will shrink the deviation,
before it is walked. `explorer.Explorer` leads the servo along one stretch, and meanwhile looks for the next.

All work is cut into shares, each of which fits behind the commands of a cycle: one cell is fitted, or one path is
judged. Nothing here grows with the time of the scan.
"""
