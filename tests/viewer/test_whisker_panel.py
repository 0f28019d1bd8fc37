"""The page opens for whiskers unlike a rat's, and its sliders begin where they are."""

import pytest

import vibrissa as vb

pytest.importorskip("viser", reason="viser is not installed", exc_type=ImportError)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("base", "tip", "modulus"),
    [(1e-3, 2e-3, 3e9), (1e-3, 1e-3, 1e5), (0.5e-3, 5e-6, 200e9)],
    ids=["wider at the tip", "rubber", "steel"],
)
def test_sliders_hold_the_whisker_as_it_is(base, tip, modulus):
    from vibrissa.viewer import view
    from vibrissa.viewer.bend import WhiskerControls

    ratio = 0.38 if modulus > 1e6 else 0.49
    whisker = vb.Whisker.straight(
        0.3, base_radius=base, tip_radius=tip, youngs_modulus=modulus, poisson_ratio=ratio
    )
    with view(whisker) as viewer:
        controls = WhiskerControls(viewer.page)
    for slider, value in (
        (controls._length, 300.0),
        (controls._taper, base / tip),
        (controls._modulus, 1e-9 * modulus),
    ):
        assert slider.value == pytest.approx(value)
        assert 0.0 < slider.min <= slider.value <= slider.max
        assert slider.max > slider.min
