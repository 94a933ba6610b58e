"""PUMA 260: geometry, kinematics, inverse kinematics, damped inverse velocity. Pure functions."""
