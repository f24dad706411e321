"""Which worker hosts which shard: load scores, costs of shards, plans.

Pure arithmetic; `parallel` measures for it and carries its plans out.
"""
