"""List the benchmarks, or run some and print each line's figure, bound and whether it is met."""

from __future__ import annotations

import argparse
import sys
import time
import traceback
from collections.abc import Iterable, Iterator, Sequence

from benchmarks.line import HEADER, WIDTHS, Line, row, rule
from benchmarks.registry import BENCHMARKS, Benchmark, names, select

LIST_HEADER = ("group", "name", "what it measures", "full", "reduced")
LIST_WIDTHS = (8, 19, 72, 7, 7)  # characters


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status: 0, 1 where a line is not met, 2 where a name is unknown."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", metavar="NAME", nargs="*", help='benchmarks, groups, or "all"; without one: list them')
    parser.add_argument("--reduced", action="store_true", help="the short form: fewer seeds, no installation")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in names()]
    if unknown:
        message = f"no benchmark or group is called {', '.join(map(repr, unknown))}: `{parser.prog}` lists them"
        print(f"{parser.prog}: {message}", file=sys.stderr)
        return 2
    if not options.names:
        print(listing())
        return 0
    return 1 if run(select(options.names), options.reduced) else 0


def listing() -> str:
    """A table of all benchmarks."""
    cells = [(b.group, b.name, b.what, b.full, b.reduced) for b in BENCHMARKS]
    return "\n".join([row(LIST_HEADER, LIST_WIDTHS), rule(LIST_WIDTHS), *(row(c, LIST_WIDTHS) for c in cells)])


def run(benchmarks: Iterable[Benchmark], reduced: bool) -> list[str]:
    """Run benchmarks, print their lines as they come, and give those that are not met."""
    begun, count, unmet = time.perf_counter(), 0, []
    for benchmark in benchmarks:
        print(f"\n== {benchmark.name}: {benchmark.what}\n{row(HEADER, WIDTHS)}\n{rule(WIDTHS)}", flush=True)
        own = time.perf_counter()
        for line in _lines(benchmark, reduced):
            print(line, flush=True)
            count += 1
            if line.met is False:
                unmet.append(f"{benchmark.name}: {line.text}: {line.figure}, bound {line.bound}")
        print(f"{benchmark.name}: {time.perf_counter() - own:.1f} s", flush=True)
    print(f"\nlines: {count}; not met: {len(unmet)}; {time.perf_counter() - begun:.0f} s in all")
    for text in unmet:
        print(f"NOT MET  {text}")
    return unmet


def _lines(benchmark: Benchmark, reduced: bool) -> Iterator[Line]:
    try:
        yield from benchmark.lines(reduced)
    except Exception as error:  # a crash is not met, and must not end the other benchmarks
        traceback.print_exc()
        yield Line("runs to its end", f"{type(error).__name__}: {error}", "no error", False)


if __name__ == "__main__":
    sys.exit(main())
