"""Maps of wires from the command line: any length, thickness and material."""

import re

import numpy as np
import pytest
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli.app import app


def run(*words):
    return CliRunner().invoke(app, ["map", "--no-grid", *map(str, words)])


def test_a_map_of_a_steel_wire(tmp_path):
    path = tmp_path / "wire.nc"
    radii = ("--base-radius", 0.5, "--tip-radius", 0.25)
    done = run("--length", 300, *radii, "--modulus", 200, "--poisson", 0.29, "-o", path)
    assert done.exit_code == 0, done.exception
    wire = vb.ContactMap.load(path).whisker
    assert (wire.length, wire.base_radius, wire.tip_radius) == pytest.approx((0.3, 5e-4, 2.5e-4))
    assert (wire.youngs_modulus, wire.poisson_ratio) == (200e9, 0.29)
    assert wire.is_straight
    assert "100 mm" in wire._repr_html_()  # the bar in its picture: a third of it


@pytest.mark.parametrize("scale", [pytest.param(1.0, marks=pytest.mark.slow), 20.0])
def test_the_noise_of_a_rat_s_whisker_is_questioned_for_a_rod(tmp_path, gamma_map, scale):
    """A rod of the same shape: its contacts would be stated far too exactly."""
    stiff = gamma_map.whisker.scaled(radius_factor=scale)
    contact_map = vb.ContactMap.simulate(stiff, grid=False)
    contact_map.save(tmp_path / "rod.nc")
    bent = vb.deflect(stiff, vb.PointContact([24e-3, 13e-3, 2e-3]))
    row = ",".join(map(repr, [*bent.force.tolist(), *bent.moment.tolist()]))
    (tmp_path / "one.csv").write_text(f"Fx,Fy,Fz,Mx,My,Mz\n{row}\n")
    words = ["estimate", str(tmp_path / "one.csv"), "--map", str(tmp_path / "rod.nc"), "--force"]
    for noise in ((), ("--force-noise", "3000", "--moment-noise", "50")):
        done = CliRunner().invoke(app, [*words, "-o", str(tmp_path / "out.csv"), *noise])
        assert done.exit_code == 0, done.exception
        questioned = "no noise is stated" in " ".join(done.output.split())
        assert questioned == (scale > 1.0 and not noise)


@pytest.mark.parametrize("density", [pytest.param(None, marks=pytest.mark.slow), 1240.0])
def test_a_neglected_weight_is_stated(tmp_path, density):
    rod = vb.Whisker.straight(0.25, base_radius=2e-3, tip_radius=0.8e-3, youngs_modulus=2.3e9)
    rod = rod.with_properties(density=density)
    vb.ContactMap.simulate(rod, grid=False).save(tmp_path / "rod.nc")
    (tmp_path / "one.csv").write_text("Fx,Fy,Fz,Mx,My,Mz\n-.003,.05,0,0,0,.008\n")
    words = ["estimate", str(tmp_path / "one.csv"), "--map", str(tmp_path / "rod.nc")]
    noise = ["--force-noise", "3000", "--moment-noise", "50"]
    done = CliRunner().invoke(app, [*words, *noise, "-o", str(tmp_path / "out.csv")])
    assert done.exit_code == 0, done.exception
    assert ("weight of the whisker is neglected" in " ".join(done.output.split())) == bool(density)


def test_the_same_shape_in_another_material(tmp_path):
    path = tmp_path / "map.nc"
    assert run("--base-radius", 0.15, "--modulus", 2, "-o", path).exit_code == 0
    whisker, usual = vb.ContactMap.load(path).whisker, vb.samples.gamma()
    assert whisker.base_radius == pytest.approx(1.5e-4)
    assert whisker.tip_radius == pytest.approx(1e-5)
    assert whisker.youngs_modulus == 2e9
    assert whisker.poisson_ratio == usual.poisson_ratio
    assert abs(whisker.centerline(20) - usual.centerline(20)).max() < 1e-12


def test_density_and_base_go_with_the_map_and_bend_it(tmp_path):
    path = tmp_path / "rod.nc"
    rod = ("--length", 250, "--base-radius", 2, "--tip-radius", 0.8, "--modulus", 2.3)
    held = ("--density", 1240, "--base-stiffness", "5e6,8e6")
    done = run(*rod, *held, "-o", path)
    assert done.exit_code == 0, done.exception
    whisker = vb.ContactMap.load(path).whisker
    assert whisker.density == 1240.0
    assert whisker.base_stiffness == pytest.approx((5.0, 8.0))
    bend = ["deflect", "--whisker", str(path), "--point-force", "150,2e5,30"]
    heavy = CliRunner().invoke(app, [*bend, "--gravity", "0,0,-9.81"])
    assert heavy.exit_code == 0, heavy.exception
    assert heavy.stdout != CliRunner().invoke(app, bend).stdout
    point = ["deflect", "--point", "25,12,1", "--gravity", "0,0,-9.81"]
    unknown = CliRunner().invoke(app, point)
    assert unknown.exit_code != 0
    assert "density" in str(unknown.exception)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--whisker", "a.csv", "--length", 30), "either --whisker or the --length"),
        (("--length", 30, "--base-end", "last"), "--base-end cannot be used"),
        (("--base-radius", 500), "--base-radius is 500 mm; more than 0 and less than 10"),
    ],
)
def test_what_does_not_go_together_is_refused(tmp_path, words, message):
    assert message in str(run(*words, "-o", tmp_path / "map.nc").exception)


def test_a_linear_sensor_is_calibrated_by_a_table_of_touches(tmp_path):
    wire = vb.Whisker.straight(0.1, base_radius=0.4e-3, tip_radius=0.2e-3, youngs_modulus=2e11)
    vb.ContactMap.simulate(wire, grid=False, cells=(2, 4, 2)).save(tmp_path / "wire.nc")
    rng = np.random.default_rng(4)
    angle = rng.uniform(-np.pi, np.pi, 30)
    bent = vb.deflect(wire, vb.PointForce(rng.uniform(0.04, 0.09, 30), 0.05, angle))
    mixing, noise = np.array([[21.0, 1.5], [-0.8, 19.0], [7.0, 7.0]]), 1e-4
    readings = bent.moment[:, 1:] @ mixing.T + [0.3, -0.1, 0.2]
    points = np.vstack([1e3 * bent.contact_point, np.full((20, 3), np.nan)])
    readings = np.vstack([readings, np.tile([0.3, -0.1, 0.2], (20, 1))])
    readings += noise * rng.normal(size=readings.shape)

    def write(header, points):
        rows = [
            ",".join("" if np.isnan(value) else f"{value:.12g}" for value in row)
            for row in np.column_stack([points, readings])
        ]
        (tmp_path / "touches.csv").write_text("\n".join([header, *rows]))

    write("x,y,z,a,b,c", points)
    target = tmp_path / "sensor.toml"
    how = ["calibrate", str(tmp_path / "touches.csv"), "-o", str(target)]
    own = ["--whisker", str(tmp_path / "wire.nc"), "--components", "My,Mz"]
    for words, fault in (([], "--whisker is needed"), ([*own, "--square", "5"], "cannot be used")):
        assert fault in str(CliRunner().invoke(app, [*how, *words]).exception)
    done = CliRunner().invoke(app, [*how, *own])
    assert done.exit_code == 0, done.exception
    sensor = vb.sensors.load_sensor(target)
    assert sensor.channels == ("a", "b", "c")
    sigma = np.sqrt(np.diagonal(sensor.mixing_covariance, axis1=1, axis2=2)[:, 4:6])
    away = np.abs(sensor.mixing[:, 4:] - mixing)
    assert (away < np.minimum(4.0 * sigma, 0.01 * mixing.max())).all()
    np.testing.assert_allclose(sensor.noise, noise, rtol=0.5)
    again = [*how, *own, "--force"]
    write("x_m,y (mm),z,a,b,c", points * [1e-3, 1.0, 1.0])
    assert CliRunner().invoke(app, again).exit_code == 0
    same = vb.sensors.load_sensor(target)
    np.testing.assert_allclose(same.mixing, sensor.mixing, atol=1e-6 * mixing.max())
    write("x,y,z,a,b,c", points + np.array([0.0, 0.1, 0.0]))
    said = " ".join(CliRunner().invoke(app, again).output.split())
    assert re.search(r"residuals of .*b, c up to [0-9.e+]+ times the noise at rest", said)
    write("X (mm),Y (mm),Z (mm),a,b,c", points)
    done = CliRunner().invoke(app, again)
    assert done.exit_code == 0
    assert "times the noise" not in done.output
    write("x,y,z,a,b,c", 1e-3 * points)
    fault = str(CliRunner().invoke(app, again).exception)
    assert "mm from the base of this whisker of 100 mm: are their unit" in fault
    points[:30] = points[29::-1]
    write("x,y,z,a,b,c", points)
    with pytest.warns(UserWarning, match=r"of the readings of a .*, b .*, c "):
        done = CliRunner().invoke(app, again)
    # Once: the noise is as large as what is not explained.
    assert done.exit_code == 0, done.exception
    assert "much noise" not in done.output
    assert "times the noise" not in done.output
