"""Run the examples and make the gallery's figures: ``python docs/make_gallery.py [NAME ...]``.

Each example is run as it stands, and its figure is written into ``docs/images/gallery``. Without
names all are run, which takes a minute or two.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from make_images import save_small
from PIL import Image

DOCS = Path(__file__).parent
EXAMPLES = DOCS.parent / "examples"


def main() -> None:
    """Run what the command line asks for."""
    names = sys.argv[1:] or sorted(file.stem for file in EXAMPLES.glob("*.py"))
    figures = DOCS / "images" / "gallery"
    figures.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            subprocess.run([sys.executable, EXAMPLES / f"{name}.py", folder], check=True)
            save_small(Image.open(Path(folder) / f"{name}.png"), figures / f"{name}.png")


if __name__ == "__main__":
    main()
