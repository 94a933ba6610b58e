"""Debian packages that tests use, beside those of Python: which are missing, and their installation.

`python3 tests/support/system_packages.py` installs them, before anything else is there: it needs the standard library
only. With CANPROBE_INSTALL=1 pytest does the same.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence

PROGRAMS = {
    "iproute2": ("ip",),
    "can-utils": ("candump",),
    "tshark": ("tshark",),
    "chromium": ("chromium", "chromium-browser", "google-chrome"),
    "user-mode-linux": ("linux.uml",),
    "spin": ("spin",),
    "build-essential": ("cc",),  # compiles what the guest needs on processors with AMX
}
"""Programs by the package that brings them; one of them is enough."""
LIBRARIES = {"libgomp1": "libgomp.so.1"}
"""Shared libraries by their package: Pinocchio needs OpenMP's, and its wheel does not bring it."""


def missing_packages() -> list[str]:
    """Packages of which this machine has neither the program nor the library."""
    programs = [package for package, names in PROGRAMS.items() if not any(map(shutil.which, names))]
    return programs + [package for package, name in LIBRARIES.items() if not _has_library(name)]


def install_missing() -> list[str]:
    """Install what is missing, with sudo where this is not root; return what is missing still.

    A package that the machine's release does not have is left out (Ubuntu: user-mode-linux, chromium).
    """
    missing = missing_packages()
    if not missing or shutil.which("apt-get") is None:
        return missing
    _apt("update", "-qq")
    installable = [package for package in missing if _apt_knows(package)]
    if installable:
        _apt("install", "-y", "-qq", "--no-install-recommends", *installable)
    return missing_packages()


def _has_library(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def _apt_knows(package: str) -> bool:
    command = ["apt-get", "install", "--simulate", package]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def _apt(*words: str) -> None:
    """Run apt-get without questions; another one that runs is waited for. Its output goes to stderr."""
    as_root: Sequence[str] = () if os.geteuid() == 0 else ("sudo",)
    command = [*as_root, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-o", "DPkg::Lock::Timeout=300", *words]
    print(" ".join(command), file=sys.stderr, flush=True)
    try:
        subprocess.run(command, stdin=subprocess.DEVNULL, stdout=sys.stderr.fileno(), check=False)
    except OSError as error:
        print(f"{command[0]}: {error.strerror}", file=sys.stderr)


if __name__ == "__main__":
    still = install_missing()
    sys.exit(f"not installed: {', '.join(still)}" if still else 0)
