"""docs/paper.md and the code say the same."""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "paper.md").read_text()
SOURCES = {path: path.read_text() for path in sorted((ROOT / "sb3_e2c").glob("*.py"))}
CORRESPONDENCE = PAGE.split("## Correspondence")[1].split("## Deviations")[0]
DEVIATIONS = set(re.findall(r"\*\*(D\d+) ", PAGE.split("## Deviations")[1]))


def tags(text):
    """Equations, algorithm lines, tables and sections that a text cites, one by one."""
    found = set()
    for name, numbers in re.findall(
        r"\b(Eq|Eqs|Table|Sec)\. ?((?:[\d.]+\d|\d)(?:, [\d.]*\d)*)", text
    ):
        found |= {f"{name.removesuffix('s')}. {n}" for n in numbers.split(", ")}
    for number, lines in re.findall(r"Alg\. (\d) l\. ([\d, -]*\d)", text):
        for part in lines.split(", "):
            first, _, last = part.partition("-")
            found |= {f"Alg. {number} l. {n}" for n in range(int(first), int(last or first) + 1)}
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_every_tag_in_the_code_stands_in_the_table(path):
    assert tags(SOURCES[path]) - tags(CORRESPONDENCE) == set()


def test_the_tags_of_the_paper_are_found():
    assert {"Eq. 6", "Eq. 8", "Alg. 1 l. 4", "Alg. 2 l. 12", "Sec. 5.2"} <= tags(CORRESPONDENCE)


@pytest.mark.parametrize("name", re.findall(r"`(sb3_e2c\.[\w.]+)`", CORRESPONDENCE))
def test_every_name_in_the_table_exists(name):
    module, rest = name, []
    while True:
        try:
            thing = importlib.import_module(module)
            break
        except ModuleNotFoundError:
            module, _, last = module.rpartition(".")
            rest.insert(0, last)
    for attribute in rest:
        thing = getattr(thing, attribute)


@pytest.mark.parametrize("name", sorted(set(re.findall(r"`(test_\w+\.py)`", CORRESPONDENCE))))
def test_every_test_in_the_table_exists(name):
    assert (ROOT / "tests" / name).is_file()


def test_deviations_that_the_code_cites_are_on_the_page():
    cited = {
        deviation
        for text in SOURCES.values()
        for line in re.findall(r"docs/paper\.md, ([D\d ,and]+)", text)
        for deviation in re.findall(r"D\d+", line)
    }
    assert cited
    assert cited <= DEVIATIONS
