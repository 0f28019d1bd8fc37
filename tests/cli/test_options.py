"""Options that would have no effect are refused before anything is computed."""

import pytest

import vibrissa as vb
from vibrissa.cli.app import app
from vibrissa.contacts import ContactMap
from vibrissa.io import save_recording
from vibrissa.objects import Peg
from vibrissa.pipeline import with_signals
from vibrissa.simulation import Motion, measure, simulate

typer_testing = pytest.importorskip("typer.testing")


def fault(*words):
    result = typer_testing.CliRunner().invoke(app, [str(word) for word in words])
    assert isinstance(result.exception, ValueError | OSError), result.output
    return str(result.exception)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A recording of a few frames of a sensor, a map, and files that only have to be there."""
    import numpy as np

    path = tmp_path_factory.mktemp("options")
    whisker = vb.Whisker.straight(length=30e-3)
    still = Motion(np.arange(3) * 1e-3, *np.zeros((3, 3)), np.zeros((3, 3)))
    far = Peg([0.02, 0.02, 0.0], [0.0, 0.0, 1.0], 1e-3)
    save_recording(path / "t.nc", with_signals(measure(simulate(whisker, still, far))))
    ContactMap.simulate(whisker, grid=False).save(path / "map.nc")
    (path / "sensor.toml").write_text("")
    (path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    for name in ("top.mkv", "front.mkv", "cameras.toml", "noise.csv"):
        (path / name).write_text("x")
    return path


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("signals t.nc --cutoff 0", "--cutoff cannot be used: signals of the sensor"),
        ("signals t.nc --whisker map.nc", "--whisker cannot be used: signals of the sensor"),
        (
            "estimate t.nc --using wrench --proximal 0.2",
            "--proximal cannot be used: --using wrench needs no map",
        ),
        ("estimate t.nc --covariance noise.csv --force-noise 2", "--force-noise cannot be used"),
        ("reconstruct t.nc --using wrench --proximal 0.2", "--proximal cannot be used"),
        ("reconstruct t.nc --cutoff 60", "--cutoff cannot be used"),
        ("signals t.nc --density 1200", "--density cannot be used: without --inertia"),
        ("deflect --point 25,12,1 --axis 0,0,1", "--axis cannot be used: they need a --peg"),
        ("deflect --point 25,12,1 --push 0,1,0", "--push cannot be used"),
        (
            "track top.mkv front.mkv --cameras cameras.toml --pixel-size 0.058 -o o.nc",
            "--pixel-size cannot be used: the --cameras determine it",
        ),
        ("calibrate a.png --pattern 9x6 --square 5 --frames 3 -o c.toml", "--frames cannot"),
        ("stream --sensor sensor.toml --using Fx,MB,MD", "--using cannot be used"),
        ("stream --sensor sensor.toml --moment-noise 0", "--moment-noise cannot be used"),
        ("stream noise.csv --topic wrench", "--topic cannot be used"),
        ("stream noise.csv --pose-topic tool", "--pose-topic cannot be used"),
        ("stream noise.csv --tare 10", "--tare cannot be used"),
        ("movie t.nc --kind contour --map map.nc", "--map cannot be used"),
        ("movie t.nc --kind signals --video top.mkv", "--video cannot be used"),
        ("figures map.nc --which 0", "--which cannot be used"),
        ("figures map.nc --colour time --map map.nc", "--map, --colour cannot be used"),
        ("report map.nc --seed 0", "--seed cannot be used"),
        ("demo --full --duration 1", "give either --duration or one of --full and --quick"),
        ("sweep show store --again", "--again cannot be used: results are only shown"),
        ("sweep s.toml --scheduler tcp://a:1 --workers 3", "--workers cannot be used"),
    ],
)
def test_options_without_effect_are_refused(folder, monkeypatch, words, said):
    if words.startswith("sweep"):
        pytest.importorskip("zarr")
    monkeypatch.chdir(folder)
    before = sorted(p.name for p in folder.iterdir())
    assert said in fault(*words.split())
    assert sorted(p.name for p in folder.iterdir()) == before
