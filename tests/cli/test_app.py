"""The command line as a whole: verbs, options, completion, and what happens to misspelt words."""

import os
import re
import subprocess
import sys
import warnings
from collections import defaultdict
from typing import get_args, get_type_hints

import numpy as np
import pytest
import typer
from matplotlib.image import imsave
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli import options
from vibrissa.cli.app import VERBS, app
from vibrissa.cli.reconstruct import ShapeOptions
from vibrissa.cli.terminal import remark_once, warnings_as_notes
from vibrissa.paper import METHODS
from vibrissa.pipeline import Shape, Source
from vibrissa.signals import REGIONS


def run(*words, **how):
    return CliRunner().invoke(app, [str(word) for word in words], **how)


@pytest.fixture(scope="module")
def commands():
    return typer.main.get_command(app).commands


def test_the_verbs():
    listed = "demo deflect map uniqueness sensitivity simulate track import calibrate correct"
    listed += (
        " signals estimate reconstruct export batch figures movie report view stream sweep info"
    )
    assert list(VERBS) == listed.split()


def test_version():
    assert run("--version").output.split() == ["vibrissa", vb.__version__]


@pytest.mark.parametrize("verb", VERBS)
def test_help_has_an_example_of_the_verb(verb):
    text = re.sub(r"[\s│]+", " ", run(verb, "--help").output)
    assert f"Example: vibrissa {verb}" in text


def test_an_option_has_one_meaning_in_all_verbs(commands):
    meanings = defaultdict(set)
    for command in commands.values():
        for option in (one for one in command.params if one.param_type_name == "option"):
            for name in option.opts:
                # What it is comes first; its values and default may be those of the verb.
                what = re.split("[,.:;]", option.help)[0]
                meanings[name].add((what, option.metavar))
    several = {name for name, found in meanings.items() if len(found) > 1}
    assert several == {"--region"}  # that of track is one of its images


def test_lengths_are_in_mm_forces_in_micronewtons_and_help_says_so(commands):
    assert "mm, forces in µN, moments in µN·m" in " ".join(run("--help").output.split())
    helps = {
        name: option.help
        for command in commands.values()
        for option in command.params
        for name in option.opts
    }
    for name in (
        "--pixel-size",
        "--square",
        "--length",
        "--base-radius",
        "--tip-radius",
        "--point",
    ):
        assert ", mm" in helps[name]
    for name in ("--force-noise", "--least-force", "--greatest-force"):
        assert "µN" in helps[name]
    assert "µN·m" in helps["--moment-noise"]


def test_choices_are_those_that_the_functions_take():
    """They are written out again because importing the packages takes seconds."""
    assert get_args(options.Method) == ("exact", *METHODS)
    assert {one.replace("-", " ") for one in get_args(options.Source)} == set(get_args(Source))
    assert tuple(options.Region) == REGIONS
    shapes = get_type_hints(ShapeOptions)["shape"]
    assert get_args(shapes) == get_args(Shape)


def test_a_word_that_is_misspelt_suggests_the_near_one():
    assert "Did you mean 'estimate'" in run("estimat").output
    assert "--using" in run("estimate", "a.csv", "--usin", "Fx,MB,MD").output
    for words in (
        ("reconstruct", "a", "--shape", "cilinder"),
        ("signals", "a", "--source", "rood"),
    ):
        done = run(*words)
        assert done.exit_code == 2
        assert "is not one of" in done.output


@pytest.mark.parametrize(
    ("typed", "offered"),
    [("tra", ["track"]), ("track --pix", ["--pixel-size"]), ("reconstruct --shape s", ["sphere"])],
)
def test_the_shell_completes_verbs_options_and_choices(typed, offered):
    words = f"vibrissa {typed}"
    asked = {
        "_VIBRISSA_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(words.count(" ")),
    }
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys; sys.argv = ['vibrissa']; from vibrissa.cli import main; main()",
        ],
        env=os.environ | asked,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.split() == offered, done.stderr


@pytest.mark.parametrize("encoding", ["cp1252", "gbk"])
def test_other_encodings_stop_nothing(encoding):
    """As of output that is piped on Windows."""
    program = "from vibrissa.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program, "deflect", "--help"],
        env=os.environ | {"PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert any(unit in done.stdout.decode(encoding) for unit in ("µN", "uN"))


def test_completion_can_be_shown(monkeypatch):
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    # The command line that is kept was made without the variable.
    monkeypatch.setattr(typer.testing, "_get_command", typer.main.get_command.__wrapped__)
    done = run("--show-completion", "bash", prog_name="vibrissa")
    assert done.exit_code == 0, done.output
    assert "_VIBRISSA_COMPLETE=complete_bash" in done.output


def test_a_warning_is_a_note(tmp_path):
    """Without the line of code that pytest would want to know."""
    path, names = tmp_path / "sensor.toml", [f"ch{i}" for i in range(6)]
    matrix = [[12.0 * (i == j) if j < 3 else 0.5 * (i == j) for j in range(6)] for i in range(6)]
    path.write_text(f"channels = {names}\nnoise = 1e-3\nmixing = {matrix}")
    done = subprocess.run(
        [sys.executable, "-m", "vibrissa", "info", path],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr.startswith("note: a force of 1 N causes the same reading")
    assert "Warning" not in done.stderr


def test_notes_that_differ_only_in_numbers_are_printed_once(capsys):
    """As for each of 62 whiskers; what they are about is part of them."""
    with warnings.catch_warnings(), warnings_as_notes():
        warnings.simplefilter("always")
        for name, value in (("Fx", 3.0), ("Fx", 2e-9), ("MB", 4.0), ("Fx", 1.0)):
            warnings.warn(f"the noise of {name} is {value} N", stacklevel=1)
    remark_once(f"its tip would sag by {value:g} mm" for value in (0.7, 1e-5, 20.0))
    assert capsys.readouterr().err.splitlines() == [
        "note: the noise of Fx is 3.0 N",
        "note: the noise of MB is 4.0 N",
        "note: 2 more like this: the noise of Fx is 3.0 N",
        "note: its tip would sag by 0.7 mm (2 more like this)",
    ]


@pytest.mark.parametrize(
    ("module", "arguments", "extra"),
    [
        ("numba_cuda", "deflect --point-force 20,10,0 --device cuda", "gpu"),
        ("cv2", "calibrate --pattern 9x6 --square 5 a_1.png b_1.png -o c.toml", "cameras"),
        ("trimesh", "simulate mesh.toml -o trial.nc", "mesh"),
    ],
)
def test_an_extra_that_is_not_installed_is_named(tmp_path, module, arguments, extra):
    """In one line, without a traceback."""
    (tmp_path / "mesh.toml").write_text('[[object]]\nkind = "mesh"\nfile = "m.stl"\n')
    (tmp_path / "m.stl").write_bytes(b"x")
    for name in ("a_1.png", "b_1.png"):
        imsave(tmp_path / name, np.zeros((8, 8)))
    program = (
        "import sys, importlib.util as util\n"
        f"sys.modules[{module!r}] = None; find = util.find_spec\n"
        f"util.find_spec = lambda name, *rest: None if name == {module!r} else find(name, *rest)\n"
        "from vibrissa.cli import main; main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments.split()],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert f"vibrissa[{extra}]" in done.stderr


@pytest.mark.parametrize(
    ("within", "error"), [("nullcontext", "KeyboardInterrupt"), ("ending_in_order", "Ended")]
)
def test_an_interrupt_that_python_ignores_is_repeated(interruptible, within, error):
    """As in a callback of the compiler, or where the last reference to an object ends.

    It ends waiting, here for what nobody writes.
    """
    code = f"""
import os, signal, time
from contextlib import nullcontext
from vibrissa.cli.terminal import Ended, ending_in_order, repeat_lost_interrupts
class Last:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)
        time.sleep(0)
repeat_lost_interrupts()
try:
    with {within}():
        Last()
        os.read(os.pipe()[0], 1)
except KeyboardInterrupt as stopped:
    print(type(stopped).__name__)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=100.0
    )
    assert done.stdout == f"{error}\n"
    assert not done.stderr


def test_ctrl_c_while_modules_are_imported_ends_without_a_traceback():
    start = """
import importlib.abc, sys
class Interrupt(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "vibrissa.cli.app":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupt())
from vibrissa.cli import main
main()
"""
    done = subprocess.run(
        [sys.executable, "-c", start], capture_output=True, text=True, check=False
    )
    assert done.returncode == 130
    assert done.stderr == ""
