"""What a whisker's file does not state, loads without an answer, and files that no verb takes."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa import samples
from vibrissa.cli.app import app
from vibrissa.io import load_centerline, load_recording, save_centerline, save_recording
from vibrissa.objects import Peg
from vibrissa.recording import Recording
from vibrissa.simulation import Motion, measure, simulate
from vibrissa.whisker import morphology

typer_testing = pytest.importorskip("typer.testing")


def ran(*words):
    return typer_testing.CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture
def centerline(tmp_path):
    save_centerline(tmp_path / "C2.csv", samples.gamma().centerline(30))
    return tmp_path / "C2.csv"


def test_a_load_without_an_answer_gives_its_status_and_no_numbers():
    result = ran("deflect", "--point", "10,60,1")
    assert result.exit_code == 1
    status = vb.deflect(samples.gamma(), vb.PointContact([10e-3, 60e-3, 1e-3])).status
    assert str(vb.Status(int(status))) in result.output
    assert "nan" not in result.output
    assert ran("deflect", "--point", "25,12,1").exit_code == 0


def test_advice_names_an_option_that_the_verb_has():
    result = ran("deflect", "--point", "8,1,0")
    assert result.exit_code == 1
    assert "The option is --proximal" in result.output
    assert ran("deflect", "--point", "8,1,0", "--proximal", "0.1").exit_code == 0


@pytest.mark.parametrize(
    "load",
    [("--point", "0.025,0.012,0.001"), ("--point-force", "0.02,50,90"), ("--peg", "0.02,.01,0,1")],
)
def test_metres_typed_for_mm_are_named(load):
    assert "Were metres meant?" in ran("deflect", *load).output
    assert "metres" not in ran("deflect", "--point", "25,12,1").output


def test_deflect_and_info_state_what_is_assumed(centerline):
    for words in (("deflect", "--whisker", centerline, "--point", "25,12,1"), ("info", centerline)):
        text = " ".join(ran(*words).output.split())
        for about in ("radius", "Young's modulus", "Poisson's ratio"):
            assert f"{about} assumed" in text, words


def test_what_is_assumed_survives_a_recording(centerline, tmp_path):
    whisker = vb.load_whisker(centerline)
    assert whisker.assumed == ("radius", "Young's modulus", "Poisson's ratio")
    still = Motion(np.arange(3) * 1e-3, *np.zeros((3, 3)), np.zeros((3, 3)))
    far = Peg([0.02, 0.02, 0.0], [0.0, 0.0, 1.0], 1e-3)
    save_recording(tmp_path / "t.nc", measure(simulate(whisker, still, far)))
    assert Recording(load_recording(tmp_path / "t.nc")).whisker().notes == whisker.notes
    text = " ".join(ran("info", tmp_path / "t.nc").output.split())
    for name in whisker.assumed:
        assert f"{name} assumed" in text
    text = ran(
        "estimate", tmp_path / "t.nc", "--using", "wrench", "-o", tmp_path / "found.nc"
    ).output
    assert "radius assumed" in " ".join(text.split())


def test_published_radii_on_the_command_line(centerline):
    text = ran("deflect", "--whisker", centerline, "--point", "25,12,1", "--rat", "C2").output
    radius = float(morphology.base_radius(3, 2, vb.load_whisker(centerline).length))
    assert f"radius {radius * 1e6:.1f} µm at the base" in text
    assert "published regressions" in text
    assert "radius assumed" not in text
    refused = ran("deflect", "--point", "25,12,1", "--rat", "C2")
    assert "needs a --whisker" in str(refused.exception)


def test_the_end_that_is_the_base_is_an_option(centerline):
    points = load_centerline(centerline)
    save_centerline(centerline.with_name("back.csv"), points[::-1])
    words = ("deflect", "--point", "25,12,1", "--whisker")
    given = ran(*words, centerline).output
    turned = ran(*words, centerline.with_name("back.csv"), "--base-end", "last").output
    table = given.index("┌"), turned.index("┌")
    assert given[table[0] : given.index("└")] == turned[table[1] : turned.index("└")]
    assert "--base-end last" in " ".join(given.split())
    assert "taken as the base" not in " ".join(turned.split())
    for whisker, reason in (((), "needs a --whisker"), (("--whisker", "gamma"), "built-in")):
        refused = ran("deflect", "--point", "25,12,1", *whisker, "--base-end", "last")
        assert reason in str(refused.exception)


def test_a_rod_longer_than_any_whisker_is_confirmed(tmp_path):
    x = np.linspace(0.0, 0.9, 12)
    save_centerline(tmp_path / "rod.csv", np.column_stack([x, 0.1 * x**2, 0 * x]))
    words = ("deflect", "--whisker", tmp_path / "rod.csv", "--point-force", "600,10,90")
    fault = str(ran(*words).exception)
    assert "millimetres given as metres" in fault
    assert "--any-length" in fault
    assert "any_length=True" in fault
    assert ran(*words, "--any-length").exit_code == 0
    long = ("map", "--length", "900", "-o", tmp_path / "no folder" / "map.nc")
    assert "the folder" in str(ran(*long, "--any-length").exception)
    assert "If a rod of this length is meant" in " ".join(
        ran("info", tmp_path / "rod.csv").output.split()
    )


def test_every_verb_that_reads_a_whisker_has_the_options_that_messages_name():
    readers = 0
    for verb in app.registered_commands:
        text = ran(verb.name, "--help").output
        if "--whisker " in text:
            readers += 1
            assert "--rat" in text, verb.name
            assert "--any-length" in text, verb.name
            assert "--base-end" in text, verb.name
    assert readers > 6


@pytest.mark.parametrize(
    "words",
    [
        "deflect --whisker M --point 25,12,1",
        "map --whisker M",
        "signals M",
        "estimate M",
        "reconstruct M",
        "report M",
        "figures M",
        "movie M",
        "view M",
        "stream M",
        "sensitivity M",
        "uniqueness M",
        "sweep M",
        "simulate --whisker M",
        "track M M --pixel-size 0.058 -o OUT.nc",
    ],
)
@pytest.mark.parametrize("head", [b"measv3\0\0", b"bwhiskbin1\0\0"])
def test_files_of_whisk_name_what_takes_them(tmp_path, monkeypatch, words, head):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "film.measurements"
    path.write_bytes(head + bytes(200))
    result = ran(*words.replace("M", str(path)).split())
    assert "vibrissa import" in str(result.exception)
