"""The master side: bring-up, drives, sensor, the cycle, supervision, safe stop and the run log."""
