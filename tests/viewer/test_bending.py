"""Bending on the page without a page: what is drawn and said is what `deflect` says."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.viewer.bend import bend_drawing
from vibrissa.viewer.readout import number, of_deflection, symbol
from vibrissa.viewer.state import (
    Shape,
    begin,
    charted,
    envelope,
    link_of,
    loaded,
    moved,
    restored,
    shape_of,
    shaped,
    with_force,
    with_radius,
    with_whisker,
)

MM = 1e3


@pytest.fixture(scope="module")
def bend():
    return begin(vb.samples.gamma())


def said(html, name):
    """What stands in the cell of a quantity."""
    return html.split(f'data-quantity="{name}"')[1].split(">", 1)[1].split("<")[0]


def test_a_moved_point_bends_as_deflect_says(bend):
    point = np.array([24e-3, 11e-3, 2e-3])
    bent = moved(bend, point)
    truth = vb.deflect(bend.whisker, vb.PointContact(point))
    np.testing.assert_array_equal(bent.deflection.force, truth.force)
    signals = vb.base_signals(truth.force, truth.moment)
    html = of_deflection(bent.deflection)
    for name in ("Fx", "FT", "FD", "Mx", "MB", "MD"):
        assert said(html, name) == number(name, float(signals[name]))
    # The drawn whisker passes through the contact point.
    line = bent.held.centerline(2000) * MM
    tube = bend_drawing(bent, 1.0)["whisker"].vertices
    assert np.linalg.norm(line - point * MM, axis=1).min() < 0.02
    assert np.linalg.norm(tube - point * MM, axis=1).min() < 0.35  # nodes are 0.56 mm apart


def test_out_of_reach_holds_the_last_shape_and_says_why(bend):
    near = moved(bend, [24e-3, 11e-3, 0.0])
    for place, status in (
        ([10e-3, 30e-3, 0.0], vb.Status.BEYOND_FOLD),
        (1.02 * bend.whisker.centerline()[-1], vb.Status.BEYOND_TIP),
    ):
        far = moved(near, place)
        assert far.status is status
        assert far.held is near.deflection
        drawn = bend_drawing(far, 5.0)
        assert "ghost" in drawn
        assert "whisker" not in drawn
        np.testing.assert_allclose(
            drawn["ghost"].vertices, bend_drawing(near, 5.0)["whisker"].vertices
        )
        html = of_deflection(far.deflection)
        assert status.explanation in html
        assert status.advice in html
        assert said(html, "MB") == "–"
        assert moved(far, near.point).status.ok


def test_the_arrow_ends_at_the_contact_and_points_along_the_force(bend):
    drawn = bend_drawing(moved(bend, [24e-3, 11e-3, 3e-3]), 5.0)
    bent = vb.deflect(bend.whisker, vb.PointContact([24e-3, 11e-3, 3e-3]))
    arrow = drawn["force"]
    start, end = arrow.start[0], arrow.end[0]
    np.testing.assert_allclose(end, bent.contact_point * MM, atol=1e-9)
    along = (end - start) / np.linalg.norm(end - start)
    np.testing.assert_allclose(along, bent.force / np.linalg.norm(bent.force), atol=1e-9)


@pytest.mark.parametrize("kind", ["point", "peg", "force"])
def test_a_link_restores_the_load(bend, kind):
    chosen = loaded(moved(bend, [24e-3, 11e-3, 3e-3]), kind)
    if kind == "peg":
        chosen = with_radius(moved(chosen, chosen.origin, [0.0, 0.6, 0.8]), 1e-3)
    again = restored(bend, link_of(chosen))
    assert again.kind == kind
    np.testing.assert_allclose(again.deflection.force, chosen.deflection.force, rtol=1e-3)
    for nonsense in ({kind: "1,2"}, {"contact": "a,b,c"}, {"peg": "1,2,3,0,0,0,1"}):
        assert restored(bend, nonsense) is bend


def test_another_load_begins_where_the_last_one_acts(bend):
    point = moved(bend, [24e-3, 11e-3, 3e-3])
    force = loaded(point, "force")
    np.testing.assert_allclose(force.deflection.contact_point, point.point, atol=1e-8)
    np.testing.assert_allclose(force.deflection.force, point.deflection.force, rtol=1e-5)
    doubled = with_force(force, force.place, 2.0 * force.magnitude, force.direction)
    assert np.linalg.norm(doubled.deflection.force) == pytest.approx(2.0 * force.magnitude)
    peg = loaded(point, "peg")
    assert peg.status.ok
    assert "peg" in bend_drawing(peg, 5.0)
    # The contact lies on the peg, and the force is normal to it.
    away = np.asarray(peg.deflection.contact_point) - peg.origin
    assert np.linalg.norm(np.cross(away, peg.axis)) < 1e-7
    assert abs(peg.deflection.force @ peg.axis) < 1e-6 * np.linalg.norm(peg.deflection.force)
    assert loaded(peg, "point").status.ok


def test_a_peg_is_dragged_turned_and_thickened(bend):
    peg = loaded(moved(bend, [22e-3, 9e-3, 0.0]), "peg")
    up = moved(peg, peg.origin + np.array([0.0, 1e-3, 0.0]))
    assert up.status.ok
    assert np.linalg.norm(up.deflection.force) > np.linalg.norm(peg.deflection.force)
    turned = moved(up, up.origin, axis=[0.2, 0.0, 1.0])
    assert turned.status.ok
    thick = with_radius(up, 1e-3)
    assert thick.status.ok
    distance = np.linalg.norm(
        np.cross(np.asarray(thick.deflection.contact_point) - thick.origin, thick.axis)
    )
    radius = 1e-3 + bend.whisker.radius(float(thick.deflection.arc_length))
    assert distance == pytest.approx(radius, rel=1e-5)


def test_sliders_change_one_thing_each():
    whisker = vb.samples.gamma()
    own = shape_of(whisker)
    assert shaped(whisker, own) is whisker
    longer = shaped(whisker, Shape(1.2 * own.length, own.turn, own.taper, own.modulus))
    assert longer.length == pytest.approx(1.2 * own.length)
    assert shape_of(longer).turn == pytest.approx(own.turn)
    for turn in (0.0, 1.3):
        bent = shaped(whisker, Shape(own.length, turn, own.taper, own.modulus))
        assert shape_of(bent).turn == pytest.approx(turn, abs=1e-9)
    blunt = shaped(whisker, Shape(own.length, own.turn, 2.0, own.modulus))
    assert blunt.tip_radius == pytest.approx(whisker.base_radius / 2.0)
    stiff = shaped(whisker, Shape(own.length, own.turn, own.taper, 2.0 * own.modulus))
    point = vb.PointContact([24e-3, 11e-3, 0.0])
    before, after = vb.deflect(whisker, point), vb.deflect(stiff, point)
    np.testing.assert_allclose(after.force, 2.0 * before.force, rtol=1e-9)
    straight = vb.samples.straight()
    curved = shaped(straight, Shape(straight.length, 0.8, 15.0, 3e9))
    assert shape_of(curved).turn == pytest.approx(0.8)


def test_a_load_goes_along_when_the_whisker_grows(bend):
    own = shape_of(bend.whisker)
    grown = with_whisker(bend, shaped(bend.whisker, Shape(1.5 * own.length, *_rest(own))))
    np.testing.assert_allclose(grown.point, 1.5 * bend.point)
    # Forces go with 1 / L² at the same shape.
    np.testing.assert_allclose(grown.deflection.force, bend.deflection.force / 2.25, rtol=1e-6)


def _rest(shape):
    return shape.turn, shape.taper, shape.modulus


def test_the_envelope_encloses_the_cloud():
    chart = charted(vb.samples.curved())
    cloud, skin = 1e3 * chart.points, envelope(chart).triangles.reshape(-1, 3)
    centre = np.array([20.0, 5.0, 0.0])
    assert np.linalg.norm(cloud - centre, axis=1).max() < np.linalg.norm(
        skin - centre, axis=1
    ).max() * (1.0 + 1e-3)
    assert np.isfinite(skin).all()


def test_numbers_have_units_and_symbols_indices():
    assert number("MB", 1.8057e-6) == "1.806 µN·m"
    assert number("Fx", -6.31e-5) == "−63.10 µN"
    assert number("MD", np.pi / 2) == "90.00°"
    assert number("Fx", -0.0) == "0.000 µN"
    assert number("Fx", np.nan) == "–"
    assert number("force", 71.76e-3) == "71.76 mN"  # of a robot's wire
    assert symbol("Fx") == "F<sub>x</sub>"
    assert symbol("theta") == "θ"
