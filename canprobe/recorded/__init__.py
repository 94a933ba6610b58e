"""A recorded bus, taken up again: recording → cycles → estimates, or observations for other tools.

`recording` reads a log as the cell needs it: the frames of the planned nodes, and the deadlines of their SYNCs.
`cycles` makes the measurements of it that a cell would have made, steps the scene's own task through them and holds
its targets against the recorded ones; where another controller drove, contacts are taken from the images alone.
`reestimate.replay` estimates the shape from that, with any estimator, and equals the online answer to the last bit
where the log is a run's. `into_bridges` hands the same observations to other tools.
"""
