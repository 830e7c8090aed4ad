"""Triangle against triangle."""
