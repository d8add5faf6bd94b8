"""A load test of the running explorer that checks every answer: `python -m tools.soak`."""
