"""A disk that is full ends in one line, never in a crash, and what was there stays as it was.

No file may grow beyond a limit that the system sets, so that this runs anywhere; and, where a file
system can be mounted, one of a few kilobytes. All is written in another process, because HDF5 has
taken the interpreter down.
"""

import json
import subprocess
import sys

import pytest

from vibrissa import samples
from vibrissa.io import save_recording
from vibrissa.simulation import facing_peg, measure, simulate, whisking

pytest.importorskip("resource", reason="this system has no limits for files")

WRITERS = """
import gc, json, resource, sys
from datetime import UTC, datetime
from pathlib import Path
import numpy as np
import vibrissa as vb
from vibrissa import io, samples
from vibrissa.io import write_netcdf

folder, limit = Path(sys.argv[1]), int(sys.argv[2])
trial = io.load_recording(sys.argv[3])
noise = np.random.default_rng(0).integers(0, 255, (50, 64, 64, 3), dtype=np.uint8)
table = trial.to_dataset().isel(whisker=0)[["force", "moment"]]
truth = trial["truth"].to_dataset().isel(whisker=0)
axes = {name: truth["contact_point"].sel(space=name, drop=True) for name in "xyz"}
contacts = table[["time"]].assign(axes | {"status": truth["status"]})

def figure(path):
    from matplotlib.figure import Figure
    from vibrissa.plots import save
    drawn = Figure()
    drawn.subplots().plot(np.arange(99.0))
    save(drawn, path.with_suffix(""), (path.suffix[1:],))

def nwb(path):
    io.save_nwb(path, trial, io.Session(datetime(2024, 5, 6, tzinfo=UTC)))

writers = {
    "trial.nc": lambda path: io.save_recording(path, trial),
    "data.nc": lambda path: write_netcdf(path, trial["truth"].to_dataset()),
    "signals.csv": lambda path: io.save_signals(path, table),
    "contacts.csv": lambda path: io.save_contacts(path, contacts),
    "line.csv": lambda path: io.save_centerline(path, samples.gamma().centerline(500)),
    "video.mkv": lambda path: io.write_video(path, iter(noise[..., 0]), 100.0),
    "movie.mp4": lambda path: io.write_movie(path, iter(noise), 25.0),
    "figure.pdf": figure,
    "figure.png": figure,
}
try:
    import ndx_pose
    writers["trial.nwb"] = nwb
except ImportError:
    pass
hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
for name, write in writers.items():
    path = folder / name
    path.write_text("old")
    if limit:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        write(path)
        said = "nothing"
    except OSError as error:
        said = str(error)
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    gc.collect()
    left = sorted(one.name for one in folder.iterdir())
    print(json.dumps([name, said, path.read_bytes().decode("latin-1"), left]), flush=True)
    path.unlink()
"""

VERBS = """
import json, resource, sys
from pathlib import Path
from vibrissa.cli import report, terminal
from vibrissa.cli.app import main

report.drawn = lambda drawings, tell: []  # figures are parts of the page, which is one file
folder = Path(sys.argv[1])
hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
chart, trial, page = folder / "map.nc", folder / "trial.nc", folder / "page.html"
verbs = [
    ["map", "--no-grid", "-o", chart],
    ["simulate", "--duration", "0.05", "-o", trial],
    ["signals", trial],
    ["estimate", trial, "--using", "wrench"],
    ["report", trial, "-o", page],
]
for limit in (hard, 1500):
    for verb in verbs:
        options = [] if limit == hard or verb[0] in ("signals",) else ["--force"]
        before = {one.name: one.read_bytes() for one in folder.iterdir()}
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
        sys.argv = ["vibrissa", *map(str, verb), *options]
        code = 0
        with terminal.errors.capture() as captured:
            try:
                main()
            except SystemExit as stopped:
                code = stopped.code or 0
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
        same = before == {one.name: one.read_bytes() for one in folder.iterdir()}
        print("\\n" + json.dumps([verb[0], limit == hard, code, same, captured.get()]), flush=True)
"""


def run(program, *arguments):
    """What a program prints, line by line.

    It compiles no sources (-B): Python would leave those of a package cut short at the limit.
    """
    command = [sys.executable, "-B", "-c", program, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, (done.returncode, done.stdout[-500:], done.stderr[-2000:])
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    """A short recording, simulated."""
    whisker = samples.gamma()
    found = simulate(whisker, whisking(duration=0.4, rate=100.0), facing_peg(whisker))
    path = tmp_path_factory.mktemp("trial") / "trial.nc"
    save_recording(path, measure(found))
    return path


def check(rows, folder):
    assert len(rows) >= 8
    for name, said, content, left in rows:
        assert str(folder / name) in said, (name, said)
        assert "cannot be written" in said
        assert "\n" not in said
        assert content == "old", name
        assert left == [name]


@pytest.mark.slow
def test_every_writer_leaves_what_was_there(tmp_path, trial):
    check(run(WRITERS, tmp_path, 1000, trial), tmp_path)


@pytest.mark.slow
def test_a_file_system_of_a_few_kilobytes(tmp_path, trial):
    small = tmp_path / "small"
    small.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8k,nr_inodes=20", "none", str(small)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no file system can be mounted here")
    try:
        (small / "filler").write_bytes(bytes(4096))
        rows = run(WRITERS, small, 0, trial)
    finally:
        subprocess.run(["umount", str(small)], check=True)
    check([[*row[:3], [name for name in row[3] if name != "filler"]] for row in rows], small)


@pytest.mark.slow
def test_every_verb_ends_in_one_line(tmp_path):
    """Each works first, and then cannot do the same again."""
    rows = run(VERBS, tmp_path)
    worked = [row for row in rows if row[1]]
    failed = [row for row in rows if not row[1]]
    assert [row[0] for row in worked] == [row[0] for row in failed]
    assert [row[2] for row in worked] == [0] * len(worked), worked
    for verb, _, code, same, said in failed:
        assert code == 2, (verb, said)
        assert same, verb
        errors = [line for line in said.splitlines() if line.startswith("Error:")]
        assert len(errors) == 1, said
        assert "cannot be written" in errors[0]
        assert "Traceback" not in said
