"""What pages tell to type can be typed, scripts use names that exist, and pictures stay small."""

import ast
import importlib
import re
import shlex
import sys
from functools import cache
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import typer

import vibrissa as vb
from vibrissa.cli.app import app

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
# Pages in different folders have the same name.
FOUND = (ROOT / "README.md", *sorted(DOCS.rglob("*.md")))
PAGES = {page.relative_to(ROOT).as_posix().removeprefix("docs/"): page for page in FOUND}
# Scripts that no other test runs
FOUND_SCRIPTS = (
    p for folder in ("studies", "benchmarks", "docs") for p in (ROOT / folder).rglob("*.py")
)
SCRIPTS = {path.relative_to(ROOT).as_posix(): path for path in sorted(FOUND_SCRIPTS)}
LARGEST = 300_000


def blocks(page, *kinds):
    """Fenced code of some languages."""
    found = re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)
    return [text for kind, text in found if kind in kinds]


def commands(text):
    """Words of each call of the command line, of its own or in a pipe."""
    calls = re.split(r"[\n|]|&&", text.replace("\\\n", " "))
    calls = [call.split(" #")[0].strip() for call in calls]
    return [shlex.split(call)[1:] for call in calls if call.startswith("vibrissa ")]


@cache
def command():
    return typer.main.get_command(app)


def parse(words):
    """Raise if there is no such verb or option."""
    group = command()
    verb = group.commands.get(words[0], group)
    if verb is group and not words[0].startswith("-"):
        raise ValueError(f"no verb {words[0]}")
    verb.make_parser(typer.Context(verb)).parse_args(words[verb is not group :])


@pytest.mark.parametrize("name", PAGES)
def test_commands_have_these_verbs_and_options(name):
    text = PAGES[name].read_text(encoding="utf-8")
    inline = [code for code in re.findall(r"`(vibrissa [^`\n]+)`", text) if " " in code]
    typed = [*blocks(PAGES[name], "", "sh", "bash", "console"), *inline]
    for words in (words for one in typed for words in commands(one)):
        # A verb alone is its name; VERB, MAP and the like stand for something.
        if words[0].isupper():
            continue
        parse(words)


def test_what_cannot_be_typed_is_noticed():
    for words, message in (
        (["deflect", "--pint", "24,14,2"], "o such option"),
        (["bnd"], "no verb"),
    ):
        with pytest.raises(Exception, match=message):
            parse(words)


def inside(node, modules):
    """The module, or what it offers, that an expression such as vb.pipeline names; else None."""
    if isinstance(node, ast.Name):
        return modules.get(node.id)
    within = inside(node.value, modules) if isinstance(node, ast.Attribute) else None
    if not isinstance(within, ModuleType):
        return None
    assert hasattr(within, node.attr), ast.unparse(node)
    return getattr(within, node.attr)


def check_names(code):
    """Raise unless all that the code names of vibrissa exists."""
    modules = {"vb": vb}
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and node.module.partition(".")[0] == "vibrissa":
            module = importlib.import_module(node.module)
            for one in node.names:
                # A module that its package does not show
                if not hasattr(module, one.name):
                    importlib.import_module(f"{node.module}.{one.name}")
                modules[one.asname or one.name] = getattr(module, one.name)
        inside(node, modules)


@pytest.mark.parametrize("name", PAGES)
def test_names_that_pages_use_exist(name):
    for code in blocks(PAGES[name], "python"):
        check_names(code)


@pytest.mark.parametrize("name", SCRIPTS)
def test_names_that_scripts_use_exist(name):
    check_names(SCRIPTS[name].read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["README.md", "tutorial.md"])
def test_the_tour_runs(name, monkeypatch, capsys):
    """All of it, but maps without the paper's grid and verdicts from few samples."""
    simulate, ask = vb.ContactMap.simulate, vb.uniqueness
    few = {"samples": 32, "resolution": False}

    def asked(contacts, triplets, **options):
        return ask(contacts, triplets[:1], ["all"], **options | few)

    monkeypatch.setattr(vb.ContactMap, "simulate", lambda whisker: simulate(whisker, grid=False))
    monkeypatch.setattr(vb, "uniqueness", asked)
    names = {}
    for code in blocks(PAGES[name], "python"):
        exec(compile(code, name, "exec"), names)
    assert names["found"].point == pytest.approx(names["bent"].contact_point, abs=1e-9)
    assert names["verdicts"].verdict.item() == "unique"


@pytest.mark.parametrize("picture", sorted(DOCS.rglob("*.png")), ids=lambda path: path.name)
def test_pictures_are_small(picture):
    assert picture.stat().st_size < LARGEST


def ros_kind(types, name):
    """Class of messages with the fields, and types of these, of a definition of ROS."""
    fields = dict(types.fielddefs[name][1])
    plain = {"float64": float, "string": str, "int32": int, "uint32": int}

    class Message:
        __slots__ = tuple(fields)

        def __init__(self):
            for field, (_, detail) in fields.items():
                if isinstance(detail, str):
                    setattr(self, field, ros_kind(types, detail)())
                elif detail[0] in plain:
                    setattr(self, field, plain[detail[0]]())

        def __setattr__(self, field, value):
            detail = fields[field][1]
            if isinstance(detail, str):
                assert tuple(value.__slots__) == tuple(dict(types.fielddefs[detail][1]))
            elif detail[0] in plain:
                assert isinstance(value, plain[detail[0]])
            else:
                ((_, (item, _)), size) = detail
                assert [type(one) for one in value] == [plain[item]] * size
            object.__setattr__(self, field, value)

    return Message


@pytest.mark.parametrize("mass", [0.0, 0.01])
def test_the_node_for_ros_answers_a_wrench_with_its_contact(tmp_path, monkeypatch, mass):
    """With the definitions of its messages, but stand-ins of ROS itself, which is not on PyPI."""
    pytest.importorskip("rosbags")
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    contact_map = vb.ContactMap.simulate(vb.samples.gamma(), grid=False)
    contact_map.save(tmp_path / "own.nc")
    sensor = vb.sensors.Sensor(noise=[1e-6] * 3 + [2e-8] * 3, mass=mass)
    vb.sensors.save_sensor(tmp_path / "sensor.toml", sensor)
    monkeypatch.chdir(tmp_path)
    stated = {"map": "own.nc", "frame_id": "left_whisker"}
    heard, published = [], []

    class Node:
        def __init__(self, name):
            assert name == "vibrissa"

        def declare_parameter(self, name, value):
            return SimpleNamespace(value=stated.get(name, value))

        def create_publisher(self, kind, topic, qos):
            assert isinstance(qos, int)

            def publish(message):
                assert isinstance(message, kind)
                published.append(message)

            return SimpleNamespace(publish=publish)

        def create_subscription(self, kind, topic, answer, qos):
            assert qos == "best effort"  # reliable ones do not receive what sensors publish
            heard.append((kind, answer))

    names = ("WrenchStamped", "PoseWithCovarianceStamped")
    kinds = {name: ros_kind(types, f"geometry_msgs/msg/{name}") for name in names}
    for name, held in (
        ("rclpy", {"init": lambda: None, "spin": lambda node: None}),
        ("rclpy.node", {"Node": Node}),
        ("rclpy.qos", {"qos_profile_sensor_data": "best effort"}),
        ("geometry_msgs", {}),
        ("geometry_msgs.msg", kinds),
    ):
        module = ModuleType(name)
        vars(module).update(held)
        monkeypatch.setitem(sys.modules, name, module)
    (code,) = blocks(PAGES["streams.md"], "py")
    exec(compile(code, "streams.md", "exec"), {})
    ((kind, answer),) = heard
    bent = vb.deflect(contact_map.whisker, vb.PointContact([24e-3, 14e-3, 2e-3]))
    noise = np.random.default_rng(1).normal(size=(100, 6)) * sensor.noise
    contact = np.concatenate([bent.force, bent.moment])
    for wrench in (contact, *noise):  # noise of a free whisker has no contact
        message = kind()
        message.header.frame_id, message.header.stamp.sec = "sensor", 7
        for part, values in (("force", wrench[:3]), ("torque", wrench[3:])):
            for axis, value in zip("xyz", values.tolist(), strict=True):
                setattr(getattr(message.wrench, part), axis, value)
        if mass:
            with pytest.raises(ValueError, match="the rotation from whisker to laboratory"):
                answer(message)
            return
        answer(message)
    (found,) = published
    place = found.pose.pose.position
    assert [place.x, place.y, place.z] == pytest.approx(bent.contact_point, abs=1e-6)
    assert (found.header.frame_id, found.header.stamp.sec) == ("left_whisker", 7)
    assert 0.0 < found.pose.covariance[0] < 1e-6
    assert found.pose.covariance[21] > 1.0
