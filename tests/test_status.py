import enum

import numba
import numpy as np
import pytest
from hypothesis import given, strategies as st

from vibrissa.status import Status, describe, flag_attributes, is_ok


def test_numbers_stored_in_files_keep_their_meaning():
    assert {member.name: int(member) for member in Status} == {
        "OK": 0,
        "TIP_CONTACT": 1,
        "NO_CONTACT": 2,
        "BEYOND_FOLD": 10,
        "BEYOND_TIP": 11,
        "TOO_PROXIMAL": 12,
        "NOT_CONVERGED": 13,
        "MISSING": 14,
        "TOO_STRONG": 15,
        "UNIQUE": 20,
        "AMBIGUOUS": 21,
        "NOT_FRICTIONLESS": 22,
        "OUTSIDE_MAP": 23,
        "DEGENERATE": 24,
        "NOT_ONE_CONTACT": 25,
        "APPROXIMATE": 26,
        "UNDERDETERMINED": 27,
        "NOT_FELT": 28,
        "OUTSIDE_PRIOR": 29,
    }
    assert enum.verify(enum.UNIQUE)(Status)
    assert all(int(member) < 127 for member in Status)  # stored as int8


@pytest.mark.parametrize("member", Status)
def test_every_status_explains_itself_and_advises(member):
    assert member.explanation.endswith(".")
    assert str(member).startswith(member.explanation)
    assert str(member).endswith(member.advice)
    assert bool(member.advice) != member.ok


@given(st.lists(st.sampled_from(Status), max_size=30))
def test_describe_counts_every_row_once(members):
    counts = describe(np.array(members, dtype=np.int8))
    assert counts.total() == len(members)
    for member in Status:
        assert counts[str(member)] == members.count(member)


def test_describe_takes_any_shape():
    assert describe(Status.OK) == {str(Status.OK): 1}
    assert describe(np.zeros((2, 3), dtype=np.int8)) == {str(Status.OK): 6}
    assert describe([]) == {}


def test_describe_names_what_it_does_not_know():
    with pytest.raises(ValueError, match=r"\[99\] are not statuses"):
        describe([0, 99])


def test_is_ok_agrees_with_the_members():
    codes = np.array([[int(member) for member in Status]], dtype=np.int8)
    assert is_ok(codes).shape == codes.shape
    assert is_ok(codes)[0].tolist() == [member.ok for member in Status]
    assert bool(is_ok(Status.OK))


def test_flags_name_every_number():
    flags = flag_attributes()
    assert flags["flag_values"].dtype == np.int8
    meanings = flags["flag_meanings"].split()
    assert [Status[meaning.upper()] for meaning in meanings] == flags["flag_values"].tolist()


def test_kernels_can_use_the_members():
    @numba.njit
    def judge(determinant, codes):
        for i in range(determinant.size):
            codes[i] = Status.OK if determinant[i] > 0 else Status.BEYOND_FOLD

    codes = np.empty(2, dtype=np.int8)
    judge(np.array([1.0, -1.0]), codes)
    assert codes.tolist() == [Status.OK, Status.BEYOND_FOLD]


@pytest.mark.parametrize("codes", [np.array([20, 0]), [0, 2]])
def test_an_array_is_referred_to_the_functions_for_arrays(codes):
    with pytest.raises(TypeError, match=r"one number, not an array of shape \(2,\).*names"):
        Status(codes)
