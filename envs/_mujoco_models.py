"""MuJoCo models: gymnasium's stock XML files with walls and a bomb added.

Only additions are made, with ElementTree, which does not depend on MuJoCo's version.
"""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from itertools import product
from typing import Any
from xml.etree import ElementTree as ET

from sb3_e2c.envs._mujoco_config import RobotConfig
from sb3_e2c.envs._mujoco_hazards import BOMB_START, SLOPE, WALL_OFFSET
from sb3_e2c.envs._mujoco_import import mujoco

STOCK_XML = {"Ant": "ant.xml", "HalfCheetah": "half_cheetah.xml"}
_HEIGHT = {"Ant": 2, "HalfCheetah": 1}  # number of the joint position that is the height
BOMB = "bomb"  # name of the body's joint, geom and motor

_WALL_COLOR = "0.95 0.45 0.4 0.4"
_NO_CONTACT = {"contype": "0", "conaffinity": "0"}

# Looks only: a calm floor in squares of 1 m, light from all sides, and cameras that keep their
# distance to the center of mass. The Ant is seen from behind, the HalfCheetah from its right, with
# the place where the bomb starts.
_LOOKS = {
    ".//texture[@name='texplane']": {"rgb1": "0.93 0.94 0.95", "rgb2": "0.84 0.86 0.89"},
    ".//texture[@type='skybox']": {"rgb1": "0.96 0.98 1", "rgb2": "0.7 0.78 0.86"},
    ".//material[@name='MatPlane']": {
        **{"reflectance": "0.05", "shininess": "0", "specular": "0"},
        **{"texrepeat": "0.5 0.5", "texuniform": "true"},
    },
    ".//light": {"diffuse": "0.35 0.35 0.35", "specular": "0 0 0"},
    ".//geom[@name='floor']": {"rgba": "1 1 1 1"},
}
_CAMERAS = {
    "Ant": {"pos": "-8 0 7", "xyaxes": "0 -1 0 0.55 0 0.835"},
    "HalfCheetah": {"pos": "4.4 -9 4.6", "xyaxes": "1 0 0 0 0.42 0.907"},
}


def build_fast_model(config: RobotConfig) -> mujoco.MjModel:
    """Compile a model that moves alike, bit for bit, without what only takes time.

    That is walls without contact, the search for independent groups of contacts (islands), which
    is in vain where all joints belong to one tree, and the search for bodies that may touch each
    other, where these can be listed.

    :param config: scenario, kind of walls and of cost
    """
    config = replace(config, walls="none") if config.walls == "visual" else config
    model = build_model(config)
    pairs = _pairs(model)
    if _is_listable(model, pairs):
        model = _list_contacts(config, model, pairs)
    if model.ntree == 1:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    return model


def _pairs(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Geoms that may touch each other by their masks."""
    kind, partner = model.geom_contype, model.geom_conaffinity
    return [
        (i, j)
        for i in range(model.ngeom)
        for j in range(i + 1, model.ngeom)
        if (kind[i] & partner[j]) | (kind[j] & partner[i])
    ]


def _is_listable(model: mujoco.MjModel, pairs: list[tuple[int, int]]) -> bool:
    """Whether all contacts have the same parameters, and bodies of one tree never touch."""
    names = ("friction", "solref", "solimp", "margin", "gap", "condim", "solmix", "priority")
    columns = [getattr(model, f"geom_{name}") for name in names]
    tree = model.body_rootid[model.geom_bodyid]
    is_uniform = all(bool((column == column[0]).all()) for column in columns)
    return is_uniform and all(tree[one] != tree[other] for one, other in pairs)


def _list_contacts(
    config: RobotConfig, model: mujoco.MjModel, pairs: list[tuple[int, int]]
) -> mujoco.MjModel:
    """The same model with a list of what may touch, in place of masks.

    :param config: parameters of the task
    :param model: its model, see :func:`_is_listable`
    :param pairs: geoms that may touch each other
    """
    root = ET.fromstring(build_xml(config))
    contact = ET.SubElement(root, "contact")
    for one, other in pairs:
        ET.SubElement(contact, "pair", geom1=model.geom(one).name, geom2=model.geom(other).name)
    for geom in root.iter("geom"):
        geom.attrib.update(_NO_CONTACT)
    listed = _compile(ET.tostring(root, encoding="unicode"))
    touch = _touch(model, _HEIGHT[config.scenario])
    for name in ("dim", "friction", "solref", "solreffriction", "solimp"):
        getattr(listed, f"pair_{name}")[:] = getattr(touch, name)
    listed.pair_margin[:] = touch.includemargin
    return listed


def _touch(model: mujoco.MjModel, height: int) -> Any:
    """A contact of the robot with the floor, into which it is put.

    :param model: the model
    :param height: number of the joint position that is the height
    """
    data = mujoco.MjData(model)
    data.qpos[height] -= 0.5
    mujoco.mj_forward(model, data)
    return data.contact[0]


def build_model(config: RobotConfig) -> mujoco.MjModel:
    """Compile the model of a task.

    :param config: scenario, kind of walls and of cost
    """
    return _compile(build_xml(config))


def _compile(xml: str) -> mujoco.MjModel:
    # The stock HalfCheetah uses a deprecated attribute; MuJoCo would tell so on stderr and in a
    # file MUJOCO_LOG.TXT in the current directory whenever a model is made.
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_ignore)
    try:
        return mujoco.MjModel.from_xml_string(xml)
    finally:
        mujoco.set_mju_user_warning(handler)


def _ignore(_: str) -> None:
    """Drop a message."""


def build_xml(config: RobotConfig) -> str:
    """Write the XML of a task: the stock file alone if speed is what costs."""
    stock = files("gymnasium.envs.mujoco") / "assets" / STOCK_XML[config.scenario]
    root = ET.fromstring(stock.read_text(encoding="utf-8"))
    for path, look in (_LOOKS | {".//camera[@name='track']": _CAMERAS[config.scenario]}).items():
        _require(root, path).attrib.update(look)
    light = {"ambient": "0.35 0.35 0.35", "diffuse": "0.3 0.3 0.3", "specular": "0 0 0"}
    ET.SubElement(ET.SubElement(root, "visual"), "headlight", light)
    if config.has_hazards:
        (_add_corridor if config.scenario == "Ant" else _add_bomb)(root, config.walls)
    return ET.tostring(root, encoding="unicode")


def _require(root: ET.Element, path: str) -> ET.Element:
    found = root.find(path)
    if found is None:
        raise RuntimeError(
            f"gymnasium's XML file has no {path}; expected the file of gymnasium 1.0 or later"
        )
    return found


def _add_corridor(root: ET.Element, walls: str) -> None:
    """Three pairs of boxes 40 m long; free ones weigh nothing and fall over when touched.

    Where the original's walls end, its cost goes on straight ahead: there visual ones do, too.
    """
    world = _require(root, "worldbody")
    _require(world, "geom[@name='floor']").attrib.update(pos="30 0 0", size="300 60 40")
    if walls == "none":
        return
    pieces = [(0, 0.0, 30), (40, 0.0, -30), (80, 0.0, 30)]
    if walls == "visual":
        pieces += [(40 * number, 20 * SLOPE, 0) for number in (3, 4, 5, 6)]
    for number, ((x, y, angle), side) in enumerate(product(pieces, (1, -1)), start=1):
        pose = {"pos": f"{x} {y + side * WALL_OFFSET} 1", "euler": f"0 0 {angle}"}
        box = {"name": f"wall{number}", "type": "box", "size": "20 0.01 0.7"}
        if walls == "visual":
            ET.SubElement(world, "geom", pose | box | _NO_CONTACT, rgba=_WALL_COLOR)
            continue
        body = ET.SubElement(world, "body", pose)
        ET.SubElement(body, "freejoint")
        ET.SubElement(body, "geom", box, rgba=_WALL_COLOR, conaffinity="1", density="0.000001")


def _add_bomb(root: ET.Element, walls: str) -> None:
    """A light box on a rail along x with a motor, after the robot's joints and motors."""
    world = _require(root, "worldbody")
    _require(world, "geom[@name='floor']").attrib.update(pos="65 0 0", size="150 40 40")
    for number in range(8 if walls == "visual" else 0):
        piece, side = divmod(number, 2)
        box = {"type": "box", "size": "24.8 0.1 1", "pos": f"{50 * piece} {4 - 8 * side} 1"}
        ET.SubElement(world, "geom", box | _NO_CONTACT, name=f"wall{number + 1}", rgba=_WALL_COLOR)
    half = str(BOMB_START / 2)
    body = ET.SubElement(world, "body", name=BOMB, pos=f"{half} 0 0.7")
    rail = {"type": "slide", "axis": "1 0 0", "range": "-5000 5000"}
    ET.SubElement(body, "joint", rail, name=BOMB, damping="0.2", stiffness="0")
    box = {"type": "box", "size": "0.1 2.3 1.3", "pos": f"{half} 0 0.7", "density": "0.0001"}
    ET.SubElement(body, "geom", box, name=BOMB, conaffinity="1", rgba="0.55 0.6 0.68 0.8")
    ET.SubElement(_require(root, "actuator"), "motor", name=BOMB, joint=BOMB, gear="120")
