"""The EDS files of the cell's nodes, and a reader for those of any vendor.

sections     bytes → sections, keys, numbers         variables   one section → one variable
structure    variables → objects of a dictionary     reading     the whole file, mended where the standard allows
description  what a dictionary states, typed         packaged    the files of this package, and how any file is loaded
"""
