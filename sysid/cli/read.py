"""``sysid read FILES... --out test.h5``: a laboratory's files as one test, with a table of its channels."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sysid.cli.command_parser import band
from sysid.cli.output import Output
from sysid.cli.status import SUCCESS
from sysid.errors import InputError, refuse
from sysid.files import description, recorded_test
from sysid.files.reading import gather
from sysid.results.identification import Recipe
from sysid.results.storage import atomically

_EXAMPLES = (
    "sysid read sine.csv --sensors sensors.toml --out test.h5",
    "sysid read CH1.csv CH2.csv --join --sensors sensors.toml --out test.h5",
    "sysid read run1.csv run2.csv --time Time --sensor CH1 role=base axis=x unit=g \\\n"
    "      --sensor CH2 role=response name=top axis=x position=0,0,3 unit=g --out test.h5",
)
MODULE = "recorded_test"  # the bundled problem that takes what this command writes


def add(command: Callable[..., argparse.ArgumentParser]) -> None:
    """Add the command to the parser."""
    read = command(
        "read",
        summary="read the files of a logger as a test that 'sysid run' takes",
        description="Read the files of a test, convert its channels to SI units, print a table of them, and write it. "
        "Which column is which sensor is said in a TOML file or by --sensor; a TOML file of the name of the first "
        "file, or sensors.toml beside it, is found by itself.",
        examples=_EXAMPLES,
        more=f"sensors.toml:\n{description.EXAMPLE}",
    )
    read.add_argument("files", metavar="FILE", nargs="+", help="of any known format; each is a run")
    read.add_argument("--out", metavar="TEST.h5", help="file to write, test.h5 by default")
    read.add_argument("--sensors", metavar="TOML", help="which column is which sensor")
    read.add_argument(
        "--sensor",
        action="append",
        nargs="+",
        default=[],
        metavar=("COLUMN", "KEY=VALUE"),
        help="one sensor: role=base|response|force axis=x position=0,0,3 unit=g name=NAME",
    )
    read.add_argument("--rate", type=float, metavar="HZ", help="samples a second, where no column has the time")
    read.add_argument("--time", metavar="COLUMN", help="the column of time")
    read.add_argument("--frequency", metavar="COLUMN", help="the column of frequencies, of spectra")
    read.add_argument(
        "--join",
        action="store_true",
        default=None,
        help="a file a sensor: the files of a folder are one run; columns are called FILE, or FILE.COLUMN of several",
    )
    read.add_argument("--base-axes", metavar="AXES", help='along which the base moves, such as "x" or "x rz"')
    read.add_argument("--frf", metavar="FORM", help="of frequency responses: transmissibility, accelerance, mobility, "
                      "receptance, apparent mass")  # fmt: skip
    read.add_argument("--convention", metavar="SIGN", help='of spectra: "exp(+iwt)" or "exp(-iwt)"')
    read.set_defaults(command=run)


def run(options: argparse.Namespace, out: Output) -> int:
    """Read, tell, write."""
    target = Path(options.out or "test.h5")
    refuse(
        (target.suffix != ".h5", f"--out {target}: give a name that ends in .h5, which 'sysid run' knows"),
        (
            any(Path(file).absolute() == target.absolute() for file in options.files),
            f"--out {target} is a file to read",
        ),
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
    out.answer(channels=[vars(row) for row in test.table], remarks=list(test.remarks), runs=len(test.runs))


def _said(options: argparse.Namespace) -> Any:
    """The description by the options; over a TOML file where both say something."""
    given: dict[str, Any] = {
        "sample_rate": options.rate, "time": options.time, "frequency": options.frequency, "join": options.join,
        "base_axes": options.base_axes, "frf": options.frf, "convention": options.convention,
    }  # fmt: skip
    given = {name: value for name, value in given.items() if value is not None}
    if options.sensor:
        given["sensor"] = [description.from_words(words) for words in options.sensor]
    file = Path(options.sensors) if options.sensors else description.description_file(Path(options.files[0]))
    if options.sensor and options.sensors:
        raise InputError("--sensor and --sensors exclude each other")
    if file is None or options.sensor:
        return description.description(given, "the command line")
    return description.description({**description.from_toml(file), **given}, str(file))


def is_test(name: str | None) -> bool:
    """True where a problem is called by the file of a test."""
    return name is not None and name.endswith(".h5")


def recipe(options: argparse.Namespace, given: Recipe) -> Recipe:
    """The recipe of a run of a test file: the bundled problem, with the test as its data."""
    if not is_test(given.module):
        asked = options.lumped or any(one is not None for one in (options.mass, options.band, options.goal))
        refuse((asked, "--mass, --lumped, --band and --goal are for a test that 'sysid read' wrote"))
        return given
    refuse((given.data is not None, f"--data {given.data}: {given.module} is the data already"))
    recorded_test.load(given.module)  # told before anything is made
    extra: dict[str, Any] = {"lumped": True} if options.lumped else {}
    if options.mass is not None:
        extra["mass"] = options.mass[0] if len(options.mass) == 1 else options.mass
    if options.band is not None:
        extra["band"] = options.band
    if options.goal is not None:
        extra["goal"] = options.goal
    return Recipe(MODULE, given.module, given.rng, {**given.parameters, **extra})


def add_options(command: argparse.ArgumentParser) -> None:
    """Add to a command what it may say of a test file: masses, lines that are fitted, and what is near enough."""
    command.add_argument(
        "--mass",
        type=_masses,
        metavar="KG",
        help="of TEST.h5: mass of the structure, kg, a number or one a direction: 1450 or 1450,1450,1450; with "
        "--lumped that at the sensors alone, without what moves with the table (adapter, base ring)",
    )
    command.add_argument("--lumped", action="store_true", help="of TEST.h5: masses at the sensors alone")
    command.add_argument(
        "--band", type=band, metavar="LOW-HIGH", help="of TEST.h5: the lines that are fitted, Hz, such as 0.5-40"
    )
    command.add_argument(
        "--goal", type=float, metavar="SHARE",
        help="of TEST.h5: relative residual that is near enough, such as 0.05; by default that of the noise",
    )  # fmt: skip


def _masses(text: str) -> list[float]:
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if not found or min(found) <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is no mass in kg, such as 1450")
    return found
