"""Accuracy and speed: everything that the page *What is measured* and its parts report.

`python studies/measured.py [PART ...]`, with the parts rod, contacts, job, speed and real; all by
default, within ten minutes on two cores. `--page` writes the numbers into the pages, else they are
printed. `--quick` shows how it goes, in a minute or two. The part real needs digitised
whiskers, a CSV each, which are not part of the repository: `--whiskers FOLDER`. Without them it is
left out, and the page keeps its numbers.
"""

import argparse
import datetime as dt
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from measures import contacts, job, real, rod, speed
from pages import put, save

import vibrissa

DOCS = Path(__file__).parents[1] / "docs"
PAGES = [DOCS / f"measured{part}.md" for part in ("", "-pipeline", "-speed")]
PARTS: dict[str, Callable[[bool], dict[str, str]]] = {
    "rod": rod.blocks,
    "contacts": contacts.blocks,
    "job": job.blocks,
    "speed": speed.blocks,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="*", choices=[*PARTS, "real", []], metavar="PART")
    parser.add_argument("--page", action="store_true", help="write docs/measured*.md")
    parser.add_argument("--quick", action="store_true", help="fewer of everything, to try it out")
    parser.add_argument("--whiskers", type=Path, help="folder of digitised whiskers", metavar="DIR")
    chosen = parser.parse_args()
    parts = PARTS | ({"real": partial(real.blocks, chosen.whiskers)} if chosen.whiskers else {})
    for name in chosen.parts or [*PARTS, "real"]:
        if name not in parts:
            print(f"left out: {name}, which needs --whiskers FOLDER")
            continue
        begun = time.perf_counter()
        blocks = parts[name](chosen.quick)
        took = time.perf_counter() - begun
        today = dt.date.today().isoformat()
        blocks[f"{name}: made"] = (
            f"*`python studies/measured.py {name}`, version {vibrissa.__version__}, {today}, "
            f"{took:.0f} s.*"
        )
        if chosen.page:
            put(PAGES, blocks)
            if name == "rod":
                save(rod.picture(), DOCS / "images" / "convergence.png")
        for title, block in blocks.items():
            print(f"\n{title}\n{block}", flush=True)


if __name__ == "__main__":
    main()
