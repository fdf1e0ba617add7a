"""How a stage's work is shared out among shards."""

from __future__ import annotations


def shard_range(count: int, shard: tuple[int, int]) -> tuple[int, int]:
    """(first, last + 1) of ``count`` things that belong to a shard. shard : its index from 0, and how many there are"""
    index, shards = shard
    return count * index // shards, count * (index + 1) // shards
