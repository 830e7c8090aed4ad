"""Resumable batch jobs in shards, in this process or on Ray."""
