"""A scene: the words of a file, checked.

`model` says what there is, one field a line with its check; `load` reads and writes it, `rules` says what goes
together, `geometry` turns it into SI.
"""
