"""Expansions and signs of all three stages against fractions, and that no compiler contracts them."""

import functools
import re
from fractions import Fraction

import numpy as np
import pytest
import warp as wp
from helpers.orient import orient2d_kernel
from oracles.signs import COUNT, KINDS, find_signs, random_floats, rounded_signs, true_signs, true_terms

from warp_abtree.kernels import poses
from warp_abtree.kernels.arithmetic import double_word, expansion, int128, predicates
from warp_abtree.kernels.arithmetic.double_word import double_orient2d, double_orient3d
from warp_abtree.kernels.arithmetic.expansion import exact_orient2d, exact_orient3d, two_product, two_sum
from warp_abtree.kernels.arithmetic.predicates import (
    EXACT,
    FILTER,
    FLOAT32,
    UNCERTAIN,
    orient3d,
    orient_edges,
)
from warp_abtree.kernels.traversal import (
    boxes,
    dual_tree,
    face_pairs,
    leaf_pairs,
    node_pair,
    nodes,
    simd,
    uncertain_pairs,
)
from warp_abtree.kernels.traversal.face_pairs import WITHIN
from warp_abtree.kernels.triangle import coplanar, float32_filter, float64_filter, intersect
from warp_abtree.kernels.triangle.float32_filter import (
    FLOAT32_UNIT,
    add_signs,
    heights_over_plane,
    one_sided,
    side_of_plane,
)
from warp_abtree.kernels.update import refit

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)


@wp.kernel
def two_sum_kernel(a: wp.array(dtype=wp.float64), b: wp.array(dtype=wp.float64), out: wp.array2d(dtype=wp.float64)):
    i = wp.tid()
    high, low = two_sum(a[i], b[i])
    out[0, i] = high
    out[1, i] = low


@wp.kernel
def two_product_kernel(a: wp.array(dtype=wp.float64), b: wp.array(dtype=wp.float64), out: wp.array2d(dtype=wp.float64)):
    i = wp.tid()
    high, low = two_product(a[i], b[i])
    out[0, i] = high
    out[1, i] = low


@wp.kernel
def sum_of_product_kernel(
    a: wp.array(dtype=wp.float64), b: wp.array(dtype=wp.float64), out: wp.array2d(dtype=wp.float64)
):
    """The product invites contraction: fused into the sum, it is not the rounded one."""
    i = wp.tid()
    high, low = two_sum(a[i] * b[i], a[i])
    out[0, i] = high
    out[1, i] = low


@wp.kernel
def orient3d_kernel(mode: wp.int32, points: wp.array2d(dtype=wp.vec3d), out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out[i] = orient3d(mode, points[i, 0], points[i, 1], points[i, 2], points[i, 3])


@wp.kernel
def orient_edges_kernel(mode: wp.int32, points: wp.array2d(dtype=wp.vec3d), out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out[i] = orient_edges(mode, points[i, 0], points[i, 1], points[i, 2], points[i, 3])


@wp.kernel
def expansion3d_kernel(mode: wp.int32, points: wp.array2d(dtype=wp.vec3d), out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out[i] = exact_orient3d(points[i, 0], points[i, 1], points[i, 2], points[i, 3])


@wp.kernel
def expansion2d_kernel(mode: wp.int32, points: wp.array2d(dtype=wp.vec2d), out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out[i] = exact_orient2d(points[i, 0], points[i, 1], points[i, 2])


@wp.kernel
def double3d_kernel(points: wp.array2d(dtype=wp.vec3d), out: wp.array(dtype=wp.float64)):
    i = wp.tid()
    out[i] = double_orient3d(points[i, 0], points[i, 1], points[i, 2], points[i, 3])


@wp.kernel
def double2d_kernel(points: wp.array2d(dtype=wp.vec2d), out: wp.array(dtype=wp.float64)):
    i = wp.tid()
    out[i] = double_orient2d(points[i, 0], points[i, 1], points[i, 2])


@wp.kernel
def float32_signs_kernel(
    error: wp.array(dtype=wp.float32),
    unit: wp.float32,
    points: wp.array2d(dtype=wp.vec3),
    out: wp.array2d(dtype=wp.int32),
):
    i = wp.tid()
    a, b, c, d, e, f = points[i, 0], points[i, 1], points[i, 2], points[i, 3], points[i, 4], points[i, 5]
    heights, bound = heights_over_plane(error[i], unit, b - a, c - a, a - d, a - e, a - f)
    signs = add_signs(0, heights, bound)
    for k in range(3):
        pair = (signs >> (4 - 2 * k)) & 3
        out[i, k] = wp.where(pair == 2, 1, wp.where(pair == 1, -1, wp.where(bound == 0.0, 0, UNCERTAIN)))
    out[i, 6] = one_sided(heights, bound)
    out[i, 3] = side_of_plane(error[i], unit, a, b, c, d)
    out[i, 4] = side_of_plane(error[i], unit, a, b, c, e)
    out[i, 5] = side_of_plane(error[i], unit, a, b, c, f)


def apply(kernel, a, b, device):
    arrays = [wp.array(x, dtype=wp.float64, device=device) for x in (a, b)]
    out = wp.zeros((2, len(a)), dtype=wp.float64, device=device)
    wp.launch(kernel, dim=len(a), inputs=arrays, outputs=[out], device=device)
    return out.numpy()


def check_exact(got, expected, rounded):
    high, low = got
    np.testing.assert_array_equal(high, rounded)
    for h, t, x in zip(high.tolist(), low.tolist(), expected):
        assert Fraction(h) + Fraction(t) == x


@pytest.mark.parametrize("kernel", [two_sum_kernel, sum_of_product_kernel], ids=lambda k: k.key)
def test_two_sum_loses_nothing(device, kernel):
    rng = np.random.default_rng(1)
    a = random_floats(rng, 3000, -500, 450)
    b = np.concatenate([np.ldexp(a[:2000], rng.integers(-110, 50, 2000)), random_floats(rng, 1000, -500, 450)])
    b[:1000] *= -rng.uniform(1, 2, 1000)
    if kernel is two_sum_kernel:
        extreme = [0.0, -0.0, 5e-324, -5e-324, 2.0**-1022, 1.0, -1.0, np.nextafter(1, 2), 2.0**1022, -(2.0**1022)]
        x, y = np.meshgrid(extreme, extreme)
        a, b = np.concatenate([a, x.ravel()]), np.concatenate([b, y.ravel()])
        first, second = a, b
    else:
        first, second = a * b, a
    expected = [Fraction(x) + Fraction(y) for x, y in zip(first.tolist(), second.tolist())]
    check_exact(apply(kernel, a, b, device), expected, first + second)


def test_two_product_loses_nothing(device):
    """Wherever the error is no smaller than float64's grid; whole multiples of 2^-342 are among that."""
    rng = np.random.default_rng(2)
    a, b = random_floats(rng, 3000, -430, 500), random_floats(rng, 3000, -430, 500)
    a[:500] = rng.integers(-(2**53), 2**53, 500) * 2.0**-342
    b[:500] = rng.integers(-(2**53), 2**53, 500) * 2.0**-684
    a[500:510], b[505:515] = 0.0, 0.0
    expected = [Fraction(x) * Fraction(y) for x, y in zip(a.tolist(), b.tolist())]
    check_exact(apply(two_product_kernel, a, b, device), expected, a * b)


# --- signs ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_signs(device, dim, kind):
    """EXACT and the expansions alone are always right, FILTER wherever it is sure, and 0 is as good as any sign."""
    points = KINDS[kind](np.random.default_rng([3, dim]), dim)
    truth = true_signs(points)
    assert len(np.unique(truth)) >= 2
    kernel, expansion = (orient2d_kernel, expansion2d_kernel) if dim == 2 else (orient3d_kernel, expansion3d_kernel)
    np.testing.assert_array_equal(find_signs(kernel, EXACT, points, device), truth)
    np.testing.assert_array_equal(find_signs(expansion, 0, points, device), truth)
    filtered = find_signs(kernel, FILTER, points, device)
    sure = filtered != int(UNCERTAIN)
    np.testing.assert_array_equal(filtered[sure], truth[sure])
    if kind == "random":
        assert sure.all()
        assert (find_signs(kernel, FLOAT32, points, device) == truth).mean() > 0.99
    elif kind in ("coplanar", "large coplanar"):
        wrong = rounded_signs(points) != truth
        assert wrong.any() and not sure[wrong].any(), "float64 alone is not good enough here"


@pytest.mark.parametrize("kind", KINDS)
def test_signs_of_edges(device, kind):
    """The same determinant from other rows."""
    points = KINDS[kind](np.random.default_rng(8), 3)
    truth = true_signs(points)
    np.testing.assert_array_equal(find_signs(orient_edges_kernel, EXACT, points, device), truth)
    filtered = find_signs(orient_edges_kernel, FILTER, points, device)
    sure = filtered != int(UNCERTAIN)
    np.testing.assert_array_equal(filtered[sure], truth[sure])
    if kind == "random":
        assert sure.all()


@pytest.mark.parametrize("across", [False, True])
@pytest.mark.parametrize("shared", [False, True])
def test_edges_laid_on_one_another_need_no_more_than_float64(device, across, shared):
    """Ends some units in the last place apart, in either order, and ends that coincide."""
    rng = np.random.default_rng(9)
    first = rng.normal(size=(COUNT, 2, 3))
    second = first + rng.integers(-3, 4, first.shape) * np.spacing(first)
    if shared:
        second[:, 0] = first[:, 0]
    points = np.concatenate([first, second[:, ::-1] if across else second], 1)
    truth = true_signs(points)
    filtered = find_signs(orient_edges_kernel, FILTER, points, device)
    sure = filtered != int(UNCERTAIN)
    np.testing.assert_array_equal(filtered[sure], truth[sure])
    np.testing.assert_array_equal(find_signs(orient_edges_kernel, EXACT, points, device), truth)
    assert (truth == 0).all() == shared and sure.mean() >= (1.0 if shared else 0.97)
    assert shared or (find_signs(orient3d_kernel, FILTER, points, device) != int(UNCERTAIN)).mean() < 0.3


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_double_words_keep_their_bound(device, kind, dim):
    points = KINDS[kind](np.random.default_rng([6, dim]), dim)
    out = wp.zeros(len(points), dtype=wp.float64, device=device)
    kernel, dtype = (double3d_kernel, wp.vec3d) if dim == 3 else (double2d_kernel, wp.vec2d)
    wp.launch(kernel, len(points), [wp.array(points, dtype=dtype, device=device), out], device=device)
    for value, rows in zip(out.numpy().tolist(), points.tolist()):
        terms = true_terms(rows)
        off = abs(Fraction(value) - sum(terms))
        # The high word alone is returned.
        assert off <= Fraction(2) ** -53 * abs(Fraction(value)) + 20 * Fraction(2) ** -106 * sum(map(abs, terms))


@pytest.mark.parametrize("dim", [2, 3])
def test_signs_change_with_the_order(device, dim):
    """Two points exchanged change every exact sign, to the bit."""
    points = np.concatenate([make(np.random.default_rng([4, dim]), dim) for make in KINDS.values()])
    kernel = orient2d_kernel if dim == 2 else orient3d_kernel
    signs = find_signs(kernel, EXACT, points, device)
    for i in range(dim):
        order = np.arange(dim + 1)
        order[[i, i + 1]] = i + 1, i
        np.testing.assert_array_equal(find_signs(kernel, EXACT, points[:, order], device), -signs)


def test_the_filter_is_tight(device):
    """The bound leaves open what it must and no more than some units in the last place around."""
    rng = np.random.default_rng(5)
    points = rng.normal(size=(2000, 4, 3))
    points[:, 3] = points[:, :3].mean(1) + 1e-12 * rng.normal(size=(2000, 3))
    assert (find_signs(orient3d_kernel, FILTER, points, device) != int(UNCERTAIN)).mean() > 0.95


# --- float32, the first stage ----------------------------------------------------------------------------------------


def float32_signs(error, unit, points, device):
    """Return signs (count, 6) of three points against a plane, all at once and one by one; points [count, 6, 3]."""
    out = wp.zeros((len(points), 7), dtype=wp.int32, device=device)
    error = wp.array(error, dtype=wp.float32, device=device)
    points = wp.array(points.astype(np.float32), dtype=wp.vec3, device=device)
    wp.launch(float32_signs_kernel, len(points), [error, float(unit), points, out], device=device)
    signs = out.numpy()
    np.testing.assert_array_equal(signs[:, 6] < 0, np.abs(signs[:, :3].sum(1)) == 3)
    return signs[:, :6]


def float32_points(rng, kind):
    """Six points about the origin of at most unit size: the fourth is that of a kind, two more lie nearby."""
    points = KINDS[kind](rng, 3)
    points = np.concatenate([points, points[:, 3:] + 1e-3 * rng.normal(size=points[:, 3:].shape), points[:, :1]], 1)
    points -= points[:, :1] + 1e-2 * rng.normal(size=(COUNT, 1, 3))
    return points / np.maximum(1e-200, np.abs(points).max((1, 2), keepdims=True))


def true_sides(points):
    return np.stack([true_signs(points[:, [0, 1, 2, k]]) for k in (3, 4, 5)] * 2, 1)


@pytest.mark.parametrize("off", [2.0**-26, 2.0**-20, 2.0**-10])
@pytest.mark.parametrize("kind", ["random", "lattice", "coplanar", "large coplanar"])
def test_float32_filter_is_right_where_it_is_sure(device, kind, off):
    """Coordinates moved by up to `off`, in a random or in the worst direction, and rounded to float32."""
    rng = np.random.default_rng(7)
    points = float32_points(rng, kind)
    normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])[:, None]
    height = rng.choice([0.0, 0.5, 1.0, 2.0, 4.0], (COUNT, 1, 1)) * off * np.sign(normal)
    points[:, 3:] += height
    truth = true_sides(points)
    worst = np.concatenate([np.sign(normal) * np.ones((1, 3, 1)), -np.sign(normal) * np.ones((1, 3, 1))], 1)
    shift = np.where(rng.random((COUNT, 1, 1)) < 0.5, worst, rng.uniform(-1, 1, points.shape)) * off
    moved = (points + shift).astype(np.float32)
    error = 2.02 * np.abs(moved - points).max((1, 2))
    signs = float32_signs(error, FLOAT32_UNIT, moved, device)
    sure = signs != int(UNCERTAIN)
    np.testing.assert_array_equal(signs[sure], truth[sure])
    plain = float32_signs(0 * error, FLOAT32_UNIT, moved, device)
    if kind != "random":
        assert (plain != truth)[plain != int(UNCERTAIN)].any(), "coordinates that are off must be reckoned with here"
    elif off < 1e-6:
        assert sure[:, [0, 1, 3, 4]].mean() > 0.98, "the sixth point lies in the plane but for the shift"
    far = float32_signs(np.full(COUNT, np.inf), FLOAT32_UNIT, moved, device)
    assert (far == int(UNCERTAIN)).all()


@pytest.mark.parametrize("kind", ["random", "coplanar", "large coplanar"])
def test_float32_filter_covers_its_own_rounding(device, kind):
    """Coordinates that float32 holds exactly: only the arithmetic rounds."""
    points = float32_points(np.random.default_rng(8), kind).astype(np.float32).astype(float)
    truth = true_sides(points)
    signs = float32_signs(np.zeros(COUNT), FLOAT32_UNIT, points, device)
    sure = signs != int(UNCERTAIN)
    np.testing.assert_array_equal(signs[sure], truth[sure])
    plain = float32_signs(np.zeros(COUNT), 0.0, points, device)
    assert (plain != int(UNCERTAIN)).all()
    assert (plain != truth).any() == (kind != "random"), "float32 alone is good enough for points at random only"


# --- no contraction --------------------------------------------------------------------------------------------------


PASSES = ("resolve_rounded", "float64_filter", "resolve_inexact")


# Modules that compute signs.
SIGNED = (
    predicates,
    expansion,
    intersect,
    coplanar,
    boxes,
    poses,
    dual_tree,
    uncertain_pairs,
    refit,
    float32_filter,
    face_pairs,
    leaf_pairs,
    node_pair,
    nodes,
    double_word,
    float64_filter,
    int128,
)


def test_modules_with_signs_do_not_contract():
    modules = [wp.get_module(module.__name__) for module in SIGNED]
    makers = [simd.thread_traversal]
    makers += [functools.partial(dual_tree.warp_traversal, for_any=for_any) for for_any in (False, True)]
    modules += [make(int(mode)).module for mode in (EXACT, FLOAT32, WITHIN) for make in makers]
    modules += [getattr(uncertain_pairs, f"{name}_kernel").module for name in PASSES]
    assert [m.name for m in modules if m.options["fuse_fp"] or m.options["fast_math"]] == []


def ptx_of(module, folder):
    """Return the PTX of a module, which needs no GPU, or skip."""
    try:
        wp.compile_aot_module(module, arch=80, module_dir=folder, use_ptx=True)
    except Exception as error:
        pytest.skip(f"no PTX without a GPU here: {error}")
    (path,) = folder.glob("*.ptx")
    return path.read_text()


def find_contraction(text):
    """Return the instructions that are fused, and those that ptxas may fuse since they name no rounding."""
    fused = re.findall(r"\bfma\.\S*f(?:32|64)", text)
    return fused + re.findall(r"\b(?:add|sub|mul)\.(?!rn\b)\S*f(?:32|64)", text)


@pytest.mark.parametrize("fuse_fp", [False, True])
def test_ptx_is_not_contracted(tmp_path, fuse_fp):
    """Every product and sum is rounded by itself; without the option, it would not be."""
    kernel = wp.Kernel(sum_of_product_kernel.func, module=wp.Module(f"ptx_{fuse_fp}", None))
    kernel.module.options.update(enable_backward=False, fuse_fp=fuse_fp)
    assert bool(find_contraction(ptx_of(kernel.module, tmp_path))) == fuse_fp


@pytest.mark.slow
def test_ptx_of_the_traversal_is_not_contracted(tmp_path):
    """The kernels that pose vertices, bound signs and test boxes; without exact signs they have no float64 fma."""
    for for_any in (False, True):
        text = ptx_of(dual_tree.warp_traversal(int(EXACT), for_any).module, tmp_path / f"warp_{for_any}")
        assert len(re.findall(r"\bmul\.rn\.f32", text)) > 50
        # In float32 the kernel itself asks for fused operations, the same on every device.
        assert {x for x in find_contraction(text) if x != "fma.rn.f32"} == set()
    text = ptx_of(uncertain_pairs.float64_filter_kernel.module, tmp_path / "filter")
    assert len(re.findall(r"\bmul\.rn\.f64", text)) > 50
    assert {x for x in find_contraction(text) if x != "fma.rn.f64"} == set()
    text = ptx_of(uncertain_pairs.resolve_rounded_kernel.module, tmp_path / "rounded")
    assert len(re.findall(r"\bmul\.rn\.f64", text)) > 50
    assert find_contraction(text) == []
