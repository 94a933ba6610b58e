"""Adapters from a cell, live or recorded, to other tools. Nothing imports them: they are loaded by name, where asked.

A neutral `Sample` (sample.py) goes through one encoder into many sinks. Each sink is a small file of its own, with an
optional extra; what there is stands in `canprobe.planning.bridges`.
"""
