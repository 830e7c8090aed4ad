"""Results, sorting and poses between device and host."""
