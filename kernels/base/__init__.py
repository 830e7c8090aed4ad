"""Arrays, nodes, boxes, poses and lanes: what every group builds on."""
