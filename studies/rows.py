"""Rows of whiskers that cross before fur: whose line is each trace?

`python studies/rows.py`: films of `tests/tracking/rows.py` with other seeds than those on which
numbers were set (1 to 3, and 11); some minutes on a free core. Bases are clicked where they truly
are; what cannot be distinguished (less than 70 % of the whisker more than 4 pixels from any other)
is not counted.
"""

import sys
import time
from pathlib import Path

import numpy as np
from pages import table

from vibrissa.tracking import trace_video

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "tracking"))

from rows import RowFilm, scored

FILMS = ((21, 3), (22, 3), (12, 4), (15, 4), (13, 5), (14, 6))
HEAD = ("film", "whiskers", "view", "images", "right, %", "lost, %", "swapped, %", "wrong, %", "ms")


def rows():
    """One row of the table for each film and view."""
    for seed, count in FILMS:
        film = RowFilm(seed, count, frames=80)
        for view, camera in enumerate(film.cameras):
            began = time.process_time()
            traces = trace_video(film.images[view], film.truth[view][0, :, 0])
            spent = 1e3 * (time.process_time() - began) / film.frames
            score = scored(traces, film.truth[view])
            clear = score[np.isfinite(score)]
            shares = [100.0 * float(np.mean(clear == kind)) for kind in (1, 0, -1, -2)]
            each = [f"{share:.1f}" for share in shares]
            yield [str(seed), str(count), camera.name, str(len(clear)), *each, f"{spent:.0f}"]


if __name__ == "__main__":
    print(table(HEAD, list(rows())))
