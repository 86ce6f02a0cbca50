"""The sessions of odd input find what is planted, and try the same inputs again."""

import sys

import pytest

from tests.fuzz import corpus
from tests.fuzz.arguments import odd
from tests.fuzz.mutate import mutated
from tests.fuzz.operations import OPERATIONS
from tests.fuzz.planted import DEFECTS, HANG, INPUTS, planted
from tests.fuzz.readers import READERS, Reader
from tests.fuzz.session import Tally, generator, run_target

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="workers are forks, and their memory is in /proc")


@pytest.mark.parametrize("kind", DEFECTS)
def test_a_planted_defect_is_found_at_its_input(kind):
    """As what it is; the inputs behind it are tried all the same."""
    target = planted(kind)
    tally = run_target(target, 0, inputs=INPUTS, hang=HANG if kind == "hang" else 20)
    assert tally.inputs == INPUTS
    assert set(tally.counts()) == {kind}
    defective = [index for index in range(INPUTS) if target.defective(target.describe(generator(target, 0, index)))]
    assert min(failure.index for failure in tally.failures.values()) == defective[0]
    assert sum(failure.count for failure in tally.failures.values()) == len(defective)
    assert tally.accepted > 0


def test_inputs_depend_on_seed_target_and_number_alone():
    reader = READERS[0]
    first, again = (reader.describe(generator(reader, 0, 7)) for _ in range(2))
    assert first == again
    assert first != reader.describe(generator(reader, 1, 7))
    assert repr(OPERATIONS[0].describe(generator(OPERATIONS[0], 0, 7))) == repr(
        OPERATIONS[0].describe(generator(OPERATIONS[0], 0, 7))
    )


@pytest.mark.parametrize("make", [corpus.objs, corpus.soups, corpus.pictures, corpus.states, corpus.gltfs])
def test_mutations_change_files_and_leave_many_of_them_whole(make):
    """Most change the file; containers are put together again with lengths and checksums that fit."""
    seeds = make()
    reader = Reader("test", lambda: [{"x": data} for data in seeds], ("x",), lambda folder: None)
    changed = [mutated(seeds[0], generator(reader, 0, index), seeds) for index in range(60)]
    assert sum(data != seeds[0] for data in changed) > 45
    assert all(isinstance(data, bytes) for data in changed)


def test_unchanged_arguments_are_accepted():
    """Every operation takes what its target starts from."""
    for operation in OPERATIONS:
        calm = odd({}, generator(operation, 0, 0))
        for valid in operation.valid:
            operation.run(type(calm)(valid, (), False), None)  # pyright: ignore[reportArgumentType]


def test_a_target_that_accepts_too_little_says_so():
    tally = Tally("none", inputs=100, accepted=3)
    assert tally.share_accepted() == 0.03
