"""Contacts and their summaries for readers: as records in the layout of `Result.contacts`, or as arrays of a type.

A record has no padding, so that its numbers lie at any byte; one thread writes one number, neighbours side by side:

    [ pair 4 | faces 2 x 4 | p0, p1, normal_a, normal_b, normal 5 x 3 x 4 or 8 | coplanar 1 ] bytes of a contact; with
    a gap its separation, 4 or 8 bytes, stands before the flag
    [ count 8 | point, normal 2 x 3 x 4 or 8 ] bytes of a summary
"""

import functools
from typing import Any

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.contacts.contact import Contacts
from warp_abtree.kernels.contacts.summary import PairContacts

MODULE_OPTIONS = native.options()
wp.set_module_options(MODULE_OPTIONS)

# Numbers of a record: three indices, five vectors, a flag, one more with a gap; a count, two vectors.
CONTACT_NUMBERS, PAIR_NUMBERS = 19, 7


@native.func_native()
def store_bits(bytes: wp.array(dtype=wp.uint8), at: wp.int32, size: wp.int32, bits: wp.int64):
    """Write the lowest bytes of a word, the lowest first."""


@native.func_native()
def round_to_float32(x: wp.float64) -> wp.float32:
    """Return a number as float32, infinite beyond its range, NaN of the bits 0x7fc00000."""


@wp.func
def float32_bits(x: wp.float64):
    return wp.int64(wp.cast(round_to_float32(x), wp.int32))


@wp.func
def float64_bits(x: wp.float64):
    return wp.cast(x, wp.int64)


@wp.func
def round_vector(v: wp.vec3d):
    return wp.vec3(round_to_float32(v[0]), round_to_float32(v[1]), round_to_float32(v[2]))


@wp.func
def keep(x: Any):
    return x


@wp.func
def load_component(contacts: Contacts, i: wp.int32, k: wp.int32):
    """Return one of the 15 numbers of a contact's vectors, then its separation."""
    if k == 15:
        return contacts.separation[i]
    c = k % 3
    vector = k // 3
    if vector == 0:
        return contacts.p0[i][c]
    if vector == 1:
        return contacts.p1[i][c]
    if vector == 2:
        return contacts.normal_a[i][c]
    if vector == 3:
        return contacts.normal_b[i][c]
    return contacts.normal[i][c]


@functools.cache
def contact_packer(real: type, with_gap: bool):
    """Return the kernel that writes records of contacts, their real numbers float32 or float64."""
    size = wp.types.type_size_in_bytes(real)
    numbers = 16 if with_gap else 15

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def pack_contact_kernel(
        first: wp.int32,
        contacts: Contacts,
        records_out: wp.array(dtype=wp.uint8),
    ):
        """Write one number a thread, of the contacts from the first one on; threads are [contact, number]."""
        i, k = wp.tid()
        at = i * wp.static(13 + numbers * size)
        if k < 3:
            store_bits(records_out, at + 4 * k, 4, wp.int64(contacts.face[first + i][k]))
        elif k < wp.static(3 + numbers):
            x = load_component(contacts, first + i, k - 3)
            bits = wp.static(float64_bits if size == 8 else float32_bits)(x)
            store_bits(records_out, at + 12 + wp.static(size) * (k - 3), wp.static(size), bits)
        else:
            records_out[at + wp.static(12 + numbers * size)] = wp.uint8(contacts.coplanar[first + i])

    return pack_contact_kernel


@functools.cache
def pair_packer(real: type):
    """Return the kernel that writes records of summaries, their real numbers float32 or float64."""
    size = wp.types.type_size_in_bytes(real)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def pack_summary_kernel(
        first: wp.int32,
        count: wp.array(dtype=wp.int64),
        means: PairContacts,
        records_out: wp.array(dtype=wp.uint8),
    ):
        """Write one number a thread, of the object pairs from the first one on; threads are [pair, number]."""
        i, k = wp.tid()
        p = first + i
        at = i * wp.static(8 + 6 * size)
        if k == 0:
            store_bits(records_out, at, 8, count[p])
            return
        x = means.point[p][(k - 1) % 3]
        if k > 3:
            x = means.normal[p][k - 4]
        bits = wp.static(float64_bits if size == 8 else float32_bits)(x)
        store_bits(records_out, at + 8 + wp.static(size) * (k - 1), wp.static(size), bits)

    return pack_summary_kernel


@functools.cache
def contact_copier(real: type):
    """Return the kernel that copies contacts into arrays of their own, real numbers float32 or float64."""
    vector = wp.vec3d if real is wp.float64 else wp.vec3
    convert = keep if real is wp.float64 else round_vector

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def copy_contact_kernel(
        contacts: Contacts,
        pair_out: wp.array(dtype=wp.int32),
        faces_out: wp.array(dtype=wp.vec2i),
        p0_out: wp.array(dtype=vector),
        p1_out: wp.array(dtype=vector),
        normal_a_out: wp.array(dtype=vector),
        normal_b_out: wp.array(dtype=vector),
        normal_out: wp.array(dtype=vector),
        coplanar_out: wp.array(dtype=wp.bool),
    ):
        """Copy one contact a thread."""
        i = wp.tid()
        pair_out[i] = contacts.face[i][0]
        faces_out[i] = wp.vec2i(contacts.face[i][1], contacts.face[i][2])
        p0_out[i] = wp.static(convert)(contacts.p0[i])
        p1_out[i] = wp.static(convert)(contacts.p1[i])
        normal_a_out[i] = wp.static(convert)(contacts.normal_a[i])
        normal_b_out[i] = wp.static(convert)(contacts.normal_b[i])
        normal_out[i] = wp.static(convert)(contacts.normal[i])
        coplanar_out[i] = contacts.coplanar[i] != 0

    return copy_contact_kernel


@functools.cache
def number_copier(real: type):
    """Return the kernel that copies float64 numbers into an array of another type."""

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def copy_number_kernel(numbers: wp.array(dtype=wp.float64), numbers_out: wp.array(dtype=real)):
        """Copy one number a thread."""
        i = wp.tid()
        numbers_out[i] = wp.static(keep if real is wp.float64 else round_to_float32)(numbers[i])

    return copy_number_kernel


@functools.cache
def summary_copier(real: type):
    """Return the kernel that copies summaries into arrays of their own, real numbers float32 or float64."""
    vector = wp.vec3d if real is wp.float64 else wp.vec3
    convert = keep if real is wp.float64 else round_vector

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def copy_summary_kernel(
        means: PairContacts,
        point_out: wp.array(dtype=vector),
        normal_out: wp.array(dtype=vector),
    ):
        """Copy the summary of one object pair a thread."""
        p = wp.tid()
        point_out[p] = wp.static(convert)(means.point[p])
        normal_out[p] = wp.static(convert)(means.normal[p])

    return copy_summary_kernel
