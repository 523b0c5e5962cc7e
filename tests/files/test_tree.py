"""A tree in a file: it comes back as it was, or the file is refused before HDF5 sees it."""

import hashlib
import io
import re

import h5py
import numpy as np
import pytest

import sysid
from sysid.files.tree import check_tree, from_bytes, is_tree, to_bytes

TREE = {
    "flag": True,
    "count": -(2**63),
    "number": 0.1 + 0.2,
    "nothing": None,
    "text": "Stütze – \U0001f527 \n\t\udcff",
    "empty text": "",
    "long text": "ζ" * 40000,
    "texts": ("a", "", "über"),
    "no texts": (),
    "real": np.array([[1e-300, np.inf], [-0.0, np.nan]]),
    "complex": np.array([1 + 2j, -3j]),
    "one": np.array(4.0),
    "none": np.zeros((0, 3)),
    "flags": np.array([True, False]),
    "integers": np.arange(3, dtype=np.int32),
    "branch": {"deeper": {"x": 1.0}, "empty": {}},
    "list": [{"x": 1}, {}, 2.5, "text", [None, []], *range(8)],
    "no list": [],
}


def assert_same(a, b, at="tree"):
    assert type(a) is type(b), at
    if isinstance(a, dict):
        assert set(a) == set(b), at
        for name in a:
            assert_same(a[name], b[name], f"{at}/{name}")
    elif isinstance(a, list):
        assert len(a) == len(b), at
        for i, (mine, other) in enumerate(zip(a, b, strict=True)):
            assert_same(mine, other, f"{at}/{i}")
    elif isinstance(a, np.ndarray):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), at
    else:
        assert a == b, at


def test_a_tree_comes_back_as_it_was():
    back, number = from_bytes(to_bytes(TREE, 7))
    assert_same(back, TREE)
    assert number == 7


def test_the_order_of_keys_makes_no_difference():
    assert to_bytes(dict(reversed(TREE.items())), 3) == to_bytes(TREE, 3)


def test_other_programs_read_the_hdf5():
    with h5py.File(io.BytesIO(to_bytes(TREE, 3)), "r") as file:
        assert file.userblock_size == 512
        assert file["branch/deeper"].attrs["x"] == 1.0
        np.testing.assert_array_equal(file["complex"][()], TREE["complex"])
        assert file.attrs["text"].decode("utf-8", "surrogatepass") == TREE["text"]


def test_the_head_tells_how_to_check_the_file_by_hand():
    image = to_bytes(TREE, 3)
    assert is_tree(image) and f"format 3, {len(image)} bytes".encode() in image[:512]
    (digits,) = re.findall(rb"\b[0-9a-f]{64}\b", image[:512])
    assert hashlib.sha256(image.replace(digits, b"0" * 64, 1)).hexdigest() == digits.decode()


def test_each_single_byte_counts():
    """Every byte of the head, and one in 50 behind it, with one bit turned."""
    image = to_bytes({"x": np.arange(300.0), "text": "abc"}, 3)
    for at in (*range(600), *range(600, len(image), 50)):
        broken = bytearray(image)
        broken[at] ^= 1 << (at % 8)
        with pytest.raises(sysid.InputError, match="it is damaged"):
            from_bytes(bytes(broken))


@pytest.mark.parametrize(
    "change",
    [lambda b: b[:-1], lambda b: b[:513], lambda b: b[:300], lambda b: b"", lambda b: b + b"\0", lambda b: b + b],
)
def test_each_missing_or_added_byte_counts(change):
    with pytest.raises(sysid.InputError, match="it is damaged"):
        from_bytes(change(to_bytes({"x": 1.0}, 3)))


@pytest.mark.parametrize("name", ["", ".", "a/b", "[]", 3, "a\0b"])
def test_what_is_no_name_is_refused(name):
    with pytest.raises(sysid.InputError, match="/branch: .* is no name"):
        check_tree({"branch": {name: 1}})


@pytest.mark.parametrize(
    "value", [object(), {1.0}, (1, 2), np.array(["a"]), np.array([None]), b"bytes", 1j], ids=lambda v: type(v).__name__
)
def test_what_cannot_be_stored_is_refused_where_it_stands(value):
    with pytest.raises(sysid.InputError, match=r"^/list/1/x: a \w+ cannot be stored"):
        to_bytes({"list": [0, {"x": value}]}, 3)


def test_a_number_of_more_than_64_bits_is_refused():
    with pytest.raises(sysid.InputError, match="/n: .* more than 64 bits"):
        check_tree({"n": 2**63})
