"""The controllers of the packaged scenes: scan, press, listen, free."""
