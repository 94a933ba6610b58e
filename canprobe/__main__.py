"""`python -m canprobe`."""

import sys

from canprobe.cli import main

if __name__ == "__main__":
    sys.exit(main())
