"""``python -m sysid`` is the ``sysid`` command."""

import sys

from sysid.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
