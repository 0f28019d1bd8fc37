"""A file's kind is told by what is in it, and `vibrissa info` says what that is."""

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

from vibrissa import samples
from vibrissa.cli.app import app
from vibrissa.io import (
    Kind,
    RawTracks,
    labelled,
    load_tracks,
    recognise,
    save_centerline,
    save_tracks,
    write_video,
)


def info(path):
    result = CliRunner().invoke(app, ["info", str(path)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return " ".join(result.output.split())


def anipose(path, ending="\n"):
    names = [f"tip_{what}" for what in ("x", "y", "z", "error", "ncams", "score")]
    path.write_text(",".join([*names, "fnum"]) + "\n1,2,3,0.5,2,0.9,0\n2,3,4,0.5,2,0.9,1" + ending)
    return path


def test_tables_are_told_apart_by_their_header(tmp_path):
    path = tmp_path / "table.csv"
    for header, kind in (
        ("scorer,a,a,a", Kind.DEEPLABCUT),
        ("tip_x,tip_y,tip_z,tip_error,tip_ncams,tip_score,fnum", Kind.ANIPOSE),
        ("time,Fx,Fy,Fz,Mx,My,Mz", Kind.SIGNALS),
        ("time_s,Fx_N,Fy_N,Fz_N,Mx_Nm,My_Nm,Mz_Nm", Kind.SIGNALS),
        ("time,x,y,z,r,theta,phi,sigma_x,sigma_y,sigma_z,status", Kind.CONTACTS),
        ("frame,x,y,z", Kind.TRACKS_TABLE),
        ("time,whisker,view,node,column,row,confidence", Kind.TRACKS_TABLE),
        ("x_mm,y_mm,z_mm", Kind.CENTERLINE),
        ("[cam_0]", Kind.CALIBRATION),
        ("name,age", Kind.UNKNOWN),
        ("\n\n", Kind.UNKNOWN),
    ):
        path.write_text(f"# comment\n{header}\n1,2,3\n")
        assert recognise(path) == (Kind.UNKNOWN if header == "\n\n" else kind), header
    path.write_bytes(b"RIFF\x01\x02\0\0AVI ")
    assert recognise(path) == Kind.VIDEO
    path.write_bytes(b"\x00\x01\x02")
    assert recognise(path) == Kind.UNKNOWN
    path.write_bytes(b"\xff\xfe\xfd nothing at all")
    assert recognise(path) == Kind.UNKNOWN


def test_other_netcdf(tmp_path):
    path = tmp_path / "a.nc"
    xr.Dataset({"a": ("x", np.zeros(3))}, {"x": np.arange(3)}).to_netcdf(path, engine="h5netcdf")
    assert recognise(path) == Kind.NETCDF
    with pytest.raises(ValueError, match=r"a.nc does not contain tracks .*NetCDF file.*DeepLabCut"):
        load_tracks(path)


def test_nothing_there(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_tracks(tmp_path / "none.h5")
    with pytest.raises(ValueError, match="is a folder"):
        load_tracks(tmp_path)
    path = tmp_path / "a.h5"
    path.write_bytes(b"")
    with pytest.raises(ValueError, match="is empty"):
        load_tracks(path)
    path.write_bytes(b"\x89HDF\r\n\x1a\n and then nothing")
    with pytest.raises(ValueError, match=r"a.h5 cannot be read as a file of a known kind"):
        load_tracks(path)


def test_info_of_tracks(tmp_path):
    said = info(anipose(tmp_path / "trial.csv"))
    for part in ("table of Anipose", "frames 2, numbered 0 to 1", "unit not stated", "100.0 %"):
        assert part in said
    names = [f"w{i}_{what}" for i in range(2) for what in ("x", "y", "z", "ncams")]
    for scale, unit in ((30.0, "mm"), (0.03, "m"), (30e3, "um")):
        row = f"0,0,0,2,{scale},0,0,2"
        (tmp_path / "line.csv").write_text(f"{','.join(names)}\n{row}\n{row}\n")
        said = info(tmp_path / "line.csv")
        assert f"--unit {unit} " in said
        assert "also cameras" in said
        assert "confidence" not in said
    image = np.ones((4, 2, 1, 3, 2))
    image[2:, 1] = np.nan
    raw = RawTracks("test", ["C1", "C2"], image=image, nodes=["base", "middle", "tip"])
    path = tmp_path / "tracks.nc"
    save_tracks(path, labelled(raw, "a.csv", fps=1000.0, view="top"))
    said = info(path)
    for part in (
        "vibrissa tracks",
        "from 0 to 0.003 s",
        "2: C1, C2",
        "1: top",
        "base, middle, tip",
        "pixel; 75.0 %",
    ):
        assert part in said


def test_info_of_videos_and_calibrations(tmp_path):
    path = tmp_path / "top.mkv"
    write_video(path, np.zeros((3, 32, 48), dtype=np.uint8), rate=25.0)
    said = info(path)
    for part in ("video, ffv1", "48 × 32 pixels", "frames 3, shown at 25 a second"):
        assert part in said
    path = tmp_path / "calibration.toml"
    path.write_text(
        '[cam_0]\nname = "top"\nsize = [1024, 768]\nrotation = [0, 0, 0]\n'
        "matrix = [[900, 0, 512], [0, 900, 384], [0, 0, 1]]\ntranslation = [0, 0, 300]\n"
    )
    assert "top 1024 × 768 pixels, perspective" in info(path)


def test_info_of_other_files(tmp_path):
    path = tmp_path / "a.csv"
    save_centerline(path, samples.gamma().centerline(12))
    assert "centreline of a whisker" in info(path)
    path.write_bytes(b"\0\1\2 a video perhaps")
    with pytest.raises(ValueError, match=r"a.csv is not of a known kind.*SLEAP"):
        info(path)
    path.write_text("name,age\nC2,3\n")
    with pytest.raises(ValueError, match="not a table of a known kind"):
        info(path)


def test_damaged_netcdf_is_named(tmp_path):
    """Whatever bytes are wrong, the error is one of ours and names the file, or all is well."""
    rng = np.random.default_rng(0)
    path = tmp_path / "tracks.nc"
    raw = RawTracks("test", ["C1"], image=rng.uniform(1, 9, (40, 1, 1, 9, 2)))
    save_tracks(path, labelled(raw, "a.csv", fps=1000.0))
    content = path.read_bytes()
    said = []
    for _ in range(40):
        spoilt = bytearray(content)
        for at in rng.integers(0, len(content), 4):
            spoilt[at] ^= 0xFF
        path.write_bytes(spoilt)
        try:
            load_tracks(path)
        except ValueError as error:
            said.append(str(error))
    assert len(said) > 5
    assert all("tracks.nc" in message for message in said)
