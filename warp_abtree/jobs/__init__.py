"""Resumable batch jobs in shards, in this process or on Ray."""

from warp_abtree.jobs.ray_pool import RayPool, WorldsJob
from warp_abtree.jobs.shard_folder import read_shards
from warp_abtree.jobs.shards import SweepJob, ThisProcess, run_shards

__all__ = ["RayPool", "SweepJob", "ThisProcess", "WorldsJob", "read_shards", "run_shards"]
