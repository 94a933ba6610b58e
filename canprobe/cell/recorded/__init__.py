"""Runs and recorded buses, estimated again: measurements → contacts → estimates, or observations for bridges.

`run_folder` reads what the master of a run measured, and steps the scene's task through it: the answers equal the
online ones to the last bit. For another tool's candump, `recording` reads the frames of the planned nodes and makes
the measurements of a cell from them. `reestimate.replay` estimates the shape from the contacts of either with any
estimator. `into_bridges` feeds the same observations to bridges.
"""
