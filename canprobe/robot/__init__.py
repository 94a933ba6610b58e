"""PUMA 260: geometry, kinematics, inverse kinematics, dynamics, tool calibration. Pure functions."""
