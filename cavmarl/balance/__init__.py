"""Which worker hosts which shard: scores of workers, costs of shards, plans."""
