"""NPY and NPZ files: numbers, and nothing that is run or unpacks to more than the file says."""

import io
import zipfile

import numpy as np
import pytest

from etsplat.io.arrays import load_npy, load_npz, names_in_npz


def test_arrays_are_those_that_were_saved(tmp_path):
    """Of every layout and order of bytes."""
    kinds = {
        "plain": np.arange(6.0).reshape(2, 3),
        "columns": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "big": np.arange(4, dtype=">f4"),
        "scalar": np.array(3.5),
        "none": np.zeros((0, 4)),
    }
    np.savez_compressed(tmp_path / "a.npz", **kinds)
    np.save(tmp_path / "a.npy", kinds["plain"])
    assert names_in_npz(tmp_path / "a.npz") == set(kinds)
    found = load_npz(tmp_path / "a.npz", kinds)
    for name, numbers in kinds.items():
        np.testing.assert_array_equal(found[name], numbers)
    np.testing.assert_array_equal(load_npy(tmp_path / "a.npy"), kinds["plain"])


def refused(path, names, match):
    with pytest.raises(ValueError, match=match):
        load_npz(path, names)


def test_what_is_no_small_array_of_numbers_is_refused(tmp_path):
    """Objects, which numpy would unpickle; much packed into little; a header that claims more than there is."""
    path = tmp_path / "a.npz"
    np.savez_compressed(path, objects=np.array([{}], object), text=np.array(["a"]), large=np.zeros(1 << 20))
    for name in ("objects", "text", "large"):
        refused(path, [name], f"{name} holds no small array of numbers")
    refused(path, ["another"], "damaged")
    file = io.BytesIO()
    np.save(file, np.zeros(4))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("claims.npy", file.getvalue().replace(b"(4,)", b"(9,)"))
        archive.writestr("no.npy", b"no array")
    for name in ("claims", "no"):
        refused(path, [name], "damaged, or no NPZ file")
    path.write_bytes(b"PK")
    refused(path, ["claims"], "damaged")
    with pytest.raises(ValueError, match="damaged"):
        names_in_npz(path)
    np.save(tmp_path / "a.npy", np.array([{}], object))
    with pytest.raises(ValueError, match="damaged, or no NPY file"):
        load_npy(tmp_path / "a.npy")
