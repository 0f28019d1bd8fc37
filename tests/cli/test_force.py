"""No verb replaces a file that somebody may still want, unless it is told to."""

import numpy as np
import pytest
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa import samples
from vibrissa.cli.app import app
from vibrissa.io import load_recording, save_recording, save_signals, write_video
from vibrissa.simulation import facing_peg, measure, simulate, whisking


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A recording, a map, a table of signals and two videos."""
    path = tmp_path_factory.mktemp("force")
    whisker = samples.gamma()
    trial = measure(simulate(whisker, whisking(duration=0.3, rate=100.0), facing_peg(whisker)))
    save_recording(path / "in.nc", trial)
    vb.ContactMap.simulate(whisker, grid=False).save(path / "map.nc")
    save_signals(path / "signals.csv", trial.to_dataset().isel(whisker=0)[["force", "moment"]])
    for view in ("top", "front"):
        noise = np.random.default_rng(0).integers(0, 255, (3, 64, 64), dtype=np.uint8)
        write_video(path / f"{view}.mkv", iter(noise), 100.0)
    return path


VERBS = {
    "map": (("--no-grid", "-o", "out.nc"), "out.nc"),
    "uniqueness": (("map.nc", "-o", "out.csv"), "out.csv"),
    "sensitivity": (("map.nc", "-o", "out.nc"), "out.nc"),
    "simulate": (("-o", "out.nc"), "out.nc"),
    "simulate ": (("-o", "none.nc", "--film", "."), "top.mkv"),
    "track": (("top.mkv", "front.mkv", "-o", "out.nc"), "out.nc"),
    "import": (("tracks.csv", "-o", "out.nc"), "out.nc"),
    "export": (("in.nc",), "in.csv"),
    "calibrate": (("--pattern", "9x6", "--square", "5", "a.png", "-o", "c.toml"), "c.toml"),
    "signals": (("in.nc", "-o", "out.nc"), "out.nc"),
    "signals ": (("in.nc", "-o", "out.csv"), "out.csv"),
    "estimate": (("in.nc", "-o", "out.nc"), "out.nc"),
    "estimate ": (("signals.csv",), "contacts.csv"),
    "reconstruct": (("in.nc",), "in_contour.csv"),
    "reconstruct ": (("in.nc", "-o", "out.nc"), "out.nc"),
    "figures": (("map.nc", "-o", "."), "whisker.png"),
    "movie": (("in.nc", "-o", "."), "in-signals.mp4"),
    "report": (("in.nc", "-o", "out.html"), "out.html"),
}


def run(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.mark.parametrize("verb", VERBS)
def test_what_is_there_stays(folder, monkeypatch, verb):
    """And is named, before anything is computed."""
    words, name = VERBS[verb]
    monkeypatch.chdir(folder)
    there = folder / name
    ours = there.exists()
    if not ours:
        there.write_bytes(b"old")
    before = {file: file.read_bytes() for file in folder.iterdir()}
    done = run(verb.strip(), *words)
    assert isinstance(done.exception, FileExistsError), done.exception
    assert name in str(done.exception)
    assert "--force" in str(done.exception)
    assert {file: file.read_bytes() for file in folder.iterdir()} == before
    if not ours:
        there.unlink()


READ = {
    "estimate": (("signals.csv", "-o", "signals.csv"), "signals.csv"),
    "estimate ": (("in.nc", "--map", "map.nc", "-o", "map.nc", "--force"), "map.nc"),
    "estimate  ": (("contacts.csv", "--map", "map.nc", "--force"), "contacts.csv"),
    "uniqueness": (("map.nc", "-o", "./map.nc", "--force"), "map.nc"),
    "track": (("top.mkv", "front.mkv", "--cameras", "in.nc", "-o", "in.nc", "--force"), "in.nc"),
    "export": (("in.csv", "-o", "in.csv", "--force"), "in.csv"),
    "signals": (("in.nc", "--events", "in.nc", "--force"), "in.nc"),
}


@pytest.mark.parametrize("verb", READ)
def test_what_is_read_is_not_replaced_even_with_force(folder, monkeypatch, verb):
    """Measurements were replaced by the contacts that were estimated from them."""
    words, name = READ[verb]
    monkeypatch.chdir(folder)
    path = folder / name
    if not path.exists():
        path.write_bytes((folder / "signals.csv").read_bytes())
    before = path.read_bytes()
    done = run(verb.strip(), *words)
    assert isinstance(done.exception, ValueError), done.exception
    assert "is read, and would be replaced" in str(done.exception)
    assert path.read_bytes() == before


def test_a_stage_is_added_to_a_recording_that_also_states_the_object(folder, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "own.nc").write_bytes((folder / "in.nc").read_bytes())
    done = run("reconstruct", "own.nc", "--objects", "own.nc", "-o", "own.nc")
    assert "is read" not in str(done.exception)
    assert "contour" in load_recording(folder / "own.nc").children


def test_every_verb_that_writes_is_asked(folder):
    """The demo, a study and a batch go on with what they made; `stream` and `correct` add to it."""
    with_force = [
        command.name
        for command in app.registered_commands
        if "force" in command.callback.__annotations__
    ]
    assert {verb.strip() for verb in VERBS} == set(with_force) - {"sweep", "stream", "batch"}


def test_force_replaces(folder, tmp_path):
    out = tmp_path / "out.csv"
    out.write_text("old")
    done = run("signals", folder / "in.nc", "-o", out, "--force")
    assert done.exit_code == 0, done.exception
    assert f"wrote {out}" in done.stdout.replace("\n", "")
    assert out.read_text().startswith("time,")


def test_a_stage_is_added_where_the_recording_is(folder, tmp_path):
    """Without being told to, and saying so."""
    path = tmp_path / "trial.nc"
    path.write_bytes((folder / "in.nc").read_bytes())
    for _ in range(2):
        done = run("signals", path)
        assert done.exit_code == 0, done.exception
        assert f"added signals to {path}" in done.stdout.replace("\n", "")
    assert "signals" in load_recording(path).children
