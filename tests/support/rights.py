"""Commands that root may type and others may not: a test that needs one is skipped where the right is missing."""

from __future__ import annotations

import subprocess

import pytest


def type_as_root(*words: str) -> None:
    """Run a command; the test is skipped, with what it said, where it fails."""
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"{' '.join(words)}: {done.stderr.strip()}")
