"""Contacts and their reduction."""
