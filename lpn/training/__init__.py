"""Training: recipes, batches, losses, optimizer, checkpoints to resume from, and the log of a run.

It imports `retrieval` and the packages below it, and needs the extra `train`."""
