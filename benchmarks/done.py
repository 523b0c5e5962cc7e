"""``python -m benchmarks.done N [--reduced]``: run each line that says when capability N is done.

Prints figure, bound and whether it is met; exit status 1 where a line is not met. ``--reduced`` runs
fewer seeds and leaves out what takes minutes; --data names the folder of real records.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from pathlib import Path

from benchmarks.line import show

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "mini_shake_table" / "flexible_3_storey"


def main() -> int:
    """Run the lines of one capability."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.done", description=__doc__.split("\n\n")[0])
    parser.add_argument("number", type=int)
    parser.add_argument("--reduced", action="store_true", help="fewer seeds, no installation")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("SYSID_DATA", DATA)))
    parser.add_argument("--only", default="", help="only the groups whose name holds this")
    options = parser.parse_args()
    try:
        lines = importlib.import_module(f"benchmarks.lines_{options.number}")
    except ModuleNotFoundError as error:
        if error.name != f"benchmarks.lines_{options.number}":
            raise
        print(f"no lines are written for {options.number}", file=sys.stderr)
        return 2
    return 1 if show(lines.lines(options.reduced, options.data, options.only)) else 0


if __name__ == "__main__":
    sys.exit(main())
