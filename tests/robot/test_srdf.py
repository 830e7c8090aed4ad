"""Pairs of links with an SRDF file: as MoveIt's matrix of allowed collisions has them."""

import warnings

import numpy as np
import pytest
from helpers import refused
from helpers.robots import asked_pairs, pairs_of

import warp_abtree as ab

pytest.importorskip("yourdfpy")
LINKS = [f"l{k}" for k in range(5)]
LINK = '<link name="{}"><collision><geometry><box size="0.1 0.1 0.2"/></geometry></collision></link>'
JOINT = (
    '<joint name="j{1}" type="{0}"><parent link="l{1}"/><child link="l{2}"/><origin xyz="0 0 0.3"/>'
    '<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
)
ALL = {frozenset((a, b)) for a in LINKS for b in LINKS if a < b}
# The last two links are fixed to one another: neighbours of neither are tested unless an SRDF says so.
JOINED = pairs_of("l0 l1", "l1 l2", "l2 l3", "l3 l4", "l2 l4")


@pytest.fixture
def load(tmp_path):
    kinds = "revolute", "revolute", "revolute", "fixed"
    joints = "".join(JOINT.format(kind, k, k + 1) for k, kind in enumerate(kinds))
    (tmp_path / "r.urdf").write_text(f'<robot name="r">{"".join(map(LINK.format, LINKS))}{joints}</robot>')

    def load(srdf, root="robot", **options):
        (tmp_path / "r.srdf").write_text(f'<{root} name="r">{srdf}</{root}>', encoding="utf-8")
        return asked_pairs(ab.Robot.load(tmp_path / "r.urdf", device="cpu", srdf=tmp_path / "r.srdf", **options))

    return load


def moveit_pairs(entries):
    """Return the pairs that are tested: a link's default, then entries of pairs, first enabled, then disabled ones."""
    default, matrix = set(), {}
    for tag, allowed in (("disable_default_collisions", None), ("enable_collisions", False), ("disable_collisions", 1)):
        for name, *links in entries:
            if name == tag:
                default |= set(links) if allowed is None else set()
                matrix |= {} if allowed is None else {frozenset(links): allowed}
    return {pair for pair in ALL if not matrix.get(pair, bool(pair & default) or pair in JOINED)}


def write(entries):
    return "".join(
        f'<{tag} link="{links[0]}"/>' if len(links) == 1 else f'<{tag} link1="{links[0]}" link2="{links[1]}"/>'
        for tag, *links in entries
    )


def test_pairs_are_those_of_moveit(load):
    assert load("") == ALL - JOINED
    rng, found = np.random.default_rng(0), []
    for _ in range(40):
        entries = [("disable_default_collisions", *rng.choice(LINKS, 1)) for _ in range(rng.integers(3))]
        for tag in ("enable_collisions", "disable_collisions"):
            entries += [(tag, *rng.choice(LINKS, 2, replace=False)) for _ in range(rng.integers(5))]
        rng.shuffle(entries)
        found.append(load(write(entries)))
        assert found[-1] == moveit_pairs(entries), entries
    assert any(pairs & JOINED for pairs in found) and any(ALL - JOINED - pairs for pairs in found)


def test_only_entries_of_the_robot_itself_count(load):
    assert load('<group name="g"><disable_collisions link1="l0" link2="l2"/></group>') == ALL - JOINED
    assert load('<disable_collisions link1=" l0 " link2="l2"/>') == ALL - JOINED - pairs_of("l0 l2")


def test_links_that_the_robot_lacks_are_refused_or_named(load):
    entries = '<disable_collisions link1="l0" link2="l2"/><disable_collisions link1="l0" link2="camera"/>'
    entries += '<enable_collisions link1="mast" link2="l1"/><disable_default_collisions link="camera"/>'
    refused(ValueError, r"disable_default_collisions names 'camera', .* \(strict=False goes on\)", load, entries)
    with pytest.warns(RuntimeWarning, match=r"r.srdf: what is said of 'camera', 'mast' is left out") as caught:
        assert load(entries, strict=False) == ALL - JOINED - pairs_of("l0 l2")
    assert len(caught) == 1 and caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load(write([("disable_collisions", "l0", "l2")]), strict=False)


def test_unknown_elements_are_named(load):
    with pytest.warns(RuntimeWarning, match="r.srdf: not read: elements disable_collision, hand$") as caught:
        assert load('<disable_collision link1="l0" link2="l2"/><hand/><hand/>') == ALL - JOINED
    assert len(caught) == 1 and caught[0].filename == __file__
    known = "group group_state end_effector virtual_joint passive_joint joint_property link_sphere_approximation"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load("<!-- none -->" + "".join(f"<{tag}/>" for tag in known.split()))


@pytest.mark.parametrize(
    "srdf, root, message",
    [
        ('<disable_collisions link1="l0"/>', "robot", "a disable_collisions without link2"),
        ("<disable_default_collisions/>", "robot", "a disable_default_collisions without link"),
        ("<enable_collisions", "robot", "not read as SRDF"),
        ("", "srdf", "not read as SRDF .its root is 'srdf', not 'robot'"),
    ],
)
def test_bad_srdf_is_refused(srdf, root, message, load):
    refused(ValueError, message, load, srdf, root, strict=False)


def test_an_srdf_goes_over_the_pairs_of_mjcf(tmp_path):
    pytest.importorskip("mujoco")
    bodies = "".join(
        f'<body name="l{k}" pos="0 0 {k}"><joint name="j{k}"/><geom name="g{k}" size=".1"/><geom size=".1" contype="2" '
        f'conaffinity="2"/></body>'
        for k in range(3)
    )
    pairs = '<contact><pair geom1="g0" geom2="g1"/><exclude body1="l1" body2="l2"/></contact>'
    (tmp_path / "r.xml").write_text(f"<mujoco><worldbody>{bodies}</worldbody>{pairs}</mujoco>", encoding="utf-8")
    entries = [("enable_collisions", "l1", "l2"), ("disable_collisions", "l1", "l0")]
    (tmp_path / "r.srdf").write_text(f"<robot>{write(entries)}</robot>", encoding="utf-8")
    robot = ab.Robot.load(tmp_path / "r.xml", device="cpu", srdf=tmp_path / "r.srdf")
    found = [tuple(sorted(robot.link_names[robot.model_link[k]] for k in pair)) for pair in robot.pairs]
    # Parts of links 0 and 2 by their bits, all of links 1 and 2.
    assert sorted(found) == [("l0", "l2")] * 2 + [("l1", "l2")] * 4
