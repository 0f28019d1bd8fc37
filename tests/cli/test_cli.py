"""The command line: each verb does its stage, and a fault is one message."""

import io
import sys

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa import samples
from vibrissa.cli.app import app, main
from vibrissa.cli.options import numbers
from vibrissa.cli.terminal import fixed, print_table, say, shown
from vibrissa.io import load_contacts, save_centerline, save_signals, write_table


def run(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def fault(monkeypatch, capsys, *arguments):
    """What is said, on one line, where the command fails."""
    monkeypatch.setattr(sys, "argv", ["vibrissa", *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    return said.err


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("cli")


@pytest.fixture(scope="module")
def chart(folder):
    path = folder / "map.nc"
    run("map", "--no-grid", "-o", path)
    return path


@pytest.fixture(scope="module")
def table(folder):
    """Signals of a few contacts, one of no contact and one missing."""
    path = folder / "signals.csv"
    points = [[25e-3, 12e-3, 1e-3], [27e-3, 2e-3, -2e-3], [0, 0, 0], [0, 0, 0]]
    bent = vb.deflect(samples.gamma(), vb.PointContact(points[:2]))
    force, moment = np.zeros((2, 4, 3))
    force[:2], moment[:2] = bent.force, bent.moment
    force[3] = np.nan
    import xarray as xr

    signals = {"force": (("time", "space"), force), "moment": (("time", "space"), moment)}
    save_signals(path, xr.Dataset(signals, {"time": np.arange(4.0)}))
    return path, np.array(points)


def test_where_to_write_is_asked_first(folder, table, monkeypatch, capsys):
    monkeypatch.setattr(vb.ContactMap, "simulate", None)
    for verb, said in (
        (("map", "-o", folder), "is a folder"),
        (("map", "-o", folder / "a.csv"), "ends in .csv; .nc"),
        (("map", "-o", folder / "none" / "a.nc"), "none does not exist"),
        (("estimate", table[0], "-o", folder / "a.nc"), "ends in .nc; .csv is needed"),
        (("demo", "-o", table[0]), "is a file; the name of a folder is needed"),
    ):
        assert said in fault(monkeypatch, capsys, *verb)


def test_estimate_refuses_millinewtons(folder, table, chart, monkeypatch, capsys):
    from vibrissa.io import load_signals

    path = folder / "millinewtons.csv"
    signals = load_signals(table[0])
    save_signals(path, signals.assign({n: signals[n] * 1e3 for n in ("force", "moment")}))
    said = fault(monkeypatch, capsys, "estimate", path, "--map", chart, "-o", folder / "c.csv")
    assert "millinewtons.csv: the force reaches" in said
    assert "multiply by 1e-3" in said


def test_deflect_prints_what_deflect_gives():
    text = run("deflect", "--point", "25,12,1")
    bent = vb.deflect(samples.gamma(), vb.PointContact([25e-3, 12e-3, 1e-3]))
    signals = vb.base_signals(bent.force, bent.moment)
    for name in signals:
        assert fixed(str(name), float(signals[name])) in text
    assert str(vb.Status.OK) in text


def test_deflect_by_force_and_by_peg():
    text = run("deflect", "--point-force", "25,50,90")
    assert "25.0000 mm" in text
    assert "OK" not in text
    away = CliRunner().invoke(app, ["deflect", "--peg", "-5,20,0,2.7"])
    assert away.exit_code == 1
    assert away.stdout.splitlines()[0] == str(vb.Status.NO_CONTACT)
    assert "nan" not in away.output
    text = run("deflect", "--peg", "25,8,0,2.7", "--push", "0,1,0")
    assert str(vb.Status.OK) in text


def test_map_and_estimate(folder, chart, table):
    path, points = table
    out = folder / "contacts.csv"
    text = run("estimate", path, "--map", chart, "-o", out)
    assert "wrote" in text
    contacts = load_contacts(out)
    names = [vb.Status(int(code)).name for code in contacts["status"].values]
    assert names == ["UNIQUE", "UNIQUE", "NO_CONTACT", "MISSING"]
    for i, axis in enumerate("xyz"):
        np.testing.assert_allclose(contacts[axis].values[:2], points[:2, i], atol=1e-9)
        assert (contacts[f"sigma_{axis}"].values[:2] > 0.0).all()
    assert np.isnan(contacts["x"].values[2:]).all()


def test_the_candidates_of_ambiguous_rows_are_in_a_second_table(folder, chart):
    there = np.array([0.0333006, 0.0003273, -0.0043394])
    bent = vb.deflect(samples.gamma(), vb.PointContact(there))
    signals = vb.base_signals(bent.force, bent.moment)
    names = ("FT", "FD", "MB")
    of_signals, of_wrench, out = (folder / f"{n}.csv" for n in ("triplet", "wrench", "several"))
    write_table(of_signals, ["time", *names], [[0.5, *(signals[n].item() for n in names)]])
    components = ["time", "Fx", "Fy", "Fz", "Mx", "My", "Mz"]
    write_table(of_wrench, components, [[0.5, *bent.force, *bent.moment]])
    for path in (of_signals, of_wrench):
        text = run(
            "estimate", path, "--map", chart, "--using", ",".join(names), "-o", out, "--force"
        )
        assert "several_candidates.csv" in text
        (time, number, *points) = np.loadtxt(
            folder / "several_candidates.csv", delimiter=",", skiprows=1
        ).T
        assert len(time) > 1
        assert (time == 0.5).all()
        assert number.tolist() == list(range(len(time)))
        away = np.linalg.norm(np.transpose(points) - there, axis=1)
        assert away.min() < 1e-6
        assert away.max() > 1e-3
    run("estimate", of_wrench, "--map", chart, "-o", out, "--force")  # all are unique now
    assert not (folder / "several_candidates.csv").exists()
    read = of_wrench.rename(folder / "several_candidates.csv")
    with pytest.raises(ValueError, match="is read, and would be replaced"):
        run("estimate", read, "--map", chart, "-o", out, "--force")


def test_signals_without_noise_are_not_compared_with_it(folder, chart, table):
    """A division by it would warn."""
    out = folder / "noiseless.csv"
    run("estimate", table[0], "--map", chart, "-o", out, "--force-noise", 0, "--moment-noise", 0)
    contacts = load_contacts(out)
    np.testing.assert_allclose(contacts["x"].values[:2], table[1][:2, 0], atol=1e-9)


def test_signals_that_cannot_locate_contacts_are_named_with_better_ones(folder):
    """As (Fx, MB, MD) of a wire of constant thickness."""
    wire = folder / "cylinder.nc"
    run("map", "--length", 40, "--base-radius", 0.1, "--tip-radius", 0.1, "--no-grid", "-o", wire)
    bent = vb.deflect(vb.ContactMap.load(wire).whisker, vb.PointContact([30e-3, 5e-3, 1e-3]))
    path = folder / "stamped.csv"
    numbers = ",".join(repr(float(x)) for x in (*bent.force, *bent.moment))
    names = [f"wrench.{kind}.{axis}" for kind in ("force", "torque") for axis in "xyz"]
    path.write_text(f"stamp,{','.join(names)}\n1700000000.25,{numbers}\n")
    assert "from 1700000000 to 1700000000 s" in run("info", path)
    out = folder / "cylinder.csv"
    text = run("estimate", path, "--map", wire, "-o", out)
    assert "--using FT,MB,MD" in text
    text = run("estimate", path, "--map", wire, "--using", "FT,MB,MD", "-o", out, "--force")
    assert "do not determine" not in text
    few = folder / "six.csv"
    few.write_text("# of today\nFx_uN,FT_uN,MB_uNm,MD_deg\n" + 12 * "-100,50,2,45\n")
    text = run("estimate", few, "--map", wire, "-o", folder / "cylinder-six.csv")
    assert "--using FT,MB,MD" in text
    assert "noise 1 µN and 0.02 µN·m" in text
    assert "numbered from 0" in text
    assert "apart" not in text
    found = load_contacts(out)
    assert found["time"].item() == 1700000000.25
    assert found["x"].item() == pytest.approx(30e-3, abs=1e-6)


def test_estimate_from_more_signals_and_from_all(folder, chart, table):
    path, points = table
    noise = folder / "noise.csv"
    np.savetxt(noise, np.diag(np.repeat([1e-12, 4e-16], 3)), delimiter=",")
    for i, options in enumerate(
        [
            ("--using", "Fx FT MB MD"),
            ("--using", "Fx,FT,FD,Mx,MB,MD", "--covariance", noise),
            ("--using", "wrench"),
            ("--using", "Fx,MB,MD"),
        ]
    ):
        out = folder / f"more{i}.csv"
        text = run("estimate", path, "--map", chart, *options, "-o", out)
        assert "wrote" in text
        contacts = load_contacts(out)
        names = [vb.Status(int(code)).name for code in contacts["status"].values]
        assert names == ["UNIQUE", "UNIQUE", "NO_CONTACT", "MISSING"]
        found = np.stack([contacts[axis].values[:2] for axis in "xyz"], axis=1)
        np.testing.assert_allclose(found, points[:2], atol=3e-7)
        assert np.isfinite(contacts["sigma_x"].values[:2]).all()
    # Of the built-in whisker; all six need no map.
    run("estimate", path, "--using", "wrench", "-o", folder / "no_map.csv")


def test_a_lookup_needs_a_map_with_a_grid(folder, table, chart, monkeypatch, capsys):
    there = ("estimate", table[0], "--map", chart, "-o", folder / "looked_up.csv")
    said = fault(monkeypatch, capsys, *there, "--method", "lookup")
    assert len(said.strip().splitlines()) == 1
    assert "has no grid to look up in" in said
    assert not (folder / "looked_up.csv").exists()


def test_estimate_without_a_map_simulates_one_and_says_so(folder, table):
    csv = folder / "whisker.csv"
    save_centerline(csv, samples.gamma().centerline(40))
    text = run("estimate", table[0], "--whisker", csv, "-o", folder / "other.csv")
    assert "no map given" in text
    assert load_contacts(folder / "other.csv").sizes["time"] == 4


@pytest.mark.slow
def test_demo_writes_and_reports(folder):
    out = folder / "demo"
    text = run("demo", "--output", out, "--no-tracking", "--duration", 0.4, "--rate", 250)
    for words in ("exactly one candidate", "3D error by deflection angle", "diameter", "median*"):
        assert words in text
    written = {file.name for file in out.iterdir()}
    assert {"trial.nc", "contacts.csv", "map.nc"} <= written
    assert {"trial.png", "contact_places.png", "contour.png", "signal_space.png"} <= written
    # Each stage works from the recording alone.
    again = folder / "again.csv"
    run("estimate", out / "trial.nc", "--map", out / "map.nc", "-o", again)
    first = load_contacts(out / "contacts.csv")
    same = load_contacts(again)
    single = first["status"].values == vb.Status.UNIQUE
    np.testing.assert_array_equal(first["x"].values[single], same["x"].values[single])
    assert "gamma" in run("deflect", "--whisker", out / "trial.nc", "--point", "25,12,1")
    assert "gamma" in run("deflect", "--whisker", out / "map.nc", "--point", "25,12,1")
    text = run("info", out / "trial.nc", "--all")
    assert "vibrissa recording" in text
    assert "/truth" in text


def test_info(folder, table, chart):
    text = run("info")
    assert vb.__version__ in text
    assert "threads" in text
    assert "table of signals" in run("info", table[0])
    brief = run("info", chart)
    assert "contact map" in brief
    assert f"next: vibrissa estimate SIGNALS.csv --map {chart}" in brief
    assert "/chart" in run("info", chart, "--all")
    csv = folder / "w.csv"
    save_centerline(csv, samples.gamma().centerline(40))
    assert "centreline of a whisker" in run("info", csv)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("deflect",), "one of --point, --point-force and --peg is needed; got none"),
        (
            ("deflect", "--point", "1,2,3", "--point-force", "1,2,3"),
            "got --point and --point-force",
        ),
        (("deflect", "--point", "1,2"), "X,Y,Z are needed"),
        (("deflect", "--whisker", "none.csv", "--point", "1,2,3"), "there is no file none.csv"),
        (("deflect", "--whisker", "C2", "--point", "1,2,3"), "no file C2; built-in whiskers are"),
        (("estimate", "none.csv"), "there is no file none.csv"),
        (("estimate", "none.csv", "--using", "Fx MB"), "at least 3 different signals"),
        (("estimate", "none.csv", "--method", "guess"), "is not one of"),
        (
            ("estimate", "none.csv", "--method", "lookup", "--using", "Fx,FT,MB,MD"),
            "--method lookup needs three signals; got 4",
        ),
        (
            ("estimate", "none.csv", "--method", "network", "--using", "wrench"),
            "no --method network",
        ),
        (("estimate", "none.csv", "--covariance", "no.csv"), "there is no file no.csv"),
        (("info", "none.nc"), "there is no file none.nc"),
        (("demo", "--whisker", "none.csv"), "there is no file none.csv"),
    ],
)
def test_a_fault_is_one_message_and_status_2(monkeypatch, capsys, arguments, message):
    assert message in fault(monkeypatch, capsys, *arguments)


def test_built_in_whiskers_have_names(folder, table, chart):
    """All verbs read --whisker in one way; a file of that name comes first."""
    targets = [folder / name for name in ("named.csv", "mapped.csv")]
    run("estimate", table[0], "--whisker", "gamma", "-o", targets[0])
    run("estimate", table[0], "--map", chart, "-o", targets[1])
    assert targets[0].read_text() == targets[1].read_text()
    assert "touches the side" in run("deflect", "--whisker", "straight", "--point", "24,8,1")


def test_files_of_the_wrong_kind(monkeypatch, capsys, folder, table, chart):
    assert "not a table of signals" not in run("info", table[0])
    bad = folder / "bad.csv"
    bad.write_text("time,Fx\n0,1\n")
    assert "lacks Fy" in fault(monkeypatch, capsys, "estimate", bad, "--map", chart)
    assert "not a table of a known kind" in fault(monkeypatch, capsys, "info", bad)
    few = folder / "few.csv"
    few.write_text("time,Fx_uN,MB_uNm,MD_deg\n0,-100,2,45\n")
    assert f"vibrissa estimate {few} --using Fx,MB,MD" in run("info", few).replace("\n", "")
    few.write_text("Fx_uN,MB_uNm,MD_deg\n" + 2 * "-100,2,45\n")
    assert "numbered from 0" in run("estimate", few, "--map", chart, "-o", folder / "few-out.csv")
    assert load_contacts(folder / "few-out.csv")["time"].values.tolist() == [0.0, 1.0]
    few.write_text("Fx_uN,MB_uNm,MD_deg\n" + 2 * "0,0,0\n" + 2 * "-100,2,45\n")
    run("estimate", few, "--map", chart, "-o", folder / "few-out.csv", "--force")
    onset = load_contacts(folder / "few-out.csv")["onset_time"].values[-1]
    assert 1.0 <= onset <= 2.0  # in numbers of rows, as the time
    few.write_text("FT_uN,MB_uNm,MD_deg\n100,2,45\n")
    named = fault(monkeypatch, capsys, "estimate", few, "--map", chart).replace("\n", " ")
    assert "use --using FT,MB,MD" in named
    both = ("--map", chart, "--whisker", table[0])
    assert "either --map" in fault(monkeypatch, capsys, "estimate", table[0], *both)
    triplet = ("--using", "Fx,MB")
    said = fault(monkeypatch, capsys, "estimate", table[0], "--map", chart, *triplet)
    assert "Error" in said


def test_info_refuses_a_camera_without_a_focal_length(monkeypatch, capsys, tmp_path):
    camera = "[cam_0]\nname = 'top'\nsize = [64, 48]\nrotation = [0, 0, 0]\n"
    camera += "translation = [0, 0, 100]\nmatrix = [[0, 0, 32], [0, 100, 24], [0, 0, 1]]\n"
    path = tmp_path / "cameras.toml"
    path.write_text(camera, encoding="utf-8")
    assert "focal lengths are 0 and 100" in fault(monkeypatch, capsys, "info", path)
    path.write_text(camera.replace("[[0, 0, 32]", "[[100, 0, 32]"), encoding="utf-8")
    assert "64 × 48 pixels, perspective" in run("info", path)


def test_numbers_and_units():
    assert shown("r", 1.5e-4, 3) == "0.15 mm"
    assert shown("theta", np.pi / 6) == "30°"
    assert fixed("Fx", -1e-15) == "0.0000 µN"
    assert numbers("1,-2.5", "AB", "--ab") == [1.0, -2.5]
    with pytest.raises(ValueError, match="A,B are needed"):
        numbers("1,x", "AB", "--ab")


def test_names_with_brackets_are_printed_as_they_are(monkeypatch, capsys, tmp_path):
    """Brackets are the marks of whoever draws tables; names of files and channels have them too."""
    folder = tmp_path / "d["
    folder.mkdir()
    path = folder / "]sensor[bold].toml"
    path.write_text(
        'channels = ["[/] a"]\nmixing = [[0, 0, 0, 0, 21.0, 1.5]]\nnoise = 2e-3\n', encoding="utf-8"
    )
    assert "[/] a" in run("info", path)
    none = folder / "[" / "]none.csv"
    assert str(none) in fault(monkeypatch, capsys, "info", none)


def test_info_says_what_settings_are_for_and_what_is_wrong_with_them(monkeypatch, capsys, tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(run("sweep", "--example"), encoding="utf-8")
    assert "a study, for vibrissa sweep" in run("info", path)
    path.write_text(run("simulate", "--example"), encoding="utf-8")
    assert "vibrissa simulate" in run("info", path)
    path.write_text("channels = [", encoding="utf-8")
    said = fault(monkeypatch, capsys, "info", path)
    assert f"{path}: it is not TOML" in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("terminal", [True, False])
def test_lines_are_broken_between_words_in_a_terminal_alone(monkeypatch, terminal):
    seen = io.StringIO()
    console = Console(file=seen, force_terminal=terminal, color_system=None, width=20)
    monkeypatch.setattr("vibrissa.cli.terminal.output", console)
    line = "  12 frames: nothing is touched, in /a/path/that/is/longer.nc"
    say(line)
    broken = ["  12 frames: nothing", "  is touched, in", "  /a/path/that/is/longer.nc"]
    assert seen.getvalue().splitlines() == (broken if terminal else [line])


def test_titles_may_be_wider_than_their_table(capsys):
    title, caption = "the error of all contacts, in a title", "and a caption as wide as that title"
    print_table(["of"], [["r"]], title, caption)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].rstrip() == title
    assert lines[-1].rstrip() == caption
