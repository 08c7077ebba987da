from __future__ import annotations

from numpy.testing import assert_allclose

from benchmarks.rigid_objects import DATA, objects
from handsim.files.arrays import read_npz
from handsim.space.objects import object_names


def test_file_is_what_the_script_makes():
    stored, made = read_npz(DATA), objects()
    assert list(stored) == list(made)
    assert tuple(dict.fromkeys(name.partition(".")[0] for name in stored)) == object_names()
    for name, array in made.items():
        if array.dtype.kind == "U":
            assert stored[name].tolist() == array.tolist()
        else:
            assert_allclose(stored[name], array, atol=1e-12)
