"""First contacts: public queries with ground truth, and the case `motion`."""
