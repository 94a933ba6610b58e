"""A cell in three dimensions: live in a browser, a recorded run with a time slider, one file to share.

Shapes, colours and what is read from a run are plain numpy; only ``server`` imports viser, and only ``stage``,
``path_nodes``, ``panel``, ``page``, ``replay`` and ``live`` speak to it. The extra ``view`` installs it.
"""
