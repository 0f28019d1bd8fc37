"""Where tracking begins without a click, in films with other whisker-like lines.

`python studies/starts.py`: films of `tests/tracking/furry.py`, 24 frames spread over 0.4 s each;
some minutes on a free core. Their seeds set no number of the method, but for those without a
whisker and 123, 125 and 127 before grey fur. `--page` writes the table into
`docs/tracking-rows.md`, else it is printed.
"""

import argparse
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pages import few, put, table

from vibrissa.tracking import Start, find_start

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "tracking"))

from furry import Film, Setup

ROOT = Path(__file__).parents[1]
CASES: dict[str, tuple[dict[str, Any], tuple[int, ...]]] = {
    "reference, 512 × 512": ({}, (101, 102, 103, 104, 116)),
    "640 × 480": ({"size": (640, 480)}, (108, 109)),
    "1024 × 1024, base 7 pixels wide": ({"size": (1024, 1024)}, (113,)),
    "H.264, rate factor 30": ({"crf": 30}, (105, 117)),
    "noise of 9 grey values": ({"noise": 9.0}, (106,)),
    "grey face": ({"face": 90.0}, (107,)),
    "no peg": ({"peg": False}, (115,)),
    "bright whisker on dark": ({"bright": True}, (112,)),
    "whisker at rest": ({"still": True}, (114,)),
    "front view before grey fur": ({"cheek": True}, (123, 124, 125, 126, 127, 128, 131, 132)),
    "no whisker": ({"whisker": False}, (110, 111)),
}
HEAD = (
    "condition",
    "films",
    "within 5 px in both views",
    "base, px",
    "confidence",
    "in doubt",
    "refused",
    "CPU, s",
)
_NEAR = 5.0


class Measured(NamedTuple):
    """What was found in a film, how far its bases are off, pixels, and the time it took, s."""

    start: Start
    misses: list[float]
    seconds: float


def measured(film: Any) -> Measured:
    """Find where the whisker of a film begins."""
    began = time.process_time()
    start = find_start(film.cameras, film.frames)
    seconds = time.process_time() - began
    true = [view[0][0] for view in film.curves]
    pairs = zip(start.bases or [], true, strict=start.bases is not None)
    return Measured(start, [float(np.linalg.norm(a - b)) for a, b in pairs], seconds)


def row(name: str, found: Iterable[Measured], whisker: bool) -> list[str]:
    found = list(found)
    misses = [max(one.misses) for one in found if one.misses and whisker]
    sure = [one.start.confidence for one in found]
    return [
        name,
        str(len(found)),
        str(sum(miss < _NEAR for miss in misses)) if whisker else "–",
        f"{few(float(np.median(misses)))} ({few(max(misses))})" if misses else "–",
        f"{min(sure):.2f}–{max(sure):.2f}" if len(sure) > 1 else f"{sure[0]:.2f}",
        str(sum(bool(one.start.doubts) and one.start.bases is not None for one in found)),
        str(sum(one.start.bases is None for one in found)),
        few(float(np.median([one.seconds for one in found]))),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--page", action="store_true", help="write the table into the page")
    page = parser.parse_args().page
    rows = []
    for name, (setup, seeds) in CASES.items():
        films = (Film(Setup(seed=seed, frames=24, rate=60.0, **setup)) for seed in seeds)
        rows.append(row(name, map(measured, films), setup.get("whisker", True)))
        print(" | ".join(rows[-1]), flush=True)
    if page:
        put(ROOT / "docs" / "tracking-rows.md", {"starts": table(HEAD, rows)})


if __name__ == "__main__":
    main()
