"""``python -m sysid`` is the ``sysid`` command."""

import sys

from sysid.cli import main

if __name__ == "__main__":
    sys.exit(main())
