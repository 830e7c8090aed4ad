"""Benchmarks: python -m bench NAME. They check their answers before they print a time; no test asserts one."""
