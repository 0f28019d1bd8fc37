"""Corrected traces as CSV."""

import numpy as np
import pytest

from vibrissa.io import load_corrections

HEADER = "view,frame,whisker,x,y\n"


def test_points_are_gathered_by_view_frame_and_whisker(tmp_path):
    path = tmp_path / "c.csv"
    path.write_text(HEADER + "0,5,0,1.5,2\n0,5,0,3,4\n1,7,1,5,6\n1,7,1,7,8\n1,7,1,9,10\n")
    found = load_corrections(path)
    np.testing.assert_array_equal(found[0][5, 0], [[1.5, 2.0], [3.0, 4.0]])
    assert found[1][7, 1].shape == (3, 2)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a,b\n1,2\n", "are needed"),
        (HEADER + "0,5,0,1.5\n", "line 2"),
        (HEADER + "0,5,0,1.5,nan\n", "no point of a trace"),
        (HEADER + "0,5,0,1.5,2\n", "has one point"),
        # Rows that were pasted twice, and those of a table that was sorted by column x.
        (HEADER + 2 * "0,5,0,1,2\n0,5,0,30,9\n", "line 4 .*there already"),
        (HEADER + "0,5,0,1,2\n0,6,0,2,2\n0,5,0,9,3\n0,6,0,11,3\n", "line 4 .*ended further up"),
    ],
)
def test_what_is_no_correction_says_why(tmp_path, text, said):
    path = tmp_path / "c.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=said):
        load_corrections(path)
