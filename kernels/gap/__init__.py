"""Face pairs that are apart by less than a gap."""
