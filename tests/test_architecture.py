"""Which module may import which (map of the README, section "Read the code")."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PURE = {
    *("entropy", "constraints", "multipliers", "returns", "losses", "objective", "ratings"),
    "bounds",
}
LIBRARY = sorted((ROOT / "sb3_e2c").glob("*.py"))
ENVS = sorted((ROOT / "envs").rglob("*.py"))


def imported(path):
    """Full names of everything that a file imports, wherever the statement stands."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def starting_with(names, *prefixes):
    return {name for name in names for p in prefixes if name == p or name.startswith(f"{p}.")}


@pytest.mark.parametrize("module", sorted(PURE))
def test_the_method_itself_knows_neither_sb3_nor_the_rest_of_the_library(module):
    names = imported(ROOT / "sb3_e2c" / f"{module}.py")
    outside = {f"sb3_e2c.{other}" for other in PURE}
    assert (
        starting_with(names, "stable_baselines3", "supersuit", "pettingzoo", "gymnasium") == set()
    )
    assert {n for n in starting_with(names, "sb3_e2c") if not starting_with({n}, *outside)} == set()


@pytest.mark.parametrize("path", LIBRARY, ids=lambda path: path.name)
def test_the_library_imports_neither_environments_nor_the_zoo(path):
    assert starting_with(imported(path), "sb3_e2c.envs", "sb3_e2c.zoo", "envs", "zoo") == set()


@pytest.mark.parametrize("path", ENVS, ids=lambda path: path.name)
def test_environments_know_nothing_of_learning(path):
    names = imported(path)
    assert starting_with(names, "stable_baselines3", "torch", "sb3_e2c.zoo", "envs", "zoo") == set()
    library = {n for n in starting_with(names, "sb3_e2c") if not n.startswith("sb3_e2c.envs")}
    assert library == set()


@pytest.mark.parametrize(
    "module",
    [
        "callbacks",
        "evaluation",
        "vec_env",
        "worlds",
        "world",
        "monitor",
        "policies",
        "buffers",
        "recorder",
        "recurrent",
        "sides",
        "opponents",
    ],
)
def test_adapters_do_not_know_the_algorithm(module):
    assert starting_with(imported(ROOT / "sb3_e2c" / f"{module}.py"), "sb3_e2c.mappo") == set()


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        (
            "sb3_e2c",
            "rl_zoo3 mujoco ray mpe2 matplotlib.pyplot onnx onnxruntime huggingface_hub optuna "
            "requests urllib3 wandb",
        ),
        ("sb3_e2c.envs", "torch mujoco mpe2"),
    ],
)
def test_importing_stays_light(module, heavy):
    # sb3_e2c.envs lives inside the package, whose __init__ imports torch: load it by its folder
    code = (
        "import sys, importlib.util as u\n"
        f"name, heavy = {module!r}, {heavy.split()!r}\n"
        "if name == 'sb3_e2c.envs':\n"
        "    import types; package = types.ModuleType('sb3_e2c')\n"
        f"    package.__path__ = [{str(ROOT / 'sb3_e2c')!r}]; sys.modules['sb3_e2c'] = package\n"
        "__import__(name)\n"
        "loaded = [h for h in heavy if h in sys.modules]\n"
        "assert not loaded, loaded\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
