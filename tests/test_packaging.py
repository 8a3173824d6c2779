"""What a user installs is all there."""

import configparser
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import sb3_e2c

ROOT = Path(__file__).parent.parent
SHIPPED = ("sb3_e2c", "envs", "zoo")


@pytest.fixture(scope="module")
def wheel_files(tmp_path_factory):
    """Names of the files in a wheel that is built from a copy of the tree."""
    tree = tmp_path_factory.mktemp("tree")
    for folder in SHIPPED:
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / folder, tree / folder, symlinks=True, ignore=ignore)
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tree)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps"]
    subprocess.run(
        [*command, "--no-build-isolation", "--wheel-dir", str(tree / "dist"), str(tree)],
        check=True,
        capture_output=True,
    )
    (wheel,) = (tree / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def test_the_wheel_has_every_module_and_every_yaml_file(wheel_files):
    expected = set()
    for folder in SHIPPED:
        for path in (ROOT / folder).rglob("*"):
            inside = path.relative_to(ROOT / folder)
            if path.suffix in (".py", ".yml", ".typed") and inside.parts[0] not in ("envs", "zoo"):
                package = "sb3_e2c" if folder == "sb3_e2c" else f"sb3_e2c/{folder}"
                expected.add(f"{package}/{inside.as_posix()}")
    assert "sb3_e2c/zoo/hyperparams/defaults.yml" in expected
    assert expected <= wheel_files


def test_the_wheel_claims_no_other_name(wheel_files):
    assert {name.split("/")[0].split("-")[0] for name in wheel_files} == {"sb3_e2c"}


def test_the_version_is_stated_once_more_and_alike():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    assert config["metadata"]["version"] == sb3_e2c.__version__


def test_torch_is_pinned():
    assert "\ntorch==2.13.0\n" in (ROOT / "constraints.txt").read_text()
