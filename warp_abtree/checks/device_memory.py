"""Device memory: what holds some is neither pickled nor copied."""


class DeviceMemory:
    """Base of whatever holds arrays of a device, which belong to one process and to one owner."""

    def __reduce_ex__(self, protocol):
        """Refuse `pickle`, `copy.copy` and `copy.deepcopy` with a TypeError."""
        raise TypeError(
            f"this {type(self).__name__} holds device memory and cannot be pickled or copied; "
            "pickle or copy what it was made of, such as models and poses, and make it anew"
        )
