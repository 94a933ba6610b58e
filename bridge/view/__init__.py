"""A cell in three dimensions: live in a browser, a recorded run with a time slider, one file to share.

Shapes, colours and what is read from a run are plain numpy; only ``stage``, ``panel``, ``page`` and their users touch
viser, which the extra ``view`` installs.
"""
