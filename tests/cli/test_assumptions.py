"""What is known beforehand, on the command line: errors all samples share, possible contacts."""

import json

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.cli.app import app
from vibrissa.contacts import ContactMap
from vibrissa.io import load_contacts
from vibrissa.sensors import Sensor, save_sensor
from vibrissa.signals import concave_backward
from vibrissa.status import Status

typer_testing = pytest.importorskip("typer.testing")
NOISE = np.repeat([1e-6, 2e-8], 3)


def run(*words, **how):
    return typer_testing.CliRunner().invoke(app, [str(word) for word in words], **how)


def done(*words, **how):
    result = run(*words, **how)
    assert result.exit_code == 0, result.exception
    return result.stdout


def fault(*words):
    result = run(*words)
    assert isinstance(result.exception, ValueError), result.exception
    return str(result.exception)


@pytest.fixture(scope="module")
def bent():
    rng = np.random.default_rng(2)
    whisker = vb.samples.gamma()
    at = rng.uniform(0.4, 0.8, 40) * whisker.length
    found = vb.deflect(whisker, vb.PointForce(at, 4e-5, rng.uniform(-3.0, 3.0, 40)))
    kept = np.flatnonzero(found.status == Status.OK)
    return np.concatenate([found.force, found.moment], axis=-1)[kept], found.contact_point[kept]


@pytest.fixture(scope="module")
def folder(tmp_path_factory, bent):
    path = tmp_path_factory.mktemp("assumptions")
    ContactMap.simulate(vb.samples.gamma(), grid=False).save(path / "map.nc")
    np.savetxt(
        path / "signals.csv",
        np.column_stack([np.arange(len(bent[0])) / 100.0, bent[0]]),
        delimiter=",",
        header="time,Fx,Fy,Fz,Mx,My,Mz",
        comments="",
    )
    return path


def estimated(folder, tmp_path, *words):
    path = tmp_path / "contacts.csv"
    done("estimate", folder / "signals.csv", *words, "-o", path, "--force")
    return load_contacts(path)


@pytest.mark.parametrize(
    "how",
    [
        ("--using", "Fx,MB,MD"),
        pytest.param(("--using", "Fx,FT,MB,MD"), marks=pytest.mark.slow),
        (),
    ],
)
def test_stated_errors_are_in_what_estimate_writes(folder, tmp_path, bent, how):
    """The same covariances as in Python, of three signals, of four and of the whole wrench."""
    given = how or ("--using", "wrench")
    maps = ("--map", folder / "map.nc") if how else ()
    options = ("--gain-sigma", 1, "--mixing-sigma", 2, "--stiffness-sigma", 3)
    sigmas = {"gain_sigma": 0.01, "mixing_sigma": 0.02, "stiffness_sigma": 0.03}
    table = estimated(folder, tmp_path, *given, *maps, *options)
    force, moment = np.hsplit(bent[0], 2)
    noise = np.diag(NOISE**2)
    if how:
        contact_map, names = ContactMap.load(folder / "map.nc"), how[1]
        found = contact_map.estimate(vb.base_signals(force, moment), names, noise, **sigmas)
    else:
        found = vb.estimate_from_wrench(vb.samples.gamma(), force, moment, noise=noise, **sigmas)
    one = found.status == Status.UNIQUE
    assert one.sum() > 20
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))[one]
    stated = np.stack([table[f"sigma_{axis}"].values[one] for axis in "xyz"], axis=-1)
    np.testing.assert_allclose(stated, sigma, rtol=1e-4)
    plain = estimated(folder, tmp_path, *given, *maps)
    assert np.median(table["sigma_x"].values[one] / plain["sigma_x"].values[one]) > 1.2


def test_a_prior_is_in_what_estimate_writes(folder, tmp_path, bent):
    options = ("--map", folder / "map.nc", "--using", "Fx,FT,FD,Mx,MB,MD")
    back = concave_backward(vb.samples.gamma(), bent[1])
    table = estimated(folder, tmp_path, *options, "--region", "CB")
    assert (table["status"].values[back] == Status.UNIQUE).mean() > 0.9
    assert (table["status"].values[~back] == Status.OUTSIDE_PRIOR).mean() > 0.9
    whole = estimated(folder, tmp_path, *options)
    r = whole["r"].values
    table = estimated(folder, tmp_path, *options, "--region", "r=20:25", "--least-force", 1)
    inside = (r > 0.02) & (r < 0.025)
    assert 0 < inside.sum() < len(r)
    found = np.isfinite(table["x"].values)
    assert found[inside].all()
    # Others may be displaced by noise.
    sigma = np.sqrt(sum(table[f"sigma_{axis}"].values ** 2 for axis in "xyz"))
    assert (np.abs(r - 0.0225) - 0.0025 <= 3.0 * sigma)[found].all()
    assert not found.all()
    table = estimated(folder, tmp_path, *options, "--greatest-force", 10)
    assert (table["status"].values == Status.OUTSIDE_PRIOR).all()


def test_a_prior_is_said_in_the_units_of_the_options(folder, tmp_path):
    words = ("estimate", folder / "signals.csv", "--map", folder / "map.nc", "-o")
    limits = ("--region", "r=20:35,theta=-30:30", "--least-force", 1, "--greatest-force", 900)
    said = " ".join(run(*words, tmp_path / "a.csv", *limits).output.split())
    where = "where r=20:35,theta=-30:30 (mm, degrees)"
    assert f"contacts only {where} and of at least 1 µN and of at most 900 µN" in said
    assert "contacts only in CB;" in run(*words, tmp_path / "b.csv", "--region", "CB").output


def lines(folder, tmp_path, *words):
    text = (folder / "signals.csv").read_text()
    out = done("stream", "--map", folder / "map.nc", *words, input=text)
    return [json.loads(line) for line in out.splitlines() if line.startswith("{")]


def test_a_stream_knows_the_same(folder, tmp_path, bent):
    plain = lines(folder, tmp_path)
    wide = lines(folder, tmp_path, "--gain-sigma", 5, "--mixing-sigma", 5)
    assert len(plain) == len(wide) == len(bent[0])
    wider = [b["sigma_x"] / a["sigma_x"] for a, b in zip(plain, wide, strict=True) if "x" in a]
    assert np.median(wider) > 1.2
    back = concave_backward(vb.samples.gamma(), bent[1])
    some = lines(folder, tmp_path, "--region", "CB", "--using", "Fx,FT,FD,Mx,MB,MD")
    for record, holds in zip(some, back, strict=True):
        assert record["status"] == ("unique" if holds else "outside_prior")


def test_a_stream_takes_errors_from_the_sensors_file(folder, tmp_path):
    sigma = {}
    for gain in (0.0, 0.05):
        save_sensor(
            tmp_path / "sensor.toml",
            Sensor(noise=NOISE, gain_error=gain, drift=2e-9, resolution=1e-9),
        )
        some = lines(folder, tmp_path, "--sensor", tmp_path / "sensor.toml", "--threshold", 0)
        sigma[gain] = some[0]["sigma_x"]
    assert sigma[0.05] > 1.2 * sigma[0.0]
    words = ("stream", "--map", folder / "map.nc", "--sensor", tmp_path / "sensor.toml")
    assert "the --sensor's file states gain_error" in fault(*words, "--gain-sigma", 1)
    described = done("info", tmp_path / "sensor.toml")
    assert "gain known to 5 %" in described
    assert "resolution 1e-09, drift 2e-09 in a second" in described


def test_maps_begin_where_they_are_asked_to(folder, tmp_path):
    """The option is of maps that are made; with one that is given it would have no effect."""
    done("map", "--no-grid", "--proximal", 0.6, "-o", tmp_path / "map.nc")
    assert ContactMap.load(tmp_path / "map.nc").chart.proximal == 0.6
    table = estimated(folder, tmp_path, "--proximal", 0.6, "--using", "Fx,MB,MD")
    near = estimated(folder, tmp_path, "--map", folder / "map.nc", "--using", "Fx,MB,MD")
    distal, here = table["r"].values, near["r"].values
    same = np.isclose(distal, here, rtol=1e-4)
    assert 5 < same.sum() < len(same) - 5
    assert (distal[~same] > here[~same]).all()
    given = ("estimate", folder / "signals.csv", "--proximal", 0.5)
    assert "--proximal cannot be used" in fault(*given, "--map", folder / "map.nc")
    assert "--proximal cannot be used" in fault(*given, "--using", "wrench")
    assert "must be from 0.05 L" in fault("map", "--no-grid", "--proximal", 2)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--region", "left"), "a region is one of all, ELD, CF, CB"),
        (("--region", "x=1:2"), "limits of r (mm), theta and phi (degrees)"),
        (("--region", "r=1"), "limits of r (mm), theta and phi (degrees)"),
        (("--region", "theta=0:600"), "angles up to 360"),
        (("--region", "r=30:20"), "least value first"),
        (("--least-force", 20, "--greatest-force", 10), "must be below --greatest-force"),
    ],
)
def test_what_is_no_prior_is_refused(folder, words, said):
    assert said in fault("estimate", folder / "signals.csv", *words)


def test_friction_is_allowed_for_in_what_estimate_writes(folder, tmp_path, bent):
    """Of contacts without friction most estimates stay, and their uncertainty grows a little."""
    how = ("--map", folder / "map.nc", "--using", "Fx,FT,MB,MD")
    table = estimated(folder, tmp_path, *how, "--friction-sigma", 0.3)
    plain = estimated(folder, tmp_path, *how)
    known = np.isfinite(table["sigma_x"].values) & np.isfinite(plain["sigma_x"].values)
    assert known.sum() > 20
    assert np.median(table["sigma_x"].values[known] / plain["sigma_x"].values[known]) > 1.0
    assert (np.abs(table["x"] - plain["x"]).values[known] < 1e-9).mean() > 0.5
    assert (table["friction"] == 0.3).all()
    assert (plain["friction"] == 0.0).all()
    error = np.stack([table[axis].values for axis in "xyz"], axis=-1) - bent[1]
    sigma = np.stack([table[f"sigma_{axis}"].values for axis in "xyz"], axis=-1)
    assert (np.abs(error / sigma)[known] < 3.0).mean() > 0.9


@pytest.mark.parametrize("how", [("--using", "wrench"), ("--method", "lookup")])
def test_friction_is_refused_where_it_has_no_effect(folder, how):
    said = fault("estimate", folder / "signals.csv", *how, "--friction-sigma", 0.3)
    assert "--friction-sigma" in said
