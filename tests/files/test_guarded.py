"""Readers in a process of their own: what they give, and what becomes of one that crashes, hangs or takes too much."""

import sys
import time

import numpy as np
import pytest

from sysid.errors import InputError
from sysid.files.guarded import guarded

READERS = """
import ctypes, os, time
import numpy as np
from sysid.errors import InputError

def sizes(path):
    return {"name": path.name, "bytes": np.frombuffer(path.read_bytes(), dtype=np.uint8)}

def refuse(path):
    raise InputError("it is no such file")

def crash(path):
    ctypes.string_at(0)

def hang(path):
    time.sleep(60)

def spin(path):
    while True:
        pass

def fill(path):
    return {"numbers": np.ones(2**31)}

def fail(path):
    raise ValueError("bad\\nbyte 7")
"""


@pytest.fixture
def reader(tmp_path, monkeypatch):
    """Give a function that reads a small file by one of the readers."""
    (tmp_path / "readers.py").write_text(READERS)
    monkeypatch.syspath_prepend(tmp_path)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "random.py").write_text("a file of the user's, which is none of Python's")
    monkeypatch.chdir(elsewhere)
    file = tmp_path / "file.bin"
    file.write_bytes(b"\1\2\3")
    return lambda name, **options: guarded(f"readers:{name}", file, **options)


def test_what_the_reader_gives_comes_back(reader):
    tree = reader("sizes")
    assert tree["name"] == "file.bin"
    np.testing.assert_array_equal(tree["bytes"], np.array([1, 2, 3], dtype=np.uint8))


@pytest.mark.skipif(sys.platform == "win32", reason="signals and limits of POSIX")
@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("refuse", "^it is no such file$"),
        ("crash", r"^it is damaged: the library that reads it crashed \(SIGSEGV\)$"),
        ("spin", r"^it is damaged: reading it takes more than 3 s of a processor$"),
        ("fill", "^it is damaged .*(Memory|allocate)"),
        ("fail", r"^it is damaged \(byte 7\)$"),
    ],
)
def test_what_goes_wrong_in_it_is_one_sentence(reader, name, told):
    with pytest.raises(InputError, match=told):
        reader(name)


def test_one_that_hangs_is_ended(reader):
    begun = time.perf_counter()
    with pytest.raises(InputError, match="takes more than 3 s"):
        reader("hang", seconds=3)
    assert time.perf_counter() - begun < 10
