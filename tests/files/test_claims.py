"""Files that claim more than they hold, or take their numbers from elsewhere, are refused before memory is taken."""

import io
import struct
import zipfile

import h5py
import numpy as np
import pytest
import scipy.io

import sysid
from sysid.files import reading, tree
from sysid.files.arrays import check_matlab
from sysid.files.tree import from_bytes, to_bytes

HUGE = 10**6  # of a side


def hdf5(write):
    def make(path):
        with h5py.File(path, "w") as file:
            write(file)

    return make


def virtual(file):
    layout = h5py.VirtualLayout((4,), "f8")
    layout[:] = h5py.VirtualSource("elsewhere.h5", "x", (4,))
    file.create_virtual_dataset("x", layout)


def mat(version, at, **options):
    """A vector whose two sizes, so many bytes behind the beginning, are changed."""

    def make(path):
        image = io.BytesIO()
        scipy.io.savemat(image, {"x": np.arange(5.0)}, format=version, **options)
        data = bytearray(image.getvalue())
        data[at : at + 8] = struct.pack("<ii", HUGE, HUGE)
        path.write_bytes(data)

    return make


def packed_mat(path):
    scipy.io.savemat(path, {"x": np.zeros(10**5)}, do_compression=True)


def npz(path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (HUGE, HUGE)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.npy", header.getvalue())


@pytest.mark.parametrize(
    ("name", "make", "words"),
    [
        ("a.h5", hdf5(lambda f: f.create_dataset("x", (HUGE, HUGE), "f8", chunks=(9, 9))), r"'/x' claims 8e\+12 bytes"),
        ("a.h5", hdf5(lambda f: f.create_dataset("x", (10**8,), "f8", chunks=(10**6,), compression=1)), "claims 8e"),
        ("a.h5", hdf5(lambda f: f.create_dataset("x", (4,), "u1", external=[("other", 0, 4)])), "in another file"),
        ("a.h5", hdf5(virtual), "'/x' has its numbers in another file"),
        ("a.h5", hdf5(lambda f: f.update(x=h5py.ExternalLink("other.h5", "/x"))), "'x' is a link to something else"),
        ("a.mat", hdf5(lambda f: f.update(x=h5py.ExternalLink("other.h5", "/x"))), "'x' is a link to something else"),
        ("a.mat", mat("5", 160), r"a matrix claims 1000000000000 entries in \d+ bytes"),
        ("a.mat", mat("4", 4), "is no MATLAB file, or is damaged"),
        ("a.mat", packed_mat, "what is compressed in it claims"),
        ("a.npz", npz, "'x.npy' claims 1000000000000 entries, and holds fewer"),
        ("a.npz", lambda path: np.savez_compressed(path, x=np.zeros(10**5)), r"'x.npy' claims 8e\+05 bytes"),
    ],
)
def test_a_claim_on_memory_or_on_another_file_is_one_line(tmp_path, monkeypatch, name, make, words):
    monkeypatch.setattr(tree, "_LEAST", 2**16)  # so that a test need not write what is too much
    make(tmp_path / name)
    with pytest.raises(sysid.InputError, match=words) as told:
        reading.gather(tmp_path / name, {"sample_rate": 1.0})
    assert "\n" not in str(told.value)


def test_what_matlab_packs_nests_or_leaves_empty_passes(tmp_path):
    content = {
        "a": {"b": np.eye(3), "c": np.array([1.0, "text", np.zeros((0, 0))], object)},
        "z": np.arange(3) * 1j, "t": "text", "sparse": scipy.sparse.eye_array(3000), "small": np.int8([1, 2]),
    }  # fmt: skip
    for packed in (False, True):
        scipy.io.savemat(tmp_path / "a.mat", content, do_compression=packed)
        check_matlab(tmp_path / "a.mat")
    scipy.io.savemat(tmp_path / "a.mat", {"x": np.eye(3), "s": scipy.sparse.eye_array(3000)}, format="4")
    check_matlab(tmp_path / "a.mat")


def sound(write):
    """Bytes of a tree, to which something is added, under their right length and SHA-256 as by our own writer."""
    image = io.BytesIO(to_bytes({"x": np.arange(3.0), "part": {"y": 1}}, 1))
    with h5py.File(image, "r+") as file:
        write(file)
    return signed(image.getvalue())


def signed(image):
    header = tree._header(1, len(image), b"0" * 64)
    digest = tree.hashlib.sha256(header + image[512:]).hexdigest().encode()
    return tree._header(1, len(image), digest) + image[512:]


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda f: f.update(y=h5py.ExternalLink("other.h5", "/x")), "'/y' is a link to something else"),
        (lambda f: f["part"].update(y=h5py.SoftLink("/x")), "'/part/y' is a link to something else"),
        (lambda f: f["part"].update(y=f["x"]), "'/x' stands in two places"),
        (lambda f: f["part"].update(all=f["/"]), "stands in two places|stand"),
        (lambda f: f.create_dataset("y", (HUGE, HUGE), "f8", chunks=(9, 9)), "'/y' claims"),
        (lambda f: f.create_dataset("y", (4,), "u1", external=[("other", 0, 4)]), "'/y' has its numbers in another"),
        (lambda f: (f.pop("x"), virtual(f)), "'/x' has its numbers in another file"),
        (lambda f: f.create_dataset("y", data=["a"], dtype=h5py.string_dtype()), "an array of the type object"),
        (lambda f: f.attrs.create("y", ["a" * 9] * 9, dtype=h5py.string_dtype()), "an array of the type object"),
    ],
)
def test_a_tree_of_somebody_elses_writing_holds_numbers_and_texts_of_its_own_alone(write, words):
    with pytest.raises(sysid.InputError, match=words):
        from_bytes(sound(write))


def test_a_filter_that_is_no_part_of_hdf5_is_refused():
    """HDF5 would look for a library by its number."""

    def write(file):
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_chunk((4,))
        properties.set_filter(32015, h5py.h5z.FLAG_OPTIONAL)
        space = h5py.h5s.create_simple((4,))
        h5py.h5d.create(file.id, b"y", h5py.h5t.IEEE_F64LE, space, properties)

    with pytest.raises(sysid.InputError, match="'/y' is packed by a filter that is no part of HDF5"):
        from_bytes(sound(write))
