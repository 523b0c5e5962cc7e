"""``sysid doctor``: what this installation has, what it lacks, and how to get that."""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from sysid.cli.output import Output
from sysid.cli.starting import MISTAKE, SUCCESS
from sysid.errors import InputError, how_to_install
from sysid.files.assembly import recorded_rate
from sysid.files.description import Description, asked
from sysid.files.kind import channels_of, coarse_lines, kind_of
from sysid.files.reading import gather, recordings_of
from sysid.files.recorded_test import is_recorded_test
from sysid.files.recording import Recording
from sysid.results.version import __version__

_PACKAGE = "structural-sysid"
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_USED = "mumps"  # the linear solver of every search
_LINEAR_SOLVERS = (_USED, "spral", "ma27", "ma57", "ma77", "ma86", "ma97", "pardiso")

# In a process of its own: a library that is found and does not fit ends the process. Names come one by one.
_TRIAL = """
import sys
import casadi
x = casadi.MX.sym("x")
for name in sys.argv[1:]:
    options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "linear_solver": name}}
    try:
        solver = casadi.nlpsol("trial", "ipopt", {"x": x, "f": (x - 1) ** 2 + x**4}, options)
        solver(x0=0.0)
        if solver.stats()["success"]:
            print("works:", name, flush=True)
    except RuntimeError:
        pass
"""


@dataclass(frozen=True)
class Package:
    """A package that sysid needs, always or for an extra."""

    name: str
    needed: str  # the least version
    extra: str  # "" where it is always needed
    version: str  # "" where it is not installed
    enough: bool  # it is installed, and late enough


def run(options: argparse.Namespace, out: Output) -> int:
    """Tell all of it; a mistake where something is missing that every search needs, or a file cannot be read."""
    if options.files:
        return _look(options.files, out)
    packages, solvers, threads = tuple(_packages()), linear_solvers(), _libraries()
    required = [package for package in packages if not package.extra]
    missing = sorted({package.extra for package in packages if package.extra and not package.enough})
    place = Path(__file__).resolve().parents[1]
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    variables = {name: os.environ[name] for name in _THREADS if name in os.environ}
    out.answer(
        sysid=__version__, folder=str(place), python=platform.python_version(), executable=sys.executable,
        platform=platform.platform(), packages=[asdict(package) for package in packages], linear_solvers=solvers,
        processors=usable, thread_libraries=threads, environment=variables, matplotlib_backend=_backend(),
        missing_extras={name: how_to_install(name) for name in missing},
    )  # fmt: skip
    out.write(f"sysid {__version__} in {place}\n")
    out.write(f"Python {platform.python_version()} ({sys.executable}) on {platform.platform()}\n\npackages\n")
    for package in required:
        out.write(f"  {package.name:<14} {_version(package)}\n")
    out.write(f"\nIPOPT {'works' if _USED in solvers else 'does NOT work'} with MUMPS, which every search takes; ")
    out.write(f"linear solvers found: {', '.join(solvers) or 'none'}\n")
    out.write(f"\n{usable} processors; linear algebra of a search is held to one thread, jobs run side by side\n")
    for name, count in threads.items():
        out.write(f"  {name}: {count} thread{'s' if count > 1 else ''} outside of a search\n")
    for name, value in variables.items():
        out.write(f"  {name}={value}\n")
    out.write(f"\nmatplotlib draws by its backend {_backend()!r}; report.html is written without a browser\n\nextras\n")
    for extra in sorted({package.extra for package in packages if package.extra}):
        members = ", ".join(f"{one.name} {_version(one)}" for one in packages if one.extra == extra)
        out.write(f"  {extra:<10} {members}" + (f": {how_to_install(extra)}\n" if extra in missing else "\n"))
    return _judged(required, solvers, out)


def _look(names: list[str], out: Output) -> int:
    """Tell channels and kind of the runs of some files, and what `sysid read` still needs to be told."""
    every, missing, runs = [Path(name) for name in names], list[str](), list[dict[str, Any]]()
    tests = [one for one in every if _is_test(one)]
    out.write("".join(f"{one}: a test that 'sysid read' wrote; 'sysid show {one}' tells of it\n" for one in tests))
    files = [one for one in every if one not in tests]
    if not files:
        out.answer(runs=runs, missing=missing)
        return SUCCESS
    said = asked(None, files)
    base = [str(channel.column) for channel in said.channels if channel.role == "base"]
    for one in _recordings(files, said):
        kind, channels, rate = kind_of(one, base), channels_of(one), ""
        if one.freq is None:
            with _collecting(missing):
                rate = f" at {recorded_rate(one, said):g} Hz"
        out.write(
            f"{one.path}: {one.columns[0].values.size} {'samples' if one.freq is None else 'lines'}{rate}, {kind}\n"
        )
        for column in channels:
            out.write(f"  {column.name:<20} {column.unit or 'no unit':<10} {column.place}\n")
        out.write("".join(f"  {remark}\n" for remark in one.remarks))
        missing += coarse_lines(one)
        runs.append({"file": str(one.path), "kind": kind, "channels": [column.name for column in channels]})
    with _collecting(missing):
        gather(files, said)
    out.answer(runs=runs, missing=missing)
    out.write("".join(f"missing: {one}\n" for one in dict.fromkeys(missing)) or "'sysid read' takes them as they are\n")
    return SUCCESS


def _is_test(file: Path) -> bool:
    """True of a file that `sysid read` wrote."""
    with contextlib.suppress(InputError):
        return is_recorded_test(file)
    return False


def _recordings(files: list[Path], said: Description) -> list[Recording]:
    """The recordings of files, beside which the list of sensors may be that of others, with another word for time."""
    others = replace(said, time=None)
    try:
        found = recordings_of(files, said)
    except InputError:
        return recordings_of(files, others)
    named = not isinstance(said.time, str) or any(said.time in one.names for one in found)
    return found if named else recordings_of(files, others)


@contextlib.contextmanager
def _collecting(missing: list[str]) -> Iterator[None]:
    """Add what is refused within to what is missing."""
    try:
        yield
    except InputError as error:
        missing.append(str(error))


def _judged(required: list[Package], solvers: list[str], out: Output) -> int:
    """One line where a search cannot work."""
    lacking = [f"{package.name}>={package.needed}" for package in required if not package.enough]
    if lacking:
        out.complain(f"these packages are missing or too old: python -m pip install {' '.join(map(repr, lacking))}")
    elif _USED not in solvers:
        out.complain("IPOPT does not work: python -m pip install --force-reinstall casadi")
    elif not required:
        out.warn("sysid is imported from its folder, not installed, so that what it needs is not known: pip install it")
    return MISTAKE if lacking or _USED not in solvers else SUCCESS


def _version(package: Package) -> str:
    old = "" if package.enough else f" (too old: {package.needed} is needed)"
    return f"{package.version}{old}" if package.version else "missing"


def _packages() -> Iterator[Package]:
    """Packages that the installed package states as needed; nothing where it is not installed."""
    try:
        stated = importlib.metadata.requires(_PACKAGE) or ()
    except importlib.metadata.PackageNotFoundError:
        return
    for line in sorted(stated, key=lambda one: ("extra" in one, one)):
        found = re.match(r"([\w.-]+)(?:\[.*\])?>=([\d.]+)(?:.*extra == ['\"](\w+)['\"])?", line)
        if found is None or found[1] == _PACKAGE:
            continue
        name, needed, extra = found[1], found[2], found[3] or ""
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            version = ""
        yield Package(name, needed, extra, version, bool(version) and _numbers(version) >= _numbers(needed))


def _numbers(version: str) -> tuple[int, ...]:
    """The leading numbers of a version: (3, 8, 2) of "3.8.2rc1"."""
    found = re.match(r"\d+(?:\.\d+)*", version)
    return tuple(map(int, found[0].split("."))) if found else ()


def linear_solvers() -> list[str]:
    """The linear solvers with which IPOPT solves a small program here."""
    done = subprocess.run(
        [sys.executable, "-P", "-c", _TRIAL, *_LINEAR_SOLVERS], capture_output=True, text=True, timeout=120, check=False
    )
    return re.findall(r"^works: (\w+)$", done.stdout, re.MULTILINE)


def _libraries() -> dict[str, int]:
    """Libraries of linear algebra by name and version, and how many threads each takes."""
    import scipy.linalg  # noqa: F401 - only libraries that are loaded are found
    from threadpoolctl import threadpool_info

    return {f"{one['prefix']} {one['version']}": one["num_threads"] for one in threadpool_info()}


def _backend() -> str:
    import matplotlib

    return str(matplotlib.get_backend())
