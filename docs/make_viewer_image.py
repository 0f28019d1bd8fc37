"""Make the picture of the viewer anew: ``python docs/make_viewer_image.py [FILE]``.

The file is ``docs/images/viewer.png`` by default. The page is opened in Chromium, without a window,
by Playwright (extra ``test``).
"""

import io
import shutil
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

import vibrissa as vb
from vibrissa.viewer import view

CONTACT = (24e-3, 3e-3, 4e-3)
TRIPLET = "Fx FT MB"
WINDOW = {"width": 1280, "height": 800}
FINE = 2  # pixels of the screen a pixel of the picture, which makes edges smooth
DRAWN = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def picture() -> bytes:
    """What is seen of a contact that three signals do not locate, as PNG."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    with view(vb.samples.gamma()) as viewer, sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=DRAWN)
        page = browser.new_page(viewport=WINDOW, device_scale_factor=FINE)
        page.set_default_timeout(120e3)  # what is drawn by software is slow
        page.goto(viewer.url)
        page.get_by_role("button", name="Locate").click()
        page.get_by_label("Signals").click()
        page.get_by_role("option", name=TRIPLET).click()
        viewer.put_contact(CONTACT)
        page.wait_for_timeout(6000)  # until everything is drawn
        page.evaluate(
            "document.querySelectorAll('.mantine-Notification-root').forEach(x => x.remove())"
        )
        page.wait_for_timeout(500)
        shown = page.screenshot()
        browser.close()
    return shown


def main() -> None:
    """Write the file."""
    target = Path(__file__).parent / "images" / "viewer.png"
    if len(sys.argv) > 1:
        target = Path(sys.argv[1])
    image = Image.open(io.BytesIO(picture())).convert("RGB").reduce(FINE)
    # 256 colours are enough for what is drawn and written.
    image.quantize(256, dither=Image.Dither.NONE).save(target, optimize=True)


if __name__ == "__main__":
    main()
