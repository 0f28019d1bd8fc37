"""Check that texts are plain scientific English: ``python .ci/words.py``.

Looks for the words and phrases of `INSTEAD` in code, documentation and examples, and prints what to
write in their place. Lines that match one of `ALLOWED` are left alone.
"""

import re
import sys
from pathlib import Path

INSTEAD = {
    r"felt|feels?": "measured, detected; has the signals",
    r"tells|told|said|says": "states, reports, shows",
    r"beside": "next to, compared with, in addition to",
    r"parted by": "separated by",
    r"hang(s)? together": "are related",
    r"knows of": "contains, has",
    r"goes with": "corresponds to",
    r"(is|are) off by|\d+ [mµ]?m,? off": "has an error of",
    r"as surely as|how surely": "confidence, probability",
    r"(is|are|was|were) no (?!longer|more|less|better|worse|\w+er )": "is not a",
    r"the paper's ways?": "the paper's method",
    r"honest test": "validation with friction and inertia",
    r"light touch(es)?": "light contact",
}
"""Patterns, and what is written instead."""

ALLOWED = (
    r"[Tt]here (is|are|was|were) no ",
    r"^- An honest test of contact points",  # the name that a page once had
)
"""Lines in which a pattern may occur."""

FOLDERS = ("src", "docs", "examples", "studies", "README.md", "CONTRIBUTING.md", "mkdocs.yml")
ENDINGS = {".py", ".md", ".csv", ".toml", ".yml"}


def main() -> int:
    """Print each line with such a word; one if there are any."""
    root = Path(__file__).resolve().parents[1]
    odd = {re.compile(rf"\b({words})\b", re.IGNORECASE): why for words, why in INSTEAD.items()}
    allowed = re.compile("|".join(ALLOWED))
    # Not by git: continuous integration checks a copy that is no repository.
    paths = [path for name in FOLDERS for path in sorted([root / name, *(root / name).rglob("*")])]
    listed = [path for path in paths if path.suffix in ENDINGS and path.is_file()]
    found = 0
    for path in listed:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            for pattern, instead in odd.items():
                if (hit := pattern.search(line)) and not allowed.search(line):
                    print(f"{path.relative_to(root)}:{number}: {hit[0]!r}; write: {instead}")
                    found += 1
    print(f"{found} odd words in {len(listed)} files")
    return int(found > 0)


if __name__ == "__main__":
    sys.exit(main())
