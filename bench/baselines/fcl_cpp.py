"""FCL in C++, where its headers and a compiler are found: `fcl_cpp.cpp`, compiled when it is first used."""

import ctypes
import functools
import os
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

SOURCE = Path(__file__).with_name("fcl_cpp.cpp")
# Not for this processor alone: FCL's own library is not, and both must lay out Eigen's types alike.
FLAGS = ["-std=c++17", "-O3", "-DNDEBUG", "-shared", "-fPIC"]


def _run(command):
    """Return what a command writes.

    Raises:
        ImportError: It fails; the message has the first line of what it complains about.
    """
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise ImportError(f"{command[0]}: {next(iter(done.stderr.splitlines()), 'failed')}")
    return done.stdout


@functools.cache
def load_library():
    """Compile and load the C++ side, once a process.

    Raises:
        ImportError: No compiler, or no FCL.
    """
    compiler = os.environ.get("CXX", "g++")
    for tool in (compiler, "pkg-config"):
        if shutil.which(tool) is None:
            raise ImportError(f"no {tool}")
    options = shlex.split(_run(["pkg-config", "--cflags", "--libs", "fcl", "eigen3"]))
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "fcl_baseline.so"
        _run([compiler, *FLAGS, str(SOURCE), "-o", str(library), *[x for x in options if not x.startswith("-std")]])
        loaded = ctypes.CDLL(str(library))
    loaded.fcl_baseline_make.restype = ctypes.c_void_p
    return loaded


def _pointer(array):
    return ctypes.c_void_p(array.ctypes.data)


class FclCpp:
    """FCL called from C++: a BVHModel (OBB tree with RSS) of each mesh; face pairs without points of contact."""

    name = "fcl-c++"

    def __init__(self, a, b, matrices):
        self.library = load_library()
        meshes = []
        for vertices, faces in (a, b):
            meshes += [np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int32)]
        rows = np.ascontiguousarray(matrices, np.float64)
        arguments = [value for array in meshes for value in (_pointer(array), ctypes.c_int64(len(array)))]
        if b is a:
            arguments[4] = None  # B is A's mesh
        made = self.library.fcl_baseline_make(*arguments, _pointer(rows), ctypes.c_int64(len(rows)))
        self.handle = ctypes.c_void_p(made)
        self.found = np.zeros(len(rows), np.uint8)
        self.count = np.zeros(len(rows), np.int64)

    def __del__(self):
        if hasattr(self, "handle"):
            self.library.fcl_baseline_free(self.handle)

    def any(self):
        self.library.fcl_baseline_any(self.handle, _pointer(self.found))
        return self.found != 0

    def faces(self):
        self.library.fcl_baseline_faces(self.handle, _pointer(self.count))
        return [(self, pose) for pose in range(len(self.count))]

    @staticmethod
    def face_pairs(answer):
        baseline, pose = answer
        pairs = np.empty((baseline.count[pose], 2), np.int64)
        baseline.library.fcl_baseline_pairs(baseline.handle, ctypes.c_int64(pose), _pointer(pairs))
        return pairs.tolist()
