"""Tracking under other image conditions, one thing changed at a time, against the truth.

`python studies/image_conditions.py [WORD ...]`: of the cases of `imaging/cases.py` those whose name
has one of the words in it, by default all, some ten minutes on a free core. Results are kept in the
folder `output/image_conditions`, case by case: stopped, it continues from there; `--again` repeats
all.
`--page` writes the table into `docs/image-conditions.md`, else it is printed.
"""

import argparse
import json
import math
import re
from pathlib import Path
from typing import Any

from imaging.cases import CASES, Case
from imaging.scores import tracked
from pages import few, put, table

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "output" / "image_conditions"
HEAD = (
    "condition",
    "images lost, wrong",
    "trace, px",
    "contact right, %",
    "contact point, µm",
    "predicted by its covariance, µm",
    "errors, in sigmas",
    "length, %",
    "",
)


def kept(case: Case) -> Path:
    """File of the result of a case."""
    return FOLDER / f"{re.sub(r'[^a-zA-Z0-9]+', '-', case.name).strip('-')}.json"


def result(case: Case, again: bool) -> dict[str, Any]:
    """Result of one case, as it is kept or anew."""
    path = kept(case)
    if path.exists() and not again:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    found = tracked(case)
    FOLDER.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(found), encoding="utf-8")
    return found


def row(found: dict[str, Any]) -> list[str]:
    if "error" in found:
        return [
            found["name"],
            *["–"] * (len(HEAD) - 2),
            "refused: " + found["error"].split(": ", 1)[1],
        ]
    length = 100.0 * found["length"]
    return [
        found["name"],
        f"{found['lost']}, {found['wrong']} of {found['frames']}",
        spread(found["trace"], 1.0),
        few(100.0 * found["right"], 3),
        spread(found["contact"], 1e6),
        spread(found["claimed"], 1e6),
        few(found["over"]) if math.isfinite(found["over"]) else "–",
        f"{length:+.1f}".replace("-", "−"),
        # That nothing is stated about fur is noted of all.
        "; ".join(
            dict.fromkeys(short(r) for r in found["remarks"] if "wrench_scale_sigma" not in r)
        ),
    ]


def spread(values: list[float], scale: float) -> str:
    """Median, and 95 % in brackets."""
    if not values:
        return "–"
    median, most = (few(scale * value) for value in values)
    return f"{median} ({most})"


def short(remark: str) -> str:
    """What a remark is about."""
    for words, about in (
        ("out of step", "noted: out of step"),
        ("does not explain", "noted: misfit"),
        ("too faint", "noted: tip not seen"),
        ("nor is it bent", "noted: tip not seen"),
        ("does not show its base", "noted: base not seen"),
        ("its base is seen", "noted: views disagree"),
        ("its shapes in the", "noted: free shapes differ"),
        ("not sure where", "noted: contact not seen"),
        ("was found (to within", "noted: offset found"),
    ):
        if words in remark:
            return about
    return remark


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("words", nargs="*", metavar="WORD")
    parser.add_argument("--again", action="store_true", help="do anew what was done before")
    parser.add_argument("--kept", action="store_true", help="only what is done already")
    parser.add_argument("--page", action="store_true", help="write the table into the page")
    chosen = parser.parse_args()
    wanted = [c for c in CASES if not chosen.words or any(w in c.name for w in chosen.words)]
    rows = []
    for case in wanted:
        if chosen.kept and not kept(case).exists():
            continue
        rows.append(row(result(case, chosen.again)))
        print(" | ".join(rows[-1]), flush=True)
    if chosen.page:
        put(ROOT / "docs" / "image-conditions.md", {"image conditions": table(HEAD, rows)})


if __name__ == "__main__":
    main()
