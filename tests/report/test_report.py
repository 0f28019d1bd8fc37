"""`vibrissa report`: what the page says is what the datasets hold, and it needs nothing else."""

import base64
import hashlib
import re
from functools import partial
from html.parser import HTMLParser

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa import __version__, plots
from vibrissa.cli import report as reporting
from vibrissa.cli.app import app
from vibrissa.cli.figures import dataset_with
from vibrissa.contacts import ContactMap
from vibrissa.io import load_recording, save_recording, video_info
from vibrissa.quantities import quantity
from vibrissa.recording import Recording
from vibrissa.report import document, figure_sections, movies_section, table, trial_sections
from vibrissa.report.page import Section, shown_value, with_sigma
from vibrissa.report.sections import (
    _settings,
    contacts_by_whisker,
    tracked_table,
    tracking_tables,
    whiskers_table,
)
from vibrissa.signals import SIGNALS
from vibrissa.status import describe

LINES = "Tracked and true lines"
VOID = {"meta", "br", "img", "path", "link", "input", "hr"}


class Page(HTMLParser):
    """What is in a page: tables by caption, attributes that load or lead somewhere, tags."""

    def __init__(self, text):
        super().__init__()
        self.tables, self.addresses, self.sheets, self.open = {}, [], [], []
        self.sections, self.images, self.scripts = [], [], 0
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        known = dict(attrs)
        for name in ("src", "href", "data", "poster", "srcset", "action", "xlink:href"):
            if name in known:
                self.addresses.append((tag, name, known[name]))
        if tag == "section":
            self.sections.append(known["id"])
        if tag == "img":
            self.images.append(known)
        self.scripts += tag == "script"
        if tag == "table":
            self.rows, self.caption = [], ""
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.handle_endtag(tag)

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open[-1] == tag, f"</{tag}> closes <{self.open[-1]}>"
        self.open.pop()
        if tag == "table":
            self.tables[self.caption] = self.rows

    def handle_data(self, data):
        if self.open and self.open[-1] == "style":
            self.sheets.append(data)
        elif "caption" in self.open:
            self.caption += data
        elif self.open and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data


def run(*words):
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.exception
    return result.stdout


def fault(*words):
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert isinstance(result.exception, ValueError | OSError), result.exception
    return str(result.exception)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A simulated trial with all groups, and the map of its whisker."""
    path = tmp_path_factory.mktemp("report")
    run("simulate", "--duration", 0.5, "--rate", 250, "--seed", 2, "-o", path / "trial.nc")
    whisker = Recording(load_recording(path / "trial.nc")).whisker()
    ContactMap.simulate(whisker, grid=False, cells=(8, 16, 8)).save(path / "map.nc")
    (path / "bare.nc").write_bytes((path / "trial.nc").read_bytes())
    run("signals", path / "trial.nc")
    run("estimate", path / "trial.nc")
    run("reconstruct", path / "trial.nc")
    return path


@pytest.fixture(scope="module")
def written(folder):
    """The page of the trial; figures are small."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOURCE_DATE_EPOCH", "1700000000")
        patch.setattr(plots, "png", partial(plots.png, dots=40.0))
        patch.setattr("vibrissa.scene.solids._SHAPE", (12, 24, 8))
        words = (folder / "trial.nc", "--map", folder / "map.nc")
        assert "wrote" in run("report", *words, "--seed", 3)
    return folder / "trial.html"


@pytest.fixture(scope="module")
def map_page(folder):
    """The page of the map, with verdicts, and the words that make it; few and small figures."""
    contact_map = ContactMap.load(folder / "map.nc")
    verdicts = vb.uniqueness(
        contact_map, [("Fx", "MB", "MD"), ("FT", "FD", "MD")], ["all", "ELD"], samples=64
    )
    vb.identifiability.save_uniqueness(verdicts, folder / "uniqueness.nc")
    words = (folder / "map.nc", "--uniqueness", folder / "uniqueness.nc")
    drawn = reporting.figures.drawn

    def few(drawings, tell):
        return drawn(dict(list(drawings.items())[::5]), tell)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reporting.figures, "drawn", few)
        patch.setenv("SOURCE_DATE_EPOCH", "1700000000")
        patch.setattr(plots, "png", partial(plots.png, dots=40.0))
        patch.setattr("vibrissa.scene.solids._SHAPE", (12, 24, 8))
        run("report", *words, "-o", folder / "map.html")
        yield folder / "map.html", words


def number(cell):
    """The first number of a cell."""
    return float(re.match(r"[−\d.e+]+", cell)[0].replace("−", "-"))


def nothing_is_loaded(page):
    for tag, name, address in page.addresses:
        assert address.startswith(("data:", "#")), (tag, name, address[:80])
        assert (tag, name) in {("img", "src"), ("a", "href"), ("video", "src")}
    for sheet in page.sheets:
        assert "@import" not in sheet
        assert "http" not in sheet


def test_the_page_is_whole_and_loads_nothing(written):
    text = written.read_text(encoding="utf-8")
    assert len(text.encode()) < 15e6
    page = Page(text)
    assert not page.open
    nothing_is_loaded(page)
    assert "default-src 'none'" in text
    assert page.sections[:2] == ["results", "picture"]
    assert page.sections[-3:] == ["recording", "settings", "provenance"]
    wanted = {"signals", "estimates", "contour", "events", "statuses", "figures", "provenance"}
    assert wanted <= set(page.sections)
    assert len(page.sections) == len(set(page.sections))
    assert len(page.images) >= 6
    for image in page.images:
        assert image["alt"]
        png = base64.b64decode(image["src"].removeprefix("data:image/png;base64,"), validate=True)
        assert png.startswith(b"\x89PNG")


def test_numbers_are_those_of_the_recording(written, folder):
    tables = Page(written.read_text(encoding="utf-8")).tables
    trial = load_recording(folder / "trial.nc")
    found, truth, fit = (trial[name].to_dataset() for name in ("estimates", "truth", "contour"))
    away = (found["contact_point"] - truth["contact_point"]).transpose(..., "space").values
    size = 1e3 * np.linalg.norm(away, axis=-1)
    size = size[np.isfinite(size)]
    row = tables["Error of the contact point"][-1]
    assert row[0] == "3D error"
    assert int(row[1]) == size.size
    expected = [np.median(size), np.quantile(size, 0.95), size.max()]
    shown = [number(cell) for cell in row[2:5]]
    np.testing.assert_allclose(shown, expected, rtol=5e-3)  # three digits
    classes = tables["Error in space by deflection angle"][1:]
    assert sum(int(row[1]) for row in classes) == size.size

    counts = dict(tables["Contacts"])
    assert int(counts["frames in contact"]) == int(truth["in_contact"].sum())
    assert int(counts["contacts detected"]) == int(found["in_contact"].sum())

    rows = {row[0]: row for row in tables[f"The fitted {fit.attrs['shape']}"]}
    sigma = np.sqrt(np.diag(fit["parameter_covariance"].values))
    names = list(fit["parameter"].values)
    assert number(rows["diameter"][1]) == pytest.approx(
        2e3 * float(fit["object_radius"]), rel=5e-4
    )  # four digits
    uncertainty = rows["diameter"][2]
    last_digit = 10.0 ** -len(re.match(r"[\d]+\.(\d+)", uncertainty)[1])
    assert number(uncertainty) == pytest.approx(
        2e3 * sigma[names.index("radius")], abs=0.5 * last_digit
    )
    x = 1e3 * float(fit["object_position"].sel(space="x"))
    assert number(rows["origin, x"][1]) == pytest.approx(x, rel=5e-4)

    heading, *rows = tables["Number of frames"]
    for column, name in enumerate(heading[1:], 1):
        data = trial if name == "recording" else trial[name]
        expected = describe(data["status"].values)
        assert {r[0]: int(r[column]) for r in rows if int(r[column])} == dict(expected)


@pytest.mark.parametrize("lost", ["force", "contact_point_whisker"])
def test_errors_that_cannot_be_computed_are_named(folder, lost):
    """Of a film the truth may be known in part; sections are not left out in silence."""
    trial = load_recording(folder / "trial.nc")
    trial["truth"] = trial["truth"].to_dataset().drop_vars(lost)
    parts = {part.name: part.body for part in trial_sections(trial)}
    stated = "Errors cannot be computed: the truth in this recording lacks"
    assert f"{stated} {lost}" in parts["signals"]
    assert (f"{stated} {lost}" in parts["estimates"]) == (lost == "contact_point_whisker")


def test_errors_of_signals_are_shares_of_the_truth(folder):
    trial = load_recording(folder / "trial.nc")
    # All forces a tenth too large and moments exact.
    truth = trial["truth"].to_dataset()
    wrong = trial["signals"].to_dataset().assign(force=1.1 * truth["force"], moment=truth["moment"])
    trial["signals"] = xr.DataTree(wrong)
    parts = {part.name: part.body for part in trial_sections(trial)}
    _, *rows = Page(parts["signals"]).tables["Error of force and moment, median"]
    assert rows
    for row in rows:
        assert row[2:] == ["10 %", "0 %", "10 %", "0 %"]
    _, *six = Page(parts["signals"]).tables["Error of the six signals"]
    assert [row[0] for row in six] == [quantity(name).long_name for name in SIGNALS]
    touching = (truth["in_contact"] & wrong["in_contact"]).values[:, 0].astype(bool)
    fx = 1e6 * np.abs(truth["force"].values[touching, 0, 0])
    assert number(six[0][2]) == pytest.approx(0.1 * np.median(fx), rel=6e-3)
    assert number(six[0][5]) == pytest.approx(np.median(fx), rel=6e-3)
    for row in six[2:]:  # neither directions nor moments have changed
        assert number(row[4]) == pytest.approx(0.0, abs=1e-9)


def test_errors_of_lines_are_distances_from_the_true_ones():
    x = np.linspace(0.0, 1.0, 11)
    frames = np.array([0.0, 1e-3, 2e-3])

    def lines(name, dim, aside, dims):
        curve = np.stack([x, 0.0 * x, 0.0 * x][: 2 if dims == "image_axis" else 3], axis=-1)
        curve = np.repeat(curve[None], 3, axis=0)
        curve[..., 1] += aside[:, None]
        return xr.DataArray(curve, dims=("time", dim, dims), name=name)

    away = 1e-3 * np.array([1.0, 2.0, 3.0])
    tracked, truth = (
        xr.Dataset(
            {
                "centerline": lines("centerline", dim, aside, "space"),
                "trace": lines("trace", dim, 1e3 * aside, "image_axis").expand_dims(view=["top"]),
                "in_contact": ("time", [True, True, False]),
                "contact_point": (("time", "space"), np.zeros((3, 3))),
            },
            {"time": frames},
        )
        for dim, aside in (("node", away), ("true_node", 0.0 * away))
    )
    rows = {row[0]: row[1:] for row in Page(tracking_tables(tracked, truth)).tables[LINES]}
    assert rows["centreline"] == ["2 mm", "3 mm"]
    assert rows["trace, top view"] == ["2 px", "3 px"]


def test_points_that_lie_on_a_bent_whisker_are_on_it():
    """Its nodes are farther apart than what was traced, and chords between them cut its bend."""

    def arc(nodes, dim):
        turn = np.linspace(0.0, 2.0, nodes)
        curve = 0.02 * np.stack([np.sin(turn), 1.0 - np.cos(turn)], axis=-1)
        data = {
            "centerline": (("time", dim, "space"), np.insert(curve, 2, 0.0, axis=-1)[None]),
            "trace": (("view", "time", dim, "image_axis"), 2e4 * curve[None, None]),
            "in_contact": ("time", [True]),
            "contact_point": (("time", "space"), np.zeros((1, 3))),
        }
        return xr.Dataset(data, {"view": ["top"], "time": [0.0]})

    tracked, truth = arc(101, "node"), arc(33, "true_node")
    # What hides the end of the whisker is traced, and is not seen.
    tracked["trace"][..., 90:, :] += 50.0
    tracked["trace_visible"] = ("view", "time", "node"), (np.arange(101) < 90)[None, None]
    _, *rows = Page(tracking_tables(tracked, truth)).tables[LINES]
    assert [row[0] for row in rows] == ["trace, top view", "centreline"]
    for row, radius in zip(rows, (400.0, 20.0), strict=True):  # pixels, mm
        sagitta = radius * (1.0 - np.cos(1.0 / 32))
        assert all(number(cell) < 0.05 * sagitta for cell in row[1:])


def two_whiskers(**groups):
    """Force on two whiskers; the second touches in two of three frames."""
    force = np.zeros((3, 2, 3))
    force[1:, 1, 0] = [3e-6, -4e-6]
    root = xr.Dataset(
        {"force": (("time", "whisker", "space"), force)},
        {"whisker": ["C1", "C2"], "time": [0, 1, 2]},
    )
    return xr.DataTree.from_dict({"/": root} | groups)


def test_whiskers_that_touch_are_listed():
    touching = xr.Dataset({"in_contact": (("whisker", "time"), [[False] * 3, [False, True, True]])})
    trial = two_whiskers(truth=touching)
    np.testing.assert_array_equal(contacts_by_whisker(trial), [0, 2])
    text = whiskers_table(trial, 0)
    assert "of whisker C1, number 0" in text
    assert Page(text).tables["Whiskers that touch"][1:] == [["C2", "1", "2", "4 µN"]]
    bare = two_whiskers()
    np.testing.assert_array_equal(contacts_by_whisker(bare), [0, 0])
    assert "None of the 2 whiskers" in whiskers_table(bare, 0)


def test_tracking_is_summarised_without_the_truth():
    root = xr.Dataset(
        {
            "in_contact": ("time", [False, True, True]),
            "base_position": (("time", "space"), [[0.0] * 3, [0.0] * 3, [np.nan] * 3]),
            "force": (("time", "space"), [[1.0, 0, 0], [1e-6, 0, 0], [0, 3e-6, 0]]),
            "contact_covariance": (
                ("time", "space", "space_2"),
                np.eye(3) * np.array([[[9.0]], [[1e-10]], [[1e-10]]]),
            ),
        }
    )
    rows = dict(Page(tracked_table(root)).tables["By the rod that fits the images"])
    assert rows["of these in contact"] == "2"
    assert rows["lost"] == "1"
    assert rows["force, in contact"] == "2 µN, up to 3 µN"
    assert rows["standard deviation of the contact point"].startswith("0.0173 mm")


def test_numbers_are_in_units_that_can_be_read():
    assert shown_value("force", 2e-6) == "2 µN"
    assert shown_value("force", 4.0) == "4000 mN"
    assert shown_value("force", 40.0) == "40 N"
    assert shown_value("moment", -3e-15) == "below 0.00001 µN·m"
    assert shown_value("r", np.nan) == "–"
    noise = {"noise": [1e-6, 1e-6, 1e-6, 1e-8, 2e-8, 2e-8]}
    said = _settings(two_whiskers(signals=xr.Dataset(attrs=noise)))
    assert "force 1 µN each; moment 0.01 µN·m, 0.02 µN·m, 0.02 µN·m" in said


def test_where_it_comes_from(written, folder):
    tables = Page(written.read_text(encoding="utf-8")).tables
    files = {row[0]: row[2] for row in tables["Files that were read"]}
    for name in ("trial.nc", "map.nc"):
        digest = hashlib.sha256((folder / name).read_bytes()).hexdigest()
        assert files[str(folder / name)] == f"SHA-256 {digest}"
    versions = dict(tables["Versions"])
    assert versions["vibrissa"] == __version__
    assert versions["numpy"] == np.__version__
    facts = dict(tables[""])
    assert facts["made"] == "2023-11-14 22:13:20 UTC"
    assert facts["seed"].startswith("3")


@pytest.mark.slow
def test_the_same_command_gives_the_same_page(map_page):
    path, words = map_page
    before = path.read_bytes()
    run("report", *words, "-o", path, "--force")
    assert path.read_bytes() == before


def test_a_page_is_replaced_only_if_asked_and_its_date_is_a_number(map_page, folder, monkeypatch):
    path, words = map_page
    assert "is there already" in fault("report", *words, "-o", path)
    monkeypatch.setattr(reporting.figures, "drawn", lambda drawings, tell: [])
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "yesterday")
    text = fault("report", folder / "map.nc", "-o", folder / "same.html")
    assert "'yesterday'" in text


def test_a_map_with_verdicts(map_page, folder):
    contact_map = ContactMap.load(folder / "map.nc")
    verdicts = dataset_with(folder / "uniqueness.nc", "verdict")
    page = Page(map_page[0].read_text(encoding="utf-8"))
    nothing_is_loaded(page)
    heading, *rows = page.tables["Verdicts by region"]
    assert heading == ["triplet", "all", "ELD", "in short", "twins"]
    for row in rows:
        cell = verdicts.sel(triplet=row[0])
        assert row[-2] == str(cell.notation.item())
        if str(cell.verdict.sel(region="all").item()) == "not unique":
            cone = np.rad2deg(float(cell.critical_cone.sel(region="all")))
            assert row[1] == f"≥{np.floor(10.0 * cone) / 10.0:.1f}°"  # a lower bound
    for row in page.tables["Farthest pairs of contacts with the same signals"][1:]:
        apart = float(verdicts["witness_separation"].sel(triplet=row[0]).max())
        assert number(row[2]) == pytest.approx(1e3 * apart, abs=1e-3)
    samples = contact_map.to_dataset()
    assert page.sections[0] == "results"
    unique = int((verdicts["verdict"].sel(region="all") == "unique").sum())
    assert f"<b>{unique} of {verdicts.sizes['triplet']}</b>" in map_page[0].read_text("utf-8")
    ranges = {row[0]: row[1:] for row in page.tables["Ranges over all contacts of the map"]}
    most = number(ranges["bending moment (µN·m)"][1])
    assert most == pytest.approx(1e6 * float(samples["MB"].max()), rel=1e-3)


def test_what_is_missing_is_named_with_the_verb_that_makes_it(folder):
    bare = load_recording(folder / "bare.nc")
    del bare["moment"].attrs["units"]
    save_recording(folder / "bare.nc", bare)
    with pytest.warns(UserWarning, match="states no units of moment") as notes:
        text = run("report", folder / "bare.nc", "-o", folder / "bare.html")
    assert len(notes) == 1
    assert "no signals" in text
    page = (folder / "bare.html").read_text(encoding="utf-8")
    for verb in ("signals", "estimate", "reconstruct"):
        assert f"<code>vibrissa {verb}</code> adds it" in page
    assert "contour" not in Page(page).sections
    recording = load_recording(folder / "trial.nc")
    groups = {g.path: g.to_dataset(inherit=False) for g in recording.subtree}
    blind = {path: data for path, data in groups.items() if path != "/truth"}
    save_recording(folder / "blind.nc", xr.DataTree.from_dict(blind))
    sections = trial_sections(load_recording(folder / "blind.nc"))
    assert [part.name for part in sections] == [
        "results",
        "recording",
        "settings",
        "contour",
        "events",
        "statuses",
    ]
    assert "no ground truth" in sections[2].body
    assert "tests tracking" not in sections[3].body
    blind["/contour"] = blind["/contour"].assign_attrs(source="contact point")
    tracked = {part.name: part.body for part in trial_sections(xr.DataTree.from_dict(blind))}
    assert "this tests tracking and inversion" in tracked["contour"]


def test_without_the_drawing_library_the_picture_in_space_is_left_out(folder, monkeypatch):
    monkeypatch.setattr("vibrissa.report.space.find_spec", lambda name: None)
    monkeypatch.setattr(reporting.figures, "drawn", lambda drawings, tell: [])
    text = run("report", folder / "map.nc", "-o", folder / "flat.html")
    assert "vibrissa[report]" in text
    page = Page((folder / "flat.html").read_text(encoding="utf-8"))
    assert "space" not in page.sections
    assert page.scripts == 0


def test_wrong_input_is_refused(folder):
    table_file = folder / "table.csv"
    table_file.write_text("x,y,z\n0,0,0\n")
    assert "recording of a trial or a map" in fault("report", table_file)
    assert "does not exist" in fault("report", folder / "none.nc").replace(
        "there is no", "does not exist"
    )
    assert "--video" in fault(
        "report", folder / "map.nc", "--video", table_file, "-o", folder / "x.html"
    )
    assert "--uniqueness" in fault(
        "report", folder / "trial.nc", "--uniqueness", folder / "map.nc", "-o", folder / "x.html"
    )
    assert ".html" in fault("report", folder / "map.nc", "-o", folder / "report.pdf")
    assert not (folder / "x.html").exists()


def test_movies_are_embedded_as_far_as_there_is_room(tmp_path):
    small, large = tmp_path / "a <b>.mp4", tmp_path / "large.mp4"
    small.write_bytes(bytes(range(100)))
    large.write_bytes(bytes(3000))
    page = Page(movies_section([large, small], tmp_path, 1000).body)
    (_, _, link), (tag, _, address) = page.addresses
    assert link == "large.mp4"
    assert tag == "video"
    data = address.removeprefix("data:video/mp4;base64,")
    assert base64.b64decode(data) == small.read_bytes()


@pytest.mark.slow
def test_movies_are_made_and_put_into_the_page(folder, tmp_path, monkeypatch):
    """Of two frames; what is drawn in them is tested with the movies."""
    recording = load_recording(folder / "trial.nc")
    touching = int(recording["truth"]["in_contact"].values[:, 0].argmax())
    few = slice(touching, touching + 2)
    groups = {
        group.path: data.isel(time=few) if "time" in data.dims else data
        for group in recording.subtree
        for data in [group.to_dataset(inherit=False)]
    }
    save_recording(tmp_path / "short.nc", xr.DataTree.from_dict(groups))
    monkeypatch.setattr(reporting.figures, "drawn", lambda drawings, tell: [])
    words = ("report", tmp_path / "short.nc", "--map", folder / "map.nc", "--make-movies")
    run(*words, "-o", tmp_path / "short.html")
    page = Page((tmp_path / "short.html").read_text(encoding="utf-8"))
    assert page.sections.index("movies") < page.sections.index("recording")
    films = [address for tag, _, address in page.addresses if tag == "video"]
    for name, film in zip(("contour", "signals"), films, strict=True):
        path = tmp_path / f"short-{name}.mp4"
        data = film.removeprefix("data:video/mp4;base64,")
        assert base64.b64decode(data) == path.read_bytes()
        assert video_info(path).frames == 2
    assert (tmp_path / "short.html").stat().st_size < 15e6

    # Where there is no room left, they lie beside the page.
    monkeypatch.setattr(reporting, "_LARGEST", 0)
    given = ("--movie", tmp_path / "short-signals.mp4")
    run("report", folder / "map.nc", *given, "-o", tmp_path / "linked.html")
    page = Page((tmp_path / "linked.html").read_text(encoding="utf-8"))
    assert ("a", "href", "short-signals.mp4") in page.addresses
    assert "video" not in [tag for tag, _, _ in page.addresses]


def test_text_cannot_become_markup():
    evil = '<script>alert("1")</script>&'
    parts = [
        Section("a", evil, table([(evil, evil)], ("b", evil), evil, evil)),
        *figure_sections({evil: b"png"}),
    ]
    text = document(evil, evil, parts)
    assert "<script" not in text
    page = Page(text)
    assert page.tables[evil] == [["b", evil], [evil, evil]]


def test_it_shows_itself_in_a_browser(written, browser):
    page = browser.new_page()
    said, asked = [], []
    page.on("console", lambda message: said.append((message.type, message.text)))
    page.on("pageerror", lambda error: said.append(("error", str(error))))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(written.as_uri())
    page.wait_for_selector("#space-picture canvas", timeout=30_000)
    assert not [text for kind, text in said if kind == "error"]
    others = {url.split(":")[0] for url in asked} - {"data", "blob"}
    assert others == {"file"}
    assert sum(url.startswith("file:") for url in asked) == 1
    box = page.locator("#space-picture .gl-container").first.bounding_box()
    assert box is not None
    assert box["width"] > 300
    for width in (1280, 390):  # on a phone, too
        page.set_viewport_size({"width": width, "height": 800})
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        shown = "[...document.images].every((image) => image.getBoundingClientRect().right <= "
        assert page.evaluate(f"{shown}window.innerWidth)")
    page.close()


def test_a_value_has_the_decimals_that_its_error_determines():
    assert with_sigma("object_radius", 1.34927e-3, 3.52e-6) == ("1.3493 mm", "0.0035 mm")
    assert with_sigma("object_radius", 2.7e-3, 7.1e-6) == ("2.7000 mm", "0.0071 mm")
    assert with_sigma("object_radius", 12.3456e-3, 1.3e-3) == ("12.3 mm", "1.3 mm")
    assert with_sigma("object_radius", 1.34927e-3, 0.0)[0] == "1.349 mm"  # exact
