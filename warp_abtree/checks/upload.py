"""Numbers that the host brings to a device again and again."""

import numpy as np
import warp as wp


class Upload:
    """An array on a device, and memory of the host that is copied there without waiting.

    Args:
        count: Numbers, float64.
        device: Device of the array; on the CPU both are the same.

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
