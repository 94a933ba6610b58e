"""Figures and studies; what needs the ``study`` extra is imported only here."""
