import ast
import importlib.metadata
import pkgutil
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import vibrissa

SOURCE = Path(vibrissa.__file__).parent


@pytest.mark.parametrize("name", vibrissa.__all__)
def test_every_public_name_resolves(name):
    assert getattr(vibrissa, name) is not None
    assert name in dir(vibrissa)


def test_every_public_name_comes_from_its_home():
    homes = {name: home for home, names in vibrissa._HOMES.items() for name in names.split()}
    for name, home in homes.items():
        module = importlib.import_module(f"vibrissa.{home}")
        assert getattr(vibrissa, name) is getattr(module, name)


def test_every_package_is_public():
    packages = {module.name for module in pkgutil.iter_modules(vibrissa.__path__) if module.ispkg}
    assert packages - set(vibrissa.__all__) <= {"cli", "demo"}
    assert set(dir(vibrissa)) == set(vibrissa.__all__)


@pytest.mark.parametrize(
    "name",
    ["cameras", "contacts", "quantities", "recording", "samples", "status", "viewer", "whisker"],
)
def test_completion_lists_public_names(name):
    module = importlib.import_module(f"vibrissa.{name}")
    assert dir(module) == sorted(module.__all__)


def imports_of(path):
    """Modules of vibrissa that a file names in its imports."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("vibrissa."):
            yield node.module


def test_packages_are_entered_through_their_faces():
    past = [
        f"{path.relative_to(SOURCE)} -> {module}"
        for path in SOURCE.rglob("*.py")
        for module in imports_of(path)
        if module.count(".") > 1 and module.split(".")[1] != path.relative_to(SOURCE).parts[0]
    ]
    assert past == []


def test_the_architecture_page_names_files_that_exist():
    page = SOURCE.parents[1] / "docs" / "architecture.md"
    if not page.exists():
        pytest.skip("the documentation is not here")
    named = re.findall(r"`([a-z_]+/[a-z_/]+\.py)`", page.read_text())
    assert len(named) > 40
    assert [name for name in named if not (SOURCE / name).is_file()] == []


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'wisker'"):
        _ = vibrissa.wisker


def test_version_is_that_of_the_distribution():
    assert importlib.metadata.version("vibrissa") == vibrissa.__version__


def test_the_package_is_a_command_too():
    words = [sys.executable, "-m", "vibrissa", "--version"]
    said = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    assert said.strip() == f"vibrissa {vibrissa.__version__}"


def test_import_loads_nothing_heavy():
    heavy = {"numba", "scipy", "xarray", "h5netcdf", "matplotlib"}
    heavier = heavy | {"numpy", "typer", "rich"}
    code = (
        f"import sys, vibrissa; print(sorted({heavier} & set(sys.modules)));"
        f"import vibrissa.cli.app; print(sorted({heavy} & set(sys.modules)))"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout
    assert loaded.split() == ["[]", "[]"]


def test_finding_a_contact_loads_neither_xarray_nor_splines(tmp_path, gamma_map):
    """They take longer than all else that a stream needs before its first answer."""
    gamma_map.save(tmp_path / "a.nc")
    code = (
        "import sys, vibrissa as vb, vibrissa.streaming\n"
        f"locate = vb.Estimator(vb.ContactMap.load({str(tmp_path / 'a.nc')!r}))\n"
        "found = locate([-1e-5, 1e-6, 0.5])\n"
        "slow = {'xarray', 'pandas', 'dask', 'scipy.interpolate', 'scipy.optimize'}\n"
        "print(sorted(slow & set(sys.modules)))"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout
    assert loaded.strip() == "[]"


def test_contacts_of_a_table_are_found_without_xarray(tmp_path, gamma_map):
    """Nor tracking, and a table is shown without the compiler."""
    gamma_map.save(tmp_path / "a.nc")
    points = [25e-3, 12e-3, 1e-3] + 1e-3 * np.arange(8)[:, None]
    bent = vibrissa.deflect(gamma_map.whisker, vibrissa.PointContact(points))
    rows = np.column_stack([np.arange(8.0), bent.force, bent.moment]).tolist()
    vibrissa.io.write_table(tmp_path / "a.csv", ["time", "Fx", "Fy", "Fz", "Mx", "My", "Mz"], rows)
    loaded = {}
    for verb in ("info a.csv", "estimate a.csv --map a.nc"):
        code = (
            "import sys; from vibrissa.cli.app import app\n"
            f"app({verb.split()}, standalone_mode=False)\n"
            "slow = {'xarray', 'pandas', 'vibrissa.tracking', 'numba'}\n"
            "print(*sorted(slow & set(sys.modules)))"
        )
        said = subprocess.run(
            [sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=tmp_path
        )
        loaded[verb] = said.stdout.splitlines()[-1]
    assert loaded == {"info a.csv": "", "estimate a.csv --map a.nc": "numba"}
    assert len(vibrissa.io.load_contacts(tmp_path / "contacts.csv").time) == 8


def test_kernels_are_at_hand_without_linear_algebra_of_scipy():
    """It takes as long as Numba; what shows a file, such as `info`, calls no kernel."""
    code = "import sys, vibrissa.contacts; print('scipy.linalg' in sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout
    assert loaded.strip() == "False"


def test_children_can_be_interrupted_where_the_tests_cannot(request):
    """As where a shell starts the tests in its background."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    request.getfixturevalue("interruptible")
    code = "import signal; print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
    child = [sys.executable, "-c", code]
    done = subprocess.run(child, check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "True"
