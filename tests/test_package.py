"""The package as it is installed: its wheel, its plugins, its extras, what importing it costs."""

import os
import subprocess
import sys
import tarfile
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

import lerobot_swr
from lerobot_swr import installation

REPOSITORY = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def distributions(tmp_path_factory):
    """Wheel and source distribution, built as a release builds them."""
    pytest.importorskip("build")
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(REPOSITORY)]
    subprocess.run(command, check=True, capture_output=True)
    [wheel], [sdist] = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, sdist


def test_wheel_and_source_distribution_hold_what_they_should(distributions):
    """LeRobot's name, typed markers, the page of the map, the commands; no tests in the wheel."""
    wheel, sdist = distributions
    names = zipfile.ZipFile(wheel).namelist()
    info = f"lerobot_policy_swr-{lerobot_swr.__version__}.dist-info"
    assert {"lerobot_swr/py.typed", "lerobot_policy_swr/py.typed", "lerobot_swr/styles/map.html"} <= set(
        names
    )
    assert {name.split("/")[0] for name in names} == {"lerobot_swr", "lerobot_policy_swr", info}
    metadata = zipfile.ZipFile(wheel).read(f"{info}/METADATA").decode()
    # LeRobot imports the distribution's name, so its underscores must stay.
    assert "\nName: lerobot_policy_swr\n" in metadata
    entry_points = zipfile.ZipFile(wheel).read(f"{info}/entry_points.txt").decode()
    assert "lerobot-swr-eval = lerobot_swr.cli.eval:main" in entry_points
    with tarfile.open(sdist) as archive:
        assert any(name.endswith("/tests/test_package.py") for name in archive.getnames())


def test_the_package_index_would_take_them(distributions):
    """``twine check --strict``."""
    pytest.importorskip("twine")
    subprocess.run([sys.executable, "-m", "twine", "check", "--strict", *map(str, distributions)], check=True)


def test_the_wheel_trains_where_the_repository_is_not(distributions, small_maze, tmp_path):
    """In an environment of its own, whose LeRobot is this one's, ``lerobot-train --policy.type=wzbc`` runs.

    ``.github/workflows/ci.yml`` does the same with every dependency installed from the index.
    """
    wheel, _ = distributions
    home = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(home)], check=True)
    python = home / "bin" / "python"
    [packages] = home.glob("lib/python3*/site-packages")
    # Dependencies without this environment's own copy of the package, whose editable install is a .pth file.
    outside = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
    (packages / "dependencies.pth").write_text("\n".join(outside) + "\n")
    zipfile.ZipFile(wheel).extractall(packages)
    run = [
        *(str(python), "-c", "from lerobot.scripts.lerobot_train import main; main()"),
        *("--policy.type=wzbc", "--policy.device=cpu", "--policy.push_to_hub=false", "--num_workers=0"),
        *("--policy.backbone.hidden_dim=16", "--batch_size=8", "--steps=2", "--save_freq=2"),
        *("--dataset.repo_id=local/small_maze", f"--dataset.root={small_maze}", "--output_dir=run"),
    ]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(run, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    assert (tmp_path / "run/checkpoints/000002/pretrained_model/model.safetensors").is_file()
    where = subprocess.run(
        [str(python), "-c", "import lerobot_swr; print(lerobot_swr.__file__)"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert Path(where.stdout.strip()).is_relative_to(home)


def test_lerobots_commands_start_no_slower():
    """Beside ``lerobot-train`` the plugin loads nothing that takes long: no plotting, no simulators."""
    code = (
        "import sys, lerobot.scripts.lerobot_train; before = set(sys.modules); import lerobot_swr; "
        "print(*{name.split('.')[0] for name in set(sys.modules) - before})"
    )
    found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert not set(found.split()) & {
        "matplotlib",
        "plotly",
        "mujoco",
        "numba",
        "pymunk",
        "diffusers",
        "joblib",
    }


def test_the_module_says_what_is_installed():
    """``python -m lerobot_swr``: versions, plugins, policies, environments, extras."""
    command = [sys.executable, "-m", "lerobot_swr"]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert f"lerobot_swr {lerobot_swr.__version__}" in told
    assert f"lerobot {version('lerobot')}" in told
    for expected in ("plugins: lerobot_policy_swr", "zbc", "wzbc", "maze2d", "mlp", "extra d3il", "video: "):
        assert expected in told


def test_a_missing_extra_is_told_with_its_packages(monkeypatch):
    """Named with the version that is asked for, where the package is absent or of another version."""
    installed = {"lerobot_policy_swr": "1", "numpy": "2.0", "plotly": "5.1"}
    asked = ["numpy>=1", 'plotly>=6; extra == "map"', 'mujoco==3.3.6; extra == "d3il"']

    class Distribution:
        def __init__(self, name):
            self.requires = asked if name == "lerobot_policy_swr" else []
            self.version = installed[name]

    def distribution(name):
        if name not in installed:
            raise installation.PackageNotFoundError(name)
        return Distribution(name)

    monkeypatch.setattr(installation, "distribution", distribution)
    assert installation.unmet_requirements() == []
    assert installation.unmet_requirements(extra="map") == ["plotly>=6 (installed: 5.1)"]
    assert installation.unmet_requirements(extra="d3il") == ["mujoco==3.3.6"]


def test_a_missing_optional_package_is_an_error_with_the_way_to_it(monkeypatch):
    """The map without plotly."""
    from lerobot_swr.styles import map as style_map

    monkeypatch.setitem(sys.modules, "plotly", None)
    monkeypatch.delitem(sys.modules, "plotly.offline", raising=False)
    with pytest.raises(installation.MissingExtraError, match=r"pip install 'lerobot_policy_swr\[map\]'"):
        style_map._plotly_js()
