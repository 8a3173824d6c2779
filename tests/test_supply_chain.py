"""What is installed, imported and called: no more than needed, all of it named, nothing at home."""

import ast
import configparser
import importlib.metadata as metadata
import re
import socket
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
PINS = (ROOT / "constraints.txt").read_text().splitlines()
# Read by the comparison with other libraries only, in environments of their own
STRANGERS = {"benchmarl", "torchrl"}


def setup_cfg():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    return config


def required(*extras):
    """Names of the distributions that the core and some extras ask for."""
    config = setup_cfg()
    sections = [config["options"]["install_requires"]]
    sections += [config["options.extras_require"][extra] for extra in extras]
    lines = [line for section in sections for line in section.splitlines()]
    return {
        canonicalize_name(Requirement(line).name)
        for line in lines
        if line.strip() and not line.startswith("#")
    }


def imported(folder):
    """Names of the modules of other projects that the files of a folder import, anywhere."""
    names = set()
    for path in (ROOT / folder).glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names.add(str(node.module).split(".")[0])
    return names - set(sys.stdlib_module_names) - {"sb3_e2c"}


def distributions(modules):
    """Canonical names of what could be installed for modules, one set for each."""
    known = metadata.packages_distributions()
    return {module: {canonicalize_name(name) for name in known[module]} for module in modules}


def test_the_core_install_is_exactly_what_the_library_imports():
    found = distributions(imported("sb3_e2c"))
    assert required() == {name for names in found.values() for name in names}


@pytest.mark.parametrize(("folder", "extra"), [("envs", "envs"), ("zoo", "zoo")])
def test_every_import_is_required_by_the_matching_extra(folder, extra):
    pytest.importorskip("rl_zoo3")
    needed = distributions(imported(folder) - STRANGERS)
    missing = {module for module, names in needed.items() if not names & required(extra)}
    assert missing == set()


def pinned():
    """Version of each pinned distribution, where its marker applies."""
    lines = [Requirement(line) for line in PINS if not line.startswith("#")]
    applying = [line for line in lines if line.marker is None or line.marker.evaluate()]
    return {canonicalize_name(line.name): str(line.specifier)[2:] for line in applying}


def test_every_line_of_the_constraints_pins_one_version():
    pattern = r'[A-Za-z0-9._-]+==[A-Za-z0-9.]+( ; python_version == "3\.\d+")?'
    assert [line for line in PINS if not re.fullmatch(f"{pattern}|#.*", line)] == []
    names = [canonicalize_name(Requirement(line).name) for line in PINS if line[0] != "#"]
    assert len(names) == len(set(names))


def closure(name, extras, seen):
    """Adds to ``seen`` all distributions that one needs, with its extras, on this machine."""
    for text in metadata.requires(name) or []:
        requirement = Requirement(text)
        marker = requirement.marker
        applies = marker is None or any(marker.evaluate({"extra": e}) for e in ("", *extras))
        key = (canonicalize_name(requirement.name), frozenset(requirement.extras))
        if applies and key not in seen:
            seen.add(key)
            closure(requirement.name, requirement.extras, seen)
    return {name for name, _ in seen}


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="pins are of Python 3.11")
def test_all_that_the_tests_install_is_pinned_to_what_is_installed():
    pytest.importorskip("onnx")
    config = setup_cfg()["options.extras_require"]
    named = [line for extra in ("export", "lint", "tests") for line in config[extra].splitlines()]
    seen = set()
    for line in [*setup_cfg()["options"]["install_requires"].splitlines(), *named]:
        if line.strip() and not line.startswith("#"):
            requirement = Requirement(line)
            seen.add((canonicalize_name(requirement.name), frozenset(requirement.extras)))
    for name, extras in list(seen):
        closure(name, extras, seen)
    versions = {name: metadata.version(name) for name, _ in seen}
    differing = {
        name: (version, pinned().get(name))
        for name, version in versions.items()
        if version.split("+")[0] != pinned().get(name)
    }
    assert differing == {}


def test_training_and_evaluating_call_nobody(tmp_path, monkeypatch):
    pytest.importorskip("rl_zoo3")
    from sb3_e2c.zoo import enjoy, train

    calls = []

    def refuse(*args):
        calls.append(args)
        raise OSError(f"the network was asked for {args}")

    for name in ("connect", "connect_ex", "sendto", "sendmsg"):
        monkeypatch.setattr(socket.socket, name, refuse)
    for name in ("getaddrinfo", "gethostbyname", "create_connection"):
        monkeypatch.setattr(socket, name, refuse)
    run = ["--algo", "e2c_t", "--env", "MultiRover-6-3-v0", "-f", str(tmp_path), "--device", "cpu"]
    small = ["n_envs:2", "n_epochs:1", "batch_size:480", "policy_kwargs.net_arch:[8]"]
    train.main([*run, "-n", "960", "--eval-freq", "480", "--eval-episodes", "2", "-params", *small])
    enjoy.main([*run, "--no-render", "--n-episodes", "2", "--n-envs", "2"])
    assert calls == []
