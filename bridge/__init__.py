"""Adapters between a cell and other tools, each optional; only a command that is asked for one imports it."""
