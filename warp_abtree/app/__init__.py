"""Applications of the library; nothing below imports them."""
