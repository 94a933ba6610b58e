"""A recorded bus, estimated again: log → recording → cycles → estimates, or observations for bridges.

`recording` reads a log: the frames of the planned nodes in order, and the deadline of each SYNC. `cycles` makes the
measurements of a cell from them, steps the scene's task through these and compares its targets with the recorded ones;
where another controller drove, it takes contacts from the images alone. `reestimate.replay` estimates the shape from
the contacts with any estimator; for a log of canprobe the answers equal the online ones to the last bit.
`into_bridges` feeds the same observations to bridges.
"""
