"""What results look like in a notebook and in a terminal."""

import re
import sys
import types
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import xarray as xr

import vibrissa as vb
from vibrissa.simulation import facing_peg, measure, simulate, sweep_past
from vibrissa.sketch import BENT, CONTACT, MOST_CURVES, MOST_POINTS, Mark, shown, symbol, views

WHISKER = vb.samples.gamma()


def paths(html, colour):
    """The paths of one colour, panel by panel, as lists of curves in pixels."""
    svg = re.search(r"<svg.*?</svg>", html, re.DOTALL)
    assert svg is not None
    elements = ET.fromstring(svg[0])
    found = [e.get("d") for e in elements if e.tag.endswith("path") and e.get("stroke") == colour]
    return [
        [
            np.array(re.findall(r"-?[\d.]+", part), float).reshape(-1, 2)
            for part in d.replace("h0", "").split("M")[1:]
        ]
        for d in found
    ]


@pytest.fixture(scope="module")
def bent():
    heights = np.linspace(-4e-3, 4e-3, 5)
    return vb.deflect(WHISKER, vb.PointContact([[25e-3, 0.0, z] for z in heights]))


def test_a_whisker_is_drawn_true_to_scale():
    top, front = paths(WHISKER._repr_html_(), BENT)
    line = WHISKER.centerline(81)
    for (curve,), axis in ((top, 1), (front, 2)):
        extent = np.ptp(curve, axis=0)
        np.testing.assert_allclose(
            extent[1] / extent[0], np.ptp(line[:, axis]) / np.ptp(line[:, 0]), atol=1e-3
        )
    assert top[0][0, 1] > top[0][-1, 1]  # the tip, at +y, is higher up on the page


def test_a_whisker_tells_its_size_and_material():
    html = WHISKER._repr_html_()
    for text in ("gamma", "40 mm", "100 µm", "6.667 µm", "3 GPa", "0.38"):
        assert text in html


def test_a_deflection_shows_every_shape_and_what_became_of_the_loads(bent):
    top, _ = paths(bent._repr_html_(), BENT)
    assert len(top) == 5
    assert "ok 5" in bent._repr_html_()
    many = vb.deflect(WHISKER, vb.PointForce(np.full(500, 30e-3), np.linspace(0, 1e-4, 500), 0.0))
    assert len(paths(many._repr_html_(), BENT)[0]) == MOST_CURVES


def test_without_an_answer_nothing_is_drawn_but_the_reason_is_told():
    lost = vb.deflect(WHISKER, vb.PointContact([[1.0, 0.0, 0.0]]))
    html = lost._repr_html_()
    assert "beyond the tip: the whisker is too short" in html
    assert "nan" not in html.lower()


def test_a_map_shows_where_contacts_are_and_their_signals():
    contact_map = vb.ContactMap.simulate(WHISKER, grid=False)
    html = contact_map._repr_html_()
    (top, _front) = paths(html, CONTACT)
    assert len(top) == MOST_POINTS
    for name in ("F_x", "F_T", "F_D", "M_x", "M_B", "M_D"):
        assert name in html


@pytest.mark.parametrize("whole", [False, True])
def test_estimates_show_points_and_their_uncertainty(bent, whole):
    noise = np.diag(np.repeat([1e-12, 4e-16], 3))
    if whole:
        found = vb.estimate_from_wrench(WHISKER, bent.force, bent.moment, noise=noise)
    else:
        contact_map = vb.ContactMap.simulate(WHISKER, grid=False)
        found = contact_map.estimate(vb.base_signals(bent.force, bent.moment), noise=noise)
    html = found._repr_html_()
    assert len(paths(html, CONTACT)[0]) == 5
    sigma = np.sqrt(np.einsum("nii->ni", found.covariance).max(axis=1))
    assert f"{1e3 * np.median(sigma):.4g} mm" in html
    assert "unique 5" in html
    # The first contacts, in a table: arc length, point, standard deviation, force.
    point, force = 1e3 * found.point[1], 1e6 * np.linalg.norm(found.contact_force[1])
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", html.split("s (mm)")[1].split("</table>")[0])
    row = cells[cells.index("1") :][:8]
    values = np.array([text.replace("−", "-") for text in row[1:7]], float)
    expected = [1e3 * found.arc_length[1], *point, 1e3 * sigma[1], force]
    np.testing.assert_allclose(values, expected, rtol=0.05, atol=2e-3)
    assert row[7] == "unique"
    assert not re.search(r"e[-−]\d", html.split("</svg>")[1] + str(found))


def test_a_recording_shows_what_it_holds():
    peg = facing_peg(WHISKER)
    motion = sweep_past(WHISKER, peg, duration=0.2, rate=100.0)
    seen = vb.show(measure(simulate(WHISKER, motion, peg)))
    assert "20 frames, 0.19 s, 100 a second" in repr(seen)
    assert "peg: origin (" in repr(seen)
    assert "quasi-static" in seen._repr_html_()
    assert len(paths(seen._repr_html_(), BENT)[0]) > 1


def test_verdicts_show_as_a_table():
    contact_map = vb.ContactMap.simulate(vb.Whisker.straight(40e-3), grid=False)
    found = vb.uniqueness(contact_map, triplets=["Fx MB MD"], regions=["all"], samples=256)
    seen = vb.show(found)
    assert "<th" in seen._repr_html_()
    assert "Fx MB MD" in seen._repr_html_()
    assert "The triplet to use: (Fx, MB, MD)" in repr(seen)


def test_what_shows_itself_is_shown_as_it_is():
    assert vb.show(WHISKER)._repr_html_() == WHISKER._repr_html_()
    assert repr(vb.show(WHISKER)) == repr(WHISKER)


@pytest.mark.parametrize("thing", [3, xr.Dataset({"x": 1})])
def test_other_things_are_refused(thing):
    with pytest.raises(ValueError, match=type(thing).__name__):
        vb.show(thing)


def test_names_are_escaped():
    whisker = vb.Whisker.straight(40e-3, name="<b>&")
    assert "&lt;b&gt;&amp;" in whisker._repr_html_()


def test_numbers_and_symbols():
    assert shown("r", [1e-3, np.nan, 3e-3]) == "2 mm (1 to 3)"
    assert shown("theta", -np.pi / 2) == "−90°"
    assert shown("force", np.nan) == "–"
    assert [symbol(name) for name in ("Fx", "theta")] == ["F_x", "θ"]


def test_nothing_known_gives_no_picture():
    assert views([Mark(np.full((3, 3), np.nan), BENT)]) == ""


def test_what_is_printed_fits_a_terminal_and_tells_numbers(bent):
    text = str(bent)
    assert "ok 5" in text
    assert "µN·m" in text
    one = vb.deflect(WHISKER, vb.PointContact([60e-3, 0.0, 0.0]))
    assert "slipped off" in str(one)
    found = vb.estimate_from_wrench(WHISKER, bent.force, bent.moment)
    assert "friction angle" in str(found)
    for printed in (text, str(one), str(found)):
        assert max(map(len, printed.splitlines())) <= 80
    # A value that is the same but for rounding has no range.
    assert shown("force", [1e-4, 1.0000000001e-4]) == "100 µN"
    assert shown("force", [0.0, -1e-18, 1e-4]) == "0 µN (0 to 100)"
    assert shown("theta", [1e-13, -1e-10]) == "0°"
    # A wire's forces are not told in a million micronewtons.
    assert shown("force", [2.0, 4.0]) == "3000 mN (2000 to 4000)"


def test_one_contact_lists_its_candidates_and_many_the_first(bent):
    contact_map = vb.ContactMap.simulate(WHISKER, grid=False)
    signals = vb.base_signals(bent.force, bent.moment)
    noise = {"Fx": 1e-6, "FT": 1e-6, "MB": 2e-8}
    locate = vb.Estimator(contact_map, "Fx FT MB", noise=noise)
    one = locate([float(signals[name][0]) for name in noise])
    listed = str(one).split("probability\n")[1].splitlines()
    assert len(listed) == one.n_candidates == 2
    assert [float(line.split()[-1]) for line in listed] == pytest.approx(
        one.candidates.probability, abs=1e-3
    )
    assert "(25.000, 0.000, " in repr(one)
    twice = {name: np.tile(signals[name], 2) for name in noise}
    many = contact_map.estimate(twice, "Fx FT MB", noise=noise)
    assert str(many).splitlines()[-1].split() == ["…", "5", "more"]


def curves_in(figure, label):
    """Lines (n, 3) of one name, m."""
    lines = [one for one in figure.data if one.name == label]
    return [1e-3 * np.column_stack([one.x, one.y, one.z]) for one in lines]


def test_results_in_space(bent):
    pytest.importorskip("plotly")
    figure = vb.in_space(bent)
    (rest,) = curves_in(figure, "at rest")
    np.testing.assert_allclose(rest, WHISKER.centerline(101), atol=1e-9)
    np.testing.assert_allclose(curves_in(figure, "bent"), bent.centerline(101), atol=1e-9)
    (dots,) = (one for one in figure.data if one.name == "contacts")
    np.testing.assert_allclose(dots.z, 1e3 * bent.contact_point[:, 2], atol=1e-9)
    assert len(curves_in(vb.in_space(WHISKER), "at rest")) == 1
    with pytest.raises(ValueError, match="got float"):
        vb.in_space(1.0)


def test_a_recording_in_space():
    pytest.importorskip("plotly")
    peg = facing_peg(WHISKER)
    trial = simulate(WHISKER, sweep_past(WHISKER, peg, 0.1, seed=1), peg)
    figure = vb.in_space(trial)
    (dots,) = (one for one in figure.data if one.name == "true contacts")
    points = trial["truth"]["contact_point"].values[:, 0]
    points = points[np.isfinite(points).all(axis=1)]
    assert len(points) > 10
    np.testing.assert_allclose(np.column_stack([dots.x, dots.y, dots.z]), 1e3 * points, atol=1e-9)
    assert "peg, known" in [one.name for one in figure.data]


class Kernel:
    """A notebook's kernel, which keeps what was displayed."""

    kernel = True

    def __init__(self):
        self.shown = []

    def update(self, html):
        self.shown.append(html)


def test_progress_in_a_notebook_and_in_a_terminal(monkeypatch, capsys):
    kernel = Kernel()
    display = types.ModuleType("IPython.display")
    display.HTML, display.display = str, lambda html, display_id: kernel
    notebook = types.ModuleType("IPython")
    notebook.get_ipython = lambda: kernel
    with vb.progress() as bar:
        bar("<signals>", 1, 4)
        bar(3, 4)
    assert "<signals>" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "IPython", notebook)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    with vb.progress() as bar:
        bar("<signals>", 1, 4)
        bar(3, 4)
    first, second = kernel.shown[-1].split("<br>")
    assert 'value="1" max="4"' in first
    assert "&lt;signals&gt; 1/4" in first
    assert second.endswith("done 3/4")


def test_what_a_session_prints_is_short():
    contact_map = vb.ContactMap.simulate(WHISKER, grid=False)
    locate = vb.Estimator(contact_map, "MD Fx MB", noise={"Fx": 1e-6, "MB": 2e-8, "MD": 0.1})
    nothing = vb.deflect(WHISKER, vb.PointContact(np.zeros((0, 3))))
    assert repr(locate) == f"<Estimator from (MD, Fx, MB) of {WHISKER!r}>"
    assert repr(vb.ContactFilter(locate)) == f"<ContactFilter of {locate!r}>"
    assert repr(nothing) == "<Deflection of (0,) by PointContact: none>"
    assert len(repr(vb.sensors.Sensor())) < 120
