"""Object pairs whose trees are both small: leaves all against all."""
