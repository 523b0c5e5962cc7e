"""Searches in processes of their own that can be killed: ``python -m benchmarks.jobs.searches CASE FOLDER``."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import sysid
from benchmarks.swarm.structured import CASES as STRUCTURED
from benchmarks.swarm.structured import problem_of
from sysid import catalogue
from sysid.files.tree import from_bytes
from sysid.results.checkpoint import Checkpoint

CASES = ("swarm", "swarm of free modes", "continuation", "law of amplitude")
STATE, RESULT = "state.h5", "result.h5"
EVERY = 0.05  # s between two states


def main(case: str, folder: str) -> None:
    """Search, or go on with it, and save the result."""
    if case == "swarm of free modes":
        recipe = sysid.Recipe("cantilever_tower", parameters={"elements": 3, "noise": 0.0, "force": False})
        problem, strategy = catalogue.build(recipe), sysid.Swarm.published()
    elif case == "law of amplitude":
        problem, strategy = catalogue.build(sysid.Recipe("softening_storey")), "auto"
    else:
        problem = problem_of(STRUCTURED[0], 9400)[0]
        strategy = sysid.Swarm(60) if case == "swarm" else sysid.Continuation(starts=3)
    checkpoint = Checkpoint(Path(folder) / STATE, every=EVERY)
    print("resumed" if checkpoint.exists and checkpoint.read()["entries"] else "anew", flush=True)
    sysid.identify(problem, strategy=strategy, rng=1, checkpoint=checkpoint).save(Path(folder) / RESULT)
    checkpoint.remove()


def start(case: str, folder: Path) -> subprocess.Popen[str]:
    """The same in another process."""
    command = [sys.executable, "-m", "benchmarks.jobs.searches", case, str(folder)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def bits(folder: Path) -> dict[str, bytes]:
    """All of a result, by its place in the file, but times."""
    tree, _ = from_bytes((folder / RESULT).read_bytes())
    return {name: part for name, part in _flat(tree, "") if not name.endswith(("/seconds", "/wall_time", "/log"))}


def _flat(tree: object, name: str) -> list[tuple[str, bytes]]:
    if isinstance(tree, dict):
        return [pair for key, part in tree.items() for pair in _flat(part, f"{name}/{key}")]
    if isinstance(tree, list):
        return [pair for key, part in enumerate(tree) for pair in _flat(part, f"{name}/{key}")]
    return [(name, tree.tobytes() if hasattr(tree, "tobytes") else repr(tree).encode())]


if __name__ == "__main__":
    main(*sys.argv[1:])
