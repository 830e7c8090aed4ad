"""python docs/figures.py: draw the pictures of concepts.md and of the guides anew, from the library itself."""

import runpy
from pathlib import Path

import matplotlib
import numpy as np
import trimesh
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyBboxPatch

import warp_abtree as ab
from warp_abtree.app import scene_geometry as geometry
from warp_abtree.app.pictures.render import Panel, draw
from warp_abtree.app.pictures.scenes import make_panel
from warp_abtree.app.render_data import Settings, Snapshot, compose
from warp_abtree.app.styles import COLOURS

FOLDER = Path(__file__).parent
SAMPLES = FOLDER.parent / "scenes"
INK, PALE, BLUE, RED = "#33373d", "#d5d8dc", "#3b76c4", "#d4472f"
RED_LINE = (0.83, 0.1, 0.1)

# The same file each time it is drawn.
matplotlib.rcParams.update({"svg.hashsalt": "warp_abtree", "font.size": 9, "svg.fonttype": "none"})


def save(figure, name):
    figure.savefig(FOLDER / name, metadata={"Date": None}, bbox_inches="tight", pad_inches=0.05)


def draw_lods():
    """A bunny at four LODs, with what is certified of each."""
    model = ab.Model.load("warp:bunny")
    panels = []
    for share in (1.0, 0.2, 0.05, 0.01):
        lod = model.lod_for(fraction=share)
        vertices, faces, _ = model.mesh_at(lod)
        error = "the original" if lod == model.lod_max else f"error at most {model.error_at(lod):.2g}"
        title = f"LOD {lod:,} of {model.lod_max:,}\n{len(faces):,} faces, {error}"
        panels.append(Panel(title, vertices[faces], np.tile(COLOURS[0][0], (len(faces), 1))))
    size = np.linalg.norm(np.ptp(model.mesh_at(model.lod_max)[0], axis=0))
    legend, view = [(COLOURS[0][0], f"bunny; its box has a diagonal of {size:.2g}")], ((0.15, 0.3, 1), (0, 1, 0))
    draw(panels, FOLDER / "concept_lods.png", "One model, every level of detail", legend, *view, 300)


# The tree.


def place_of(node):
    """Return where a heap node is drawn: its place in its level, and its level."""
    level = node.bit_length() - 1
    return (node - (1 << level) + 0.5) / (1 << level), -level


def draw_tree(axes, tree, title, marked=()):
    nodes = [node for node in range(1, len(tree.node_face)) if tree.used[node]]
    for colour, width, chosen in ((PALE, 0.8, False), (RED, 1.4, True)):
        children = [node for node in nodes if (node in marked) is chosen and node > 1]
        ways = [point for node in children for point in (place_of(node), place_of(node // 2), (np.nan, np.nan))]
        axes.plot(*np.array(ways or [(np.nan, np.nan)]).T, color=colour, lw=width)
    kinds: dict[tuple, list] = {}
    for node in nodes:
        leaf, active = tree.node_face[node] >= 0, tree.status[node] != 0
        passed = active and not leaf and tree.skip[node] != node
        colour = RED if node in marked else BLUE if active else PALE
        kind = ("s" if leaf else "o", colour, "white" if passed or not active else colour)
        kinds.setdefault(kind, []).append(place_of(node))
    for (marker, colour, inside), places in kinds.items():
        axes.plot(*np.array(places).T, marker, ms=4.5 if marker == "s" else 5.5, mec=colour, mfc=inside)
    axes.set_title(title, loc="left", color=INK)
    axes.set_axis_off()


class TreeAt:
    """The tree of a model at a LOD, as the device has it."""

    def __init__(self, model, lod):
        scene = ab.Scene("cpu")
        scene.add(model, lod=lod)
        state = scene.tree_state(0)
        self.status, self.skip, self.node_face = state.status, state.skip, model.tree.node_face
        self.used = np.zeros(len(self.node_face), bool)
        for node in state.face_node:
            while node:
                self.used[node] = True
                node //= 2


def draw_trees():
    """An AB-Tree at the original, at a coarser LOD, and what an update between two LODs visits."""
    model = ab.Model.load(trimesh.creation.torus(1.0, 0.4, 6, 4), base_faces=8)
    progressive, top = model.progressive, model.lod_max
    low, high = top // 2 - 1, top // 2
    changed = progressive.split_face[progressive.split_start[low] : progressive.split_start[high]]
    marked = set()
    for node in model.tree.leaf_node[changed].tolist():
        while node:
            marked.add(node)
            node //= 2
    figure = Figure(figsize=(7.4, 5.6))
    rows = figure.subplots(3, 1)
    draw_tree(rows[0], TreeAt(model, top), f"LOD {top}, the original: all {model.face_count} leaves are active")
    count = len(model.mesh_at(low)[1])
    draw_tree(rows[1], TreeAt(model, low), f"LOD {low}: {count} active leaves; hollow circles are passed by")
    title = f"LOD {low} to {high}: {len(set(changed.tolist()))} faces change, {len(marked)} nodes are refitted"
    draw_tree(rows[2], TreeAt(model, high), title, marked)
    dot = {"marker": "o", "ls": ""}
    figure.legend(
        handles=[
            Line2D([], [], color=BLUE, marker="s", ls="", label="active leaf, one face"),
            Line2D([], [], color=BLUE, **dot, label="active"),
            Line2D([], [], mec=BLUE, mfc="white", **dot, label="active, one active child"),
            Line2D([], [], mec=PALE, mfc="white", **dot, label="inactive"),
            Line2D([], [], color=RED, **dot, label="marked and refitted"),
        ],
        loc="lower center", ncols=5, frameon=False, handletextpad=0.2, columnspacing=1.2, fontsize=8,
    )  # fmt: skip
    save(figure, "concept_tree.svg")


# Traversal.


def meeting_nodes(states, poses, levels):
    """Return for each level the pairs of active nodes whose boxes overlap, of those whose parents' do."""
    turn = [trimesh.transformations.quaternion_matrix(np.roll(pose[3:], 1))[:3, :3] for pose in poses]

    def box(side, node):
        """Box in the world around a posed node."""
        lower, upper = states[side].lower[node], states[side].upper[node]
        middle = turn[side] @ (0.5 * (lower + upper)) + np.asarray(poses[side][:3])
        half = np.abs(turn[side]) @ (0.5 * (upper - lower))
        return middle - half, middle + half

    pairs, found = [(1, 1)], []
    for _ in range(levels):
        kept = []
        for a, b in pairs:
            (low_a, high_a), (low_b, high_b) = box(0, a), box(1, b)
            if (low_a <= high_b).all() and (low_b <= high_a).all():
                kept.append((a, b))
        found.append(kept)
        counts = [len(state.status) for state in states]
        inner = [(2 * a, 2 * b) for a, b in kept if 2 * a + 1 < counts[0] and 2 * b + 1 < counts[1]]
        children = [(a + i, b + j) for a, b in inner for i in (0, 1) for j in (0, 1)]
        pairs = [(a, b) for a, b in children if states[0].status[a] and states[1].status[b]]
    return found


def box_lines(boxes):
    """Return the edges of boxes (b, 2, 3), (12 b, 2, 3)."""
    # Bit a of a corner's number says lower or upper along axis a.
    corner = np.arange(8)
    corners = np.stack([boxes[:, (corner >> axis) & 1, axis] for axis in range(3)], axis=-1)
    return corners[:, [(c, c | bit) for c in range(8) for bit in (1, 2, 4) if not c & bit]].reshape(-1, 2, 3)


def draw_traversal():
    """Two rings, and the nodes that a traversal still holds at some levels."""
    model = ab.Model.load(trimesh.creation.torus(1.0, 0.3, 48, 24))
    half = 0.5**0.5
    poses = [(0, 0, 0, 0, 0, 0, 1), (0.55, 0.1, 0, half, 0, 0, half)]
    scene = ab.Scene("cpu")
    for pose in poses:
        scene.add(model, pose)
    states = [scene.tree_state(i) for i in (0, 1)]
    found = meeting_nodes(states, poses, model.tree.depth + 1)
    count = int(scene.intersect([[0, 1]], output="count").count[0])
    eye, up = (0.3, 0.5, 1.0), (0, 1, 0)
    vertices, faces, _ = model.mesh_at(model.lod_max)
    panels = []
    where = np.array(poses)
    corners = [geometry.place(where, np.full(len(faces), k), vertices[faces]) for k in (0, 1)]
    for level in (2, 5, 8):
        triangles, colours = list(corners), [np.tile(COLOURS[k][0], (len(faces), 1)) for k in (0, 1)]
        lines = []
        for side, colour in enumerate(((0.75, 0.15, 0.1), (0.1, 0.25, 0.7))):
            nodes = sorted({pair[side] for pair in found[level]})
            edges = box_lines(np.stack([states[side].lower[nodes], states[side].upper[nodes]], axis=1))
            lines.append((geometry.place(where, np.full(len(edges), side), edges), colour))
        title = f"level {level}: {len(found[level]):,} of {4**level:,} pairs of nodes overlap"
        panels.append(Panel(f"{title}\n", np.concatenate(triangles), np.concatenate(colours), lines))
    legend = [((0.75, 0.15, 0.1), "nodes of the first"), ((0.1, 0.25, 0.7), "nodes of the second")]
    title = f"From two roots to {count:,} intersecting pairs of {len(faces):,} by {len(faces):,} faces"
    draw(panels, FOLDER / "concept_traversal.png", title, legend, eye, up, 380)


# The search.


def draw_search():
    """Lists of a search, and the functions of a policy that take from one and add to the next."""
    figure = Figure(figsize=(7.6, 2.5))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, 16.1), ylim=(0, 5))
    axes.axis("off")

    def box(x, y, title, text, colour):
        axes.add_patch(FancyBboxPatch((x, y), 2.6, 1.2, "round,pad=0.05", facecolor=colour, edgecolor=INK, lw=0.8))
        axes.text(x + 1.3, y + 0.8, title, ha="center", va="center", fontweight="bold", color=INK)
        axes.text(x + 1.3, y + 0.32, text, ha="center", va="center", fontsize=7.5, color=INK)

    def arrow(start, end, bend=0.0, colour=INK):
        style = {"arrowstyle": "-|>", "color": colour, "lw": 1.0, "connectionstyle": f"arc3,rad={bend}"}
        axes.annotate("", end, start, arrowprops=style)

    lists = ("node pairs", "a stack"), ("leaf pairs", "until a warp waits"), ("open pairs", "until a warp waits")
    steps = ("expand", "boxes and slabs drop"), ("leaf", "float32 drops"), ("open", "float64, exact signs")
    for k, ((name, what), (step, drops)) in enumerate(zip(lists, steps, strict=True)):
        x = 0.2 + 4.4 * k
        box(x, 1.9, name, what, "white")
        box(x + 2.2, 0.2, step, drops, "#dbe7f5")
        arrow((x + 1.3, 1.85), (x + 2.6, 1.45))
        arrow((x + 4.3, 1.45), (x + 5.4, 1.85))
    arrow((2.6, 1.45), (0.9, 1.85), -0.5)
    box(13.4, 1.9, "report", "what was found", "white")
    box(5.6, 3.6, "refresh", "what is known by now", "#fbe3dc")
    arrow((14.7, 3.15), (8.3, 4.2), 0.15, RED)
    arrow((5.55, 4.2), (2.2, 3.15), 0.15, RED)
    arrow((6.5, 3.55), (6.1, 3.15), 0, RED)
    arrow((7.8, 3.55), (9.6, 3.15), 0, RED)
    save(figure, "concept_search.svg")


# The guides: what their samples compute.


def panel_of(scene, title, poses, lods=None, objects=None, query=True):
    """Return a picture of a scene's objects (all), intersecting faces coloured if a query is made."""
    lods = scene.lods if lods is None else np.asarray(lods, np.int32)
    objects = np.arange(scene.object_count) if objects is None else np.asarray(objects)
    scene.set_poses(poses)
    scene.set_lods(lods)
    pairs = scene.broad_phase() if query else np.empty((0, 2), np.int32)
    cache, found = geometry.MeshCache(scene), scene.intersect(pairs, output="faces")
    snapshot = Snapshot(0, 0.0, np.asarray(poses, np.float64), lods, found, None)
    panel = make_panel(cache, compose(cache, snapshot, objects, Settings(intersecting=query)))
    panel.title = title
    return panel


def run_sample(name):
    """Run a sample of scenes/; return what its names stand for."""
    return runpy.run_path(str(SAMPLES / f"{name}.py"))


def draw_which_pairs():
    sample = run_sample("01_which_pairs")
    half = 0.5**0.5
    poses = [(0, 0, 0, 0, 0, 0, 1), (1.0, 0, 0, half, 0, 0, half), (0, 0, 0, 0, 0, 0, 1)]
    panel = panel_of(sample["scene"], "", poses)
    legend = [(COLOURS[0][0], "rings"), (COLOURS[1][0], "pipe")]
    legend += [(COLOURS[k][1], "faces that intersect") for k in (0, 1)]
    counts = sample["result"].count.tolist()
    title = f"Three pairs: {counts[0]}, {counts[1]} and {counts[2]} face pairs intersect"
    draw([panel], FOLDER / "sample_which_pairs.png", title, legend, (0.6, -1, 0.5), (0, 0, 1), 560)


def draw_how_far():
    sample = run_sample("02_how_far")
    where = [(0, 0, 0), (0.1, 0, 0), (2.2, 0, 0.4), (0, -1.2, 0.55)]
    panel = panel_of(sample["scene"], "", [(*point, 0, 0, 0, 1) for point in where])
    points = sample["result"].points
    panel.lines = [(points, RED_LINE)]
    distances = ", ".join(f"{distance:.2f}" for distance in sample["result"].distance)
    legend = [(COLOURS[0][0], "ring"), (COLOURS[1][0], "balls"), (RED_LINE, "from nearest point to nearest point")]
    title = f"Signed distances {distances}"
    draw([panel], FOLDER / "sample_how_far.png", title, legend, (0.5, -0.9, 0.9), (0, 0, 1), 560)


def draw_when():
    sample = run_sample("03_when")
    starts, ends, time = sample["starts"], sample["ends"], sample["result"].time
    panels = []
    for part, title in ((0.0, "time 0"), (time[1], f"time {time[1]:.3f}: contact"), (1.0, "time 1")):
        poses = np.array(starts)
        poses[1, :3] += part * (ends - starts)[1, :3]
        poses[2, :3] += min(part, time[1]) * (ends - starts)[2, :3]
        panels.append(panel_of(sample["scene"], title, poses, query=False))
    legend = [(COLOURS[0][0], "ring"), (COLOURS[1][0], "balls; one stops where it touches, one is through")]
    draw(panels, FOLDER / "sample_when.png", "First contacts", legend, (0.5, -1, 0.45), (0, 0, 1), 330)


def draw_way_out():
    """A pin through a plate, and where it is free."""
    scene = ab.Scene("cpu")
    for sizes in ((12, 12, 1), (1, 1, 10)):
        scene.add(ab.Model.load(trimesh.creation.box(sizes)), solid=True)
    start = np.array([(0, 0, 0, 0, 0, 0, 1), (3, 0, 0, 0, 0, 0, 1.0)])
    scene.set_poses(start)
    deepest = scene.intersect([(0, 1)], "distance", signed=True).distance[0]
    panels = [panel_of(scene, f"as posed: signed distance {deepest:.3g}", start, query=False)]
    for directions, title in ((None, "the least way out"), ([(0, 0, 1)], "the way out upwards")):
        scene.set_poses(start)
        way, end = scene.penetration([(0, 1)], directions), start.copy()
        end[1, :3] += way.depth[0] * way.direction[0]
        panels.append(panel_of(scene, f"{title}: {way.depth[0]:.3g}", end, query=False))
    legend = [(COLOURS[0][0], "plate"), (COLOURS[1][0], "pin")]
    draw(panels, FOLDER / "sample_way_out.png", "A pin through a plate", legend, (0.5, -1, 0.45), (0, 0, 1), 330)


def draw_which_lod():
    sample = run_sample("04_which_lod")
    model, half = sample["model"], 0.5**0.5
    poses = [(0, 0, 0, 0, 0, 0, 1), (0.5, 0, 0, half, 0, 0, half)]
    panels = []
    for lod, result in zip(sample["lods"], sample["results"]):
        faces, error = len(model.mesh_at(lod)[1]), model.error_at(lod)
        title = f"LOD {lod:,}: {faces:,} faces\nerror {error:.2g}, {result.count[0]} face pairs"
        panels.append(panel_of(sample["scene"], title, poses, [lod, lod]))
    legend = [(COLOURS[0][0], "rings"), (COLOURS[0][1], "faces that intersect")]
    draw(panels, FOLDER / "sample_which_lod.png", "One query at four LODs", legend, (0.4, -1, 0.7), (0, 0, 1), 300)


def draw_simulator():
    sample = run_sample("05_in_a_simulator")
    scene, rings = sample["scene"], sample["rings"]
    panels = []
    for world in range(3):
        objects = [0, *range(1 + world * rings, 1 + (world + 1) * rings)]
        panels.append(panel_of(scene, f"world {world}", sample["poses"], objects=objects, query=False))
    title = f"After 150 steps, three of {sample['worlds']} worlds"
    legend = [(COLOURS[0][0], "peg and plate, in every world"), (COLOURS[1][0], "rings")]
    draw(panels, FOLDER / "sample_in_a_simulator.png", title, legend, (0.5, -1, 0.5), (0, 0, 1), 330)


def draw_places():
    """Two worlds at the start of the descent and at its end."""
    sample = run_sample("07_place_without_overlap")
    scene, size, end = sample["scene"], sample["size"], sample["scene"].poses
    panels = []
    for world in range(2):
        for poses, when in ((sample["first"], "at first"), (end, f"after {sample['step']} steps")):
            objects = range(world * size, (world + 1) * size)
            panels.append(panel_of(scene, f"world {world}, {when}", poses, objects=objects))
    legend = [(COLOURS[0][1], "in bright colours: faces that intersect")]
    file, title = "sample_place_without_overlap.png", "Descent along the gradient of the sum of overlaps"
    draw(panels, FOLDER / file, title, legend, (0.5, -1, 0.6), (0, 0, 1), 300)


def draw_own_query():
    sample = run_sample("06_your_own_query")
    plate, near = sample["plate"], sample["near"]
    panel = panel_of(sample["scene"], "", sample["scene"].poses, query=False)
    panel.colours[: len(plate.faces)][near.any(axis=0)] = COLOURS[0][1]
    legend = [(COLOURS[0][0], "plate"), (COLOURS[1][0], "balls"), (COLOURS[0][1], "faces within 0.1 of a ball")]
    areas = ", ".join(f"{area:.2f}" for area in near @ plate.area_faces)
    title = f"Areas near the balls: {areas}"
    draw([panel], FOLDER / "sample_your_own_query.png", title, legend, (0.4, -1, 0.9), (0, 0, 1), 560)


def main():
    draw_lods()
    draw_trees()
    draw_traversal()
    draw_search()
    draw_which_pairs()
    draw_how_far()
    draw_when()
    draw_way_out()
    draw_which_lod()
    draw_simulator()
    draw_places()
    draw_own_query()


if __name__ == "__main__":
    main()
