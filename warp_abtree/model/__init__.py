"""Built once on the host: the mesh, its progressive mesh and its AB-Tree."""
