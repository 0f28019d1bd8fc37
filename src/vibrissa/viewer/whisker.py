"""The sliders that change the whisker."""

from __future__ import annotations

import numpy as np

from vibrissa.quantities import quantity
from vibrissa.viewer.page import EXAGGERATION, Page, asked, put
from vibrissa.viewer.state import shape_of

_MM = quantity("length").display_factor
_GPA = 1e-9


class WhiskerControls:
    """Length, turn, taper, modulus, and how thick the whisker is drawn."""

    def __init__(self, page: Page) -> None:
        own = shape_of(page.original)
        gui = page.server.gui
        self.folder = gui.add_folder("Whisker")
        length, modulus = round(_MM * own.length, 2), _rounded(_GPA * own.modulus)
        turn, taper = round(float(np.rad2deg(own.turn)), 1), round(own.taper, 1)
        step = 10.0 ** (np.floor(np.log10(modulus)) - 3.0)
        with self.folder:
            self._length = gui.add_slider(
                "Length (mm)", round(0.5 * length, 2), round(1.5 * length, 2), 0.01, length
            )
            self._turn = gui.add_slider(
                "Curvature (°)",
                0.0,
                max(90.0, round(2.0 * turn)),
                0.1,
                turn,
                hint="Angle by which the tangent turns from base to tip at rest",
            )
            self._taper = gui.add_slider(
                "Base / tip radius",
                min(1.0, taper),
                max(30.0, taper),
                0.1,
                taper,
                hint="Taper: base radius over tip radius",
            )
            self._modulus = gui.add_slider(
                "Modulus (GPa)", _rounded(0.1 * modulus), _rounded(3.0 * modulus), step, modulus
            )
            self._thick = gui.add_slider(
                "Drawn × thick", 1.0, 20.0, 0.5, EXAGGERATION, hint="Affects the picture only"
            )
            self._reset = gui.add_button("Reset", hint="Restore the original whisker", color="blue")
        asked(self._length, lambda value: page.reshape(length=value / _MM))
        asked(self._turn, lambda value: page.reshape(turn=float(np.deg2rad(value))))
        asked(self._taper, lambda value: page.reshape(taper=value))
        asked(self._modulus, lambda value: page.reshape(modulus=value / _GPA))
        asked(self._thick, page.thicken)

        starts = (
            (self._length, length),
            (self._turn, turn),
            (self._taper, taper),
            (self._modulus, modulus),
        )

        @self._reset.on_click
        async def _(_: object) -> None:
            for slider, value in starts:
                put(slider, value)
            page.reshape(**vars(own))


def _rounded(value: float) -> float:
    """To four digits, however small: rubber has a thousandth of a hair's modulus."""
    return float(f"{value:.4g}")
