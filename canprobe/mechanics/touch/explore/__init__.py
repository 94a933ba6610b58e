"""Exploration: a path over a rectangle of ground that ends where all of it is known as well as was asked.

The rectangle lies in the scan plane, its middle at the end of the approach. `ground.GroundCells` divides it into cells,
each with the deviation of the height that the surface map states there. In `lanes`, `LaneForecast` says how far apart
lanes may lie on ground that is as smooth as the map has seen so far, and `InwardLanes` lays them, from the border
inwards. `stretches` has the smooth paths: turns at constant radius, and straight lines. `explorer.Explorer` leads the
servo along one stretch, and meanwhile looks for the next: a lane while there is one, then the way to the nearest cell
that is not good enough yet. Where the contact turns round an edge it goes back, and the ground ahead is closed.

All work is cut into shares, each of which fits behind the commands of a cycle: one cell is fitted, or one path is
judged. Nothing here grows with the time of the scan.
"""
