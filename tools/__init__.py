"""Programs for developers, which are not installed: benchmarks, what must not get worse, soak, fuzz, and shared fixtures."""
