"""Programs for developers, which are not installed: benchmarks, soak, fuzz, and the fixtures they share with the tests."""
