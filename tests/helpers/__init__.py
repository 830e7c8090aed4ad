"""What tests of several packages make and ask."""
