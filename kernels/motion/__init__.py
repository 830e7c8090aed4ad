"""First contact of moving objects: their paths, safe steps in time of node pairs and face pairs, and the search."""
