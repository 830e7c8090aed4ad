"""Two checkouts beside each other: `python -m bench gate`."""
