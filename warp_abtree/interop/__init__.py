"""Other libraries: trimesh, Newton, glTF, USD, and arrays of other frameworks."""
