"""What every search of two trees shares: items, stacks, load balancing, slabs."""
