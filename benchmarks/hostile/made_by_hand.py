"""Results, tests, recipes, unfinished runs and ledgers that somebody made to have something run, or memory filled.

They are written by h5py, sqlite3 and NumPy over sound ones, each under its right length and SHA-256, as anybody can.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import re
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

CANARIES = "traces"  # folder in which whatever ran leaves a file
SECRET = b"contents of another file of this machine"
# A name that would end the line, turn the screen red, and write from right to left.
CONTROL = "top\nimport evil_models\x1b[31m\u202e"
_HUGE = 10**6  # of a side

Change = Callable[[Any], object]


@dataclass(frozen=True)
class HandMade:
    """One file, and what is done with it.

    Attributes
    ----------
    what : str
        In words.
    place : str
        Where it stands, from the folder in which the commands run.
    content : bytes
    commands : tuple of tuple of str
        Of ``sysid``, each with the file somewhere in it; ``load`` is `sysid.load`, ``import`` runs a module.
    """

    what: str
    place: str
    content: bytes
    commands: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Sound:
    """Bytes of files that sysid wrote: results of models, of expressions, of a model of one's own, and the others."""

    models: bytes
    expressions: bytes
    own: bytes
    test: bytes
    unfinished: bytes
    ledger: bytes


def signed(image: bytes) -> bytes:
    """A file of `sysid.files.tree` with its right length and SHA-256, whatever was changed in it."""
    head = re.sub(rb"\d+ bytes", b"%d bytes" % len(image), image[:512].rstrip(b"\0"), count=1)
    head = re.sub(rb"[0-9a-f]{64}", b"0" * 64, head).ljust(512, b"\0")
    digest = hashlib.sha256(head + image[512:]).hexdigest().encode()
    return head.replace(b"0" * 64, digest) + image[512:]


def changed(image: bytes, change: Change) -> bytes:
    """The same file after a change by h5py, signed anew."""
    buffer = io.BytesIO(image)
    with h5py.File(buffer, "r+") as file:
        change(file)
    return signed(buffer.getvalue())


def everywhere(name: str, value: object) -> Change:
    """A change of all attributes of a name."""

    def change(file: Any) -> None:
        def visit(_: str, item: Any) -> None:
            if name in item.attrs:
                put(item, name, value)

        visit("", file)
        file.visititems(visit)

    return change


def put(group: Any, name: str, value: object) -> None:
    """Set an attribute of a group; a text as the package writes one."""
    if name in group.attrs:
        del group.attrs[name]
    if name in group:
        del group[name]
    text = np.bytes_(value.encode("utf-8", "surrogatepass")) if isinstance(value, str) else value
    group.attrs.create(
        name, text, dtype=h5py.string_dtype("utf-8", max(1, len(text))) if isinstance(text, bytes) else None
    )


def results(sound: Sound, folder: Path) -> list[HandMade]:
    """Files of results."""
    refine = ("refine", "evil.h5", "--starts", "1", "--workers", "1")
    reading = (("load", "evil.h5"), ("report", "evil.h5"), ("export", "evil.h5", "out.csv"), refine)

    def of(what: str, change: Change, image: bytes = sound.models) -> HandMade:
        return HandMade(what, "evil.h5", changed(image, change), reading)

    made = [
        of(f"a model of the class {kind}", everywhere("kind", kind))
        for kind in (
            "evil_models:Tank", "beside_it:Tank", "evil_package.inside:Tank", "_sysid_problem_00000000_evil:Tank",
            "os:system", "this:d", "antigravity:Tank", "sysid.results.identification:Recipe", "scipy:datasets.Tank",
            ":",
        )
    ]  # fmt: skip
    other = str((folder / "secret").absolute())
    base = "/problem/measurement"
    made += [
        of("another file's bytes as its records", lambda f: _replaced(f, f"{base}/freq", external=[(other, 0, 40)])),
        of("a link to another file", lambda f: _linked(f, f"{base}/freq", h5py.ExternalLink("elsewhere.h5", "/x"))),
        of("a soft link", lambda f: _linked(f, f"{base}/freq", h5py.SoftLink(f"{base}/base"))),
        of("records of a virtual data set", _virtual),
        of("a group in itself", lambda f: f["problem"].update(again=f["/"])),
        of("a thousand million million numbers", lambda f: f.create_dataset("y", (_HUGE, _HUGE), "f8", chunks=(9, 9))),
        of("a gigabyte that is packed to one megabyte", _packed),
        of("texts of free length, all one", lambda f: f.attrs.create("y", ["a" * 999] * 99, dtype=h5py.string_dtype())),
        of("a filter of a library of its own", _filtered),
        of("control characters in the names of sensors", everywhere("name", CONTROL)),
        of("control characters and HTML in its message",
           lambda f: put(f, "message", f"<script>evil()</script>{CONTROL}")),
        of("a matrix of one number in the place of many", lambda f: _replaced(f, "/structure/mass", (1, 1))),
        of("without its structure", lambda f: f.pop("structure")),
        of("the expressions of an earlier format, which CasADi reads", _of_casadi(_text()), sound.expressions),
    ]  # fmt: skip
    for name, text in casadi_texts(folder).items():
        made.append(of(f"CasADi's text of {name}", _of_casadi(text), sound.expressions))
        image = _of_format_2(text)
        made.append(HandMade(f"a file of format 2 with CasADi's text of {name}", "evil.h5", image, reading))
    made.append(HandMade("a model of a module that is not here", "evil.h5", sound.own, reading[-1:]))
    for at, rng in enumerate(np.random.default_rng(7).spawn(3)):
        image = bytearray(sound.models)
        for place in rng.integers(512, len(image), 3):
            image[place] ^= 1 << int(rng.integers(8))
        made.append(HandMade(f"bits that were flipped, {at + 1}", "evil.h5", bytes(image), reading))
    return made


def recipes(sound: Sound) -> list[HandMade]:
    """Results whose recipe names what is to run."""
    refine = ("refine", "evil.h5", "--starts", "1", "--workers", "1")

    def of(what: str, change: Change) -> HandMade:
        return HandMade(what, "evil.h5", changed(sound.expressions, change), (refine,))

    return [
        *(
            of(f"a recipe of the module {module!r}", lambda f, module=module: put(f["recipe"], "module", module))
            for module in ("evil.py", "./evil.py", "evil", "evil_package.inside", "evil.h5", "../here/evil.py")
        ),
        of("a recipe of a bundled name that ./problems hides", lambda f: None),
        of("a parameter that is an expression", lambda f: _parameter(f, "__import__('evil_models')")),
        of("a parameter a hundred thousand brackets deep", lambda f: _parameter(f, "-" * 10**5 + "1")),
        of("a seed of 5,000 digits", lambda f: put(f["recipe"], "rng", "9" * 4000 + "9" * 90 + "x")),
        of("control characters in the name of its module", lambda f: put(f["recipe"], "module", f"{CONTROL}.py")),
    ]


def tests(sound: Sound, folder: Path) -> list[HandMade]:
    """Files of tests, which `sysid read` wrote."""
    other = str((folder / "secret").absolute())

    def of(what: str, change: Change, place: str = "test.h5") -> HandMade:
        name = Path(place).stem.lower()
        commands = (("new", f"x_{name}", "--data", place), ("import", f"x_{name}.py"), ("run", place, "--out", "out"))
        return HandMade(what, place, changed(sound.test, change), commands)

    python = b"import pathlib\npathlib.Path('traces/evil').touch()\n"
    return [
        of("a bundled name that ./problems hides", lambda f: None),
        of("a line feed and Python in a sensor's name", everywhere("name", "top\nimport evil_models\n")),
        of("Python in a sensor's name, in a file called SENSORS.h5",
           everywhere("name", "'+str(__import__('evil_models'))+'"), "SENSORS.h5"),
        of("a line feed in the axes of its base", lambda f: _texts(f, "base_axes", ["x\n x"])),
        of("a line feed in the axis of a sensor", everywhere("axis", "x\nimport evil_models")),
        of("another file's bytes as a record", lambda f: _replaced(f, "/runs/0/base", external=[(other, 0, 40)])),
        of("a thousand million million samples", lambda f: _replaced(f, "/runs/0/base", (_HUGE, _HUGE))),
        of("a run without its base", lambda f: f["/runs/0"].pop("base")),
        of("records of several lengths", lambda f: _replaced(f, "/runs/0/base", (1, 7))),
        HandMade("Python in the place of a test", "test.h5", python,
                 (*((word, "./test.h5") for word in ("run", "compare", "show")), ("new", "x", "--data", "test.h5"))),
    ]  # fmt: skip


def unfinished(sound: Sound) -> list[HandMade]:
    """States of searches that were stopped."""

    def of(what: str, change: Change, *more: str) -> HandMade:
        commands = (("run", "--resume", "stopped"),)
        return HandMade(what, "stopped/unfinished.h5", changed(sound.unfinished, change), commands)

    return [
        *(
            of(f"a state of the module {module!r}", lambda f, module=module: put(f["begun/recipe"], "module", module))
            for module in ("evil.py", "evil_package.inside")
        ),
        of("a state of another search, of a name that ./problems hides", lambda f: put(f, "search", "0" * 64)),
        of("a seed that is no number", lambda f: put(f["begun"], "seed", "__import__('evil_models')")),
        of("a strategy that is none", lambda f: put(f["begun"], "strategy", CONTROL)),
        of("parts of another form", _without_content),
        of("a state of the random source that is none", _nonsense_of_texts),
        of("a link to another file", lambda f: _linked(f, "/entries/0", h5py.ExternalLink("elsewhere.h5", "/x"))),
    ]


def ledgers(sound: Sound, folder: Path) -> list[HandMade]:
    """Ledgers of jobs beside a sound result, in whose folder `sysid refine` looks for them."""
    endless = (
        "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n) SELECT i AS job, i AS result, i AS sha256 FROM n"
    )
    refine = ("refine", "sound", "--starts", "1", "--workers", "1")

    def of(what: str, change: Callable[[sqlite3.Connection], object]) -> HandMade:
        file = folder / "ledger"
        file.write_bytes(sound.ledger)
        with contextlib.closing(sqlite3.connect(file)) as opened:
            change(opened)
            opened.commit()
        return HandMade(what, "sound/refine/jobs.sqlite", file.read_bytes(), (refine,))

    return [
        of("a view without an end", lambda s: s.executescript(f"DROP TABLE results; CREATE VIEW results AS {endless}")),
        of("a trigger", lambda s: s.execute("CREATE TRIGGER t AFTER INSERT ON results BEGIN DELETE FROM results; END")),
        of("a table of another program", lambda s: s.execute("CREATE TABLE bookmarks (place TEXT)")),
        of("a result a hundred thousand lists deep", lambda s: _row(s, "[" * 10**5)),
        of("a result of one number too few", lambda s: _row(s, json.dumps([True, "", [1.0], 0.1, None]))),
        of("control characters in its message",
           lambda s: _row(s, json.dumps([True, CONTROL, [], 0.1, None]))),
    ]  # fmt: skip


def _row(file: sqlite3.Connection, text: str) -> None:
    digest = hashlib.sha256(text.encode()).hexdigest()
    file.execute("UPDATE results SET result = ?, sha256 = ?", (text, digest))


def _replaced(file: Any, name: str, shape: tuple[int, ...] = (5,), **options: Any) -> None:
    """Another data set in the place of one; a large one without a byte of its own."""
    if name in file:
        del file[name]
    chunks = (9, 9) if np.prod(shape, dtype=float) > 1e6 else None
    made = file.create_dataset(name, shape, "f8", chunks=chunks, **options)
    if chunks is None and not options:
        made[...] = 1.0


def _linked(file: Any, name: str, link: object) -> None:
    if name in file:
        del file[name]
    file[name] = link


def _virtual(file: Any) -> None:
    layout = h5py.VirtualLayout((5,), "f8")
    layout[:] = h5py.VirtualSource("elsewhere.h5", "x", (5,))
    del file["/problem/measurement/freq"]
    file.create_virtual_dataset("/problem/measurement/freq", layout)


def _packed(file: Any) -> None:
    made = file.create_dataset("y", (10**8,), "f8", chunks=(10**7,), compression=1)
    chunk = np.zeros(10**7)
    for at in range(10):
        made[at * 10**7 : (at + 1) * 10**7] = chunk


def _filtered(file: Any) -> None:
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_chunk((4,))
    properties.set_filter(32015, h5py.h5z.FLAG_OPTIONAL)
    h5py.h5d.create(file.id, b"y", h5py.h5t.IEEE_F64LE, h5py.h5s.create_simple((4,)), properties)


def _texts(file: Any, name: str, values: list[str]) -> None:
    del file[name]
    file[name] = np.array(values, h5py.string_dtype("utf-8", max(map(len, values))))


def _parameter(file: Any, text: str) -> None:
    group = file["recipe"].require_group("parameters")
    if len(text) > 4096:
        group["noise"] = np.array(text.encode(), h5py.string_dtype("utf-8", len(text)))
    else:
        put(group, "noise", text)


def _without_content(file: Any) -> None:
    for part in file["entries"].values():
        for name in [*part, *part.attrs]:
            del (part if name in part else part.attrs)[name]


def _nonsense_of_texts(file: Any) -> None:
    """Every text and every array of numbers in the parts of a search becomes another."""

    def visit(_: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.dtype.kind == "f":
            item[...] = np.nan
        if "random" in item.attrs:
            put(item, "random", '{"bit_generator": "evil_models", "state": [[[]]]}')

    file["entries"].visititems(visit)


def _of_casadi(text: bytes) -> Change:
    """CasADi's text in the place where results had it, and has no version of the package it any more."""

    def change(file: Any) -> None:
        given = file["problem/given"]
        for place in (given, given.attrs):
            if "expressions" in place:
                del place["expressions"]
        given["expressions"] = np.array(text, h5py.string_dtype("utf-8", len(text)))

    return change


def _text() -> bytes:
    """CasADi's text of a harmless function."""
    import casadi as ca

    x = ca.MX.sym("x", 2)
    return str(ca.Function("expressions", [x], [2 * x]).serialize()).encode()


def _of_format_2(text: bytes) -> bytes:
    """As results of format 2 were: HDF5 from the first byte, CasADi's text of each part."""
    image = io.BytesIO()
    with h5py.File(image, "w") as file:
        file.attrs["content"], file.attrs["format"] = np.bytes_(b"sysid identification"), 2
        place = file.create_group("problem/formulation/matrices")
        place.attrs["function"] = np.bytes_(text)
    return image.getvalue()


_COMPILED = """
import pathlib, subprocess, sys
import casadi as ca

def touch(name):
    return f"touch {pathlib.Path(sys.argv[1], name)}"

x = ca.MX.sym("x", 2)
options = {"jit": True, "compiler": "shell", "jit_options": {"compiler": touch("jit") + "; gcc", "flags": ["-O0"]}}
made = {"a function compiled when it is read": ca.Function("expressions", [x], [2 * x], options)}
ca.Function("evil", [x], [2 * x]).generate("evil.c")
source = pathlib.Path("evil.c")
call = '__attribute__((constructor)) static void left(void) { system("%s"); }' % touch("library")
source.write_text("#include <stdlib.h>\\n" + source.read_text() + call)
subprocess.run(["gcc", "-shared", "-fPIC", "-O0", "evil.c", "-o", "evil.so"], check=True)
library = ca.external("evil", str(pathlib.Path("evil.so").absolute()))
made["a library that is loaded when it is read"] = ca.Function("expressions", [x], [library(x)])
for name, function in made.items():
    print(name, function.serialize(), sep="\\t")
"""


def casadi_texts(folder: Path) -> dict[str, bytes]:
    """CasADi's texts of functions that run something when they are read; none without a C compiler."""
    try:
        subprocess.run(["gcc", "--version"], capture_output=True, check=True)
    except OSError:
        return {}
    command = [sys.executable, "-c", _COMPILED, str((folder / CANARIES).absolute())]
    done = subprocess.run(command, cwd=folder, capture_output=True, check=True)
    for trace in (folder / CANARIES).iterdir():  # of their making
        trace.unlink()
    return dict((name.decode(), text) for name, _, text in (line.partition(b"\t") for line in done.stdout.splitlines()))
