"""List the benchmarks, or run some and print each line's figure, bound and whether it is met."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from benchmarks.line import row, rule
from benchmarks.measure import run
from benchmarks.registry import BENCHMARKS, names, select

LIST_HEADER = ("group", "name", "what it measures", "full", "reduced")
LIST_WIDTHS = (10, 21, 72, 7, 7)  # characters


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status: 0, 1 where a line is not met, 2 where a name is unknown."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", metavar="NAME", nargs="*", help='benchmarks, groups, or "all"; without one: list them')
    parser.add_argument("--reduced", action="store_true", help="the short form: fewer seeds, no installation")
    parser.add_argument(
        "--processes", type=int, default=1, metavar="N", help="run those that judge no seconds in N processes first"
    )
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in names()]
    if unknown:
        message = f"no benchmark or group is called {', '.join(map(repr, unknown))}: `{parser.prog}` lists them"
        print(f"{parser.prog}: {message}", file=sys.stderr)
        return 2
    if not options.names:
        print(listing())
        return 0
    return 1 if run(select(options.names), options.reduced, options.processes) else 0


def listing() -> str:
    """A table of all benchmarks."""
    cells = [(b.group, b.name, b.what, b.full, b.reduced) for b in BENCHMARKS]
    return "\n".join([row(LIST_HEADER, LIST_WIDTHS), rule(LIST_WIDTHS), *(row(c, LIST_WIDTHS) for c in cells)])


if __name__ == "__main__":
    sys.exit(main())
