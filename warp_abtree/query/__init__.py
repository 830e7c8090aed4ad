"""Queries of object pairs: broad phase, narrow phase, contacts and distances."""
