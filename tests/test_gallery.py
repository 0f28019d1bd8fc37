"""The gallery shows every example, and every example has its figure there."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted(file.stem for file in (ROOT / "examples").glob("*.py"))
LARGEST = 100_000


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_gallery_shows_the_example_and_its_figure(name):
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    assert f"--8<--\n    {name}.py\n" in page
    assert f"(images/gallery/{name}.png)" in page
    assert (ROOT / "docs" / "images" / "gallery" / f"{name}.png").stat().st_size < LARGEST
