"""Study `shapes`: surfaces of unknown shapes from the same contacts, by the package and by what others would use.

    scans ─► contacts.npz ─► methods: contacts, budget ─► surface ─► mesh ─► scores against the truth ─► table, picture

Eight development and twelve test shapes (formulae; free forms, grooves and an edge as heights made from fixed seeds)
are scanned through the whole emulated sensor on the direct bus, on arrays and seeds of their own (`scans`). Contacts
with their stated noise, and the truth under them, are one file (`contacts_file`), published beside the results with its
SHA-256. Every method (`methods`) gets the same file: the Gaussian process and the local fits are in `implicit`, the
surface of answers along the path in `patches` and `blend`. One mesh code and one score serve all (`study`). A new
method is a class and a line in `METHODS`.

Accuracy (map to truth) and completeness (truth in the footprint to map) are apart; F-scores join them at 0.05 to 0.5 mm
as Knapitsch and others do. Normals and curvature count away from edges. Likelihood and coverage are of the height, with
the σ that a method states. Time is of one thread. Intervals draw the shapes anew.

Source: Knapitsch, Park, Zhou and Koltun, "Tanks and temples", ACM ToG 36(4), 2017 (F-score); Gneiting and Raftery,
"Strictly proper scoring rules, prediction, and estimation", 2007.
"""

from canprobe.lab.studies.shapes.study import run

__all__ = ["run"]
