"""`vibrissa figures`: files for what is given, and one message for a fault."""

import sys

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa import plots
from vibrissa.cli.app import app, main
from vibrissa.identifiability import witness_pairs
from vibrissa.plots import HIGHLIGHTED

# The known pair of contacts that feel the same by (F_x, M_B, M_D): parabola with A·L = 0.82,
# arc length in L and force in EI/L² (the second found by Newton from (0.645, 0.440)).
LENGTH = 40e-3
ARC = np.array([0.323051, 0.64485501]) * LENGTH
STIFFNESS = 3e9 * np.pi * (1e-4) ** 4 / 4.0
FORCE = np.array([0.762684, 0.43984376]) * STIFFNESS / LENGTH**2


@pytest.fixture(scope="module")
def whisker():
    return vb.Whisker.parabola(length=LENGTH, coefficient=0.82 / LENGTH)


@pytest.fixture(scope="module")
def chart(whisker, tmp_path_factory):
    path = tmp_path_factory.mktemp("figures") / "map.nc"
    vb.ContactMap.simulate(whisker, grid=False, cells=(8, 16, 8)).save(path)
    return path


@pytest.fixture
def verdicts(whisker):
    """What `uniqueness` would say of two triplets and one region, in its form."""
    force = np.stack([FORCE, np.zeros(2)], axis=-1)
    loads = vb.PointForce(ARC, components=np.column_stack([np.zeros(2), force]))
    bent = vb.deflect(whisker, loads)
    felt = vb.base_signals(bent.force, bent.moment)
    point = bent.contact_point
    cell = ("triplet", "region", "witness")

    def both(values):
        """For the first triplet the pair, for the second nothing."""
        values = np.asarray(values)[None, None, None]
        return np.concatenate([values, np.full_like(values, np.nan)])

    return xr.Dataset(
        {
            "verdict": (("triplet", "region"), np.array([["not unique"], ["unique"]])),
            "ambiguous_share": (("triplet", "region", "signal_tolerance"), np.zeros((2, 1, 2))),
            "witness_arc_length": ((*cell, "pair"), both(ARC)),
            "witness_contact_force": ((*cell, "pair", "component"), both(force)),
            "witness_separation": (cell, both(np.linalg.norm(point[1] - point[0]))),
            "witness_signals": (
                (*cell, "signal"),
                both([felt[name].values[0] for name in ("Fx", "MB", "MD")]),
            ),
        },
        {
            "triplet": ["Fx MB MD", "Mx MB MD"],
            "region": ["all"],
            "signal_tolerance": [1e-4, 1e-2],
            "component": ["fy", "fz"],
        },
    )


def run(*arguments):
    result = CliRunner().invoke(app, ["figures", *map(str, arguments)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def fault(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["vibrissa", "figures", *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    return " ".join(capsys.readouterr().err.split())


def test_a_map_gives_three_figures_and_verdicts_three_more(chart, verdicts, tmp_path) -> None:
    saved = tmp_path / "uniqueness.nc"
    verdicts.to_netcdf(saved, engine="h5netcdf")
    folder = tmp_path / "new" / "folder"
    said = run(chart, "-o", folder, "--uniqueness", saved, "--format", "png", "--width", "single")
    names = {
        *("whisker", "signal_space", "contact_surfaces", "sensitivity", "solid"),
        *("verdicts", "resolution", "witness_Fx_MB_MD"),
    }
    assert {file.name for file in folder.iterdir()} == {f"{name}.png" for name in names}
    for file in folder.iterdir():
        assert str(file) in said
        assert file.read_bytes().startswith(b"\x89PNG")


def test_witnesses_feel_the_same_and_lie_apart(whisker, verdicts) -> None:
    ((triplet, pair),) = witness_pairs(whisker, verdicts, HIGHLIGHTED)
    assert triplet == pair.attrs["triplet"] == "Fx MB MD"
    for name in triplet.split():
        np.testing.assert_allclose(*pair[name].values, rtol=1e-7)
    apart = np.linalg.norm(np.diff(pair.contact_point.values, axis=0))
    assert apart == pytest.approx(0.32 * LENGTH, rel=5e-3)
    # The centreline passes through the contact.
    gap = np.linalg.norm(pair.centerline - pair.contact_point, axis=-1).min(axis=1)
    assert gap.max() < 0.5 * LENGTH / 100.0


def test_without_a_verdict_on_all_contacts_another_region_is_drawn(whisker, verdicts) -> None:
    partly = verdicts.assign_coords(region=["CF"])
    none = verdicts.assign_coords(region=["CB"])
    none["witness_separation"] = none["witness_separation"] * np.nan
    found = xr.concat([none, partly], "region")
    ((triplet, pair),) = witness_pairs(whisker, found, HIGHLIGHTED)
    ((_, wanted),) = witness_pairs(whisker, verdicts, HIGHLIGHTED)
    assert triplet == "Fx MB MD"
    xr.testing.assert_allclose(pair, wanted)
    (axes,) = plots.verdict_table(found).axes
    assert "critical" not in " ".join(text.get_text() for text in axes.texts)


def test_verdicts_of_another_whisker_are_refused(verdicts) -> None:
    other = vb.Whisker.parabola(length=LENGTH, coefficient=0.8 / LENGTH)
    with pytest.raises(ValueError, match="not of this map's whisker"):
        list(witness_pairs(other, verdicts, HIGHLIGHTED))


def test_faults_are_told_before_anything_is_drawn(chart, tmp_path, monkeypatch, capsys) -> None:
    folder = tmp_path / "none"
    there = (chart, "-o", folder)
    assert "is not one of" in fault(monkeypatch, capsys, *there, "--format", "bmp")
    assert "is not one of" in fault(monkeypatch, capsys, *there, "--width", "triple")
    missing = tmp_path / "missing.nc"
    assert "there is no file" in fault(monkeypatch, capsys, missing, "-o", folder)
    assert "there is no file" in fault(monkeypatch, capsys, *there, "--uniqueness", missing)
    said = fault(monkeypatch, capsys, *there, "--uniqueness", chart)
    assert "contains vibrissa contact map, and no variable 'verdict'" in said
    table = tmp_path / "verdicts.csv"
    assert "NetCDF (-o FILE.nc) is needed" in fault(
        monkeypatch, capsys, *there, "--uniqueness", table
    )
    text = tmp_path / "text.nc"
    text.write_text("nothing")
    assert "cannot be read as NetCDF-4" in fault(monkeypatch, capsys, *there, "--cones", text)
    assert not folder.exists()
