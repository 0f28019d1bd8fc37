"""Mode Bend: a whisker bent by a dragged contact, a peg or a force, and controls of its shape."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from vibrissa import scene
from vibrissa.numerics import Array
from vibrissa.quantities import quantity, to_display
from vibrissa.sketch import round_step
from vibrissa.viewer import readout, state
from vibrissa.viewer.page import EXAGGERATION, Mode, Page, asked, put, show
from vibrissa.viewer.stage import triple
from vibrissa.whisker import Whisker

NODES = 48
_AXES = np.array([(190, 60, 60), (70, 140, 70), (70, 90, 190)], dtype=np.uint8)
# Start of the ruler, over its length: below the contacts, away from other labels.
_ASIDE = np.array([0.0, -0.15, -0.55])
_ARROW = 0.3  # length of the arrow of a force of EI/L², over L; lengths vary as the square root


def whisker_body(
    whisker: Whisker,
    line: Array,
    exaggeration: float,
    colour: scene.Colour = readout.WHISKER,
    opacity: float | None = None,
) -> scene.Body:
    """Body of a whisker along a centreline (n, 3), m, with its thickness exaggerated."""
    radius = whisker.radius(np.linspace(0.0, whisker.length, len(line)))
    vertices, faces = scene.tube(mm(line), exaggeration * mm(radius))
    return scene.Body(vertices, faces, colour, opacity)


def follicle(whisker: Whisker, exaggeration: float) -> scene.Body:
    """Sleeve that marks the clamped base."""
    radius = 1.9 * exaggeration * whisker.base_radius
    depth = 0.06 * whisker.length
    middle = np.array([-0.5 * depth, 0.0, 0.0])
    vertices, faces = scene.cylinder(
        mm(middle), np.array([1.0, 0.0, 0.0]), _size(radius), _size(depth)
    )
    return scene.Body(vertices, faces, (196, 152, 132))


def axes(whisker: Whisker) -> dict[str, scene.Mark]:
    """Axes of the whisker frame at the base: x red, y green, z blue."""
    size = _size(0.14 * whisker.length)
    ends = size * np.eye(3)
    out: dict[str, scene.Mark] = {"axes": scene.Arrows(np.zeros((3, 3)), ends, _AXES, 0.05 * size)}
    out |= {f"axis {name}": scene.Label(1.12 * ends[i], name) for i, name in enumerate("xyz")}
    length = _size(whisker.length)
    return out | ruler(_ASIDE * length, length, length)


def ruler(start: Array, length: float, view: float) -> dict[str, scene.Mark]:
    """Ruler along x from a position (3,), over a length, for a view of a given width, mm."""
    step = round_step(length / 4.0)
    ticks = np.arange(0.0, length + 1e-9, step)
    at = start + ticks[:, None] * np.array([1.0, 0.0, 0.0])
    down = np.array([0.0, 0.0, -0.02 * view])
    pieces = np.concatenate([np.stack([at, at + down], axis=1), [[at[0], at[-1]]]])
    out: dict[str, scene.Mark] = {"ruler": scene.Line(pieces, readout.REST, 1.5)}
    for place, tick in zip(at[1:], ticks[1:], strict=True):
        unit = " mm" if tick == ticks[-1] else ""
        out[f"tick {tick:g}"] = scene.Label(place + 6.0 * down, f"{tick:g}{unit}")
    return out


def force_arrow(whisker: Whisker, force: Array, at: Array) -> dict[str, scene.Mark]:
    """Arrow of the force on a whisker, ending where it acts, with its magnitude."""
    size = float(np.linalg.norm(force))
    if not (np.isfinite(at).all() and size > 0.0):
        return {}
    reach = _ARROW * whisker.length * np.sqrt(size / state.force_scale(whisker))
    start = at - reach * force / size
    colours = np.array([readout.FORCE], dtype=np.uint8)
    thickness = _size(0.006 * whisker.length)
    return {
        "force": scene.Arrows(mm(start)[None], mm(at)[None], colours, thickness),
        "force size": scene.Label(mm(start), readout.number("force", size, 3)),
    }


def bend_drawing(bend: state.Bend, exaggeration: float) -> scene.Drawing:
    """Draw whisker, load and force; without an equilibrium, the last shape is drawn transparent."""
    whisker, held, ok = bend.whisker, bend.held, bend.status.ok
    out = dict(resting(whisker, exaggeration))
    line = held.centerline(NODES)
    if ok:
        out["whisker"] = whisker_body(whisker, line, exaggeration)
        out |= force_arrow(whisker, np.asarray(held.force), np.asarray(held.contact_point))
    else:
        out["ghost"] = whisker_body(whisker, line, exaggeration, readout.GHOST, 0.4)
        out |= _missed(bend)
    if bend.kind == "peg":
        # A line is drawn with a visible thickness.
        radius = max(bend.radius, 0.004 * whisker.length)
        peg = mm(bend.origin), bend.axis, _size(radius), _size(0.8 * whisker.length)
        out["peg"] = scene.Body(*scene.cylinder(*peg), readout.OBJECT, 0.8)
    elif ok:
        at = triple(mm(held.contact_point))
        out["contact"] = replace(_ball(whisker, exaggeration), position=at)
    return out


@lru_cache(maxsize=4)
def resting(whisker: Whisker, exaggeration: float) -> dict[str, scene.Mark]:
    """Draw the parts that do not change while a whisker is bent."""
    return {
        "follicle": follicle(whisker, exaggeration),
        **axes(whisker),
        "rest": whisker_body(
            whisker, whisker.centerline(NODES), 0.7 * exaggeration, readout.REST, 0.35
        ),
    }


@lru_cache(maxsize=4)
def _ball(whisker: Whisker, exaggeration: float) -> scene.Body:
    """Ball that marks the contact, larger than the whisker."""
    own = float(whisker.radius(0.5 * whisker.length))
    radius = max(1.7 * exaggeration * own, 0.006 * whisker.length)
    vertices, faces = scene.ellipsoid(np.zeros(3), _size(radius) * np.eye(3), 12)
    return scene.Body(vertices, faces, readout.CONTACT)


def _missed(bend: state.Bend) -> dict[str, scene.Mark]:
    """Line from the last contact to the requested one, with the reason why it is not reached."""
    last = np.asarray(bend.held.contact_point)
    out: dict[str, scene.Mark] = {}
    if np.isfinite(last).all() and bend.kind == "point":
        out["missed"] = scene.Line(mm(np.stack([last, bend.point])[None]), readout.GHOST)
    words = bend.status.explanation.split(":")[0].rstrip(".")
    lift = np.array([0.0, 0.0, 0.05 * bend.whisker.length])
    return {**out, "reason": scene.Label(mm(bend.target + lift), words)}


def mm(values: object) -> Array:
    """Lengths in mm."""
    return to_display("length", np.asarray(values, dtype=np.float64))


def _size(length: float) -> float:
    return float(to_display("length", length))


_MM = quantity("length").display_factor
_UN = quantity("force").display_factor
_HELD = "The whisker is in stable equilibrium."


class BendMode(Mode):
    """Mode with the controls of a load, and the bent whisker."""

    name = "Bend"
    layers = ("bend", "reachable")

    def __init__(self, page: Page) -> None:
        gui = page.server.gui
        super().__init__(page, gui.add_folder("Load", visible=False))
        self._clouded: state.Chart | None = None
        self._shown_kind: state.Kind | None = None
        bend = page.bend
        length = page.original.length
        with self._folder:
            self._kind = gui.add_dropdown(
                "Load",
                state.KINDS,
                hint="What bends the whisker: a point, a straight peg, or a force",
            )
            self._target = gui.add_vector3(
                "Position (mm)", triple(_MM * bend.point), step=0.05, hint="Drag the ball, or type"
            )
            self._radius = gui.add_slider(
                "Radius (mm)", 0.0, _MM * 0.08 * length, 0.01, bend.radius, visible=False
            )
            self._place = gui.add_slider(
                "At s / L", 0.05, 1.0, 0.005, bend.place, visible=False, hint="Along the whisker"
            )
            self._size = gui.add_slider(
                "Force (µN)",
                0.0,
                round(3.0 * _UN * state.force_scale(page.original), 1),
                0.1,
                round(_UN * bend.magnitude, 1),
                visible=False,
            )
            self._way = gui.add_slider(
                "Direction (°)",
                -180.0,
                180.0,
                1.0,
                0.0,
                visible=False,
                hint="About the whisker: 0° along its y at the base, 90° along z",
            )
            self._state = gui.add_html("")
            self._numbers = gui.add_html("")
        change = page.change
        asked(self._kind, lambda v: change("kind", partial(state.loaded, kind=v)))
        asked(self._target, lambda v: change("drag", partial(state.moved, to=np.array(v) / _MM)))
        asked(self._radius, lambda v: change("radius", partial(state.with_radius, radius=v / _MM)))
        for slider in (self._place, self._size, self._way):
            asked(slider, lambda _: self._pushed())

    def enter(self) -> None:
        """Show the controls, and point the cameras at the whisker."""
        super().enter()
        self._clouded = None
        self._page.face_whisker()

    def redraw(self) -> None:
        """Draw the whisker and its reachable space."""
        page, bend = self._page, self._page.bend
        page.stage.show("bend", bend_drawing(bend, page.exaggeration))
        if page.chart is not self._clouded:
            self._clouded = page.chart
            cloud = {} if page.chart is None else {"envelope": state.envelope(page.chart)}
            page.stage.show("reachable", cloud)

    def write(self, brief: bool = False) -> None:
        """Show signals, contact and position of the load."""
        bend = self._page.bend
        show(self._state, readout.sentence(bend.status, _HELD if bend.kind == "force" else None))
        show(self._numbers, readout.numbers(bend.deflection))
        if brief:
            return
        self._target.visible = bend.kind != "force"
        self._radius.visible = bend.kind == "peg"
        self._place.visible = self._size.visible = self._way.visible = bend.kind == "force"
        if bend.kind != "force":
            put(self._target, triple(np.round(_MM * bend.target, 3)))
        if bend.kind != self._shown_kind:  # sliders are not set while they are being moved
            self._shown_kind = bend.kind
            put(self._kind, bend.kind)
            put(self._radius, round(_MM * bend.radius, 2))
            put(self._place, round(bend.place, 3))
            put(self._size, round(_UN * bend.magnitude, 1))
            put(self._way, round(np.rad2deg(bend.direction)))

    def _pushed(self) -> None:
        place, size, way = self._place.value, self._size.value / _UN, np.deg2rad(self._way.value)
        self._page.change("force", lambda bend: state.with_force(bend, place, size, way))


_GPA = 1e-9


class WhiskerControls:
    """Controls of length, turning angle, taper, modulus, and the drawn thickness of the whisker."""

    def __init__(self, page: Page) -> None:
        own = state.shape_of(page.original)
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
        page.reshaped = self._shown

        @self._reset.on_click
        async def _(_: object) -> None:
            self._shown(own)
            page.reshape(**vars(own))

    def _shown(self, shape: state.Shape) -> state.Shape:
        """Set the sliders to a shape within their ranges, and return the shape shown."""
        sliders = self._length, self._turn, self._taper, self._modulus
        values = _MM * shape.length, np.rad2deg(shape.turn), shape.taper, _GPA * shape.modulus
        length, turn, taper, modulus = (
            float(np.clip(value, slider.min, slider.max))
            for slider, value in zip(sliders, values, strict=True)
        )
        for slider, value in zip(sliders, (length, turn, taper, modulus), strict=True):
            put(slider, float(f"{value:.5g}"))
        return state.Shape(length / _MM, float(np.deg2rad(turn)), taper, modulus / _GPA)


def _rounded(value: float) -> float:
    """Round to four significant digits, as moduli range over orders of magnitude."""
    return float(f"{value:.4g}")
