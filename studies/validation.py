"""Validation with friction and inertia: contacts from the true wrench with noise.

`python studies/validation.py [FOLDER]`; with `--quick` one short trial of each kind, with
`--no-video` nothing is filmed. Recordings and results are kept in the folder (`output/validation`
by default), condition by condition: stopped, it goes on from there. `--again` computes the results
anew from the recordings; remove the folder to simulate, film and track anew. `--page` writes the
tables into the pages `docs/validation*.md`, else they are written to the folder.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from friction_inertia.conditions import CONDITIONS, FAST, Condition, Recorded, recorded
from friction_inertia.figure import draw
from friction_inertia.methods import METHODS, RUBBING, chart, located, scored, sensed, truth_of
from friction_inertia.summaries import summary
from friction_inertia.tables import TABLES, write
from friction_inertia.video import cutoffs, paper_test, tracked_scores
from pages import save

from vibrissa.recording import Recording

TRIALS = 3
ROOT = Path(__file__).parent.parent


def from_wrench(trials: list[Recorded]) -> dict[str, Any]:
    """All methods, placed by the true pose."""
    rows: dict[str, list[Any]] = {method: [] for method in (*METHODS, *RUBBING)}
    for trial in trials:
        truth, contacts = truth_of(trial.true), chart(Recording(trial.true).whisker())
        wrench = sensed(trial.true, bool(trial.condition.of))
        for method, done in rows.items():
            found = located(method, wrench, contacts)
            done.append(scored(found, truth, truth.pose, trial.true))
    return {"true": {method: summary(done) for method, done in rows.items()}}


def from_video(trials: list[Recorded]) -> dict[str, Any]:
    """All methods, placed by tracked poses; and what video alone gives."""
    out: dict[str, Any] = {}
    for method in METHODS:
        placed = [tracked_scores(trial, method) for trial in trials]
        for pose in placed[0]:
            out.setdefault(pose, {})[method] = summary([one[pose] for one in placed])
    return out | {"paper": paper_test(trials), "cutoffs": cutoffs(trials)}


def results_of(
    condition: Condition, counts: tuple[int, int], duration: float, folder: Path, again: bool
) -> dict[str, Any]:
    """Of one condition, so many trials and so many of these filmed.

    What is in the folder is not computed again.
    """
    path = folder / f"{condition.name}.json"
    kept = json.loads(path.read_text()) if path.exists() and not again else {}
    for part, count in zip((from_wrench, from_video), counts, strict=True):
        about = [count, duration]
        if count == 0 or kept.get(part.__name__) == about:
            continue
        video = part is from_video
        trials = [recorded(condition, seed, duration, folder, video) for seed in range(count)]
        print(f"{condition.label}: {count} trials", flush=True)
        kept |= {part.__name__: about} | part(trials)
        path.write_text(json.dumps(kept, indent=1))
    return kept


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "output" / "validation")
    parser.add_argument("--quick", action="store_true", help="one trial of 0.4 s of each kind")
    parser.add_argument("--no-video", action="store_true", help="true pose only")
    parser.add_argument("--again", action="store_true", help="new results from old recordings")
    parser.add_argument("--trials", type=int, default=TRIALS, help="trials of each kind")
    parser.add_argument("--page", action="store_true", help="write the documentation's tables")
    chosen = parser.parse_args()
    folder = chosen.folder / "quick" if chosen.quick else chosen.folder
    folder.mkdir(parents=True, exist_ok=True)
    most, duration = (1, 0.4) if chosen.quick else (chosen.trials, 1.0)

    def results(condition: Condition, count: int) -> dict[str, Any]:
        filmed = 0 if chosen.no_video else min(most, condition.filmed)
        return results_of(condition, (count, filmed), duration, folder, chosen.again)

    found = {one.name: results(one, most) for one in CONDITIONS}
    found[FAST.name] = results(FAST, 0)
    for name, make in TABLES.items():
        print(f"\n{name}\n{make(found)}")
    page = ROOT / "docs" / "validation.md" if chosen.page else None
    if page is not None:
        write([page, page.with_name("validation-tables.md")], found)
    images = folder if page is None else page.parent / "images"
    save(draw(found), images / "validation.png")


if __name__ == "__main__":
    main()
