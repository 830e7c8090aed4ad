"""Resumable batch jobs. Each shard is written atomically; rerunning a job skips finished shards.

A job (`SweepJob`) is split into shards. A pool of workers (`ThisProcess`, `RayPool`) computes them and
`run_shards` writes them to a folder, the same bytes whatever the pool; `read_shards` reads a finished folder.
"""

from warp_abtree.jobs.ray_pool import RayPool
from warp_abtree.jobs.run import ThisProcess, run_shards
from warp_abtree.jobs.shard_folder import read_shards
from warp_abtree.jobs.sweep_job import SweepJob

__all__ = ["RayPool", "SweepJob", "ThisProcess", "read_shards", "run_shards"]
