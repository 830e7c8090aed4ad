"""Rows of frames in a file, written as they come."""

import csv
import io
import json
from pathlib import Path

from warp_abtree.checks.atomic_write import atomic_write
from warp_abtree.simulate.frame_row import FrameRow


class FrameFile:
    """A list of rows as .json, or CSV by any other name, that can be read after each row, whatever ends the run.

    What stood there is replaced with the first rows, in one step. A row for which the disk has no room is taken back.
    """

    def __init__(self, path):
        self.path = Path(path)
        self._is_json = self.path.suffix.lower() == ".json"
        self._tail = b"\n]\n" if self._is_json else b""
        self._written, self._end = 0, 0  # rows, and bytes without the tail

    def append(self, history: list[FrameRow]):
        """Write the rows that are not in the file yet; where that raises OSError, the file holds those before."""
        rows = [row.as_dict() for row in history[self._written :]]
        if not rows:
            return
        data = self._encode(rows)
        if self._written:
            self._write_at_end(data + self._tail)
        else:
            with atomic_write(self.path) as file:
                file.write(data + self._tail)
        self._written, self._end = len(history), self._end + len(data)

    def _encode(self, rows) -> bytes:
        if self._is_json:
            return ((",\n" if self._written else "[\n") + ",\n".join(map(json.dumps, rows))).encode()
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, FrameRow.names())
        if not self._written:
            writer.writeheader()
        writer.writerows(rows)
        return text.getvalue().encode()

    def _write_at_end(self, data):
        with open(self.path, "r+b", buffering=0) as file:
            try:
                file.seek(self._end)
                left = memoryview(data)
                while left:
                    left = left[file.write(left) :]
            except BaseException:
                # Over bytes that it held before, so that there is room.
                file.seek(self._end)
                file.write(self._tail)
                file.truncate(self._end + len(self._tail))
                raise
