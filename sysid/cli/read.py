"""``sysid read FILES... --out test.h5``: a laboratory's files as one test, with a table of its channels."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from sysid.cli.output import Output
from sysid.cli.requests import tell_band
from sysid.cli.starting import SUCCESS
from sysid.errors import refuse
from sysid.files import description, recorded_test
from sysid.files.reading import gather
from sysid.results.storage import atomically


def run(options: argparse.Namespace, out: Output) -> int:
    """Read, tell, write."""
    target = Path(options.out or "test.h5")
    read = target.absolute() in [Path(file).absolute() for file in options.files]
    refuse(
        (target.suffix != ".h5", f"--out {target}: give a name that ends in .h5, which 'sysid run' knows"),
        (read, f"--out {target} is a file to read"),
    )
    test = gather(options.files, _said(options))
    with atomically(target) as temporary:
        temporary.write_bytes(test.to_bytes())
    tell_channels(test, out)
    out.wrote(target)
    out.write(f"'sysid run {target}' identifies it\n")
    return SUCCESS


def tell_channels(test: recorded_test.RecordedTest, out: Output) -> None:
    """Write the channels of a test and what was noticed while it was read."""
    out.write(f"{test.in_words()}\n")
    damage = test.damage
    for one in damage:
        out.write(f"run {one.run}: {one.sentence}\n")
    out.answer(
        channels=[vars(row) for row in test.table], remarks=list(test.remarks), runs=len(test.runs),
        damage=[{**vars(one), "stretches": one.stretches.tolist()} for one in damage],
    )  # fmt: skip
    tell_band(test, "the lines that 'sysid run' fits where no --band is given", out)


def _said(options: argparse.Namespace) -> Any:
    """The description by the options; over a TOML file where both say something."""
    given: dict[str, Any] = {
        "sample_rate": options.rate, "time": options.time, "frequency": options.frequency, "join": options.join,
        "align": options.align,
        "base_axes": options.base_axes, "frf": options.frf, "convention": options.convention,
        "window": options.window, "averages": options.averages,
    }  # fmt: skip
    given = {name: value for name, value in given.items() if value is not None}
    if options.sensor:
        given["sensor"] = [description.from_words(words) for words in options.sensor]
    file = Path(options.sensors) if options.sensors else description.description_file(Path(options.files[0]))
    refuse((options.sensor and options.sensors, "--sensor and --sensors exclude each other"))
    if file is None or options.sensor:
        return description.description(given, "the command line")
    return description.description({**description.from_toml(file), **given}, str(file))
