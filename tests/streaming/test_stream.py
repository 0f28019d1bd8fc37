"""Lines in, contacts out: by pipe, UDP and bag; bad lines are said and passed over."""

import errno
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli.app import app
from vibrissa.contacts import ContactFilter, Estimator
from vibrissa.io import bag_wrenches
from vibrissa.sensors import Sensor, SensorFrame, save_sensor
from vibrissa.streaming import (
    Answers,
    ContactStream,
    ContactStreams,
    LineKind,
    Lines,
    NewestLines,
    Poses,
    advice,
    file_lines,
)
from vibrissa.streaming.contacts import COMPONENTS, as_json
from vibrissa.streaming.lines import POSITION, QUATERNION
from vibrissa.streaming.sources import udp_lost, udp_socket


def stream(*words):
    """What the verb prints; its exception where it fails."""
    done = CliRunner().invoke(app, ["stream", *map(str, words)])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done


START = "from vibrissa.cli import main; main()"
NOISE = np.repeat([1e-6, 2e-8], 3)

HELD = {"time": 0.0, "Fx": 0.0, "MB": 0.0, "MD": 0.0, "base_qw": 1.0}
HELD |= dict.fromkeys((*POSITION, *QUATERNION[1:]), 0.0)


@pytest.fixture(scope="module")
def gamma_map():
    return vb.ContactMap.simulate(vb.samples.gamma(), grid=False)


@pytest.fixture(scope="module")
def bent(gamma_map):
    t = np.linspace(0.0, 1.0, 12)
    load = vb.PointForce((0.8 - 0.3 * t) * 40e-3, 3e-5 + 6e-5 * t, 0.5 + 1.5 * t)
    return vb.deflect(gamma_map.whisker, load)


@pytest.fixture(scope="module")
def wrench(bent):
    return np.concatenate([bent.force, bent.moment], axis=1)


@pytest.fixture(scope="module")
def map_file(gamma_map, tmp_path_factory):
    path = tmp_path_factory.mktemp("stream") / "map.nc"
    gamma_map.save(path)
    return path


def csv_lines(wrench):
    yield "time," + ",".join(COMPONENTS)
    for i, row in enumerate(wrench):
        yield f"{0.001 * i}," + ",".join(repr(float(x)) for x in row)


def estimator(contacts, names="Fx MB MD", **options):
    return Estimator(contacts, names, np.diag(NOISE**2), **options)


@pytest.mark.parametrize("names", ["Fx MB MD", "MD Fx MB", "Fx FT FD Mx MB MD"])
@pytest.mark.parametrize("kind", ["components", "signals", "json", "spreadsheet"])
def test_lines_give_the_contacts(gamma_map, bent, wrench, names, kind):
    lines = list(csv_lines(wrench))
    known = vb.base_signals(bent.force, bent.moment)
    rows = np.stack([known[name] for name in names.split()], axis=-1)
    if kind == "signals":
        lines = [",".join(["time", *names.split()])]
        lines += [f"{0.001 * i}," + ",".join(map(repr, row.tolist())) for i, row in enumerate(rows)]
    if kind == "json":
        lines = [json.dumps(dict(zip(names.split(), row.tolist(), strict=True))) for row in rows]
    if kind == "spreadsheet":
        lines = ["Time (ms);Fx [mN];fy_mN;Fz/mN;Mx (mN·mm);Ty_uNm;Torque Z (µN·m)"]
        size = np.repeat([1e-3, 1e-6], 3)
        lines += [
            ";".join(map(repr, [1.0 * i, *(w / size).tolist()])) for i, w in enumerate(wrench)
        ]
        lines = [lines[0], *(line.replace(".", ",") for line in lines[1:])]
    running = ContactStream(estimator(gamma_map, names))
    records = list(running.records(lines))
    assert len(records) == len(wrench) == running.samples
    for i, record in enumerate(records):
        assert record["status"] in ("unique", "ambiguous")
        away = np.linalg.norm(np.array(record["candidates"]) - bent.contact_point[i], axis=1)
        assert away.min() < 1e-8
        assert record["sigma_x"] > 0.0
        assert record["friction"] == 0.0
        if kind != "json":
            assert record["time"] == pytest.approx(0.001 * i, rel=1e-15)


def test_bad_lines_are_said_and_passed_over(gamma_map, wrench):
    good = list(csv_lines(wrench))
    lines = [
        "# a comment",
        good[0],
        good[1],
        "1.0,2.0",
        "",
        good[2].replace(good[2].split(",")[1], "abc"),
        "{broken",
        '{"Fx": 1e-5}',
        '{"Fx": true, "MB": 1e-6, "MD": 0.5}',
        '{"Fx": 1e-5, "MB": -1e-6, "MD": 0.5}',
        good[3].rsplit(",", 1)[0] + ",",
        good[0],
        good[4],
    ]
    running = ContactStream(estimator(gamma_map))
    records = list(running.records(lines))
    faults = {record["line"]: record["error"] for record in records if "error" in record}
    assert set(faults) == {4, 6, 7, 8, 9, 10}
    assert running.faults == 6
    assert "2 cells" in faults[4]
    assert "'abc', which is not a number" in faults[6]
    assert "not JSON" in faults[7]
    assert "lacks MB, MD" in faults[8]
    assert "not a number" in faults[9]
    assert "cannot be negative" in faults[10]
    found = [record["status"] for record in records if "status" in record]
    assert found == ["unique", "missing", "unique"]
    header = ContactStream(estimator(gamma_map))
    (record,) = header.records(["time,Fx,My"])
    assert "the header lacks MB, MD; or Mz" in record["error"]


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("0.0,1e-5\r2,0,0,0,0,0", "no CSV"),
        ('{"Fx": 1' + 400 * "0" + ', "MB": 1e-6, "MD": 0.5}', "larger than any number"),
        ('{"Fx": ' + 60_000 * "[", "not JSON"),
        ('{"Fx": ' + 100_000 * "[", "a line of more than 65536 characters"),
        (",".join(30_000 * ["0"]), "30000 cells; the header has 7"),
        (",".join(f"c{i}" for i in range(9_000)), "9000 cells; the header has 7"),
        ("0.1,1e-5\0,0,0,0,0,0", "not a number"),
        (json.dumps(HELD | {"base_qw": 1e155}), "of length 1e+155, not 1"),
        (json.dumps(HELD | {"base_x": 1e308}), "its position is in m"),
        (json.dumps(HELD | {"base_x": float("inf")}), "its position is in m"),
        (json.dumps(HELD | {"stamp_ns": 1.5}), "a whole number of ns"),
        (b"0.1,1e-5,\xe2\x82".decode(errors="replace"), "3 cells; the header has 7"),
        ("nan,0,0,0,0,0,0", "time is 'nan'; a finite number"),
        (",0,0,0,0,0,0", "time is ''"),
        ('{"time": Infinity, "Fx": 1e-5, "MB": 1e-6, "MD": 0.5}', "time is inf"),
        ("0.1,1e-5,2e-5,0,0,3", "6 cells; the header has 7"),
        ("0.1,1e-5,2e-5,0,0,1e-7,3.4e", "not a number"),
    ],
)
def test_no_line_ends_a_stream(gamma_map, wrench, line, error):
    """Noise on a serial line and strangers' datagrams give faults, not exceptions."""
    good = list(csv_lines(wrench))
    records = list(ContactStream(estimator(gamma_map)).records([good[0], line, good[1]]))
    assert error in records[0]["error"]
    assert records[1]["status"] == "unique"


def test_garbage_gives_faults_only(gamma_map, wrench):
    """Random bytes, as from a stranger's datagrams, and lines cut anywhere."""
    rng = np.random.default_rng(7)
    good = list(csv_lines(wrench))
    garbage = [rng.bytes(n).decode("utf-8", errors="replace") for n in rng.integers(1, 80, 300)]
    cut = [good[1][:n] for n in range(1, len(good[1]) - 30)]
    running = ContactStream(estimator(gamma_map))
    records = list(running.records([*garbage[:150], good[0], *garbage[150:], *cut, good[1]]))
    assert all("error" in record for record in records[:-1])
    assert records[-1]["status"] == "unique"
    for record in records:
        assert json.loads(as_json(record))


@pytest.mark.parametrize("names", ["Fx MB MD", "Fx FT MB MD"])
def test_numbers_of_which_squares_are_none_give_a_status(gamma_map, names):
    """Also in the batch, which looks for the nearest signals in the same way."""
    contacts = estimator(gamma_map, names, felt_above=5.0)
    row = dict.fromkeys(names.split(), 1e-6)
    strange = (1e99, 1e154, 1e155, -1e155, 1e200, 1e308, -1e308, 5e-324, -0.0)
    rows = [row | {"Fx": value} for value in strange]
    running = ContactStream(contacts)
    records = list(running.records(map(json.dumps, rows)))
    assert running.faults == 0
    assert {record["status"] for record in records[:-2]} == {"outside_map"}
    table = {key: np.array([1e200 if key == "Fx" else 1e-6, 1e-6]) for key in row}
    found = gamma_map.estimate(table, tuple(row))
    assert found.status[0] == vb.Status.OUTSIDE_MAP


def test_a_header_that_names_a_column_twice_is_refused():
    lines = Lines(COMPONENTS)
    with pytest.raises(ValueError, match="the header has Fx more than once"):
        lines("time,Fx,Fx,Fy,Fz,Mx,My,Mz")
    with pytest.raises(ValueError, match="that of line 1 was refused"):
        lines("0,1,2,3,4,5,6,7")


@pytest.mark.parametrize(
    "text",
    [
        "time,Fx,MB,MD\nms,mN,mN·mm,deg\n{rows}",
        "# of 2026\ntime_ms,Fx_mN,MB (mN mm),MD [deg]\n{rows}\n,,,\n",
        "sep=;\ntime;Fx;MB;MD\nms;mN;mNmm;°\n{rows}",
        "time,note,Fx,MB,MD\nms,,mN,Nmm,deg\n{noted}",
    ],
)
def test_lines_of_spreadsheets(text):
    """A line of units, of the separator, a comment, and rows without any number."""
    rows = "1,2,3,-90\n2,,,"
    if "sep" in text:
        rows = rows.replace(",", ";")
    noted = "1,first,2,3e-3,-90\n2,,,,"
    lines = Lines(("Fx", "MB", "MD"))
    samples = [lines(line) for line in text.format(rows=rows, noted=noted).splitlines()]
    first, second = (sample for sample in samples if sample is not None)
    assert (first.time, second.time) == (1e-3, 2e-3)
    np.testing.assert_allclose(first.values, [2e-3, 3e-6, -np.pi / 2])
    assert np.isnan(second.values).all()


def test_a_line_that_states_no_units_is_an_error():
    lines = Lines(("Fx", "MB", "MD"))
    assert lines("time,Fx,MB,MD") is None
    with pytest.raises(ValueError, match="the header lacks Fx"):
        lines("s,apples,Nm,rad")


def test_rows_are_not_read_under_a_header_that_was_refused(gamma_map, wrench):
    """A sensor's channels have no units: a header that gives some cannot be used."""
    sensor = Sensor(noise=NOISE)
    good = list(csv_lines(wrench))
    running = ContactStream(Estimator.of_sensor(gamma_map, sensor), COMPONENTS)
    units = "time," + ",".join(f"{name} (mN)" for name in COMPONENTS)
    *before, header, row, other, again = running.records(
        [*good[:2], units, good[2], "Fx;Fy;Fz", good[0], good[2]]
    )
    assert [record["status"] for record in before] == ["unique"]
    assert "without units) lacks Fx, Fy" in header["error"]
    assert row == {
        "line": 4,
        "error": "a row without a header that names its columns: that of line 3 was refused",
    }
    assert "lacks" in other["error"]
    assert again["status"] == "unique"
    # Other names of its channels are understood, and times in other units, as ROS writes them.
    running = ContactStream(Estimator.of_sensor(gamma_map, sensor), COMPONENTS)
    called = [f"wrench.{kind}.{axis}" for kind in ("force", "torque") for axis in "xyz"]
    (record,) = running.records(["t_ns," + ",".join(called), "3e9," + good[2].partition(",")[2]])
    assert record["time"] == 3.0
    np.testing.assert_allclose([record[n] for n in "xyz"], [again[n] for n in "xyz"], rtol=1e-9)
    # Without a sensor its units count, also where its cells are parted otherwise.
    running = ContactStream(estimator(gamma_map))
    milli = "time;" + ";".join(f"{name} [mN]" for name in COMPONENTS[:3]) + ";Mx;My;Mz"
    size = np.repeat([1e3, 1.0], 3)
    rows = [";".join(map(repr, [0.1, *(size * w).tolist()])) for w in wrench[:1]]
    first, second = running.records([*good[:2], milli, *rows])
    np.testing.assert_allclose([second[n] for n in "xyz"], [first[n] for n in "xyz"], rtol=1e-9)
    # Noise and strangers' lines are no headers.
    running = ContactStream(estimator(gamma_map))
    lines = [*good[:2], "hello, world", "\ufffd\ufffd nonsense", good[2]]
    assert ["error" in one for one in running.records(lines)] == [False, True, True, False]


def test_a_sender_of_json_may_begin_anew_as_well(gamma_map, wrench):
    """JSON has no header: time that falls far tells; a little is a sample that comes too late."""
    contacts = estimator(gamma_map)
    running = ContactStream(contacts, follow=ContactFilter(contacts))
    rows = [dict(zip(COMPONENTS, row, strict=True)) for row in wrench.tolist()]
    times = (100.0, 100.001, 100.001, 100.0, 0.0, 0.001)
    lines = [json.dumps({"time": t} | row) for t, row in zip(times, rows, strict=False)]
    records = list(running.records(lines))
    assert ["error" in record for record in records] == [False, False, True, True, False, False]
    assert "times must increase" in records[2]["error"]
    assert records[4]["status"] == "unique"


@pytest.mark.parametrize(
    ("factor", "suspicion"),
    [(1000.0, "larger than any"), (1e-3, "far enough from zero"), (1.0, "")],
)
def test_wrong_units_are_suspected(gamma_map, wrench, factor, suspicion):
    running = ContactStream(estimator(gamma_map, "Fx FT MB MD", felt_above=5.0))
    list(running.records(csv_lines(factor * wrench)))
    said = " ".join(advice(running))
    assert suspicion in said
    assert bool(suspicion) == bool(said)


def test_a_sender_that_begins_anew_may_begin_time_anew(gamma_map, bent, wrench):
    contacts = estimator(gamma_map)
    running = ContactStream(contacts, follow=ContactFilter(contacts))
    signals = vb.base_signals(bent.force[:2], bent.moment[:2])
    rows = np.stack([signals[name] for name in ("Fx", "MB", "MD")], axis=-1)
    other = ["Fx,MB,MD,time"]  # also in other columns
    other += [",".join(map(repr, [*row, 0.001 * i])) for i, row in enumerate(rows.tolist())]
    first, again, changed = (
        list(running.records(lines)) for lines in (*2 * (list(csv_lines(wrench[:2])),), other)
    )
    assert [record["status"] for record in first] == ["unique", "unique"]
    for record, same, new in zip(first, again, changed, strict=True):
        assert same == record
        np.testing.assert_allclose([new[n] for n in "xyz"], [record[n] for n in "xyz"], rtol=1e-9)
    assert running.faults == 0


def test_records_are_json_whatever_is_missing(gamma_map):
    running = ContactStream(Estimator(gamma_map, "Fx MB MD"))
    (record,) = running.records(['{"time": 1.0, "Fx": null, "MB": 1e-6, "MD": 0.5}'])
    assert json.loads(as_json(record)) == {"time": 1.0, "status": "missing"}
    assert (
        as_json({"a": [np.inf, 1.0], "b": {"c": np.nan}}) == '{"a": [null, 1.0], "b": {"c": null}}'
    )


def test_a_filter_gives_the_laboratory_by_the_pose_in_the_line(gamma_map, bent, wrench):
    contacts = estimator(gamma_map)
    running = ContactStream(contacts, follow=ContactFilter(contacts))
    # Contact 3 has a straight region, so that the mean of the posterior is the contact itself.
    half = np.sqrt(0.5)  # a quarter turn about z
    pose = {"base_x": 0.1, "base_y": 0.2, "base_z": 0.3}
    pose |= {"base_qw": half, "base_qx": 0.0, "base_qy": 0.0, "base_qz": half}
    row = dict(zip(COMPONENTS, wrench[3].tolist(), strict=True))
    (record,) = running.records([json.dumps({"time": 0.0} | row | pose)])
    x, y, z = bent.contact_point[3]
    lab = [record[name] for name in ("lab_x", "lab_y", "lab_z")]
    np.testing.assert_allclose(lab, [0.1 - y, 0.2 + x, 0.3 + z], atol=1e-7)
    np.testing.assert_allclose([record[n] for n in "xyz"], bent.contact_point[3], atol=1e-7)
    sigma, lab_sigma = ([record[f"{p}sigma_{n}"] for n in "xyz"] for p in ("", "lab_"))
    np.testing.assert_allclose(lab_sigma, [sigma[1], sigma[0], sigma[2]], rtol=1e-6)
    for lost in ({"base_qw": None}, {"base_x": None}):
        contacts.reset()
        (record,) = ContactStream(contacts, follow=ContactFilter(contacts)).records(
            [json.dumps({"time": 0.0} | row | pose | lost)]
        )
        assert record == {"time": 0.0, "status": "missing"}
    late = json.dumps({"time": 0.0} | row | pose)
    bent_quaternion = json.dumps({"time": 1.0} | row | pose | {"base_qw": 3.0})
    errors = [record["error"] for record in running.records([late, bent_quaternion])]
    assert "times must increase" in errors[0]
    assert "not 1" in errors[1]


@contextmanager
def run(*options):
    """The verb, stopped at the end come what may."""
    with subprocess.Popen(
        [sys.executable, "-c", START, "stream", *map(str, options)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": ""},
    ) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.usefixtures("interruptible")
def test_the_verb_answers_each_line_at_once_and_ends_cleanly(map_file, bent, wrench):
    lines = list(csv_lines(wrench))
    with run("--map", map_file) as process:
        process.stdin.write("\n".join(lines[:2]) + "\n")
        process.stdin.flush()
        first = json.loads(process.stdout.readline())  # while its input stays open
        assert first["status"] == "unique"
        process.stdin.buffer.write(b"\xff nonsense\n" + lines[2].encode() + b"\n")
        process.stdin.flush()
        assert "error" in json.loads(process.stdout.readline())
        second = json.loads(process.stdout.readline())
        np.testing.assert_allclose([second[n] for n in "xyz"], bent.contact_point[1], atol=1e-8)
        process.send_signal(signal.SIGINT)
        process.wait(timeout=60)  # while its input stays open, as a terminal's does
        rest, told = process.communicate()
        assert rest == ""
        assert "2 samples, 1 lines that could not be read" in told
        assert "unique: 2" in told
        assert "Traceback" not in told
        assert process.returncode == 0


def test_the_verb_listens_to_udp_with_a_sensor(map_file, bent, wrench, tmp_path):
    """Two lines in one datagram, one in the next; channels of a sensor that sits askew."""
    sensor = Sensor(
        ("a", "b", "c"),
        np.eye(6)[[0, 4, 5]] * [1e5, 1, 1, 1, 1e7, 1e7],
        noise=0.1,
        bias=[1.0, 2.0, 3.0],
        frame=SensorFrame(("x", "z", "-y")),
    )
    save_sensor(tmp_path / "sensor.toml", sensor)
    readings = wrench @ sensor.base_mixing.T + sensor.bias
    with run(
        "--udp",
        "127.0.0.1:0",
        "--map",
        map_file,
        "--sensor",
        tmp_path / "sensor.toml",
        "--every",
        "--count",
        3,
    ) as process:
        heard = process.stderr.readline()
        port = int(heard.rsplit(":", 1)[1])
        lines = [json.dumps(dict(zip("abc", row, strict=True))) for row in readings[:3].tolist()]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.sendto("\n".join(lines[:2]).encode(), ("127.0.0.1", port))
            time.sleep(0.05)
            out.sendto(lines[2].encode(), ("127.0.0.1", port))
        output, _ = process.communicate(timeout=120)
    records = [json.loads(line) for line in output.splitlines()]
    assert len(records) == 3
    for record, point in zip(records, bent.contact_point[:3], strict=True):
        np.testing.assert_allclose([record[n] for n in "xyz"], point, atol=1e-7)


def test_of_what_waits_at_a_socket_only_the_newest_sample_is_read():
    """Headers, and poses that a motion is continued from, are not dropped with samples."""
    wanted = Lines(("Fx", "MB", "MD"))
    pose = {"time": 0.0} | dict.fromkeys((*POSITION, *QUATERNION), 0.5)
    poses = [json.dumps(pose | {"time": i}) for i in range(5)]
    sample = json.dumps({"Fx": 1.0, "MB": 1.0, "MD": 1.0})
    with udp_socket("127.0.0.1", 0) as heard, socket.socket(type=socket.SOCK_DGRAM) as out:

        def send(*lines):
            out.sendto("\n".join(lines).encode(), heard.getsockname())

        newest = NewestLines(heard, wanted.kind)
        read = iter(newest)
        for each in ("1,2,3\n.5,6,7", poses[0], "Fx,MB,MD", sample, *poses[1:], "-8,9,1", "7,8,9"):
            send(each)
        send("1,1,1", "2,2,2")
        assert [next(read) for _ in range(5)] == ["Fx,MB,MD", *poses[3:], "1,1,1", "2,2,2"]
        assert newest.dropped == 5
        send("3,3,3")
        assert next(read) == "3,3,3"
        assert newest.dropped == 5


def test_what_the_system_throws_away_is_counted():
    with udp_socket("127.0.0.1", 0) as heard, socket.socket(type=socket.SOCK_DGRAM) as out:
        heard.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)  # the least that it allows
        for _ in range(1000):
            out.sendto(bytes(100), heard.getsockname())
        heard.setblocking(False)
        came = 0
        with suppress(BlockingIOError):
            while heard.recv(200):
                came += 1
        assert 0 < came < 1000
        if sys.platform == "linux":
            assert came + udp_lost(heard) == 1000


@pytest.mark.usefixtures("interruptible")
def test_over_udp_stale_samples_are_dropped_and_counted(map_file, wrench):
    """More come than can be answered: the last is answered, and the others are accounted for."""
    lines = list(csv_lines(wrench))
    count = 3000
    with run("--udp", "127.0.0.1:0", "--map", map_file) as process:
        port = int(process.stderr.readline().rsplit(":", 1)[1])
        assert process.stderr.readline() == "ready\n"
        samples = [f"{i},{lines[1].split(',', 1)[1]}" for i in range(count)]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            for burst in ([lines[0], *samples[: count // 2]], samples[count // 2 :]):
                for line in burst:
                    out.sendto(line.encode(), ("127.0.0.1", port))
                while json.loads(process.stdout.readline())["time"] != float(
                    burst[-1].split(",")[0]
                ):
                    pass
                time.sleep(1.1)  # losses are reported once a second
        process.send_signal(signal.SIGTERM)
        rest, said = process.communicate(timeout=60)
    assert rest == ""
    answered = int(said.split(" samples, 0 lines")[0].rsplit("\n", 1)[-1])
    dropped = int(said.rsplit(" samples dropped because newer", 1)[0].rsplit(" ", 1)[-1])
    assert answered + dropped == count
    assert said.count("so far ") >= 1


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_pipe_that_closes_is_waited_for(tmp_path):
    path, said = tmp_path / "pipe", []
    os.mkfifo(path)
    read = file_lines(path, reconnect=True, report=said.append)

    def write(text, after):
        # The pipe is opened again only once the reader has seen it closed.
        while len(said) < after:
            time.sleep(0.01)
        path.write_text(text)

    for after, text in enumerate(("1\n2\n3.1", "4\n")):  # the third number was to have more digits
        writer = threading.Thread(target=write, args=(text, after))
        writer.start()
        assert [next(read) for _ in range(text.count("\n"))] == text.splitlines(keepends=True)[:2]
        writer.join()
    assert said == [f"{path} closed; waiting until it opens again", f"{path} is open again"]
    (tmp_path / "file").write_text("1\n")
    with pytest.raises(ValueError, match="only a named pipe or device"):
        next(file_lines(tmp_path / "file", reconnect=True))


def test_poses_may_come_at_another_rate_and_of_what_carries_the_base(gamma_map, bent, wrench):
    """The base turns and travels evenly; every sixth sample a pose of the flange comes before."""
    contacts = estimator(gamma_map)
    turn = Rotation.from_rotvec([0.1, 0.2, 0.3])
    place = np.array([1e-2, 0.0, 2e-2])
    poses = Poses(turn.as_matrix(), place)
    running = ContactStream(contacts, follow=ContactFilter(contacts), poses=poses)

    def flange(time):
        return Rotation.from_rotvec([0.0, 0.0, 40.0 * time]), np.array([0.1 * time, 0.0, 0.5])

    lines, expected = [], []
    for i, row in enumerate(wrench.tolist()):
        time = 0.001 * i
        rotation, position = flange(time)
        if i in (0, 1, 6):
            q = rotation.as_quat()[[3, 0, 1, 2]]
            pose = dict(zip((*POSITION, *QUATERNION), [*position, *q], strict=True))
            lines.append(json.dumps({"time": time} | pose))
        lines.append(json.dumps({"time": time} | dict(zip(COMPONENTS, row, strict=True))))
        expected.append((rotation * turn, position + rotation.apply(place)))
    records = list(running.records(lines))
    assert len(records) == len(wrench) == running.samples
    for i, record in enumerate(records):
        rotation, base = expected[i]
        own = [record[name] for name in "xyz"]
        lab = [record[name] for name in ("lab_x", "lab_y", "lab_z")]
        np.testing.assert_allclose(lab, rotation.apply(own) + base, atol=1e-12)
    assert poses.number == 3
    assert np.isnan(poses.at(1.0).position).all()  # long after the last
    assert not advice(running)
    far = Poses()
    for i in range(3):
        far.put(0.001 * i, np.eye(3), np.array([0.2 * i, 0.0, 0.0]))  # mm that are taken for m
    running.poses = far
    assert "is its position in m" in " ".join(advice(running))


def test_the_offset_is_found_anew_from_the_first_samples(gamma_map, bent, wrench):
    sensor = Sensor(noise=NOISE, mass=1e-3, mass_moment=(1e-6, 0.0, 0.0), bias=7e-4)
    drifted = replace(sensor, bias=9e-4)
    turned = Rotation.from_euler("x", 30, degrees=True)
    rotation = [turned.as_matrix()] * 12
    free = drifted.read(np.arange(12.0), np.zeros((12, 6)), 1, rotation)
    touch = replace(drifted, noise=0.0).read(np.arange(12.0), wrench, 2, rotation)
    running = ContactStream(Estimator.of_sensor(gamma_map, sensor), COMPONENTS, tare=12)
    pose = dict(zip(QUATERNION, turned.as_quat()[[3, 0, 1, 2]], strict=True))
    pose |= dict.fromkeys(POSITION, 0.0)
    rows = np.concatenate([free, touch[8:9]]).tolist()
    lines = [json.dumps(pose | dict(zip(COMPONENTS, row, strict=True))) for row in rows]
    *before, last = running.records(lines)
    assert {record["status"] for record in before} == {"tare"}
    away = np.array([last[name] for name in "xyz"]) - bent.contact_point[8]
    assert np.linalg.norm(away) < 1e-3
    (unposed,) = running.records([json.dumps(dict(zip(COMPONENTS, rows[0], strict=True)))])
    assert "base_qw" not in unposed.get("error", "")  # the pose before still counts
    running = ContactStream(Estimator.of_sensor(gamma_map, sensor), COMPONENTS)
    (unposed,) = running.records([json.dumps(dict(zip(COMPONENTS, rows[0], strict=True)))])
    assert "base's rotation is needed: base_qw" in unposed["error"]
    with pytest.raises(ValueError, match="tare needs a sensor"):
        ContactStream(estimator(gamma_map), tare=3)


@pytest.mark.parametrize(
    ("tare", "missing", "touched"), [(10, 0, False), (18, 0, True), (30, 10, False)]
)
def test_an_offset_of_too_few_samples_or_of_a_touched_whisker_is_questioned(
    gamma_map, wrench, tare, missing, touched
):
    sensor = Sensor(noise=NOISE)
    loads = np.concatenate([np.zeros((12, 6)), np.tile(wrench[8], (8, 1))])
    running = ContactStream(Estimator.of_sensor(gamma_map, sensor), COMPONENTS, tare=tare)
    list(running.records(csv_lines(sensor.read(np.arange(20.0), loads, 1))))
    assert running.tare_missing == missing
    assert ("scatter" in " ".join(advice(running))) == touched


def test_a_general_error_is_suspected_where_many_samples_have_no_contact(gamma_map, wrench):
    """As with forces in gf, or rotations inverted: some contacts are found, and are wrong too."""
    wrong = wrench[:8] * np.repeat([0.1, 1.0], 3)
    for share, suspected in ((wrong, True), (wrench[:8], False)):
        running = ContactStream(estimator(gamma_map, "Fx FT FD Mx MB MD", felt_above=5.0))
        list(running.records(csv_lines(np.concatenate([share, wrench]))))
        assert bool(advice(running)) == suspected
        assert not suspected or "8 of 20 samples with signals" in advice(running)[0]


def test_a_base_that_moves_now_and_then_in_millimetres_is_questioned(gamma_map):
    running = ContactStream(estimator(gamma_map))
    for i in range(100):  # at rest, and for a tenth of the time at 50 mm/s
        running.poses.put(0.001 * i, np.eye(3), np.array([0.05 * min(i, 10), 0.0, 0.0]))
    assert "is its position in m" in " ".join(advice(running))


def test_times_in_a_smaller_unit_are_noticed(gamma_map, wrench):
    row = dict(zip(COMPONENTS, wrench[8].tolist(), strict=True))
    running = ContactStream(estimator(gamma_map))
    (record,) = running.records([json.dumps({"time": 1.7e18} | row)])
    assert "in ms, µs or ns" in record["error"]
    for step, noticed in ((1e6, True), (1.0, True), (0.01, False)):
        running = ContactStream(estimator(gamma_map))
        list(running.records(json.dumps({"time": step * i} | row) for i in range(5)))
        assert ("is their time in s?" in " ".join(advice(running))) == noticed


def test_a_serial_line_that_is_unplugged_is_named(tmp_path, monkeypatch):
    def unplugged(file):
        yield "time,Fx\n"
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("vibrissa.streaming.sources.bounded_lines", unplugged)
    (tmp_path / "ttyUSB0").touch()
    lines = file_lines(tmp_path / "ttyUSB0")
    assert next(lines) == "time,Fx\n"
    with pytest.raises(OSError, match=r"ttyUSB0 was lost .* --reconnect"):
        next(lines)


def write_wrenches(path, topics, sec=7, position=None, stamps=None):
    """A bag with WrenchStamped messages a millisecond apart, and a pose at their beginning.

    Time stamps that are given are recorded 40 ns later.
    """
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    t, kind = store.types, "geometry_msgs/msg/WrenchStamped"
    with Writer(path, version=Writer.VERSION_LATEST) as writer:
        for name, wrenches in topics.items():
            topic = writer.add_connection(name, kind, typestore=store)
            for i, row in enumerate(wrenches):
                nanosec = 1_000_000 * i if sec else 0
                if stamps is not None:
                    sec, nanosec = divmod(stamps[i], 10**9)
                stamp = t["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
                header = t["std_msgs/msg/Header"](stamp=stamp, frame_id="sensor")
                force = t["geometry_msgs/msg/Vector3"](*row[:3].tolist())
                torque = t["geometry_msgs/msg/Vector3"](*row[3:].tolist())
                both = t["geometry_msgs/msg/Wrench"](force=force, torque=torque)
                raw = store.serialize_cdr(t[kind](header=header, wrench=both), kind)
                recorded = 7_000_000_000 + 1_000_000 * i if stamps is None else stamps[i] + 40
                writer.write(topic, recorded, raw)
        if position is None:
            return
        kind = "geometry_msgs/msg/TransformStamped"
        topic = writer.add_connection("/flange", kind, typestore=store)
        vector = t["geometry_msgs/msg/Vector3"](*position)
        half = t["geometry_msgs/msg/Quaternion"](0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
        stamp = t["builtin_interfaces/msg/Time"](sec=sec, nanosec=0)
        header = t["std_msgs/msg/Header"](stamp=stamp, frame_id="world")
        pose = t["geometry_msgs/msg/Transform"](translation=vector, rotation=half)
        message = t[kind](header=header, child_frame_id="flange", transform=pose)
        writer.write(topic, 7_100_000_000, store.serialize_cdr(message, kind))


def test_time_stamps_and_frames_go_through_unchanged(gamma_map, wrench, tmp_path, monkeypatch):
    """Nanoseconds since 1970 have more digits than a 64-bit float."""
    pytest.importorskip("rosbags")
    stamps = 1_700_000_000_123_456_789 + 1_000_003 * np.arange(12)
    write_wrenches(tmp_path / "in", {"/wrench": wrench}, stamps=stamps.tolist())
    gamma_map.save(tmp_path / "map.nc")
    stream(tmp_path / "in", "--map", tmp_path / "map.nc", "--bag-out", tmp_path / "out")
    assert [each.stamp for each in bag_wrenches(tmp_path / "in")] == stamps.tolist()
    shown = CliRunner().invoke(app, ["info", str(tmp_path / "in")]).output
    assert "12 messages, geometry_msgs/msg/WrenchStamped" in shown
    assert "next: vibrissa stream" in shown
    messages = bag_messages(tmp_path / "out")
    for name in ("/contact_point", "/contact_candidates"):
        headers = [message.header for _, message in messages[name]]
        said = [10**9 * header.stamp.sec + header.stamp.nanosec for header in headers]
        assert said == stamps.tolist()
        assert [recorded for recorded, _ in messages[name]] == (stamps + 40).tolist()
        assert {header.frame_id for header in headers} == {"sensor"}


def bag_messages(path):
    """Recording times and messages of a bag by their topic."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([path], default_typestore=store) as reader:
        found = {c.topic: [] for c in reader.connections}
        for connection, recorded, raw in reader.messages():
            found[connection.topic].append((recorded, reader.deserialize(raw, connection.msgtype)))
        assert reader.message_count == sum(map(len, found.values()))
    return found


@pytest.mark.slow
@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("name", ["SIGHUP", "SIGKILL"])
def test_a_bag_is_whole_however_the_stream_ends(map_file, wrench, tmp_path, name):
    """All samples after a signal that can be taken; after SIGKILL those of a second before it.

    All signals that can be taken are handled alike; SIGTERM and SIGINT end streams above.
    """
    pytest.importorskip("rosbags")
    lines = list(csv_lines(wrench))
    with run("--map", map_file, "--bag-out", tmp_path / "out") as process:
        process.stdin.write("\n".join(lines[:8]) + "\n")
        process.stdin.flush()
        for _ in range(7):
            assert json.loads(process.stdout.readline())["status"] == "unique"
        if name == "SIGKILL":
            time.sleep(1.0)
        process.send_signal(getattr(signal, name))
        process.wait(timeout=60)
        said = process.stderr.read()
    assert "Traceback" not in said
    if name != "SIGKILL":
        assert process.returncode == 0
        assert "7 samples" in said
    messages = bag_messages(tmp_path / "out")
    assert [recorded for recorded, _ in messages["/contact_point"]] == [
        1_000_000 * i for i in range(7)
    ]
    assert len(messages["/contact_candidates"]) == 7
    metadata = json.loads((tmp_path / "out" / "metadata.yaml").read_text())  # JSON is YAML
    assert metadata["rosbag2_bagfile_information"]["message_count"] == 28


def test_a_bag_that_was_killed_while_it_was_written_is_finished_by_the_reader(wrench, tmp_path):
    """A journal of SQLite is left beside the database; what it undoes must not be read."""
    pytest.importorskip("rosbags")
    import shutil
    import sqlite3

    write_wrenches(tmp_path / "bag", {"/wrench": wrench})
    (file,) = (tmp_path / "bag").glob("*.db3")
    database = sqlite3.connect(file)
    database.execute("PRAGMA cache_size = 0")  # what is changed goes to the file at once
    database.execute("UPDATE messages SET data = zeroblob(40000)")
    shutil.copytree(tmp_path / "bag", tmp_path / "killed")
    database.close()
    assert Path(f"{tmp_path / 'killed' / file.name}-journal").stat().st_size
    values = [message.values for message in bag_wrenches(tmp_path / "killed")]
    np.testing.assert_array_equal(values, wrench)


def test_a_bag_that_cannot_be_written_is_said_and_the_stream_goes_on(
    map_file, wrench, tmp_path, monkeypatch
):
    pytest.importorskip("rosbags")

    def full(self):
        raise OSError("no space")

    lines = list(csv_lines(wrench))
    (tmp_path / "lines.csv").write_text("\n".join(lines))
    monkeypatch.setattr("vibrissa.io.rosbag.ContactBag.write", lambda *_, **__: full(None))
    done = stream(tmp_path / "lines.csv", "--map", map_file, "--bag-out", tmp_path / "out")
    assert done.exit_code == 1
    assert len(done.stdout.splitlines()) == len(wrench)
    assert done.stderr.count("no space; the stream goes on without it") == 1


def test_bags_that_hold_something_else(wrench, tmp_path):
    pytest.importorskip("rosbags")
    write_wrenches(tmp_path / "two", {"/left": wrench[:2], "/right": wrench[2:3]})
    with pytest.raises(ValueError, match=r"name one of those .*: /left, /right"):
        list(bag_wrenches(tmp_path / "two"))
    with pytest.raises(ValueError, match="no '/up' with WrenchStamped; name one of those"):
        list(bag_wrenches(tmp_path / "two", "/up"))
    assert len(list(bag_wrenches(tmp_path / "two", "/right"))) == 1
    write_wrenches(tmp_path / "both", {"/wrench": wrench[:2], "/rod/contact_force": wrench[:3]})
    assert len(list(bag_wrenches(tmp_path / "both"))) == 2
    write_wrenches(tmp_path / "answers", {"/contact_force": wrench[:3]})
    with pytest.raises(ValueError, match=r"only /contact_force \(estimated forces at contacts\)"):
        list(bag_wrenches(tmp_path / "answers"))
    assert len(list(bag_wrenches(tmp_path / "answers", "/contact_force"))) == 3
    write_wrenches(tmp_path / "empty", {"/wrench": wrench[:0]})
    assert list(bag_wrenches(tmp_path / "empty")) == []
    write_wrenches(tmp_path / "nothing", {})
    with pytest.raises(ValueError, match="no topic with WrenchStamped messages, only none at all"):
        list(bag_wrenches(tmp_path / "nothing"))
    write_wrenches(tmp_path / "unstamped", {"/wrench": wrench[:3]}, sec=0)
    stamps = [message.stamp for message in bag_wrenches(tmp_path / "unstamped")]
    assert stamps == [7_000_000_000, 7_001_000_000, 7_002_000_000]


@pytest.mark.parametrize("name", ["out", "out.mcap"])
def test_a_bag_goes_in_and_a_bag_comes_out(name, map_file, bent, wrench, tmp_path):
    pytest.importorskip("rosbags")
    write_wrenches(tmp_path / "in", {"/wrench": wrench})
    out = tmp_path / name
    output = stream(tmp_path / "in", "--map", map_file, "--bag-out", out).stdout
    records = [json.loads(line) for line in output.splitlines()]
    assert [record["time"] for record in records] == pytest.approx(7.0 + 1e-3 * np.arange(12))
    found = bag_messages(out)
    points = [(m.point.x, m.point.y, m.point.z) for _, m in found["/contact_point"]]
    np.testing.assert_allclose(points, bent.contact_point, atol=1e-8)
    stamp, first = found["/contact_point"][3]
    assert stamp == 7_003_000_000
    assert (first.header.stamp.sec, first.header.stamp.nanosec) == (7, 3_000_000)
    assert first.header.frame_id == "sensor"
    for record, (_, cloud) in zip(records, found["/contact_candidates"], strict=True):
        table = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(cloud.width, 4)
        np.testing.assert_allclose(table[:, :3], record["candidates"], rtol=1e-6)
        assert [field.name for field in cloud.fields] == ["x", "y", "z", "probability"]
        assert cloud.row_step == cloud.data.size == 16 * cloud.width
    for k, (record, (_, pose)) in enumerate(zip(records, found["/contact_pose"], strict=True)):
        place, spread = pose.pose.pose.position, pose.pose.covariance.reshape(6, 6)
        np.testing.assert_allclose([place.x, place.y, place.z], bent.contact_point[k], atol=1e-8)
        sigma = [record[f"sigma_{axis}"] for axis in "xyz"]
        np.testing.assert_allclose(np.sqrt(np.diag(spread)[:3]), sigma, rtol=1e-12)
    for k, (_, message) in enumerate(found["/contact_force"]):
        pull = message.wrench.force
        np.testing.assert_allclose([pull.x, pull.y, pull.z], bent.force[k], rtol=1e-6)


def test_onset_loss_and_slip_are_events(gamma_map, wrench):
    """A free whisker, a contact that slides, jumps by 8 mm, and is lost; sample by sample."""
    arc = np.array([32e-3, 31.9e-3, 31.8e-3, 24e-3, 23.9e-3])
    load = vb.PointForce(arc, np.where(arc > 30e-3, 5e-5, 1e-4), 0.5)
    bent = vb.deflect(gamma_map.whisker, load)
    rows = np.concatenate([bent.force, bent.moment], axis=1)
    rows = np.concatenate([np.zeros((2, 6)), rows, np.zeros((2, 6))])
    running = ContactStream(estimator(gamma_map, felt_above=5.0))
    lines = [
        json.dumps({"time": 0.01 * i} | dict(zip(COMPONENTS, row, strict=True)))
        for i, row in enumerate(rows.tolist())
    ]
    events = {r["time"]: r["event"] for r in running.records(lines) if "event" in r}
    assert events == {0.02: "onset", 0.05: "slip", 0.07: "loss"}
    assert running.events == {"onset": 1, "slip": 1, "loss": 1}
    steady = ContactStream(estimator(gamma_map, felt_above=5.0), slip_speed=10.0)
    assert "slip" not in {r.get("event") for r in steady.records(lines)}
    with pytest.raises(ValueError, match="speed of a slip"):
        ContactStream(estimator(gamma_map), slip_speed=0.0)


def events_of(gamma_map, rows, rate):
    """Events of a stream, by the number of the sample."""
    lines = [
        json.dumps({"time": i / rate} | dict(zip(COMPONENTS, row, strict=True)))
        for i, row in enumerate(rows.tolist())
    ]
    records = ContactStream(estimator(gamma_map, felt_above=5.0)).records(lines)
    return {i: record["event"] for i, record in enumerate(records) if "event" in record}


def test_noise_along_a_valley_is_no_slip(gamma_map):
    """A contact slides by 0.1 mm a sample, and noise moves its points much farther."""
    n = 60
    load = vb.PointForce(26e-3, np.linspace(3e-5, 8e-5, n), np.linspace(0.5, 1.5, n))
    bent = vb.deflect(gamma_map.whisker, load)
    rows = np.concatenate([bent.force, bent.moment], axis=1)
    rows = rows + NOISE * np.random.default_rng(0).normal(size=(n, 6))
    assert events_of(gamma_map, rows, 500.0) == {0: "onset"}


def test_a_slip_is_found_behind_a_sample_that_nothing_explains(gamma_map):
    arc = np.array([32e-3, 31.9e-3, 24e-3, 23.9e-3, 23.8e-3])
    load = vb.PointForce(arc, np.where(arc > 30e-3, 5e-5, 1e-4), 0.5)
    bent = vb.deflect(gamma_map.whisker, load)
    rows = np.concatenate([bent.force, bent.moment], axis=1)
    rows = np.insert(rows, 2, [2e-4, 1e-5, 0.0, 0.0, 0.0, 3e-7], axis=0)
    assert events_of(gamma_map, rows, 500.0) == {0: "onset", 3: "slip"}


@pytest.mark.parametrize("kind", ["csv", "json", "apart"])
def test_several_whiskers_in_one_stream(gamma_map, bent, wrench, kind):
    both = ContactStreams([ContactStream(estimator(gamma_map), whisker=w) for w in ("a", "b")])
    pairs = list(zip(wrench[:3].tolist(), wrench[3:6].tolist(), strict=True))
    named = [[f"{w}.{n}" for n in COMPONENTS] for w in "ab"]
    if kind == "csv":
        lines = [",".join(["time", *named[0], *named[1]])]
        lines += [",".join(map(repr, [0.1 * i, *a, *b])) for i, (a, b) in enumerate(pairs)]
    else:
        rows = [
            [dict(zip(n, v, strict=True)) for n, v in zip(named, p, strict=True)] for p in pairs
        ]
        rows = [[a | b] if kind == "json" else [a, b] for a, b in rows]
        lines = [json.dumps({"time": 0.1 * i} | one) for i, row in enumerate(rows) for one in row]
    records = list(both.records(lines))
    assert [record["whisker"] for record in records] == 3 * ["a", "b"]
    for k, record in enumerate(records):
        point = bent.contact_point[k // 2 + 3 * (k % 2)]
        np.testing.assert_allclose([record[n] for n in "xyz"], point, atol=1e-8)
    assert both.samples == 6
    (fault,) = both.records(["{broken"])
    assert "not JSON" in fault["error"]
    assert both.kind(lines[-1]) == LineKind.SAMPLE
    with pytest.raises(ValueError, match="different names"):
        ContactStreams(2 * [ContactStream(estimator(gamma_map))])


def test_whiskers_of_a_line_without_a_time_are_read_at_one_time(gamma_map, wrench):
    both = ContactStreams([ContactStream(estimator(gamma_map), whisker=w) for w in ("a", "b")])
    named = [f"{w}.{n}" for w in "ab" for n in COMPONENTS]
    lines = [json.dumps(dict(zip(named, [*row, *row], strict=True))) for row in wrench[:2].tolist()]
    time = [record["time"] for record in both.records(lines)]
    assert time[0] == time[1] < time[2] == time[3]


def test_two_whiskers_from_the_command_line(map_file, bent, wrench, tmp_path):
    pytest.importorskip("rosbags")
    rows = [
        {
            f"{w}.{n}": v
            for w, row in zip(("left", "right"), pair, strict=True)
            for n, v in zip(COMPONENTS, row, strict=True)
        }
        for pair in zip(wrench[:2].tolist(), wrench[2:4].tolist(), strict=True)
    ]
    path = tmp_path / "lines.jsonl"
    path.write_text("\n".join(json.dumps({"time": 0.1 * i} | row) for i, row in enumerate(rows)))
    maps = ["--map", f"left={map_file}", "--map", f"right={map_file}"]
    done = stream(path, *maps, "--bag-out", tmp_path / "out")
    records = [json.loads(line) for line in done.stdout.splitlines()]
    assert [record["whisker"] for record in records] == 2 * ["left", "right"]
    assert "right: 2 samples" in done.stderr
    (_, first), _ = bag_messages(tmp_path / "out")["/right/contact_point"]
    np.testing.assert_allclose([first.point.x, first.point.y], bent.contact_point[2, :2], atol=1e-8)
    with pytest.raises(ValueError, match="several whiskers need names"):
        stream(path, "--map", map_file, "--map", map_file)
    with pytest.raises(ValueError, match="--sensor is of other"):
        stream(path, *maps, "--sensor", "other=sensor.toml")


@pytest.mark.parametrize("kind", ["sensor", "signals"])
def test_estimate_takes_the_lines_of_a_stream(kind, gamma_map, map_file, bent, wrench, tmp_path):
    """Channels of a sensor, or signals by name: one row a sample, as `stream` answers."""
    sensor = Sensor(("a", "b", "c"), np.eye(6)[[0, 4, 5]] * 1e6, noise=[1.0, 0.02, 0.02])
    save_sensor(tmp_path / "sensor.toml", sensor)
    known = vb.base_signals(bent.force, bent.moment)
    names = {"sensor": "abc", "signals": ("MB", "Fx", "MD")}[kind]
    rows = wrench[:, [0, 4, 5]] * 1e6
    options = ["--sensor", tmp_path / "sensor.toml", "--stiffness-sigma", 1.0]
    if kind == "signals":
        rows = np.stack([known[name] for name in names], axis=-1)
        options = ["--using", "Fx,MB,MD"]
    table = tmp_path / "lines.csv"
    lines = [",".join(["time", *names])]
    lines += [",".join(map(repr, [0.1 * i, *row])) for i, row in enumerate(rows.tolist())]
    table.write_text("\n".join(lines))
    words = ["estimate", table, "--map", map_file, *options, "-o", tmp_path / "contacts.csv"]
    done = CliRunner().invoke(app, list(map(str, words)))
    assert done.exit_code == 0, done.output
    found = np.genfromtxt(
        tmp_path / "contacts.csv", delimiter=",", names=True, dtype=None, encoding="utf-8"
    )
    points = np.stack([found[name] for name in "xyz"], axis=1)
    np.testing.assert_allclose(points, bent.contact_point, atol=1e-7)
    assert (found["sigma_x"] > 0.0).all()
    assert set(found["status"]) <= {"unique", "ambiguous"}


def test_answers_go_to_another_program(map_file, wrench, tmp_path):
    path = tmp_path / "lines.csv"
    path.write_text("\n".join(csv_lines(wrench[:3])))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard:
        heard.bind(("127.0.0.1", 0))
        heard.settimeout(10.0)
        port = heard.getsockname()[1]
        printed = stream(path, "--map", map_file, "--send", f"udp://127.0.0.1:{port}").stdout
        assert "".join(heard.recv(65535).decode() for _ in range(3)) == printed
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        assert stream(path, "--map", map_file, "--send", address).stdout == printed
        accepted, _ = server.accept()
        with accepted, accepted.makefile() as lines:
            assert lines.read() == printed
    with pytest.raises(ValueError, match="answers cannot go to tcp"):
        Answers(address)
    for wrong in ("127.0.0.1:5", "http://127.0.0.1:5", "tcp://here"):
        with pytest.raises(ValueError, match="HOST:PORT"):
            Answers(wrong)


def test_a_bag_may_hold_the_pose_of_what_carries_the_base(map_file, wrench, tmp_path):
    """A quarter turn about z, and the base 10 mm along the flange's x."""
    pytest.importorskip("rosbags")
    write_wrenches(tmp_path / "in", {"/wrench": wrench[5:9]}, position=[0.1, 0.2, 0.3])
    pose = ("--filter", "--pose-topic", "/flange", "--mount", "10,0,0,1,0,0,0")
    for line in stream(tmp_path / "in", "--map", map_file, *pose).stdout.splitlines():
        record = json.loads(line)
        x, y, z = (record[name] for name in "xyz")
        lab = [record[name] for name in ("lab_x", "lab_y", "lab_z")]
        np.testing.assert_allclose(lab, [0.1 - y, 0.21 + x, 0.3 + z], atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--mount", "1,2,3"], "X,Y,Z,QW,QX,QY,QZ are needed"),
        (["nothing.csv"], "there is no file"),
        (["--udp", "here"], "HOST:PORT"),
        (["x", "--udp", "127.0.0.1:0"], "either a source or --udp"),
        (["--sensor", "none.toml"], r"none\.toml"),
        (["--udp", "127.0.0.1:0", "--speed", 1.0], "add --filter"),
        (["--every"], "samples are dropped only with --udp"),
        (["--reconnect"], "neither a named pipe nor a device"),
        ([__file__, "--reconnect"], "for named pipes and devices"),
    ],
)
def test_what_cannot_be_is_said(options, message, map_file):
    with pytest.raises((ValueError, OSError), match=message):
        stream(*options, "--map", map_file)


@pytest.mark.parametrize("repeats", [1, 4])
def test_a_sensor_that_is_slower_than_its_lines_is_noticed(gamma_map, repeats):
    whisker = gamma_map.whisker
    touch = vb.deflect(whisker, vb.PointForce(0.7 * whisker.length, 2e-4, 0.3))
    wrench = np.concatenate([touch.force, touch.moment])
    noisy = wrench + NOISE * np.random.default_rng(0).normal(size=(160, 6))
    sensor = Sensor(noise=NOISE)
    running = ContactStream(Estimator.of_sensor(gamma_map, sensor, felt_above=5.0), COMPONENTS)
    lines = [
        json.dumps({"time": 0.001 * i} | dict(zip(COMPONENTS, noisy[i // repeats], strict=True)))
        for i in range(160)
    ]
    assert all(record["status"] == "unique" for record in running.records(lines))
    said = " ".join(advice(running))
    assert ("120 of 160 samples with signals have exactly" in said) == (repeats > 1)
