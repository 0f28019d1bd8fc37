"""Contacts of digitised whiskers found again; the whiskers are not part of the repository."""

import sys
from pathlib import Path

from pages import table

import vibrissa as vb

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from acceptance_real_whiskers import Found, examine

CONTACTS = {False: 20_000, True: 5000}


def blocks(folder: Path, quick: bool) -> dict[str, str]:
    """All whiskers of a folder, contacts spread and crowded; some minutes."""
    files = sorted(path for path in folder.glob("*.csv") if path.stem != "index")
    whiskers = [vb.load_whisker(path) for path in (files[:3] if quick else files)]
    cells = []
    for crowded, number in CONTACTS.items():
        count = number // 20 if quick else number
        cells.append(summed([examine(one, one.name, count, crowded) for one in whiskers]))
    names = [name for name, _ in cells[0]]
    rows = [[name, *(dict(column)[name] for column in cells)] for name in names]
    head = [
        f"{len(whiskers)} whiskers",
        "uniform up to the fold",
        "near the fold: 0.9 to 1 − 10⁻⁸ of the fold force, a quarter at the tip",
    ]
    return {"real": table(head, rows)}


def summed(found: list[Found]) -> list[tuple[str, str]]:
    """Over all whiskers."""

    def total(name: str) -> int:
        return sum(getattr(one, name) for one in found)

    least = min(1.0 - one.missed / one.contacts for one in found)
    return [
        ("contacts", f"{total('contacts'):,}"),
        (
            "found (p to 10⁻⁹ L, M to 10⁻⁶ or, at the fold, the stable side)",
            share(1.0 - total("missed") / total("contacts")),
        ),
        ("on the whisker with the fewest", share(least)),
        ("reported as slipped", str(total("slipped"))),
        (
            "points 10⁻⁴, 10⁻³, 10⁻² L beyond the fold that get another status",
            f"{total('fold_wrong')} of {total('fold_asked'):,}",
        ),
        ("the same beyond the tip", f"{total('tip_wrong')} of {total('tip_asked'):,}"),
    ]


def share(value: float) -> str:
    return f"{100 * value:.4f} %"
