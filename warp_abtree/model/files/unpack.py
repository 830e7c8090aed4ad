"""Compressed files, unpacked within a limit that is checked before memory is taken."""

import gzip
import io
import zipfile

from warp_abtree.model.files.found import MeshError

# A file may unpack to 256 MiB, or to 100 times its size if that is more; meshes and models as saved take 2 to 30 times.
UNPACKED_BYTES, UNPACKED_RATIO = 2**28, 100


def exceeds_limit(unpacked: int, packed: int) -> bool:
    """Return whether a file of so many bytes unpacks to more than is read."""
    return unpacked > max(UNPACKED_BYTES, UNPACKED_RATIO * packed)


def limit_message(packed: int) -> str:
    """Return what to say of a file that exceeds the limit."""
    limit = max(UNPACKED_BYTES, UNPACKED_RATIO * packed)
    return f"unpacks to more than {limit >> 20:,} MiB, the most that is read of a file of {packed:,} bytes"


def gunzip(data: bytes, where: str) -> bytes:
    """Unpack gzip; raise MeshError beyond the limit, and what gzip raises for damaged data."""
    with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
        found = file.read(max(UNPACKED_BYTES, UNPACKED_RATIO * len(data)) + 1)
    if exceeds_limit(len(found), len(data)):
        raise MeshError(f"{where}: {limit_message(len(data))}; unpack it yourself")
    return found


def unzip(data: bytes, where: str) -> dict[str, bytes]:
    """Return the members of a zip archive; raise MeshError beyond the limit, and what zipfile raises for damage."""
    archive = zipfile.ZipFile(io.BytesIO(data))
    members = [member for member in archive.infolist() if not member.is_dir()]
    if exceeds_limit(sum(member.file_size for member in members), len(data)):
        raise MeshError(f"{where}: {limit_message(len(data))}; unpack it yourself")
    found = {}
    for member in members:
        with archive.open(member) as file:
            # Without a size, it would unpack more than is declared before it looks.
            found[member.filename] = file.read(member.file_size)
    return found
