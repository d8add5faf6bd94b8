"""The `lpn` command: `main` finds and runs a subcommand; each subcommand is a dataclass of its options with a `run` method.

It imports every package of `lpn`; commands import what they need when they run. Only the console script imports it.
"""
