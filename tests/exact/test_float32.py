"""Reciprocals, quotients and roots in float32 without branches: rounded as IEEE's, the same on every device."""

import numpy as np
import warp as wp
from helpers.questions import launch
from oracles.signs import random_floats

from warp_abtree.kernels import native
from warp_abtree.kernels.base.quotients import divide32, normalize32, root32

wp.set_module_options(native.options("base/quotients.cuh"))

LEAST, MOST = np.float32(2.0**-126), np.float32(2.0**125)


@wp.kernel
def divide_kernel(a: wp.array[wp.float32], b: wp.array[wp.float32], out: wp.array[wp.float32]):
    i = wp.tid()
    out[i] = divide32(a[i], b[i])


@wp.kernel
def root_kernel(x: wp.array[wp.float32], out: wp.array[wp.float32]):
    i = wp.tid()
    out[i] = root32(x[i])


@wp.kernel
def normalize_kernel(v: wp.array[wp.vec3], out: wp.array[wp.vec3]):
    i = wp.tid()
    out[i] = normalize32(v[i])


def all_mantissas():
    """Return all numbers from 1 to 2."""
    return (np.arange(2**23, dtype=np.uint32) + np.uint32(0x3F800000)).view(np.float32)


def random_numbers(rng, count, least, most):
    return random_floats(rng, count, least, most).astype(np.float32)


def assert_same_bits(found, expected):
    wrong = np.flatnonzero(found.view(np.uint32) != expected.view(np.uint32))
    assert len(wrong) == 0, (found[wrong[:3]], expected[wrong[:3]])


def divide(device, a, b):
    return launch(divide_kernel, device, len(a), a, b)


def test_quotients(device):
    """Reciprocals of all mantissas, and others at random; of what is not normal there is none."""
    rng, x = np.random.default_rng(0), all_mantissas()
    for scale in (np.float32(2.0**-60), np.float32(1), np.float32(2.0**124)):
        assert_same_bits(divide(device, np.ones_like(x), x * scale), np.float32(1) / (x * scale))
    a, b = random_numbers(rng, 10**6, -40, 40), np.abs(random_numbers(rng, 10**6, -40, 40))
    a[:9] = 0.0
    assert_same_bits(divide(device, a, b), a / b)
    b = np.array([0.0, -1.0, 2.0**-140, LEAST, MOST, np.inf, -np.inf, np.nan], np.float32)
    assert (divide(device, np.ones_like(b), b)[:-1] == 0).all()


def test_roots(device):
    rng = np.random.default_rng(1)
    x = all_mantissas()
    numbers = [x, 2 * x, np.abs(random_numbers(rng, 10**5, -149, 127))]
    numbers.append(np.array([0.0, -0.0, 2.0**-149, 2.0**-96, np.inf], np.float32))
    for some in numbers:
        assert_same_bits(launch(root_kernel, device, len(some), some), np.sqrt(some))
    assert np.isnan(launch(root_kernel, device, 3, np.array([-1.0, -(2.0**-140), np.nan], np.float32))).all()


def test_unit_vectors(device):
    v = np.random.default_rng(2).normal(size=(10**5, 3)).astype(np.float32)
    for scale in (2.0**-50, 1.0, 2.0**50):
        found = launch(normalize_kernel, device, len(v), v * np.float32(scale))
        expected = v / np.linalg.norm(v.astype(np.float64), axis=1, keepdims=True)
        assert np.abs(found - expected).max() < 3 * 2.0**-23
    assert not launch(normalize_kernel, device, 1, np.zeros((1, 3), np.float32)).any()
