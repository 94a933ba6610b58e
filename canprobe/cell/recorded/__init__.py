"""Runs and recorded buses, estimated again: measurements → contacts → estimates, or observations for bridges.

`recording` reads what the master of a run measured, and steps the scene's task through it: the answers equal the
online ones to the last bit. Of another tool's candump it reads the frames of the planned nodes, and makes the
measurements of a cell from them. `reestimate.replay` estimates the shape from the contacts of either with any
estimator; `reestimate.replay_into` feeds the same observations to bridges.
"""
