"""Result files that were damaged: an error or the same numbers."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator

import numpy as np

import sysid
from benchmarks.hostile.damage import KINDS, damaged
from benchmarks.line import Line, above
from sysid import catalogue

CORRUPTIONS = 1000


def lines(reduced: bool) -> Iterator[Line]:
    """One file, damaged in a thousand ways; the numbers of those that are read are held against the sound one's."""
    count = 120 if reduced else CORRUPTIONS
    rng = np.random.default_rng(21)
    with tempfile.TemporaryDirectory() as folder:
        problem = catalogue.build(
            sysid.Recipe("cantilever_tower", parameters={"elements": 3, "noise": 0.0, "force": False})
        )
        sound = sysid.identify(problem, rng=0).save(folder)
        data, tree = sound.read_bytes(), repr(sysid.load(sound).to_tree())
        ends: Counter[str] = Counter()
        for i in range(count):
            sound.write_bytes(damaged(data, KINDS[i % len(KINDS)], rng))
            try:
                ends["the same numbers" if repr(sysid.load(sound).to_tree()) == tree else "other numbers"] += 1
            except sysid.InputError:
                ends["an error"] += 1
            except Exception as error:  # what this looks for
                ends[type(error).__name__] += 1
    told = ", ".join(f"{end} {many}" for end, many in ends.items())
    text = (
        f"{count} corruptions of a result file of {len(data)} bytes ({', '.join(KINDS)}): an error or the same numbers"
    )
    yield above(f"{text} ({told})", ends["an error"] + ends["the same numbers"], count)
