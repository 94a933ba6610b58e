"""A recorded bus, taken up again: recording → cycles → estimates, or observations for other tools."""
