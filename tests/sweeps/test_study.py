"""What a study says, and what it must not say."""

from pathlib import Path

import numpy as np
import pytest

from vibrissa import Whisker
from vibrissa.sweeps import EXAMPLE, read_study

WHISKERS = "[[whiskers]]\n"
TASKS = '[[tasks]]\nkind = "map"\n'


def whiskers(text, folder=Path()):
    return [one.make() for one in read_study(f"[[whiskers]]\n{text}\n{TASKS}", folder).specimens]


def test_the_example_is_a_study_of_all_combinations():
    study = read_study(EXAMPLE, Path())
    assert len(study.specimens) == 15
    assert study.size == 30
    assert study.seconds > 0
    assert {
        (one.parameters["taper_ratio"], one.parameters["curvature"]) for one in study.specimens
    } == {(taper, bend) for taper in (1, 2, 5, 15, 60) for bend in (0.0, 0.4, 0.8)}


def test_units_are_those_of_the_text():
    (whisker,) = whiskers(
        "length = 30\ntaper_ratio = 10\nbase_radius = 80\nyoungs_modulus = 4\ncurvature = 0.3"
    )
    assert whisker.length == pytest.approx(30e-3)
    assert (whisker.base_radius, whisker.tip_radius) == pytest.approx((80e-6, 8e-6))
    assert whisker.youngs_modulus == 4e9
    # y = A x² with A L = 0.3: at the tip the tangent has the slope 2 A x.
    x, y, z = whisker.centerline(50)[-1]
    assert y == pytest.approx(0.3 / 30e-3 * x**2, rel=1e-6)
    assert z == pytest.approx(0.0, abs=1e-12)


def test_bend_is_the_angle_that_the_tangent_turns_by_and_corkscrew_leaves_the_plane():
    ring, screw = whiskers("bend = 120\ncorkscrew = [0, 360]")
    assert ring.frame(ring.length)[:, 0] == pytest.approx(
        [np.cos(np.radians(120)), np.sin(np.radians(120)), 0.0], abs=1e-6
    )
    assert np.abs(ring.centerline(100)[:, 2]).max() < 1e-9
    assert np.abs(screw.centerline(100)[:, 2]).max() > 1e-3


def test_trim_leaves_what_is_proximal():
    whole, half = whiskers("curvature = 0.4\ntrim = [1.0, 0.5]")
    assert half.length == pytest.approx(whole.length / 2)
    s = np.linspace(0.0, half.length, 7)
    assert half.radius(s) == pytest.approx(whole.radius(s), rel=1e-6)


def test_a_random_population_keeps_its_bounds_and_its_first_members():
    text = 'kind = "random"\ncount = {}\nlength = [20, 60]\ntaper_ratio = [2, 50]\n'
    text += 'logarithmic = ["taper_ratio"]'
    many = whiskers(text.format(40))
    assert all(20e-3 <= one.length <= 60e-3 for one in many)
    ratios = [one.base_radius / one.tip_radius for one in many]
    assert 2 <= min(ratios) < max(ratios) <= 50
    again = whiskers(text.format(40))
    assert [one.length for one in many] == [one.length for one in again]


def test_files_are_whiskers_and_their_content_is_their_identity(tmp_path):
    points = Whisker.parabola(30e-3, 10.0).centerline(40) * 1e3
    for name, scale in (("one", 1.0), ("two", 1.1)):
        np.savetxt(
            tmp_path / f"{name}.csv",
            points * scale,
            delimiter=",",
            header="x_mm,y_mm,z_mm",
            comments="",
        )
    text = f'[[whiskers]]\nkind = "files"\nfiles = "*.csv"\nyoungs_modulus = 2.5\n{TASKS}'
    folder = tmp_path / "[a]"  # not those of a folder called "a"
    for other in (folder, tmp_path / "a"):
        other.mkdir()
        (other / f"{other.name}.csv").write_bytes((tmp_path / "one.csv").read_bytes())
    assert [one.name for one in read_study(text, folder).specimens] == ["[a]"]
    one, two = read_study(text, tmp_path).specimens
    assert (one.name, two.name) == ("one", "two")
    assert two.make().length == pytest.approx(33e-3, rel=0.01)
    assert one.make().youngs_modulus == 2.5e9
    (tmp_path / "one.csv").write_bytes((tmp_path / "two.csv").read_bytes())
    changed, same = read_study(text, tmp_path).specimens
    assert changed.identity == two.identity == same.identity != one.identity


def test_the_array_is_a_population():
    names = [
        one.name
        for one in read_study(
            f'[[whiskers]]\nkind = "array"\nrows = "C"\nprefix = "rat "\n{TASKS}', Path()
        ).specimens
    ]
    assert "rat C1" in names or any(name.endswith("C1") for name in names)


def test_a_cell_is_the_same_in_any_study_that_has_it():
    small = read_study(f"[[whiskers]]\ntaper_ratio = [15]\n{TASKS}", Path())
    large = read_study(f"[[whiskers]]\ntaper_ratio = [5, 15]\n{TASKS}", Path())
    (one,) = small.cells()
    two = next(cell for cell in large.cells() if cell.specimen.parameters["taper_ratio"] == 15)
    assert (one.identity, one.seed) == (two.identity, two.seed)
    other = read_study(f"seed = 1\n[[whiskers]]\ntaper_ratio = [15]\n{TASKS}", Path())
    assert next(other.cells()).seed != one.seed


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("whiskers = ", "not TOML"),
        (TASKS, r"no whiskers: at least one \[\[whiskers\]\]"),
        ("[[whiskers]]\n", r"no tasks: at least one \[\[tasks\]\]"),
        ("colour = 1\n" + WHISKERS + TASKS, "colour; known are name, seed, tasks, whiskers"),
        ("seed = -1\n" + WHISKERS + TASKS, "seed is -1; a whole number from 0"),
        (WHISKERS + 'kind = "cat"\n' + TASKS, "kind is 'cat'; one of grid, random, files, array"),
        (WHISKERS + "lenght = 3\n" + TASKS, "lenght; known are base_radius"),
        (WHISKERS + "length = [20, -1]\n" + TASKS, "length is -1; it must be above 0"),
        (WHISKERS + 'length = "long"\n' + TASKS, "a number or a list of numbers"),
        (WHISKERS + "trim = 1.5\n" + TASKS, "trim is 1.5; it is the share"),
        (WHISKERS + "curvature = 0.4\nbend = 20\n" + TASKS, "cannot be combined with bend"),
        (WHISKERS + "length = [3, 3]\n" + TASKS, "share the names length 3"),
        (WHISKERS + 'kind = "random"\n' + TASKS, "count is None; a whole number from 1"),
        (WHISKERS + 'kind = "files"\nfiles = "no*.csv"\n' + TASKS, "no file is called"),
        (WHISKERS + 'kind = "array"\nrows = "Q"\n' + TASKS, r"\[\[whiskers\]\] 1: "),
        (WHISKERS + '[[tasks]]\nkind = "dance"\n', "kind is 'dance'; one of map, uniqueness"),
        (WHISKERS + '[[tasks]]\nkind = ["map"]\n', "one of map, uniqueness"),
        (WHISKERS + TASKS + "samples = 3\n", "sets samples; settings of map are: nothing"),
        (WHISKERS + TASKS + TASKS, "another name for each task"),
        (WHISKERS + '[[tasks]]\nkind = "uniqueness"\nsamples = 3\n', "samples is 3; a number from"),
        (WHISKERS + '[[tasks]]\nkind = "uniqueness"\nregions = ["N"]\n', "known are all"),
        (WHISKERS + '[[tasks]]\nkind = "uniqueness"\ntriplets = "Fx"\n', "a list without"),
        (
            WHISKERS + '[[tasks]]\nkind = "uniqueness"\ntriplets = ["Fx MB MD", "MD,fx,MB"]\n',
            "without repetitions",
        ),
        (WHISKERS + '[[tasks]]\nkind = "uniqueness"\nresolution = "no"\n', "true or false"),
        (WHISKERS + '[[tasks]]\nkind = "estimation"\nsignals = ["Q"]\n', r"\[\[tasks\]\] 1: "),
        (WHISKERS + '[[tasks]]\nkind = "friction"\nfriction = [-1]\n', "coefficients from 0"),
        (WHISKERS + '[[tasks]]\nkind = "friction"\nfriction = [inf]\n', "coefficients from 0"),
        (WHISKERS + '[[tasks]]\nkind = "friction"\nfriction = 0.3\n', "friction is 0.3; a list"),
        (WHISKERS + '[[tasks]]\nkind = "uniqueness"\ncone = 100\n', "a number from 0 to 89"),
        (WHISKERS + 'kind = "array"\nrows = "A"\nnames = ["C2"]\n' + TASKS, "rows or columns"),
        (WHISKERS + '[[tasks]]\nkind = "friction"\ncontacts = 1e12\n', "from 1 to 1e"),
        (WHISKERS + '[[tasks]]\nkind = "sensitivity"\nforce_noise = nan\n', "a number from 0"),
        (
            WHISKERS + '[[tasks]]\nkind = "sensitivity"\nforce_noise = 1e-6\n',
            "smaller than any sensor",
        ),
        (WHISKERS + "kind = []\n" + TASKS, r"kind is \[\]; one of grid"),
        (WHISKERS + "kind = {a = 1}\n" + TASKS, "kind is .*; one of grid"),
        (WHISKERS + 'kind = "array"\nrows = [true]\n' + TASKS, "a list of words"),
        (WHISKERS + 'kind = "array"\nside = []\n' + TASKS, "right or left"),
        (WHISKERS + 'kind = "array"\ncolumns = ["1"]\n' + TASKS, "whole numbers"),
        (WHISKERS + 'kind = "random"\ncount = 1000000000000\n' + TASKS, "1e.12 whiskers"),
        (WHISKERS + 'kind = "random"\ncount = 1\nlogarithmic = [[]]\n' + TASKS, "list of words"),
        (WHISKERS + f"length = {'9' * 400}\n" + TASKS, "a number or a list of numbers"),
        ("a = " + 5000 * "[", "nested too deeply"),
    ],
)
def test_what_is_wrong_is_told_with_what_is_allowed(text, message):
    with pytest.raises(ValueError, match=message):
        read_study(text, Path())


def test_several_radii_of_files_are_refused(tmp_path):
    """Only a grid combines values: the first alone would be used."""
    (tmp_path / "one.csv").write_text("x,y,z\n0,0,0\n")
    text = "[[whiskers]]\nkind='files'\nfiles='*.csv'\nbase_radius=[50, 100]\n[[tasks]]\nkind='map'"
    with pytest.raises(ValueError, match="one number"):
        read_study(text, tmp_path)


def test_a_file_that_is_changed_while_the_study_runs_is_refused(tmp_path):
    """Its cells are called by what it was when the study began."""
    file = tmp_path / "one.csv"
    rows = [f"{x},{0.01 * x**2},0" for x in np.linspace(0.0, 30.0, 40)]
    file.write_text("\n".join(["x_mm,y_mm,z_mm", *rows]))
    text = "[[whiskers]]\nkind='files'\nfiles='*.csv'\n[[tasks]]\nkind='map'"
    study = read_study(text, tmp_path)
    before = study.specimens[0]
    assert before.make().length > 0.0
    file.write_text(file.read_text().replace("0.0,0.0,0", "0.0,0.001,0"))
    with pytest.raises(ValueError, match="was changed while the study ran"):
        before.make()
    assert read_study(text, tmp_path).specimens[0].identity != before.identity
