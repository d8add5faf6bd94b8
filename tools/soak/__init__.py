"""Many people at the running explorer at once, every answer checked against a direct computation: `python -m tools.soak`."""
