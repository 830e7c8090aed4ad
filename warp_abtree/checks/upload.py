"""Arrays that the host makes on a device: those of structs, and numbers that it brings there again and again."""

import numpy as np
import warp as wp


def struct_of(struct, device, **values):
    """Return a struct with arrays on a device of the types that its fields have; those that are not given are empty.

    Args:
        values: Rows of an array, an array of the device, or the value of a field that is none, by the fields' names.
    """
    made = struct()
    for name, value in values.items():
        kind = struct.vars[name].type
        if isinstance(kind, wp.array) and not isinstance(value, wp.array):
            value = wp.array(np.ascontiguousarray(value), dtype=kind.dtype, device=device)
        setattr(made, name, value)
    return made


def view_memory(pointer: int, dtype, shape: tuple, device="cpu", owner=None, strides=None) -> wp.array:
    """Return a Warp array on memory that another object owns, which the array keeps alive."""
    if 0 in shape:
        return wp.empty(shape, dtype=dtype, device=device)

    def keep(*_, owner=owner):
        """Hold the owner until Warp calls this, when the last view goes."""

    return wp.array(ptr=pointer, dtype=dtype, shape=shape, strides=strides, device=device, deleter=keep)


def zeros_of(struct, rows, columns, device):
    """Return a struct of device arrays that are 0: `rows` entries each, or rows and columns."""
    made = struct()
    for name, variable in struct.vars.items():
        shape = rows if variable.type.ndim == 1 else (rows, columns)
        setattr(made, name, wp.zeros(shape, dtype=variable.type.dtype, device=device))
    return made


class Download:
    """Numbers that kernels write where the host reads them: on a GPU in pinned memory of the host.

    Attributes:
        array: For kernels, (count,), 0 at first.
        view: NumPy's view of them, up to date once the launches are over.
    """

    def __init__(self, count: int, dtype, device):
        self._host = self.array = wp.zeros(count, dtype=dtype, device="cpu", pinned=device.is_cuda)
        if device.is_cuda:
            self.array = view_memory(self._host.ptr, dtype, (count,), device, self._host)
        self.view = self._host.numpy()


class Upload:
    """Numbers on a device, float64, and memory of the host that is copied there without waiting; on the CPU one array.

    Attributes:
        array: Device float64 (count,), 0 at first.
    """

    def __init__(self, count: int, device):
        self.array = wp.zeros(count, dtype=wp.float64, device=device)
        self._copied = None
        self._host = self.array
        if device.is_cuda:
            self._host = wp.zeros(count, dtype=wp.float64, device="cpu", pinned=True)
            self._copied = wp.Event(device)
        self._view = self._host.numpy()

    def send(self, values):
        """Bring numbers to the device, (count,), once the copy before is over; whatever is launched then reads them."""
        if self._copied is not None:
            wp.synchronize_event(self._copied)
        np.copyto(self._view, values)
        if self._copied is not None:
            wp.copy(self.array, self._host)
            wp.get_stream(self.array.device).record_event(self._copied)
