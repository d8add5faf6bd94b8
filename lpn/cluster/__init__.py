"""Descriptors computed on many machines by Ray, and the shards that they write.

It imports `descriptors` and the packages below it, and needs the extra `ray`."""
