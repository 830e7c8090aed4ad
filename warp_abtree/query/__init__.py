"""Which object pairs and which faces intersect, and where: broad phase, narrow phase, contacts."""
