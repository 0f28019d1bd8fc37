"""Maps of wires from the command line: any length, thickness and material."""

import pytest

import vibrissa as vb
from vibrissa.cli.charting import chart


def test_a_map_of_a_steel_wire(tmp_path):
    path = tmp_path / "wire.nc"
    chart(
        length=300.0,
        base_radius=500.0,
        tip_radius=250.0,
        modulus=200.0,
        poisson=0.29,
        path=path,
        grid=False,
    )
    wire = vb.ContactMap.load(path).whisker
    assert (wire.length, wire.base_radius, wire.tip_radius) == pytest.approx((0.3, 5e-4, 2.5e-4))
    assert (wire.youngs_modulus, wire.poisson_ratio) == (200e9, 0.29)
    assert wire.is_straight
    assert "100 mm" in wire._repr_html_()  # the bar in its picture: a third of it


def test_the_same_shape_in_another_material(tmp_path):
    path = tmp_path / "map.nc"
    chart(base_radius=150.0, modulus=2.0, path=path, grid=False)
    whisker, usual = vb.ContactMap.load(path).whisker, vb.samples.gamma()
    assert whisker.base_radius == pytest.approx(1.5e-4)
    assert whisker.tip_radius == pytest.approx(1e-5)
    assert whisker.youngs_modulus == 2e9
    assert whisker.poisson_ratio == usual.poisson_ratio
    assert abs(whisker.centerline(20) - usual.centerline(20)).max() < 1e-12


def test_a_file_and_a_length_do_not_go_together(tmp_path):
    with pytest.raises(ValueError, match="either --whisker or the --length"):
        chart(whisker=tmp_path / "a.csv", length=30.0, path=tmp_path / "map.nc")
