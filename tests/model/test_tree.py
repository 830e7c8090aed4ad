"""The AB-Tree: its build, and walks of LODs, whose states equal a rebuild and the plain oracle to the bit."""

import hypothesis.strategies as st
import numpy as np
import pytest
from helpers import refused
from helpers.samples import plain, raw_state, repeated, sample, soup
from helpers.scenes import scene_with
from hypothesis import HealthCheck, given, settings
from oracles import abtree as oracle

import warp_abtree as ab
from warp_abtree.model.tree import active_build

pytestmark = pytest.mark.usefixtures("half_refitted_in_part")


@settings(deadline=None, max_examples=60)
@given(
    st.integers(1, 70), st.integers(0, 2**31), st.sampled_from([0, 2, 3, 9]), st.sampled_from([1.0, 2.0**90, 2.0**-90])
)
def test_build_of_soups_equals_the_oracle(count, seed, lattice, scale):
    vertices, faces = soup(count, seed, lattice)
    vertices = vertices * scale
    tree, none = active_build(vertices, faces), [-1] * len(vertices)
    mesh = oracle.Progressive(none, vertices.tolist(), faces.tolist(), [0] * len(faces), [0], [])
    numbers = [leaf.number for leaf in oracle.active_build(mesh).leaf]
    assert tree.leaf_node.tolist() == numbers
    assert tree.depth == (len(faces) - 1).bit_length() and tree.node_count == 2 << tree.depth
    inverse = np.full(tree.node_count, -1)
    inverse[numbers] = np.arange(len(faces))
    assert tree.node_face.tolist() == inverse.tolist()


def test_build_refuses_no_face():
    refused(ValueError, "1 to 2", active_build, np.zeros((3, 3)), np.zeros((0, 3), np.int32))


def assert_same_bits(state, other):
    for name, value in state.items():
        assert np.asarray(value).tobytes() == np.asarray(other[name]).tobytes(), name


class Walker:
    """A scene whose LODs walk, compared with a new scene at the same LODs and with the oracle's rebuilds, cached."""

    def __init__(self, models, objects, device):
        self.models, self.objects, self.device, self.truth = models, objects, device, {}
        self.scene = scene_with(device, *[models[m] for m in objects])

    def tops(self):
        return np.array([self.models[m].lod_max for m in self.objects])

    def oracle_state(self, m, lod, corner_type):
        """Return the raw state that the oracle's rebuild has at a LOD."""
        if (m, lod) not in self.truth:
            mesh = plain(self.models[m])
            flat = oracle.active_build(mesh, lod).flat()
            faces = range(len(mesh.face_vertex))
            corner = [mesh.corners(f, lod) if mesh.is_active(f, lod) else [-1] * 3 for f in faces]
            state = {"lod": lod, "status": flat["status"].astype(np.int32), "corner": np.array(corner, corner_type)}
            self.truth[m, lod] = state | {name: flat[name] for name in ("lower", "upper", "skip")}
        return self.truth[m, lod]

    def check_states(self, lods, with_oracle=True):
        placed = list(zip(self.objects, map(int, lods), strict=True))
        fresh = scene_with(self.device, *[(self.models[m], {"lod": lod}) for m, lod in placed])
        for m, lod in set(placed):
            i = placed.index((m, lod))
            state = raw_state(self.scene, i)
            assert state["lod"] == lod
            assert state["status"].max() <= oracle.ACTIVE, "a node was left deformed"
            assert_same_bits(state, raw_state(fresh, i))
            if with_oracle:
                assert_same_bits(state, self.oracle_state(m, lod, state["corner"].dtype))
        return set(placed)

    def step(self, lods, with_oracle=True):
        """Set LODs; check states, sharing, counters and equation 1. Returns the number of partial updates."""
        models, states, objects = self.scene.batch().models, self.scene.batch().states, self.scene.batch().objects
        before = {int(s): (states.slots[s].model, states.slots[s].lod) for s in objects.state}
        stats = self.scene.set_lods(lods)
        seen = self.check_states(lods, with_oracle)
        assert len(set(objects.state.tolist())) == len(seen), "objects that share model and LOD share a state"
        assert len(set(stats.state.tolist())) == len(stats.state)
        held = {(states.slots[s].model, states.slots[s].lod) for s in objects.state}
        assert held == {(self.scene.models.index(self.models[m]), lod) for m, lod in seen}
        for row, (state, lod) in enumerate(zip(stats.state, stats.lod, strict=True)):
            self.check_counters(stats, row, before, state, int(lod), states, models, with_oracle)
        return int((~stats.full).sum())

    def check_counters(self, stats, row, before, state, lod, states, models, with_oracle):
        owner = states.slots[state].model
        mesh = self.scene.models[owner].progressive
        n = mesh.face_count
        starts = [before[state]] if state in before else [b for b in before.values() if b[0] == owner]
        # A copy starts from the nearest state of its model; of two equally near, either one.
        span = [abs(int(mesh.split_start[lod]) - int(mesh.split_start[b[1]])) for b in starts]
        sources = [b[1] for b, s in zip(starts, span, strict=True) if s == min(span)]
        slices = [mesh.split_face[slice(*sorted((mesh.split_start[a], mesh.split_start[lod])))] for a in sources]
        k, nodes = int(stats.k[row]), int(stats.nodes_refitted[row])
        assert k in [len(np.unique(part)) for part in slices]
        if stats.full[row]:
            assert nodes == 2 * n - 1
            return
        assert nodes <= oracle.refit_bound(n, k) if k else nodes == 0
        if with_oracle:
            counted = []
            for source in sources:
                tree = oracle.active_build(plain(self.scene.models[owner]), source)
                counted.append(oracle.set_lod(tree, lod))
            assert (k, nodes) in [(update.k, update.nodes_refitted) for update in counted]


@pytest.mark.parametrize("name", ["cow", "fcl-env"])
@pytest.mark.slow
@pytest.mark.usefixtures("update_path")
def test_random_walk_of_real_meshes(device, name):
    rng = np.random.default_rng(4)
    walker = Walker([sample(name)], [0, 0, 0], device)
    top, partial = walker.tops(), 0
    for t in range(12):
        lods = np.clip((top * rng.choice([0.0, 0.1, 0.5, 0.9, 1.0], 3)).astype(int) + rng.integers(-30, 31, 3), 0, top)
        partial += walker.step(lods, with_oracle=t == 11)
    assert partial > 3


soups = st.builds(
    lambda count, seed, lattice, twice: (repeated if twice else lambda *mesh: mesh)(*soup(count, seed, lattice)),
    st.integers(1, 40),
    st.integers(0, 2**31),
    st.sampled_from([0, 3, 6]),
    st.booleans(),
)
shares = st.lists(st.tuples(*[st.floats(0, 1)] * 3), min_size=1, max_size=6)


@pytest.mark.usefixtures("update_path")
@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(soups, soups, shares)
def test_walks_over_soups(device, first, second, walk):
    models = [ab.Model.from_arrays(*mesh, base_faces=1) for mesh in (first, second)]
    walker = Walker(models, [0, 1, 0], device)
    for step in walk:
        walker.step(np.round(np.array(step) * walker.tops()).astype(int))


@pytest.mark.parametrize("name", ["one", "crumbs", "soup", "lattice soup"])
def test_tree_state_shows_the_state(device, name):
    model = sample(name)
    scene = scene_with(device, model, lod=0)
    for lod in (0, model.lod_max // 2, model.lod_max):
        scene.set_lods([lod])
        raw, shown = raw_state(scene, 0), scene.tree_state(0)
        assert shown.lod == lod
        np.testing.assert_array_equal(shown.status, raw["status"])
        np.testing.assert_array_equal(shown.skip, raw["skip"])
        np.testing.assert_array_equal(shown.face_node, model.tree.leaf_node)
        assert shown.lower.dtype == shown.upper.dtype == np.float64
        empty = shown.status == 0
        assert (shown.lower[empty] == np.inf).all() and (shown.upper[empty] == -np.inf).all()
        vertices, faces, ids = model.mesh_at(lod)
        assert set(np.flatnonzero(shown.status[model.tree.leaf_node])) == set(ids)
        for face, f in zip(faces, ids, strict=True):
            node = shown.face_node[f]
            while node:
                assert (shown.lower[node] <= vertices[face].min(0)).all()
                assert (shown.upper[node] >= vertices[face].max(0)).all()
                node >>= 1
        slack = 1e-5 * np.abs(vertices).max()
        used = vertices[np.unique(faces)]
        assert (shown.lower[1] > used.min(0) - slack).all() and (shown.upper[1] < used.max(0) + slack).all()


def test_objects_share_states(device):
    model, other = sample("small ball"), sample("crumbs")
    scene = scene_with(device, model, other, model, model)
    states, objects = scene.batch().states, scene.batch().objects
    assert objects.state[0] == objects.state[2] == objects.state[3] != objects.state[1]
    assert len(states.slots) == 2
    scene.set_lods([10, 5, 20, 30])  # more targets than states: copies
    assert len(set(objects.state)) == 4 and len(states.slots) == 4
    room = states.node_room, states.face_room
    stay = objects.state.tolist()
    stats = scene.set_lods([10, 5, 20, 30])
    assert len(stats.state) == len(stats.k) == len(stats.nodes_refitted) == 0
    stats = scene.set_lods([20, 5, 30, 11])  # only one target is new, and 10 is the state that no object keeps
    assert stats.state.tolist() == [stay[0]] and stats.lod.tolist() == [11]
    assert objects.state.tolist() == [stay[2], stay[1], stay[3], stay[0]]
    scene.set_lods([7, 5, 7, 7])
    assert len(set(objects.state)) == 2
    assert sum(map(len, states.free.values())) == 2
    scene.set_lods([1, 2, 3, 4])  # freed states are taken again
    assert len(states.slots) == 4 and not any(states.free.values())
    assert (states.node_room, states.face_room) == room
    np.testing.assert_array_equal(objects.pool.state.numpy(), objects.state)
    np.testing.assert_array_equal(scene.lods, [1, 2, 3, 4])


@pytest.mark.slow
def test_thousands_of_objects_in_one_batch(device):
    rng = np.random.default_rng(7)
    models = [sample(name) for name in ("small ball", "crumbs", "twins", "one")]
    walker = Walker(models, rng.integers(0, 4, 1000).tolist(), device)
    ladders = [np.unique(np.linspace(0, model.lod_max, 50).astype(int)) for model in models]
    for _ in range(3):
        lods = np.array([rng.choice(ladders[m]) for m in walker.objects])
        stats = walker.scene.set_lods(lods)
        assert (stats.nodes_refitted > 0).all()
        walker.check_states(lods)
    assert len(walker.scene.batch().states.slots) <= sum(map(len, ladders))
